"""Look for what is wrong with a recording, before its phase is known and after."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import OptionalNames, SignalNames
from ..data import SectionData
from ..findings import Finding, Inspection, places
from ..phase import Phase
from ..recording import Recording
from ..smoothing import FEWEST
from .answers import feedback, unanswered
from .samples import clipped, doubled_signals, frozen, placeholders, repeated_samples, wrapped
from .trials import clocks, other_cycles, other_settings, slow_changes


_NOT_MEASURED = (
    ("no value", placeholders, "has samples that stand for no value, such as -9999"),
    ("frozen", frozen, "does not change at all, as if a sensor or wire had failed"),
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
    """Look for what is wrong with a recording, before anything is computed from it.

    Findings: numbers that stand for "no value", frozen, clipped and overflowing signals; signals,
    trials and parts of trials that occur twice; trials with other units, zeros, columns or clocks.
    Samples that certainly were not measured are left out: missing in the returned recording.

    With `phase` and `data`, also trials of other periods and cycles, slow changes of the outputs,
    inputs that the outputs do not answer, and inputs that depend on the outputs.

    **Arguments:** `inputs`, `outputs`: names of signals; others are not inspected. `phase`, `data`:
    phase and data at the sections, of this recording or of the one that an inspection returned.
    Default: None.

    **Raises:** `DefinitionError` for unknown names.
    """
    inputs, outputs = tuple(inputs), tuple(outputs)
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
                text = f"{name} {text} ({places(clean.trials, bad)}): taken for missing."
                findings.append(Finding(cause, text, "left out"))
                clean = _masked(clean, [name], bad)
        findings += clipped(clean, name)
        findings += () if name in inputs else wrapped(clean, name)
    findings += doubled_signals(clean, names)
    copies, more = repeated_samples(clean, names)
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
    if not kept:
        text = "no trial has samples of all outputs that can be used."
        findings.append(Finding("an empty recording", text, "refused"))
    clean = clean.with_trials(kept or clean.trials)
    findings += [*other_settings(clean, names, outputs), *clocks(clean)]
    if phase is not None and data is not None:
        same = len(phase.stretches) == len(recording.trials)
        findings += inspect_cycles(recording if same else clean, phase, data)
    return Inspection(tuple(findings), clean)


def inspect_cycles(recording: Recording, phase: Phase, data: SectionData) -> list[Finding]:
    """Return the findings that need the phase and the data at the sections."""
    outputs = tuple(x for x in data.outputs if x in recording.signals)
    return [
        *other_cycles(recording, phase, outputs),
        *slow_changes(recording, phase, outputs),
        *(unanswered(data, [t.name for t in recording.trials]) if outputs else ()),
        *feedback(data),
    ]


def _masked(recording: Recording, names: list[str], bad: list[Bool[np.ndarray, " _"]]) -> Recording:
    """Return the recording with NaN for some samples of some signals."""
    columns = [recording.column(name) for name in names]
    trials = []
    for trial, rows in zip(recording.trials, bad, strict=True):
        values = trial.values.copy()
        values[np.ix_(rows, columns)] = np.nan
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
