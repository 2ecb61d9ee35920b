"""All that can be seen in a recording before its phase is known, and after."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import OptionalNames, SignalNames
from ...errors import DefinitionError
from ..data import SectionData
from ..phase.winding import Phase
from ..recording import Recording, Trial
from ..smoothing import FEWEST
from .coupling import unanswered
from .cycles import other_cycles, slow_changes
from .feedback import feedback
from .finding import Finding, Inspection
from .repeats import doubled_signals, repeated_samples
from .samples import Rows, Signal, clipped, frozen, placeholders, wrapped
from .settings import clocks, other_settings


# Of a signal's range, how far it must go to either side of its middle before it counts as having
# gone round once. Doubled: small swings in between do not count.
_SWING, _TAIL = 0.25, 0.1


@checked
def inspect(recording: Recording, *, inputs: SignalNames, outputs: OptionalNames) -> Inspection:
    """Look for what is wrong with a recording, before anything is computed from it.

    Numbers that stand for "no value", frozen, clipped and overflowing signals; signals, trials and
    parts of trials that are there twice; trials with other units, zeros, columns or clocks. What
    certainly was not measured is left out: missing in the recording that is returned.

    **Arguments:** names of signals; others are not looked at.

    **Raises:** `DefinitionError` for names that are not there.
    """
    names = [name for name in (*inputs, *outputs) if _recorded(recording, name)]
    found: list[Finding] = []
    clean = recording
    periods = [
        _samples_per_cycle(t.values[:, [recording.column(x) for x in outputs]])
        for t in recording.trials
    ]
    for name in names:
        for check in (placeholders, frozen):
            bad, more = check(_signal(clean, name, periods, name in inputs))
            clean = _masked(clean, [name], bad)
            found += more
        signal = _signal(clean, name, periods, name in inputs)
        found += clipped(signal) + ([] if name in inputs else wrapped(signal))
    found += doubled_signals(clean, names)
    known, repeated = repeated_samples(clean, names)
    found += repeated
    once = [not rows.all() for rows in known]
    clean, empty = _without_empty(_masked(clean, names, known), outputs, once)
    found += empty
    found += other_settings(clean, names, outputs) + clocks(clean)
    return Inspection(tuple(found), clean)


@checked
def inspect_cycles(recording: Recording, phase: Phase, data: SectionData) -> tuple[Finding, ...]:
    """What can be seen when the phase is known: trials of other periods and cycles, slow changes of
    the outputs, inputs that the outputs do not answer, and inputs that answer the outputs."""
    outputs = tuple(x for x in data.outputs if x in recording.signals)
    names = tuple(t.name for t in recording.trials)
    return (
        *other_cycles(recording, phase, outputs),
        *slow_changes(recording, phase, outputs),
        *(unanswered(data, names) if outputs else ()),
        *feedback(data),
    )


def refuse(findings: Sequence[Finding]) -> None:
    """**Raises:** `DefinitionError` with the first finding that makes a recording useless."""
    for finding in findings:
        if finding.action == "refused":
            raise DefinitionError(finding.text)


def _recorded(recording: Recording, name: str) -> bool:
    """Whether there is any sample of a signal."""
    k = recording.column(name)
    return any(bool(np.isfinite(t.values[:, k]).any()) for t in recording.trials)


def _signal(recording: Recording, name: str, periods: list[float], is_input: bool) -> Signal:
    values = [t.values[:, recording.column(name)] for t in recording.trials]
    return Signal(name, recording.trials, values, periods, is_input)


def _masked(recording: Recording, names: list[str], bad: Rows) -> Recording:
    """With NaN for some samples of some signals."""
    columns = [recording.column(name) for name in names]
    trials = []
    for trial, rows in zip(recording.trials, bad, strict=True):
        values = trial.values.copy()
        values[:, columns] = np.where(rows[:, None], np.nan, values[:, columns])
        trials.append(Trial(trial.time, values, trial.events, trial.name))
    return eqx.tree_at(lambda r: r.trials, recording, tuple(trials))


def _samples_per_cycle(values: Float[np.ndarray, "n k"]) -> float:
    """The largest median number of samples from one swing of a signal to the next."""
    found = []
    for x in values.T:
        x = x[np.isfinite(x)]
        if not len(x):
            continue
        low, high = np.quantile(x, [_TAIL, 1 - _TAIL])
        side = np.where(x > high - _SWING * (high - low), 1, 0)
        side[x < low + _SWING * (high - low)] = -1
        side = np.stack([np.flatnonzero(side), side[side != 0]])
        up = side[0, 1:][np.diff(side[1]) > 0]
        if len(up) > 2:
            found.append(float(np.median(np.diff(up))))
    return max(found, default=float(len(values)))


def _without_empty(
    recording: Recording, outputs: tuple[str, ...], once: list[bool]
) -> tuple[Recording, list[Finding]]:
    """Without trials in which nothing is left of an output; `once`: those that are no copies."""
    columns = [recording.column(name) for name in outputs]
    kept, found = [], []
    for trial, new in zip(recording.trials, once, strict=True):
        lost = np.isfinite(trial.values[:, columns]).sum(axis=0) < FEWEST
        if not lost.any():
            kept.append(trial)
            continue
        name = outputs[int(np.argmax(lost))]
        text = f"nothing is left of {name} in trial '{trial.name}': the trial is left out."
        found += [Finding("an empty trial", "left out", text)] if new else []
    if not kept:
        text = "no trial has samples of all outputs that can be used."
        return recording, [*found, Finding("an empty recording", "refused", text)]
    return eqx.tree_at(lambda r: r.trials, recording, tuple(kept)), found
