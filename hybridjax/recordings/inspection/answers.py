"""Do the outputs answer each input, alike in all parts of a recording, and was it exogenous?"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data import SectionData
from ..findings import CLEAR, Finding, listed, place


# Numbers of outputs per cycle that are predicted: the first for which there are `_ENOUGH` cycles
# per unknown. More cycles: short recordings are not checked. Fewer: predictions are noise.
_SECTIONS, _ENOUGH = (8, 4, 2), 3
# Cycles of a part, at least, and parts of a record, at most. More: short faults are diluted, or
# long records take longer. Fewer: the gain of a part is noise.
_SHORTEST, _PARTS = 16, 4
# Gain relative to the median that is usual. Larger: other gains are reported. Smaller: partly wrong
# inputs pass.
_USUAL = 0.8
# Unexplained power of a part relative to the median that makes a disturbance. Larger: stumbles
# pass. Smaller: noisy parts are reported.
_DISTURBED = 9.0


class _Part(NamedTuple):
    """A part of a record, in whole cycles from section 0."""

    trial: int
    time: Float[np.ndarray, " n"]
    before: Float[np.ndarray, "t k"]
    """Outputs of the cycle before the predicted one."""
    inputs: list[Float[np.ndarray, "t k"]]
    """Means of each input over parts of the cycles around the predicted one."""
    outputs: Float[np.ndarray, "t k"]
    """Outputs of the predicted cycle."""


class _Answer(NamedTuple):
    """The response of a part to an input: `gain` times as learned from other parts."""

    part: _Part
    gain: float
    error: float
    """Standard error of the gain."""
    left: float
    """Mean square of the residual of the prediction."""
    explained: float
    """Mean square of the predicted response to the input."""


def unanswered(data: SectionData, names: Sequence[str]) -> Iterator[Finding]:
    """Find inputs that the outputs do not answer, in all trials or in parts of them.

    Each cycle is predicted linearly from the one before and from the inputs, as learned from the
    other trials (or the other parts of a single one). The gain of a part is the ratio of actual to
    predicted response: about 1, but 0 for the input of another trial, -1 for the other sign.
    Standard errors come from the residuals, cycle by cycle.

    **Arguments:** `names`: names of the trials.
    """
    for i, name in enumerate(data.inputs):
        for sections in _SECTIONS:
            parts = [p for r in range(len(data.records)) for p in _parts(data, r, sections)]
            size = [float(p.inputs[i].std()) for p in parts]
            pushed = [p for p, x in zip(parts, size, strict=True) if x > 0.1 * np.median(size)]
            if answers := _answers(pushed, i):
                yield from _odd(name, answers, names)
                break


def _odd(name: str, answers: list[_Answer], names: Sequence[str]) -> Iterator[Finding]:
    """Find odd gains of an input."""
    gain, error = np.array([(a.gain, a.error) for a in answers]).T
    usual = float(np.median(gain))
    together = abs(error**-2.0 @ gain) / np.sqrt((error**-2.0).sum())
    if together < CLEAR and np.mean((gain / error) ** 2) < CLEAR:
        yield Finding("no answer", f"the outputs do not answer {name}: was it recorded with them?")
        return
    left = np.median([a.left for a in answers])
    texts = {
        "another sign": "the outputs answer {} with the other sign ({}): turn it.",
        "foreign input": "the outputs do not answer {} as elsewhere ({}): it belongs to another "
        "trial, or came earlier or later.",
        "disturbed": "something else than {} moved the outputs ({}).",
    }
    odd = {
        "another sign": gain < -np.maximum(usual / 2, CLEAR * error),
        "foreign input": (gain < usual / 2) & (gain + CLEAR * error < _USUAL * usual),
        "disturbed": [a.left > max(_DISTURBED * left, a.explained / 4) for a in answers],
    }
    for k, (cause, parts) in enumerate(odd.items()):
        parts = np.asarray(parts) & ~np.any([*odd.values()][:k], axis=0)
        if parts.any():
            spans = [place(names[answers[n].part.trial], answers[n].part.time) for n in
                     np.flatnonzero(parts)]  # fmt: skip
            action = "refused" if cause == "another sign" else "warned"
            yield Finding(cause, texts[cause].format(name, listed(spans)), action)


def _answers(parts: list[_Part], i: int) -> list[_Answer]:
    """Return the answer of each part, learned from other trials; none if there are too few."""
    regressors = [np.concatenate([p.before, *p.inputs], axis=1) for p in parts]
    squares = [x.T @ x for x in regressors]
    products = [x.T @ p.outputs for x, p in zip(regressors, parts, strict=True)]
    answers = []
    for n, (part, x) in enumerate(zip(parts, regressors, strict=True)):
        training = [k for k, p in enumerate(parts) if p.trial != part.trial]
        training = training or [k for k in range(len(parts)) if k != n]
        unknowns = x.shape[1]
        if sum(len(regressors[k]) for k in training) < _ENOUGH * unknowns:
            return []
        square = np.sum([squares[k] for k in training], axis=0)
        square += 1e-4 * np.trace(square) / unknowns * np.eye(unknowns)  # of collinear inputs
        b = np.linalg.solve(square, np.sum([products[k] for k in training], axis=0))
        first = sum(u.shape[1] for u in (part.before, *part.inputs[:i]))
        predicted = part.inputs[i] @ b[first : first + part.inputs[i].shape[1]]
        response = part.outputs - x @ b + predicted
        power = float((predicted**2).sum())
        gain = float((response * predicted).sum()) / power
        each = ((response - gain * predicted) * predicted).sum(axis=1)
        error = float(np.sqrt((each**2).sum())) / power
        left = float(((response - predicted) ** 2).mean())
        answers.append(_Answer(part, gain, error, left, float((predicted**2).mean())))
    return answers


def _parts(data: SectionData, r: int, sections: int) -> Iterator[_Part]:
    """Yield the parts of a record, inputs in their rms, outputs in robust standard deviations."""
    record, N = data.records[r], data.n_sections
    sections = min(N, sections)
    first, ahead = -record.first_section % N, -(-record.lead // N)
    size_u, size_y = data.rms()
    robust = 1.4826 * np.nanmedian(np.abs(np.concatenate([x.y for x in data.records])), axis=0)
    size_y = np.maximum(robust, 0.1 * size_y)  # (more than half of the samples may be zero)
    at = np.linspace(0, N, sections, endpoint=False).astype(int)
    cycles = (len(record.u) - first) // N
    number = min(_PARTS, cycles // _SHORTEST)
    edges = np.linspace(0, cycles, number + 1).astype(int) if number else []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        where = slice(first + a * N, first + b * N)
        u = (record.u[where] / size_u).reshape(b - a, N, -1)
        y = (record.y[where] / size_y).reshape(b - a, N, -1)[:, at].reshape(b - a, -1)
        y = np.clip(y, -8, 8)  # outliers
        means = [x.mean(axis=1) for x in np.array_split(u, sections, axis=1)]
        u = np.moveaxis(means, 0, 1)
        rows = np.arange(1, b - a - ahead)
        inputs = np.stack([u[rows + c] for c in range(-1, ahead + 1)], axis=1)
        known = np.isfinite(inputs).all(axis=(1, 2, 3))
        known &= np.isfinite(y[rows - 1]).all(axis=1) & np.isfinite(y[rows]).all(axis=1)
        if known.sum() >= _SHORTEST / 2:
            rows, inputs = rows[known], inputs[known]
            each = [_centered(inputs[..., i].reshape(len(rows), -1)) for i in range(u.shape[2])]
            outputs = [_centered(y[rows - 1]), each, _centered(y[rows])]
            yield _Part(data.trials[r], data.times[r][where], *outputs)


def _centered(x: Float[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
    """Subtract the means: each part has a level of its own."""
    return x - x.mean(axis=0)


def feedback(data: SectionData) -> Iterator[Finding]:
    """Find inputs that repeat with the rhythm.

    An input chosen without regard to the rhythm averages out over many cycles. One whose average
    cycle holds most of its variance was made from the rhythm's phase or state, by a controller or a
    trigger: its deviations then depend on those of the outputs, and on their disturbances, and no
    regression on it is unbiased (Söderström and Stoica, *System Identification*, 1989, ch. 10:
    direct identification in closed loop).
    """
    deviations, _ = data.rms()
    for i, name in enumerate(data.inputs if data.cycles >= 6 else ()):
        repeated = float(np.nanvar(data.cycle_inputs[:, i]))
        share = repeated / max(repeated + float(deviations[i]) ** 2, np.finfo(float).tiny)
        if share > 0.5:
            yield Finding(
                "feedback",
                f"{100 * share:.0f} % of the variance of {name} repeats with the cycle: it is not "
                "exogenous, and fits are biased. Add a perturbation, and name that as the input.",
            )
