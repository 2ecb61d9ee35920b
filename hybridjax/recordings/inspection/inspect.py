"""`check_recording`: look for errors in a recording before anything is computed from it.

It calls the tests in `failures.py`, `differences.py` and `answers.py`, and returns an `Inspection`:
findings, and the recording without samples that were certainly not measured. `inspect_cycles` runs
the tests that need the phase and the data at the sections. A new test is a function in one of these
files, and a line here; one that leaves samples of a signal out is an entry of `_NOT_MEASURED` and
of `_TEXTS`. The order must stay: samples that were not measured are left out before trials are
compared, since they would change what is compared.

If a finding is missed or needless, look at its function in these files. If a resting signal is
taken for frozen, look also at `_samples_per_cycle`, by which `frozen` judges; if a trial is left
out, at `_trials_with_samples`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ..._core.arguments import require_apart
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import OptionalNames
from ..._core.findings import Finding, warn_of
from ..data import SectionData
from ..findings import Inspection, places
from ..phase import Phase
from ..read import RecordingLike, as_recording
from ..recording import Recording, Trial
from ..smoothing import FEWEST
from . import differences, failures
from .answers import feedback, inexact_events, unanswered


_NOT_MEASURED = {
    "no value": failures.placeholders,
    "frozen": failures.frozen,
}
_TEXTS = {
    "no value": "{} has samples that stand for no value, such as -9999 ({}): taken for missing.",
    "frozen": "{} does not change at all, as if a sensor or wire had failed ({}): taken for "
    "missing.",
}
"""Texts of findings by their causes; signal and places are filled in."""


@checked
def check_recording(
    recording: RecordingLike,
    *,
    inputs: OptionalNames = (),
    outputs: OptionalNames | None = None,
    phase: Phase | None = None,
    data: SectionData | None = None,
) -> Inspection:
    """Look for errors in a recording before anything is computed from it.

    The findings are numbers that represent "no value"; frozen, clipped and overflowing signals;
    signals, trials and parts of trials that occur twice; trials with other units, offsets, columns
    or clocks. Samples that were certainly not measured are missing in the returned recording. With
    `phase` and `data`, the function also finds trials with another period or cycle, slow changes of
    the outputs, inputs to which the outputs do not respond, and inputs that depend on the outputs.

    **Arguments:**

    - `recording`: the recording, or the path of its file, or a table (`hj.Recording.from_frame`).
    - `inputs`, `outputs`: names of signals; others are not inspected. Default of `inputs`: none; of
      `outputs`: all signals that are no inputs.
    - `phase`, `data`: phase and data at the sections, of this recording or of the one that an
      inspection returned. Default: None.

    **Returns:** `hj.recordings.Inspection`: `findings`, a tuple of `hj.errors.Finding`, and the
    `recording` in which samples that were certainly not measured are missing.

    **Raises:** `DefinitionError` for unknown names, and for an output that is an input.

    **Example:**

    ```python
    checked = hj.recordings.check_recording(recording, inputs="u", outputs=("yM", "vM"))
    print(checked)
    ```

    **Before:** `hj.read_recording`. **After:** `hj.recordings.estimate_phase`.
    """
    inputs = tuple(inputs)
    recording = as_recording(recording)
    others = [name for name in recording.signals if name not in inputs]
    outputs = tuple(others if outputs is None else outputs)
    require_apart(inputs, outputs)
    names = [
        name
        for name in (*inputs, *outputs)
        if any(np.isfinite(x).any() for _, x in recording.samples(name))
    ]
    findings: list[Finding] = []
    clean = recording
    columns = [recording.column(name) for name in outputs]
    periods = [_samples_per_cycle(t.values[:, columns]) for t in recording.trials]
    for name in names:
        clean, more = _without_failures(clean, name, periods, name in inputs)
        findings += more
        findings += failures.clipped(clean, name)
        if name not in inputs:
            findings += failures.wrapped(clean, name)
    findings += failures.silent_inputs(
        clean, [name for name in names if name in inputs]
    )
    findings += failures.doubled_signals(clean, names)
    copies, more = failures.repeated_rows(clean, names)
    findings += more
    clean = _masked(clean, names, copies)
    trials, more = _trials_with_samples(clean, copies, outputs)
    findings += more
    if trials:
        clean = clean.with_trials(trials)
        findings += differences.other_settings(clean, names, outputs)
        findings += differences.clocks(clean)
        findings += differences.coarse_stamps(clean, names)
    else:
        findings.append(
            Finding(
                "an empty recording",
                "no trial has samples of all outputs that can be used.",
                "refused",
            )
        )
    if phase is not None and data is not None:
        of_all = len(phase.stretches) == len(recording.trials)
        findings += inspect_cycles(recording if of_all else clean, phase, data)
    warn_of(findings)
    return Inspection(tuple(findings), clean)


def _without_failures(
    recording: Recording,
    name: str,
    periods: Sequence[float],
    is_input: bool,
) -> tuple[Recording, list[Finding]]:
    """Return the recording without samples of a signal that were certainly not measured."""
    findings = []
    for cause, samples_of in _NOT_MEASURED.items():
        pairs = zip(recording.samples(name), periods, strict=True)
        bad = [samples_of(x, period, is_input) for (_, x), period in pairs]
        if any(rows.any() for rows in bad):
            text = _TEXTS[cause].format(name, places(recording.trials, bad))
            findings.append(Finding(cause, text, "left out"))
            recording = _masked(recording, [name], bad)
    return recording, findings


def _trials_with_samples(
    recording: Recording,
    copies: Sequence[Bool[np.ndarray, " _"]],
    outputs: Sequence[str],
) -> tuple[list[Trial], list[Finding]]:
    """Return the trials with samples of all outputs; copies of other trials need no finding."""
    columns = [recording.column(name) for name in outputs]
    trials = []
    findings = []
    for trial, rows in zip(recording.trials, copies, strict=True):
        lost = np.isfinite(trial.values[:, columns]).sum(axis=0) < FEWEST
        if not lost.any():
            trials.append(trial)
        elif not rows.all():
            name = outputs[int(np.argmax(lost))]
            text = f"trial '{trial.name}' has no samples of {name}."
            findings.append(Finding("an empty trial", text, "left out"))
    return trials, findings


def inspect_cycles(
    recording: Recording,
    phase: Phase,
    data: SectionData,
) -> list[Finding]:
    """Return the findings that need the phase and the data at the sections."""
    outputs = tuple(x for x in data.outputs if x in recording.signals)
    removed = data.records[0].drift or np.inf
    findings = [
        *differences.odd_cycles(recording, phase),
        *differences.alternating_cycles(data, phase),
        *inexact_events(data),
        *differences.other_cycles(recording, phase, outputs),
        *differences.slow_changes(recording, phase, outputs, removed),
    ]
    if outputs:
        findings += unanswered(data, [trial.name for trial in recording.trials])
    findings += feedback(data)
    return findings


def _masked(
    recording: Recording,
    names: list[str],
    bad: list[Bool[np.ndarray, " _"]],
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
    counts = []
    for x in values.T:
        x = x[np.isfinite(x)]
        if not len(x):
            continue
        low, high = np.quantile(x, [0.1, 0.9])
        margin = 0.25 * (high - low)
        is_high = x > high - margin
        is_low = x < low + margin
        side = np.sign(is_high * 1 - is_low * 1)
        at = np.flatnonzero(side)
        upward = at[1:][np.diff(side[at]) > 0]
        if len(upward) > 2:
            counts.append(float(np.median(np.diff(upward))))
    return max(counts, default=float(len(values)))
