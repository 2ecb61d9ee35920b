"""Phase that grows by one from each event, or crossing of a level, to the next."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from ...orbits.crossing import AtEvent, Crossing
from ..recording import Recording, Trial
from ..smoothing import bridgeable, gaps, inside
from .winding import LONGEST_GAP, Phase, Winding


# Bandwidth of a signal whose crossings are taken, in cycles per cycle. Doubled: crossings are less
# late where the signal is steep, and noisier.
_CROSSING_HARMONICS = 16
# Intervals shorter than this part of the median do not count when the period is found. Doubled: a
# recording with most of its events doubled is understood, one of irregular cycles no longer.
_SPURIOUS = 0.25
# An event this part of a period after the one before is doubled. Doubled: every event is.
_DOUBLED = 0.5
# An event was missed in an interval of more than so many periods. Doubled: an interval with one
# event missed is taken for a long cycle.
_MISSED = 1.5
# Intervals of a trial from which its own period is taken, and how irregular it is; else those of
# all trials are. Doubled: long trials are judged by the others' period.
_OWN = 20
# Parts of a period by which lengths of intervals must differ from all others', that they count as
# those of another kind: long ones, and short ones. Doubled: in irregular rhythms missed, or
# doubled, events pass for cycles.
_LONG_GAP, _SHORT_GAP = 0.25, 0.1
# Share of intervals of another kind that make them part of the rhythm. Doubled: rhythms of long and
# short cycles are cut at each long one.
_COMMON = 0.1
# Cycles by which a causal phase goes on until the next event, at least. Doubled: it follows a
# sudden change of the period with more delay.
_LEAST_PROGRESS = 0.1


def from_crossings(
    recording: Recording, crossing: Crossing, bandwidth: float | None, causal: bool
) -> Phase:
    """One cycle from each crossing to the next; `bandwidth` of the signal's spline in Hz."""
    event = AtEvent(str(crossing))
    if bandwidth is None:  # noise adds crossings of the samples themselves
        rough = from_events(recording.mark(event.name, crossing), event, causal=False)
        bandwidth = _CROSSING_HARMONICS / rough.period
    return from_events(recording.mark(event.name, crossing, bandwidth=bandwidth), event, causal)


def from_events(recording: Recording, event: AtEvent, causal: bool) -> Phase:
    """One cycle from each event to the next."""
    name, times = event.name, []
    for trial in recording.trials:
        if name not in trial.events:
            there = ", ".join(trial.events) or "none"
            raise DefinitionError(
                f"trial '{trial.name}' has no event '{name}'; its events are: {there}."
            )
        times.append(trial.events[name])
        _refuse_outside(trial, name)
    intervals = np.concatenate([np.diff(t) for t in times])
    if len(intervals) < 2:
        raise DefinitionError(f"there are too few events '{name}' for two cycles.")
    common, dropped, kept, rhythms = _period(intervals), 0, [], []
    for t in times:
        own = np.diff(t)
        enough = (own > _SPURIOUS * common).sum() >= _OWN
        rhythm = _Rhythm.of(own) if enough else _Rhythm(common, _DOUBLED, _MISSED)
        good = []
        for x in t:
            if good and x - good[-1] < rhythm.doubled * rhythm.period:
                dropped += 1
            else:
                good.append(x)
        kept.append(np.array(good))
        rhythms.append(rhythm)
    missed, stretches = 0, []
    for trial, t, rhythm in zip(recording.trials, kept, rhythms, strict=True):
        period = rhythm.period
        sampled = np.isfinite(trial.time)
        pauses = gaps(trial.time, sampled, bridgeable(trial.time, sampled, LONGEST_GAP * period))
        unseen = (np.diff(t) > rhythm.missed * period) | inside(pauses, t[:-1], t[1:])
        wide = np.flatnonzero(unseen) + 1
        missed += sum(max(round(float(t[k] - t[k - 1]) / period), 1) for k in wide)
        parts = [part for part in np.split(t, wide) if len(part) > 1]
        if causal:
            stretches.append(tuple(_extrapolated(p) for p in parts if len(p) > 2))
        else:
            stretches.append(tuple(Winding(p, np.arange(len(p), dtype=float), True) for p in parts))
    return Phase(stretches, dropped=dropped, missed=missed, lead=0 if causal else 1)


def _refuse_outside(trial: Trial, name: str) -> None:
    """**Raises:** `DefinitionError` if events of this name all lie before the first sample of a
    trial or after the last."""
    at, time = trial.events[name], trial.time
    if len(at) and not ((at >= time[0]) & (at <= time[-1])).any():
        raise DefinitionError(
            f"trial '{trial.name}': all events '{name}' ({at[0]:.6g} s, ...) are outside of the "
            f"recording, which is from {time[0]:.6g} to {time[-1]:.6g} s: their times have another "
            "zero or unit."
        )


class _Rhythm(NamedTuple):
    """The period of a trial, and in parts of it up to where an event is doubled, and from where on
    one was missed."""

    period: float
    doubled: float
    missed: float

    @classmethod
    def of(cls, intervals: Float[np.ndarray, " n"]) -> "_Rhythm":
        """By the intervals themselves: those of an irregular rhythm are of all lengths, with no gap
        between its own and those with a missed or a doubled event."""
        period = _period(intervals)
        length = np.sort(intervals / period)
        middle = len(length) // 2
        above = np.flatnonzero(np.diff(length[middle:]) > _LONG_GAP)
        below = np.flatnonzero(np.diff(length[: middle + 1]) > _SHORT_GAP)
        longest = length[middle + above[0]] if len(above) else length[-1]
        shortest = length[below[-1] + 1] if len(below) else length[0]
        missed, doubled = max(_MISSED, 1.01 * longest), min(_DOUBLED, 0.99 * shortest)
        if (length > missed).mean() > _COMMON:
            missed = np.inf
        if (length < doubled).mean() > 2 * _COMMON:
            doubled = _DOUBLED  # most are
        return cls(period, doubled, missed)


def _period(intervals: Float[np.ndarray, " n"]) -> float:
    """The median. Doubled events make two intervals of one, of which one is short; missed events
    make long ones. Neither moves it by much once the short ones are out."""
    period = float(np.median(intervals))
    return float(np.median(intervals[intervals > _SPURIOUS * period]))


def _extrapolated(t: Float[np.ndarray, " n"]) -> Winding:
    """In each cycle the rate that would make the phase right at the next event, if that comes after
    as long a time as the last one did."""
    phase = [1.0]
    for k, (before, own) in enumerate(zip(np.diff(t[:-1]), np.diff(t[1:]), strict=True), 1):
        phase.append(phase[-1] + max(k + 1 - phase[-1], _LEAST_PROGRESS) * own / before)
    return Winding(t[1:], np.array(phase), True)
