"""`estimate_phase`: from a definition of phase to the phase of a recording.

There are three ways: by the angle of two signals (`_from_angles`), by crossings of a smooth signal
(`_from_crossings`) and by events (`_from_events`); each returns a `Phase`, which must be a whole
number at section 0. For events, `_rhythm` decides which intervals are too short (doubled events) or
too long (missed events): look there if cycles are lost or counted twice.

If section 0 of an angle lies at a wrong place, look at `_angles` (an anchor that is a number) and
`_angle_at` (a crossing); if an angle is said not to wind, at `_plane`, which chooses the center; if
pulses of a trigger are lost, at `_is_switched`.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from ..errors import DefinitionError
from ..orbits.crossing import Crossing, SectionLike
from ..sections.families import KinematicPhase
from .phase import HARMONICS, LONGEST_GAP, Phase, Winding
from .read import RecordingLike, as_recording
from .recording import Recording, signal_of
from .smoothing import (
    FEWEST,
    Bandwidth,
    Series,
    bridgeable,
    gaps,
    inside,
    require_passing,
    spline,
    without_spikes,
)


PhaseDefinition: TypeAlias = KinematicPhase | SectionLike
"""Definition of the phase of a recording; see `estimate_phase`."""

# The rhythm of a trial is estimated from the trial alone if it has this many intervals. More: long
# trials are judged by the period of other trials. Fewer: it is estimated from too few intervals.
_ENOUGH = 20
# Long intervals are part of the rhythm if they are more than this part of all intervals. Larger: in
# rhythms of long and short cycles, each long cycle counts as a missed event. Smaller: missed events
# pass for cycles.
_COMMON = 0.1
# A signal is a switch if it jumps by this part of its range, and if this part of its samples is at
# its two values. Larger: noisy triggers are smoothed, and lost. Smaller: waves (41 %) are not
# smoothed.
_SWITCHED = 0.8


@checked
def estimate_phase(
    recording: RecordingLike,
    sections: PhaseDefinition,
    *,
    bandwidth: Bandwidth | None = None,
) -> Phase:
    """Estimate the phase of every trial.

    **Arguments:**

    - `recording`: the recording, or the path of its file, or a table (`hj.Recording.from_frame`).
    - `sections`, one of
        - a `KinematicPhase`: the angle of two signals about a center, counted in the sense in which
          it turns.
        - a `Crossing`: the phase grows by one from each crossing of a level by a signal to the
          next, linearly in between. The signal should cross the level once in each cycle in this
          direction, and fast: at mid-stance, at the apex. A signal that jumps there, as of a
          trigger, is not smoothed.
        - the name of a recorded event, or its `AtEvent`: the phase grows by one from each event to
          the next, linearly in between. An event less than half of the trial's median period after
          the one before counts as doubled, and is left out. If an interval is longer than 1.5
          median periods, an event was missed, and the cycles of this interval are left out. In
          irregular rhythms, with intervals of all lengths, these limits are the first gaps in the
          distribution of intervals. A crossing in a gap counts as missed. This phase, like that of
          a `Crossing`, depends on the time of the next event, and so do outputs that are sampled at
          a given phase.
    - `bandwidth`: bandwidth in Hz of the splines through the signals. Default: 32 harmonics of the
      cycle for a `KinematicPhase`, 16 for a `Crossing`.

    Angles that run backwards in noise are replaced by the mean of the two monotone envelopes, one
    from below and one from above. Stretches end at gaps longer than a quarter of a cycle: in the
    signals of an angle, or in all signals where the phase comes from crossings or events.

    **Returns:** `hj.recordings.Phase`: `stretches`, for each trial the times in seconds and the
    phase in cycles; `periods`, for each trial the durations of its cycles (n,), and `period`, their
    median, in seconds.

    **Raises:** `DefinitionError` for unknown signals or events, sections that a recording cannot
    have (functions of a state, charts), a phase that does not wind, or a recording of fewer than
    two cycles.

    **Example:**

    ```python
    phase = hj.recordings.estimate_phase(recording, hj.Crossing("vM", "falling"))
    print(phase.period)
    ```

    **Before:** `hj.recordings.check_recording`. **After:** `hj.recordings.sample_sections`.
    """
    recording = as_recording(recording)
    if isinstance(sections, KinematicPhase):
        angles = _angles(recording, sections, bandwidth)
        return _from_angles(angles, sections.n_sections)
    if isinstance(sections, Crossing):
        return _from_crossings(recording, sections, bandwidth)
    if bandwidth is not None:
        raise DefinitionError("events are not smoothed: leave `bandwidth` out.")
    name = sections if isinstance(sections, str) else sections.name
    return _from_events(recording, name)


def _from_crossings(
    recording: Recording,
    crossing: Crossing,
    bandwidth: float | None,
) -> Phase:
    """Return a phase with one cycle per crossing of a smooth signal."""
    name = str(crossing)
    if bandwidth is None:  # noise adds crossings of the samples themselves
        of_samples = recording.mark(name, crossing)
        rough = _from_events(of_samples, name)
        if _is_switched(of_samples, crossing, name):
            return rough
        bandwidth = HARMONICS / 2 / rough.period
    marked = recording.mark(name, crossing, bandwidth=bandwidth)
    phase = _from_events(marked, name)
    require_passing(bandwidth, 1 / phase.period)
    return phase


def _is_switched(recording: Recording, crossing: Crossing, name: str) -> bool:
    """Return whether a signal stays at two values and jumps at its marked crossings, like the
    signal of a trigger. Smoothing would move the crossings, or remove short pulses."""
    shares = []
    at_two_values = []
    for trial, x in recording.samples(signal_of(crossing)):
        low = np.nanmin(x)
        range_ = np.nanmax(x) - low
        is_at_one = np.abs((x - low) / range_ - 0.5) > _SWITCHED / 2
        at_two_values.append(is_at_one[np.isfinite(x)].mean())
        after = np.searchsorted(trial.time, trial.events[name])
        after = np.clip(after, 1, len(x) - 1)
        # (A sample of an edge may lie between the two values.)
        last = np.minimum(after + 1, len(x) - 1)
        first = np.maximum(after - 2, 0)
        within = x[after] - x[after - 1]
        around = x[last] - x[first]
        jumps = np.abs(np.stack([within, around]))
        shares.append(np.nanmax(jumps, axis=0) / range_)
    jumps_there = np.nanmedian(np.concatenate(shares)) > _SWITCHED
    return bool(jumps_there and min(at_two_values) > _SWITCHED)


def signals_of(definition: PhaseDefinition) -> set[str]:
    """Return the signals that define the phase, as far as the definition names them."""
    if isinstance(definition, Crossing):
        return {signal_of(definition)}
    if isinstance(definition, KinematicPhase):
        anchor = definition.anchor
        at_anchor = signals_of(anchor) if isinstance(anchor, Crossing) else set()
        return {definition.position, definition.velocity} | at_anchor
    return set()


_Angle = tuple[Series, Series]
"""Times, and an angle of one trial in rad, modulo 2 pi; section 0 lies at 0."""


def _from_angles(angles: Sequence[_Angle], n_sections: int) -> Phase:
    """Return the phase of all trials from angles. (The phase grows in the direction in which the
    angles go round.)"""
    rate = _turns_per_time(angles)
    backwards = 0
    total = 0
    stretches = []
    for time, angle in angles:
        longest = LONGEST_GAP / abs(rate)
        ends = np.flatnonzero(np.diff(time) > longest) + 1
        of_trial = []
        for part in np.split(np.arange(len(time)), ends):
            unwrapped = np.unwrap(angle[part])
            phase = np.sign(rate) * unwrapped / (2 * np.pi)
            from_below = np.maximum.accumulate(phase)
            from_above = np.minimum.accumulate(phase[::-1])[::-1]
            mean = (from_below + from_above) / 2
            rising = np.diff(mean, prepend=-np.inf) > 1e-12  # more than rounding
            if len(part) < FEWEST or rising.sum() < 2:
                continue
            backwards += int((np.diff(phase) < 0).sum())
            total += len(part)
            t = time[part]
            unseen = gaps(t, bridgeable(t))[1:-1]
            of_trial.append(
                Winding(
                    time=t[rising],
                    phase=mean[rising],
                    linear=False,
                    gaps=unseen,
                )
            )
        stretches.append(tuple(of_trial))
    return Phase(
        tuple(stretches), n_sections=n_sections, backwards=backwards / max(total, 1)
    )


def _angles(
    recording: Recording,
    family: KinematicPhase,
    bandwidth: float | None,
) -> list[_Angle]:
    """Return the angle of two signals about a center in each trial; `bandwidth` of the splines in
    Hz."""
    position = recording.samples(family.position)
    velocity = recording.samples(family.velocity)
    center, scale = _plane(recording, family)
    samples = []
    for (trial, x), (_, v) in zip(position, velocity, strict=True):
        columns = np.stack([without_spikes(x), without_spikes(v)], axis=1)
        signals = _at_common_times(trial.time, columns)
        both = np.isfinite(signals).all(axis=1)
        if both.sum() < FEWEST:
            raise DefinitionError(
                f"trial '{trial.name}' has {int(both.sum())} samples of {family.position} and "
                f"{family.velocity}: too few: leave it out."
            )
        samples.append((trial.time[both], (signals[both] - center) / scale))
    anchor = family.anchor
    first = 0.0 if isinstance(anchor, Crossing) else float(anchor)

    def angle_of(x: Series, v: Series) -> Series:
        start = np.exp(-1j * first)
        return np.angle((x + 1j * v) * start)

    rate = abs(_turns_per_time([(time, angle_of(*z.T)) for time, z in samples]))
    bandwidth = bandwidth or HARMONICS * rate
    require_passing(bandwidth, rate)
    angles = []
    for time, z in samples:
        smooth = [spline(time, x, bandwidth)(time) for x in z.T]
        angles.append((time, angle_of(*smooth)))
    if isinstance(anchor, Crossing):
        at_anchor = _angle_at(recording, anchor, bandwidth, angles)
        relative = []
        for time, a in angles:
            difference = np.exp(1j * (a - at_anchor))
            relative.append((time, np.angle(difference)))
        angles = relative
    return angles


def _at_common_times(
    time: Series,
    signals: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """Interpolate two signals with different sampling times, each at the times of the other one,
    but not in gaps."""
    finite = np.isfinite(signals)
    fewest = finite.sum(axis=0).min()
    if finite.all(axis=1).sum() > fewest / 2 or fewest < FEWEST:
        return signals
    signals = signals.copy()
    for k, mine in enumerate(finite.T):
        holes = gaps(time[mine], bridgeable(time[mine]))
        missing = finite.any(axis=1) & ~mine & ~inside(holes, time, time)
        curve = spline(time, signals[:, k], np.inf)
        signals[missing, k] = curve(time[missing])
    return signals


def _plane(
    recording: Recording,
    family: KinematicPhase,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return center and scale, by default from the middle 98 % of the signals over all trials."""
    limits = []
    for name in (family.position, family.velocity):
        finite = [x[np.isfinite(x)] for _, x in recording.samples(name)]
        values = np.concatenate(finite)
        if not len(values):
            raise DefinitionError(
                f"{name} is missing at every sample: define the phase by others."
            )
        low, high = np.quantile(values, [0.01, 0.99])
        if family.scale is None and low == high:
            raise DefinitionError(
                f"{name} is constant: define the phase by a signal that varies."
            )
        limits.append((low, high))
    low, high = np.transpose(limits)
    center = (low + high) / 2
    scale = (high - low) / 2
    if family.center is not None:
        center = np.asarray(family.center)
    if family.scale is not None:
        scale = np.asarray(family.scale)
    return center, scale


def _angle_at(
    recording: Recording,
    crossing: Crossing,
    bandwidth: float,
    angles: Sequence[_Angle],
) -> float:
    """Return the mean angle at which a signal crosses a level."""
    name = str(crossing)
    crossed = []
    marked = recording.mark(name, crossing, bandwidth=bandwidth)
    for trial, (time, angle) in zip(marked.trials, angles, strict=True):
        at = trial.events[name]
        at = at[(at >= time[0]) & (at <= time[-1])]
        crossed.append(np.interp(at, time, np.unwrap(angle)))
    mean = np.exp(1j * np.concatenate(crossed)).mean()
    if not abs(mean) > 0.5:
        raise DefinitionError(
            f"{name}, the anchor of section 0, happens all around the cycle: choose a crossing "
            "that comes once in each."
        )
    return float(np.angle(mean))


def _turns_per_time(angles: Sequence[_Angle]) -> float:
    """Return the signed rate. **Raises:** `DefinitionError` if the angle does not wind twice."""
    unwrapped = [np.unwrap(a) for _, a in angles]
    advance = sum(float(a[-1] - a[0]) for a in unwrapped)
    turns = advance / (2 * np.pi)
    span = sum(float(t[-1] - t[0]) for t, _ in angles)
    if abs(turns) < 2:
        raise DefinitionError(
            f"the phase does not wind: {turns:.2g} turns in {span:.4g}; the center must lie within "
            "the loop of the signals, and two cycles are needed."
        )
    return turns / span


def _from_events(recording: Recording, name: str) -> Phase:
    """Return a phase with one cycle per event."""
    times = []
    for trial in recording.trials:
        if name not in trial.events and name in recording.signals:
            raise DefinitionError(
                f"'{name}' is a signal, not an event: `hj.Crossing('{name}', 'falling')` marks the "
                "beginning of cycles."
            )
        require_among("event", [name], trial.events, f"trial '{trial.name}': ")
        times.append(trial.events[name])
    intervals = np.concatenate([np.diff(t) for t in times])
    if len(intervals) < 2:
        raise DefinitionError(
            f"two cycles need three events '{name}' in a trial: record more."
        )
    usual = _Rhythm(_period(intervals), doubled=0.5, missed=1.5)
    dropped = 0
    missed = 0
    stretches = []
    for trial, t in zip(recording.trials, times, strict=True):
        intervals = np.diff(t)
        is_long = (intervals > usual.period / 4).sum() >= _ENOUGH
        rhythm = _rhythm(intervals) if is_long else usual
        kept = _without_doubled(t, rhythm.doubled * rhythm.period)
        dropped += len(t) - len(kept)
        pauses = gaps(trial.time, bridgeable(trial.time, LONGEST_GAP * rhythm.period))
        lengths = np.diff(kept) / rhythm.period
        is_wide = lengths > rhythm.missed
        is_wide |= inside(pauses, kept[:-1], kept[1:])
        wide = np.flatnonzero(is_wide)
        missed += sum(max(round(float(length)), 1) for length in lengths[wide])
        parts = np.split(kept, wide + 1)
        stretches.append(
            tuple(
                Winding(part, np.arange(len(part), dtype=float), True)
                for part in parts
                if len(part) > 1
            )
        )
    return Phase(tuple(stretches), dropped=dropped, missed=missed, lead=1)


def _without_doubled(events: Series, shortest: float) -> Series:
    """Return events that follow the one before by `shortest` or more."""
    kept: list[float] = []
    for t in events:
        if not kept or t - kept[-1] >= shortest:
            kept.append(t)
    return np.array(kept)


class _Rhythm(NamedTuple):
    """The period of a trial and, in periods, the limits of doubled and missed events."""

    period: float
    doubled: float
    missed: float


def _rhythm(intervals: Series) -> _Rhythm:
    """Return the rhythm of a trial.

    Irregular rhythms have intervals of many lengths. The limits therefore lie at the first gap in
    the distribution of intervals on either side of the median. (A gap is 0.25 periods wide above
    the median, and 0.1 below.)
    """
    period = _period(intervals)
    length = np.sort(intervals / period)
    middle = int(np.searchsorted(length, 1.0))
    longer = length[middle:]
    shorter = length[middle::-1]
    longest = longer[np.argmax(np.diff(longer, append=np.inf) > 0.25)]
    falls = np.diff(shorter, append=-np.inf) < -0.1
    shortest = shorter[np.argmax(falls)]
    missed = max(1.5, 1.01 * float(longest))
    doubled = min(0.5, 0.99 * float(shortest))
    if (length > missed).mean() > _COMMON:
        missed = np.inf
    if (length < doubled).mean() > 2 * _COMMON:
        doubled = 0.5  # most events are doubled
    return _Rhythm(period, doubled, missed)


def _period(intervals: Series) -> float:
    """Return the median of the intervals, without the short ones that doubled events cause. An
    interval is short if it is less than a quarter of a typical one. (Half of the time is spent in
    intervals shorter than the typical one.)"""
    ascending = np.sort(intervals)
    spent = np.cumsum(ascending)
    usual = ascending[np.searchsorted(spent, spent[-1] / 2)]
    return float(np.median(intervals[intervals > usual / 4]))
