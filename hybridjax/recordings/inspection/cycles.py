"""Average cycles of trials that differ, and cycles that change slowly."""

import numpy as np
from jaxtyping import Float

from ..phase.winding import Phase, Winding
from ..recording import Recording, Trial
from ..smoothing import means
from .finding import Finding


# Phases at which average cycles are compared. Doubled: events that differ are seen to half a phase.
_PHASES = 16
# The least correlation of cycles that are the same. (Not to be doubled: it lies below 1.)
_ALIKE = 0.8
# Median periods of trials differ if they do by this share, and by so many of their scatters.
# Doubled: larger differences pass.
_OTHER_PERIOD, _SCATTERS = 0.02, 5.0
# Slow changes: the first of so many cosines over a trial, the others up to the second number, and
# the ratio of their mean powers that is drift. (A multiplier of 0.9 makes 14 of it.) Doubled: more
# drift passes.
_SLOW, _FASTER, _RATIO = 6, 24, 20.0


def other_cycles(recording: Recording, phase: Phase, outputs: tuple[str, ...]) -> list[Finding]:
    """Trials whose period differs, in which an output has the other sign, or cycles begin
    elsewhere."""
    found = []
    for s, trial in enumerate(recording.trials):
        rest = [p for k, p in enumerate(phase.periods) if k != s and len(p)]
        if not len(phase.periods[s]) or not rest:
            continue
        own, usual = np.median(phase.periods[s]), np.median([np.median(p) for p in rest])
        if abs(own / usual - 1) > max(_OTHER_PERIOD, _SCATTERS * phase.jitter):
            text = (
                f"cycles of trial '{trial.name}' last {own:.4g}, those of the others {usual:.4g}: "
                "if it ran at another speed it is another system; identify it alone."
            )
            found.append(Finding("another period", "warned", text))
    if not outputs:
        return found
    mean = np.array(
        [
            [_average(t, recording.column(name), parts) for name in outputs]
            for t, parts in zip(recording.trials, phase.stretches, strict=True)
        ]
    )
    known = np.flatnonzero(np.isfinite(mean).all(axis=(1, 2)))
    for s in known if len(known) > 1 else ():
        usual = np.median(mean[known[known != s]], axis=0)
        difference = _difference(mean[s], usual, recording.trials[s].name, outputs)
        found += [] if difference is None else [difference]
    return found


def slow_changes(recording: Recording, phase: Phase, outputs: tuple[str, ...]) -> list[Finding]:
    """Means over cycles that change much more slowly than they scatter."""
    found = []
    for name in outputs:
        slow, faster = 0.0, 0.0
        for trial, parts in zip(recording.trials, phase.stretches, strict=True):
            for part in parts:
                level = _means(trial, recording.column(name), part)
                level = level[np.isfinite(level)]
                if len(level) >= 2 * _FASTER:
                    n, k = len(level), np.arange(1, _FASTER + 1)
                    c = np.cos(np.pi * k[:, None] * (np.arange(n) + 0.5) / n) @ level / np.sqrt(n)
                    slow += float((c[:_SLOW] ** 2).mean())
                    faster += float((c[_SLOW:] ** 2).mean())
        if slow > _RATIO * faster:
            text = (
                f"{name} drifts or slips: slow changes have {slow / faster:.3g} times the power of "
                "those from cycle to cycle; if that is the sensor, `drift=50` takes it out; if "
                "not, a multiplier lies near 1."
            )
            found.append(Finding("drift", "warned", text))
    return found


def _average(trial: Trial, column: int, parts: tuple[Winding, ...]) -> Float[np.ndarray, " P"]:
    """The mean of a signal at each phase, without the mean of all."""
    x, at = trial.values[:, column], np.full(len(trial.time), np.nan)
    for part in parts:
        inside = (trial.time >= part.time[0]) & (trial.time <= part.time[-1])
        at[inside] = np.interp(trial.time[inside], part.time, part.phase)
    known = np.isfinite(at) & np.isfinite(x)
    bins = (np.mod(at[known], 1) * _PHASES).astype(int) % _PHASES
    count = np.bincount(bins, minlength=_PHASES)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(bins, x[known], _PHASES) / count
    return mean - mean.mean()


def _difference(
    own: Float[np.ndarray, "k P"],
    usual: Float[np.ndarray, "k P"],
    name: str,
    outputs: tuple[str, ...],
) -> Finding | None:
    alike = _correlations(own, usual)
    if (alike > _ALIKE).all():
        return None
    for k in np.flatnonzero(alike < -_ALIKE):
        if (np.delete(alike, k) > _ALIKE).all():
            text = f"{outputs[k]} has the other sign in trial '{name}': turn it."
            return Finding("another sign", "refused", text)
    shifted = [_correlations(np.roll(own, m, axis=1), usual).min() for m in range(_PHASES)]
    best = int(np.argmax(shifted))
    if best and shifted[best] > _ALIKE:
        text = (
            f"cycles of trial '{name}' begin {min(best, _PHASES - best) / _PHASES:.2g} of a cycle "
            "away from where those of the others do: look at its events, or signs."
        )
        return Finding("another event", "refused", text)
    which = ", ".join(outputs[k] for k in np.flatnonzero(alike <= _ALIKE))
    text = (
        f"the average cycle of {which} in trial '{name}' is not that of the others: look at its "
        "signs, columns and events, or identify it alone."
    )
    return Finding("another cycle", "warned", text)


def _correlations(
    a: Float[np.ndarray, "k P"], b: Float[np.ndarray, "k P"]
) -> Float[np.ndarray, " k"]:
    size = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return (a * b).sum(axis=1) / np.maximum(size, np.finfo(float).tiny)


def _means(trial: Trial, column: int, part: Winding) -> Float[np.ndarray, " c"]:
    """The mean of a signal over each whole cycle of a stretch."""
    edges = part.when(np.arange(np.ceil(part.phase[0]), np.floor(part.phase[-1]) + 1))
    return means(trial.time, trial.values[:, column], edges)
