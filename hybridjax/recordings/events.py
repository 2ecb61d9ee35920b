"""Phase that grows by one from each event, or crossing of a level, to the next."""

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError
from ..orbits.crossing import AtEvent, Crossing
from .phase import LONGEST_GAP, Phase, Winding
from .recording import Recording, check_events
from .smoothing import bridgeable, gaps, inside


# Default bandwidth of a signal whose crossings are taken, in harmonics of the cycle. Larger:
# crossings are noisier. Smaller: crossings of steep signals are displaced.
_CROSSING_HARMONICS = 16
# Lengths of intervals, in periods: up to `_DOUBLED` an event is doubled, beyond `_MISSED` one was
# missed. Nearer to 1: irregular cycles are left out. Further: intervals with one event too many
# or too few pass for cycles.
_DOUBLED, _MISSED = 0.5, 1.5
# Number of intervals from which the rhythm of a trial is estimated alone. More: long trials are
# judged by the period of the others. Fewer: it is estimated from too few.
_ENOUGH = 20
# Fraction of long intervals that makes them part of the rhythm. Larger: rhythms of long and short
# cycles are cut at each long one. Smaller: missed events pass for cycles.
_COMMON = 0.1


def from_crossings(recording: Recording, crossing: Crossing, bandwidth: float | None) -> Phase:
    """Return a phase with one cycle per crossing; `bandwidth` of the signal's spline in Hz."""
    event = AtEvent(str(crossing))
    if bandwidth is None:  # noise adds crossings of the samples themselves
        rough = from_events(recording.mark(event.name, crossing), event)
        bandwidth = _CROSSING_HARMONICS / rough.period
    return from_events(recording.mark(event.name, crossing, bandwidth=bandwidth), event)


def from_events(recording: Recording, event: AtEvent) -> Phase:
    """Return a phase with one cycle per event."""
    name, times = event.name, []
    for trial in recording.trials:
        if name not in trial.events:
            present = ", ".join(trial.events) or "none"
            raise DefinitionError(
                f"trial '{trial.name}' has no event '{name}'; its events are: {present}."
            )
        times.append(trial.events[name])
        check_events(f"trial '{trial.name}'", name, times[-1], trial.time)
    intervals = np.concatenate([np.diff(t) for t in times])
    if len(intervals) < 2:
        raise DefinitionError(f"there are too few events '{name}' for two cycles.")
    common, dropped, missed, stretches = _period(intervals), 0, 0, []
    for trial, t in zip(recording.trials, times, strict=True):
        period, doubled, longest = common, _DOUBLED, _MISSED
        if (np.diff(t) > common / 4).sum() >= _ENOUGH:
            period, doubled, longest = _rhythm(np.diff(t))
        kept: list[float] = []
        for x in t:
            if not kept or x - kept[-1] >= doubled * period:
                kept.append(x)
        dropped += len(t) - len(kept)
        t = np.array(kept)
        sampled = np.isfinite(trial.time)
        pauses = gaps(trial.time, sampled, bridgeable(trial.time, sampled, LONGEST_GAP * period))
        wide = np.flatnonzero((np.diff(t) > longest * period) | inside(pauses, t[:-1], t[1:])) + 1
        missed += sum(max(round(float(t[k] - t[k - 1]) / period), 1) for k in wide)
        parts = [part for part in np.split(t, wide) if len(part) > 1]
        stretches.append([Winding(p, np.arange(len(p), dtype=float), True) for p in parts])
    return Phase(stretches, dropped=dropped, missed=missed, lead=1)


def _rhythm(intervals: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Return the period of a trial and, in periods, the limits of doubled and missed events.

    Irregular rhythms have intervals of all lengths: the limits lie at the first gap in their
    distribution on either side of the median (0.25 periods above, 0.1 below).
    """
    period = _period(intervals)
    length = np.sort(intervals / period)
    middle = len(length) // 2
    above = np.flatnonzero(np.diff(length[middle:]) > 0.25)
    below = np.flatnonzero(np.diff(length[: middle + 1]) > 0.1)
    longest = length[middle + above[0]] if len(above) else length[-1]
    shortest = length[below[-1] + 1] if len(below) else length[0]
    missed, doubled = max(_MISSED, 1.01 * float(longest)), min(_DOUBLED, 0.99 * float(shortest))
    if (length > missed).mean() > _COMMON:
        missed = np.inf
    if (length < doubled).mean() > 2 * _COMMON:
        doubled = _DOUBLED  # most events are doubled
    return period, doubled, missed


def _period(intervals: Float[np.ndarray, " n"]) -> float:
    """Return the median of the intervals without short ones, of which a doubled event makes one."""
    return float(np.median(intervals[intervals > np.median(intervals) / 4]))
