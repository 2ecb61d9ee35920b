"""Checks of inputs: do the outputs respond to each input, alike in all parts of a recording, and
was the input exogenous?

`inspect.py` calls three functions, which yield findings: `unanswered` (predicts each cycle, see
there), `inexact_events` and `feedback`. In this file, an *answer* is the response of the outputs to
an input within one part of a recording, and its *gain* the ratio of the actual to the predicted
response.

If an input is reported without need, look at the prediction in `_answers`; if events are, at
`inexact_events` and `_SHIFTED`; if feedback is, at the limits in `feedback`. The constants say when
a gain is odd. A part must be predicted from other parts only (`training`): a part that predicts
itself seems to answer.
"""

from collections.abc import Iterator, Sequence
from itertools import compress, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core.findings import Finding, listed
from ..data import SectionData, whole_cycles
from ..findings import CLEAR, NAME_REFERENCE, place


# Possible numbers of sections per cycle whose outputs are predicted. The first one with `_ENOUGH`
# cycles per unknown is taken. More cycles: short recordings are not checked. Fewer: predictions are
# noise.
_SECTIONS = (8, 4, 2)
_ENOUGH = 3
# Least number of cycles of a part, and largest number of parts of a record. More cycles: short
# faults are diluted. More parts: long records take longer. Fewer cycles: the gain of a part is
# noise.
_SHORTEST = 16
_PARTS = 4
# A part is disturbed if its unexplained power exceeds this multiple of the median. Larger: stumbles
# pass. Smaller: noisy parts are reported.
_DISTURBED = 9.0
# Events are inexact if errors of their times would explain more than this part of the outputs'
# variance. Larger: inexact events pass. Smaller: real deviations along the cycle count as errors.
_SHIFTED = 0.7

_TEXTS = {
    "another sign": "the outputs respond to {0} with the opposite sign ({1}): change the sign "
    "of {0} there.",
    "foreign input": "the outputs do not answer {} as elsewhere ({}): it belongs to another trial, "
    "or came earlier or later.",
    "disturbed": "something else than {} moved the outputs ({}).",
}
"""Texts of findings by their causes; input and places are filled in."""

Signals = Float[np.ndarray, "t k"]
"""Several signals in each cycle."""


class _Part(NamedTuple):
    """A part of a record, in whole cycles from section 0."""

    trial: int
    time: Float[np.ndarray, " n"]
    before: Signals
    """Outputs of the cycle before the predicted one."""
    inputs: list[Signals]
    """Means of each input over parts of cycles: of the predicted cycle and its neighbors."""
    outputs: Signals
    """Outputs of the predicted cycle."""

    def regressors(self) -> Signals:
        return np.concatenate([self.before, *self.inputs], axis=1)


class _Answer(NamedTuple):
    """The response of the outputs to an input in one part."""

    gain: float
    """Gain: the actual response relative to the response that is predicted from other parts."""
    error: float
    """Standard error of the gain."""
    left: float
    """Mean square of the residuals."""
    explained: float
    """Mean square of the predicted response."""


def unanswered(data: SectionData, names: Sequence[str]) -> Iterator[Finding]:
    """Find inputs that the outputs do not answer, in all trials or in parts of them.

    Each cycle is predicted linearly from the cycle before and from the inputs. The coefficients are
    learned from the other trials (or from the other parts of a single trial). The gain of a part is
    the ratio of actual to predicted response: about 1, but 0 for the input of another trial, -1 for
    the other sign. Standard errors come from the residuals, cycle by cycle.

    **Arguments:** `names`: names of the trials.
    """
    for i, name in enumerate(data.inputs):
        for sections in _SECTIONS:
            parts = [
                part
                for record in range(len(data.records))
                for part in _parts(data, record, sections)
            ]
            sizes = [float(part.inputs[i].std()) for part in parts]
            least = 0.1 * np.median(sizes) if sizes else 0.0
            pushed = list(compress(parts, np.array(sizes) > least))
            answers = _answers(pushed, i)
            if answers:
                where = [place(names[part.trial], part.time) for part in pushed]
                yield from _odd(name, answers, where, len(data.inputs) > 1)
                break


def _odd(
    name: str,
    answers: Sequence[_Answer],
    where: Sequence[str],
    several: bool,
) -> Iterator[Finding]:
    """Find odd gains of an input. `where`: phrases for the places of the parts. `several`: whether
    there are other inputs."""
    gain, error, left, explained = np.array(answers).T
    weight = error**-2.0
    together = abs(weight @ gain) / np.sqrt(weight.sum())
    if together < CLEAR and np.mean((gain / error) ** 2) < CLEAR:
        yield Finding(
            "no answer",
            f"the outputs do not answer {name}: was it recorded with them?",
            "warned" if several else "refused",
        )
        return
    usual = float(np.median(gain))
    turned = gain < -np.maximum(usual / 2, CLEAR * error)
    surely_less = gain + CLEAR * error < usual
    foreign = (gain < usual / 2) & surely_less & ~turned
    disturbed = left > np.maximum(_DISTURBED * np.median(left), explained / 4)
    disturbed &= ~turned & ~foreign
    causes = {
        "another sign": turned,
        "foreign input": foreign,
        "disturbed": disturbed,
    }
    for cause, parts in causes.items():
        if parts.any():
            text = _TEXTS[cause].format(name, listed(list(compress(where, parts))))
            # (A wrong sign spoils every estimate; other odd gains may be a matter of few strides.)
            yield Finding(cause, text, "refused" if parts is turned else "warned")


def _answers(parts: Sequence[_Part], i: int) -> list[_Answer]:
    """Return the answer to input i in each part. The prediction is learned from other trials, or
    from other parts of a single trial; without enough of these, the list is empty."""
    regressors = [part.regressors() for part in parts]
    squares = [x.T @ x for x in regressors]
    products = [x.T @ p.outputs for x, p in zip(regressors, parts, strict=True)]
    answers = []
    for n, part in enumerate(parts):
        training = [k for k, other in enumerate(parts) if other.trial != part.trial]
        if not training:
            training = [k for k in range(len(parts)) if k != n]
        unknowns = regressors[n].shape[1]
        if sum(len(regressors[k]) for k in training) < _ENOUGH * unknowns:
            return []
        square = np.sum([squares[k] for k in training], axis=0)
        product = np.sum([products[k] for k in training], axis=0)
        # (A ridge, since inputs may be collinear.)
        ridge = 1e-4 * np.trace(square) / unknowns
        b = np.linalg.solve(square + ridge * np.eye(unknowns), product)
        answers.append(_answer(part, i, b))
    return answers


def _answer(part: _Part, i: int, b: Signals) -> _Answer:
    """Return the answer to input i of a part, where b are learned coefficients."""
    first = sum(x.shape[1] for x in (part.before, *part.inputs[:i]))
    of_input = slice(first, first + part.inputs[i].shape[1])
    predicted = part.inputs[i] @ b[of_input]
    response = part.outputs - part.regressors() @ b + predicted
    power = float((predicted**2).sum())
    gain = float((response * predicted).sum()) / power
    by_cycle = ((response - gain * predicted) * predicted).sum(axis=1)
    return _Answer(
        gain=gain,
        error=float(np.linalg.norm(by_cycle)) / power,
        left=float(((response - predicted) ** 2).mean()),
        explained=float((predicted**2).mean()),
    )


def _parts(data: SectionData, r: int, sections: int) -> Iterator[_Part]:
    """Yield the parts of a record, inputs in their rms, outputs in robust standard deviations."""
    record = data.records[r]
    N = data.n_sections
    whole = whole_cycles(record)
    cycles = (whole.stop - whole.start) // N
    number = min(_PARTS, cycles // _SHORTEST)
    if number < 1:
        return
    scaled_inputs = record.u[whole] / data.rms()[0]
    u = scaled_inputs.reshape(cycles, N, -1)
    y = (record.y[whole] / _robust_size(data)).reshape(cycles, N, -1)
    sections = min(N, sections)
    means = [x.mean(axis=1) for x in np.array_split(u, sections, axis=1)]
    u = np.stack(means, axis=1)
    at = np.linspace(0, N, sections, endpoint=False).astype(int)
    in_cycles = y[:, at].reshape(cycles, -1)
    y = np.clip(in_cycles, -8, 8)  # outliers
    time = data.times[r][whole].reshape(cycles, N)
    ahead = -(-record.lead // N)
    edges = np.linspace(0, cycles, number + 1).astype(int)
    for a, b in pairwise(edges):
        rows = np.arange(a + 1, b - ahead)
        lags = range(-1, ahead + 1)
        inputs = np.stack([u[rows + c] for c in lags], axis=1)
        known = np.isfinite(inputs).all(axis=(1, 2, 3))
        known &= np.isfinite(y[rows - 1]).all(axis=1)
        known &= np.isfinite(y[rows]).all(axis=1)
        rows = rows[known]
        if len(rows) >= _SHORTEST / 2:
            by_input = np.moveaxis(inputs[known], -1, 0)
            yield _Part(
                trial=data.trials[r],
                time=time[a:b].ravel(),
                before=_centered(y[rows - 1]),
                inputs=[_centered(x.reshape(len(rows), -1)) for x in by_input],
                outputs=_centered(y[rows]),
            )


def _robust_size(data: SectionData) -> Float[np.ndarray, " ny"]:
    """Return standard deviations of the outputs from the medians of their moduli, but not less than
    a tenth of the rms: more than half of the samples may be zero."""
    deviations = np.abs(np.concatenate([record.y for record in data.records]))
    robust = 1.4826 * np.nanmedian(deviations, axis=0)
    return np.maximum(robust, 0.1 * data.rms()[1])


def _centered(x: Signals) -> Signals:
    """Subtract the means, since the level of a signal may differ between parts."""
    return x - x.mean(axis=0)


def inexact_events(data: SectionData) -> Iterator[Finding]:
    """Find events whose times are inexact: outputs after an event are shifted along the average
    cycle by a time that does not depend on the shifts after earlier events."""
    N = data.n_sections
    size = data.rms()[1]
    tiny = np.finfo(float).tiny
    orders = np.fft.fftfreq(N, 1 / N)[:, None]
    waves = 2j * np.pi * orders
    spectrum = np.fft.fft(data.cycle_outputs, axis=0)
    slope = np.fft.ifft(waves * spectrum, axis=0).real / size
    slope = slope[: N // 5].ravel()
    times = []
    whole = 0.0
    left = 0.0
    for record in data.records:
        y = record.y[whole_cycles(record)] / size
        y = y.reshape(-1, N * len(size))
        y = y[:, : len(slope)]
        y = y[np.isfinite(y).all(axis=1)]
        late = y @ slope / max(slope @ slope, tiny)
        times.append(late)
        whole += (y**2).sum()
        left += ((y - late[:, None] * slope) ** 2).sum()
    late = np.concatenate(times)
    products = abs(late[1:] @ late[:-1])
    follows = products / max(late @ late, tiny)
    # (Times of more than a cycle come from outputs that hardly change along the cycle.)
    if left < (1 - _SHIFTED) * whole and follows < 0.5 and late.std() < 1:
        yield Finding(
            "inexact events",
            f"the starts of cycles seem to scatter by {late.std():.2g} of a cycle: use an angle, "
            "or a crossing where the signal changes fast.",
        )


def feedback(data: SectionData) -> Iterator[Finding]:
    """Find inputs that repeat with the rhythm, or whose average cycle has the shape of an output's
    average cycle.

    The average cycle of an input that is chosen without regard to the rhythm is nearly zero. If the
    average cycle has most of the input's variance, the input was made from the rhythm's phase or
    state, by a controller or a trigger. Its deviations then depend on the outputs and their
    disturbances, so that every regression on it is biased (Söderström and Stoica, *System
    Identification*, 1989, ch. 10: direct identification in closed loop). The same holds if an
    output leaks into the input.
    """
    if data.cycles < 6:
        return
    deviations, _ = data.rms()
    shapes = _varying(data.cycle_outputs)
    for name, cycle, deviation in zip(
        data.inputs, data.cycle_inputs.T, deviations, strict=True
    ):
        repeated = float(np.nanvar(cycle))
        total = repeated + float(deviation) ** 2
        share = repeated / max(total, np.finfo(float).tiny)
        if share > 0.5:
            yield Finding(
                "feedback",
                f"{100 * share:.0f} % of the variance of {name} repeats with the cycle: fits are "
                f"biased. {NAME_REFERENCE}",
            )
        elif share > CLEAR**2 / data.cycles and data.n_sections > 2 * shapes.shape[1]:
            shape = _varying(cycle)
            unlike = shape - shapes @ np.linalg.lstsq(shapes, shape)[0]
            if unlike @ unlike < 0.1 * (shape @ shape):
                yield Finding(
                    "feedback",
                    f"{name} contains the outputs ({100 * share:.0f} % of its variance repeats as "
                    "they do): fits are biased. Name the perturbation alone as the input.",
                )


def _varying(cycle: np.ndarray) -> np.ndarray:
    """Return an average cycle without its mean; zero where it is unknown."""
    return np.nan_to_num(cycle - np.nanmean(cycle, axis=0))
