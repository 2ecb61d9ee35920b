"""Look for what is wrong with a recording, before its phase is known and after.

Do the outputs answer each input, alike in all parts of a recording, and was it exogenous?
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..._core.arguments import require_apart
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import OptionalNames, SignalNames
from ..._core.findings import Finding, listed, warn_of
from ..data import SectionData
from ..findings import CLEAR, NAME_REFERENCE, Inspection, place, places
from ..phase import Phase
from ..recording import Recording
from ..smoothing import FEWEST
from . import faults


# Numbers of outputs per cycle that are predicted: the first for which there are `_ENOUGH` cycles
# per unknown. More cycles: short recordings are not checked. Fewer: predictions are noise.
_SECTIONS, _ENOUGH = (8, 4, 2), 3
# Cycles of a part, at least, and parts of a record, at most. More: short faults are diluted, or
# long records take longer. Fewer: the gain of a part is noise.
_SHORTEST, _PARTS = 16, 4
# Unexplained power of a part relative to the median that makes a disturbance. Larger: stumbles
# pass. Smaller: noisy parts are reported.
_DISTURBED = 9.0
# Part of the outputs' variance that errors of event times explain. Larger: inexact events pass.
# Smaller: real deviations along the cycle are called errors.
_SHIFTED = 0.7

_NOT_MEASURED = (
    (
        "no value",
        faults.placeholders,
        "has samples that stand for no value, such as -9999",
    ),
    (
        "frozen",
        faults.frozen,
        "does not change at all, as if a sensor or wire had failed",
    ),
)


@checked
def inspect(
    recording: Recording,
    *,
    inputs: SignalNames,
    outputs: OptionalNames,
    phase: Phase | None = None,
    data: SectionData | None = None,
) -> Inspection:
    """Look for errors in a recording before anything is computed from it.

    The findings are numbers that represent "no value"; frozen, clipped and overflowing signals;
    signals, trials and parts of trials that occur twice; trials with other units, offsets, columns
    or clocks. Samples that were certainly not measured are missing in the returned recording. With
    `phase` and `data`, the function also finds trials with another period or cycle, slow changes of
    the outputs, inputs to which the outputs do not respond, and inputs that depend on the outputs.

    **Arguments:** `inputs`, `outputs`: names of signals; others are not inspected. `phase`, `data`:
    phase and data at the sections, of this recording or of the one that an inspection returned.
    Default: None.

    **Raises:** `DefinitionError` for unknown names, and for an output that is an input.
    """
    inputs, outputs = tuple(inputs), tuple(outputs)
    require_apart(inputs, outputs)
    names = [
        name
        for name in (*inputs, *outputs)
        if any(np.isfinite(x).any() for _, x in recording.samples(name))
    ]
    findings: list[Finding] = []
    clean = recording
    columns = [recording.column(x) for x in outputs]
    periods = [_samples_per_cycle(t.values[:, columns]) for t in recording.trials]
    for name in names:
        for cause, samples_of, text in _NOT_MEASURED:
            pairs = zip(clean.samples(name), periods, strict=True)
            bad = [samples_of(x, period, name in inputs) for (_, x), period in pairs]
            if any(map(np.any, bad)):
                text = (
                    f"{name} {text} ({places(clean.trials, bad)}): taken for missing."
                )
                findings.append(Finding(cause, text, "left out"))
                clean = _masked(clean, [name], bad)
        findings += faults.clipped(clean, name)
        findings += () if name in inputs else faults.wrapped(clean, name)
    findings += faults.silent_inputs(clean, [name for name in names if name in inputs])
    findings += faults.doubled_signals(clean, names)
    copies, more = faults.repeated_rows(clean, names)
    findings += more
    clean = _masked(clean, names, copies)
    kept = []
    for trial, rows in zip(clean.trials, copies, strict=True):
        lost = np.isfinite(trial.values[:, columns]).sum(axis=0) < FEWEST
        if not lost.any():
            kept.append(trial)
        elif not rows.all():
            text = f"trial '{trial.name}' has no samples of {outputs[int(np.argmax(lost))]}."
            findings.append(Finding("an empty trial", text, "left out"))
    if kept:
        clean = clean.with_trials(kept)
        findings += [
            *faults.other_settings(clean, names, outputs),
            *faults.clocks(clean),
        ]
    else:
        text = "no trial has samples of all outputs that can be used."
        findings.append(Finding("an empty recording", text, "refused"))
    if phase is not None and data is not None:
        same = len(phase.stretches) == len(recording.trials)
        findings += inspect_cycles(recording if same else clean, phase, data)
    warn_of(findings)
    return Inspection(tuple(findings), clean)


def inspect_cycles(
    recording: Recording, phase: Phase, data: SectionData
) -> list[Finding]:
    """Return the findings that need the phase and the data at the sections."""
    outputs = tuple(x for x in data.outputs if x in recording.signals)
    return [
        *faults.odd_cycles(recording, phase),
        *inexact_events(data),
        *faults.other_cycles(recording, phase, outputs),
        *faults.slow_changes(
            recording, phase, outputs, data.records[0].drift or np.inf
        ),
        *(unanswered(data, [t.name for t in recording.trials]) if outputs else ()),
        *feedback(data),
    ]


def _masked(
    recording: Recording, names: list[str], bad: list[Bool[np.ndarray, " _"]]
) -> Recording:
    """Return the recording with NaN for some samples of some signals."""
    columns = np.array([recording.column(name) for name in names], int)
    trials = []
    for trial, rows in zip(recording.trials, bad, strict=True):
        values = trial.values.copy()
        values[np.ix_(np.flatnonzero(rows), columns)] = np.nan
        trials.append(replace(trial, values=values))
    return recording.with_trials(trials)


def _samples_per_cycle(values: Float[np.ndarray, "n k"]) -> float:
    """Return the largest median number of samples from one upward swing of a signal to the next.

    A swing crosses the middle half of the range between the quantiles 10 and 90 %.
    """
    counts = [float(len(values))]
    for x in (x[np.isfinite(x)] for x in values.T):
        low, high = np.quantile(x, [0.1, 0.9]) if len(x) else (0.0, 0.0)
        margin = 0.25 * (high - low)
        side = np.where(x > high - margin, 1, np.where(x < low + margin, -1, 0))
        at = np.flatnonzero(side)
        up = at[1:][np.diff(side[at]) > 0]
        if len(up) > 2:
            counts.append(float(np.median(np.diff(up))))
    return max(counts[1:] or counts)


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
            parts = [
                p for r in range(len(data.records)) for p in _parts(data, r, sections)
            ]
            size = [float(p.inputs[i].std()) for p in parts]
            pushed = [
                p for p, x in zip(parts, size, strict=True) if x > 0.1 * np.median(size)
            ]
            answers = _answers(pushed, i)
            if len(answers):
                where = [place(names[p.trial], p.time) for p in pushed]
                yield from _odd(name, answers, where, len(data.inputs) > 1)
                break


def _odd(
    name: str, answers: Float[np.ndarray, "n 4"], where: list[str], several: bool
) -> Iterator[Finding]:
    """Find odd gains of an input; `where`: places of the parts. `several`: it is not alone."""
    gain, error, left, explained = answers.T
    usual = float(np.median(gain))
    together = abs(error**-2.0 @ gain) / np.sqrt((error**-2.0).sum())
    if together < CLEAR and np.mean((gain / error) ** 2) < CLEAR:
        text = f"the outputs do not answer {name}: was it recorded with them?"
        yield Finding("no answer", text, "warned" if several else "refused")
        return
    turned = gain < -np.maximum(usual / 2, CLEAR * error)
    foreign = (gain < usual / 2) & (gain + CLEAR * error < usual)
    disturbed = left > np.maximum(_DISTURBED * np.median(left), explained / 4)
    first = np.select([turned, foreign, disturbed], [0, 1, 2], -1)
    texts = {
        "another sign": "the outputs respond to {0} with the opposite sign ({1}): change the sign "
        "of {0} there.",
        "foreign input": "the outputs do not answer {} as elsewhere ({}): it belongs to another "
        "trial, or came earlier or later.",
        "disturbed": "something else than {} moved the outputs ({}).",
    }
    for k, (cause, text) in enumerate(texts.items()):
        if spans := [where[n] for n in np.flatnonzero(first == k)]:
            text = text.format(name, listed(spans))
            yield Finding(
                cause, text, "refused" if cause == "another sign" else "warned"
            )


def _answers(parts: list[_Part], i: int) -> Float[np.ndarray, "n 4"]:
    """Return for each part the gain of its response relative to that learned from other trials, its
    standard error, and mean squares of residuals and of the learned response. Too few: none."""
    regressors = [np.concatenate([p.before, *p.inputs], axis=1) for p in parts]
    squares = [x.T @ x for x in regressors]
    products = [x.T @ p.outputs for x, p in zip(regressors, parts, strict=True)]
    answers = []
    for n, (part, x) in enumerate(zip(parts, regressors, strict=True)):
        training = [k for k, p in enumerate(parts) if p.trial != part.trial]
        training = training or [k for k in range(len(parts)) if k != n]
        unknowns = x.shape[1]
        if sum(len(regressors[k]) for k in training) < _ENOUGH * unknowns:
            return np.zeros((0, 4))
        square = np.sum([squares[k] for k in training], axis=0)
        square += (
            1e-4 * np.trace(square) / unknowns * np.eye(unknowns)
        )  # of collinear inputs
        b = np.linalg.solve(square, np.sum([products[k] for k in training], axis=0))
        first = sum(u.shape[1] for u in (part.before, *part.inputs[:i]))
        predicted = part.inputs[i] @ b[first : first + part.inputs[i].shape[1]]
        response = part.outputs - x @ b + predicted
        power = float((predicted**2).sum())
        gain = float((response * predicted).sum()) / power
        each = ((response - gain * predicted) * predicted).sum(axis=1)
        error = float(np.sqrt((each**2).sum())) / power
        left = float(((response - predicted) ** 2).mean())
        answers.append((gain, error, left, float((predicted**2).mean())))
    return np.array(answers).reshape(-1, 4)


def _parts(data: SectionData, r: int, sections: int) -> Iterator[_Part]:
    """Yield the parts of a record, inputs in their rms, outputs in robust standard deviations."""
    record, N = data.records[r], data.n_sections
    sections = min(N, sections)
    first, ahead = -record.first_section % N, -(-record.lead // N)
    size_u, size_y = data.rms()
    robust = 1.4826 * np.nanmedian(
        np.abs(np.concatenate([x.y for x in data.records])), axis=0
    )
    size_y = np.maximum(
        robust, 0.1 * size_y
    )  # (more than half of the samples may be zero)
    at = np.linspace(0, N, sections, endpoint=False).astype(int)
    cycles = (len(record.u) - first) // N
    number = min(_PARTS, cycles // _SHORTEST)
    edges = np.linspace(0, cycles, number + 1).astype(int)[: number and None]
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        where = slice(first + a * N, first + b * N)
        u = (record.u[where] / size_u).reshape(b - a, N, -1)
        y = (record.y[where] / size_y).reshape(b - a, N, -1)[:, at].reshape(b - a, -1)
        y = np.clip(y, -8, 8)  # outliers
        means = [x.mean(axis=1) for x in np.array_split(u, sections, axis=1)]
        u, rows = np.stack(means, axis=1), np.arange(1, b - a - ahead)
        inputs = np.stack([u[rows + c] for c in range(-1, ahead + 1)], axis=1)
        usable = np.isfinite(inputs).all(axis=(1, 2, 3))
        usable &= np.isfinite(y[rows - 1]).all(axis=1) & np.isfinite(y[rows]).all(
            axis=1
        )
        if usable.sum() >= _SHORTEST / 2:
            rows, inputs = rows[usable], inputs[usable]
            each = [
                _centered(inputs[..., i].reshape(len(rows), -1))
                for i in range(u.shape[2])
            ]
            before, outputs = _centered(y[rows - 1]), _centered(y[rows])
            yield _Part(data.trials[r], data.times[r][where], before, each, outputs)


def _centered(x: Float[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
    """Subtract the means: each part has a level of its own."""
    return x - x.mean(axis=0)


def inexact_events(data: SectionData) -> Iterator[Finding]:
    """Find events whose times scatter: outputs after them deviate along the average cycle, by times
    that do not depend on those of the events before."""
    N, size = data.n_sections, data.rms()[1]
    waves = 2j * np.pi * np.fft.fftfreq(N, 1 / N)[:, None]
    slope = (
        np.fft.ifft(waves * np.fft.fft(data.cycle_outputs, axis=0), axis=0).real / size
    )
    slope, late, whole, left = slope[: N // 5].ravel(), [], 0.0, 0.0
    for r in data.records:
        first = -r.first_section % N
        y = (r.y[first:] / size)[: (len(r.y) - first) // N * N].reshape(
            -1, N * len(size)
        )
        y = y[np.isfinite(y[:, : len(slope)]).all(axis=1), : len(slope)]
        late.append(y @ slope / max(slope @ slope, np.finfo(float).tiny))
        whole, left = (
            whole + (y**2).sum(),
            left + ((y - late[-1][:, None] * slope) ** 2).sum(),
        )
    times = np.concatenate(late)
    follows = abs(times[1:] @ times[:-1]) / max(times @ times, np.finfo(float).tiny)
    # (Times beyond a cycle are those of outputs that do not change along it.)
    if left < (1 - _SHIFTED) * whole and follows < 0.5 and times.std() < 1:
        text = f"the starts of cycles seem to scatter by {times.std():.2g} of a cycle: use an angle"
        yield Finding(
            "inexact events", f"{text}, or a crossing where the signal changes fast."
        )


def feedback(data: SectionData) -> Iterator[Finding]:
    """Find inputs that repeat with the rhythm, or whose average cycle is shaped as the outputs'.

    An input chosen without regard to the rhythm averages out over many cycles. One whose average
    cycle holds most of its variance was made from the rhythm's phase or state, by a controller or a
    trigger: its deviations then depend on those of the outputs, and on their disturbances, and no
    regression on it is unbiased (Söderström and Stoica, *System Identification*, 1989, ch. 10:
    direct identification in closed loop). The same holds if an output leaks into the input.
    """
    deviations, _ = data.rms()
    shapes = np.nan_to_num(data.cycle_outputs - np.nanmean(data.cycle_outputs, axis=0))
    for i, name in enumerate(data.inputs if data.cycles >= 6 else ()):
        repeated = float(np.nanvar(data.cycle_inputs[:, i]))
        share = repeated / max(
            repeated + float(deviations[i]) ** 2, np.finfo(float).tiny
        )
        if share > 0.5:
            text = f"{100 * share:.0f} % of the variance of {name} repeats with the cycle: "
            yield Finding("feedback", f"{text}fits are biased. {NAME_REFERENCE}")
        elif share > CLEAR**2 / data.cycles and data.n_sections > 2 * shapes.shape[1]:
            mean = np.nan_to_num(
                data.cycle_inputs[:, i] - np.nanmean(data.cycle_inputs[:, i])
            )
            left = mean - shapes @ np.linalg.lstsq(shapes, mean)[0]
            if left @ left < 0.1 * (mean @ mean):
                text = f"{name} contains the outputs ({100 * share:.0f} % of its variance repeats "
                text += "as they do): fits are biased. Name the perturbation alone as the input."
                yield Finding("feedback", text)
