"""Where in its cycle a recorded system is: phase from an angle, from events, or a function."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from ..errors import DefinitionError
from .recording import Recording, Trial
from .smoothing import FEWEST, spline
from .tracker import track


_BREAK = 0.25  # of a cycle: the turns in a longer gap cannot be counted
_HARMONICS = 32  # bandwidth of the angle's signals, in cycles per cycle
_OF_CROSSINGS = 16  # and of a signal whose crossings are taken
_SLOWEST = 0.1  # cycles that a causal phase goes on until the next event, at least
_TAILS = 0.01  # of the samples at either end, which say nothing of the range


Number = int | float
Pair = tuple[Number, Number]


class AnglePhase(eqx.Module):
    """Phase as the angle of two signals, a position and its velocity, say, around a center.

    The angle of `(position - o_p) / s_p + i (velocity - o_v) / s_v`, counted in the sense in which
    it turns. Section 0 lies at `start`. At its sections the two signals are two sides of one
    number: as outputs they tell less than at those of a `CrossingPhase`.

    **Fields:**

    - `position`, `velocity`: names of signals.
    - `center` (o_p, o_v), `scale` (s_p, s_v): by default the middle of each signal's range and
      half of its width, over all trials.
    - `start`: angle of section 0 in rad; at 0 the velocity is that of the center, and the position
      is beyond it.
    - `bandwidth`: of the splines through the signals, in Hz; by default 32 harmonics of the cycle.
    """

    position: str = eqx.field(static=True)
    velocity: str = eqx.field(static=True)
    center: Pair | None = None
    scale: Pair | None = None
    start: Number = 0.0
    bandwidth: Number | None = None


class EventPhase(eqx.Module):
    """Phase that grows by one from each event to the next, linearly in between.

    Since it depends on the event that comes next, so do the outputs sampled at it. Events that
    follow the one before by less than half of the median period are taken for doubled and left
    out; where an interval is longer than 1.5 median periods one was missed, and these cycles are
    left out.

    **Fields:** `event`: its name.
    """

    event: str = eqx.field(static=True)


class CrossingPhase(eqx.Module):
    """Phase that grows by one from each crossing of a level to the next, linearly in between.

    What an `EventPhase` makes of the events that `Recording.mark` finds. The signal should cross
    the level once in each cycle in this direction, and fast: at mid-stance, at the apex.

    **Fields:**

    - `signal`: its name. `direction`: "rising" or "falling". `level`: in the signal's unit.
    - `bandwidth`: of the spline through the signal, in Hz; by default 16 harmonics of the cycle.
    """

    signal: str = eqx.field(static=True)
    direction: Literal["rising", "falling"] = eqx.field(static=True, default="rising")
    level: Number = 0.0
    bandwidth: Number | None = None

    def __check_init__(self):
        if self.direction not in ("rising", "falling"):
            raise DefinitionError(
                f"a CrossingPhase has direction {self.direction!r}; say 'rising' or 'falling'."
            )


class Winding(eqx.Module):
    """The phase of one stretch of a trial.

    **Fields:** `time` (n,), `phase` (n,) in cycles: both strictly increasing. `linear`: whether
    the phase is linear in between, or smooth.
    """

    time: Float[np.ndarray, " n"]
    phase: Float[np.ndarray, " n"]
    linear: bool = eqx.field(static=True)

    def when(self, phase: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """The times at which the phase has these values, by inverse interpolation."""
        if self.linear:
            return np.interp(phase, self.phase, self.time)
        return PchipInterpolator(self.phase, self.time)(phase)


class Phase(eqx.Module):
    """The phase of all trials of a recording, as `estimate_phase` finds it.

    **Fields:**

    - `stretches`: for each trial, the stretches that are not interrupted.
    - `periods`: for each trial, the durations of its cycles. `period`: their median.
    - `backwards`: the share of samples at which the angle ran backwards (noise).
    - `dropped`: events taken for doubled; `missed`: cycles left out since an event was missed.
    - `lead`: how many cycles the phase looks ahead.
    """

    stretches: tuple[tuple[Winding, ...], ...]
    periods: tuple[Float[np.ndarray, " _"], ...]
    period: float = eqx.field(static=True)
    backwards: float = eqx.field(static=True)
    dropped: int = eqx.field(static=True)
    missed: int = eqx.field(static=True)
    lead: int = eqx.field(static=True)

    @property
    def cycles(self) -> int:
        """The number of whole cycles."""
        return sum(len(p) for p in self.periods)

    @property
    def drift(self) -> float:
        """Change of the period per cycle, relative to it: a straight line through each trial."""
        slopes, weights = [], []
        for p in self.periods:
            k = np.arange(len(p)) - (len(p) - 1) / 2
            if len(p) > 2:
                slopes.append(float(k @ p / (k @ k)))
                weights.append(float(k @ k))
        return float(np.average(slopes, weights=weights)) / self.period if slopes else 0.0

    @property
    def jitter(self) -> float:
        """Standard deviation of the periods of each trial about their line, relative to them."""
        rest, freedom = 0.0, 0
        for p in self.periods:
            if len(p) > 2:
                k = np.arange(len(p))
                rest += float(((p - np.polyval(np.polyfit(k, p, 1), k)) ** 2).sum())
                freedom += len(p) - 2
        return float(np.sqrt(rest / freedom)) / self.period if freedom else 0.0

    def __repr__(self) -> str:
        notes = ""
        if self.backwards:
            notes += f"; {100 * self.backwards:.2g} % of samples ran backwards"
        if self.dropped:
            notes += f"; {self.dropped} doubled events left out"
        if self.missed:
            notes += f"; {self.missed} cycles with missed events left out"
        pieces = sum(len(s) for s in self.stretches)
        return (
            f"Phase({self.cycles} cycles in {pieces} stretches of {len(self.stretches)} trials; "
            f"period {self.period:.6g}, jitter {100 * self.jitter:.2g} %, drift "
            f"{100 * self.drift:.2g} % per cycle{notes})"
        )


Definition = (
    AnglePhase | CrossingPhase | EventPhase | Callable[[np.ndarray, Mapping[str, np.ndarray]], Any]
)


def estimate_phase(recording: Recording, definition: Definition, *, causal: bool = False) -> Phase:
    """The phase of every trial.

    **Arguments:**

    - `definition`: an `AnglePhase`, a `CrossingPhase`, an `EventPhase`, or a function of the times
      (n,) and the signals by name, that returns an angle (n,) in rad, with or without its whole
      turns, NaN where it is not known.
    - `causal`: from the past only, as hardware in real time would find it: an angle by a
      `PhaseTracker`; from events by the duration of the last cycle, which remembers three cycles
      (fit it with `overhang=2 * sections`).

    Angles that run backwards in noise are replaced by the mean of the two monotone envelopes, one
    from below and one from above. Stretches end at gaps longer than a quarter of a cycle.

    **Raises:** `DefinitionError` for signals or events that are not there, a phase that does not
    wind, or a recording of less than two cycles.
    """
    if isinstance(definition, CrossingPhase):
        return _from_events(*_marked(recording, definition), causal)
    if isinstance(definition, EventPhase):
        return _from_events(recording, definition, causal)
    if isinstance(definition, AnglePhase):
        angles = _angles(recording, definition, smooth=not causal)
    else:
        angles = [_from_function(recording, trial, definition) for trial in recording.trials]
    rate = _turns_per_time(angles)
    backwards, total, stretches = 0, 0, []
    for time, angle in angles:
        parts = []
        edges = np.flatnonzero(np.diff(time) > _BREAK / abs(rate)) + 1
        for part in np.split(np.arange(len(time)), edges):
            if len(part) < FEWEST:
                continue
            phase = np.sign(rate) * np.unwrap(angle[part]) / (2 * np.pi)
            if causal:
                phase = track(time[part], angle[part], rate)
            backwards += int((np.diff(phase) < 0).sum())
            total += len(part)
            if (winding := _monotone(time[part], phase)) is not None:
                parts.append(winding)
        stretches.append(tuple(parts))
    return _phase(stretches, backwards / max(total, 1))


def _angles(recording: Recording, definition: AnglePhase, smooth: bool):
    """Times and angles, modulo whole turns, of each trial."""
    columns = [recording.column(x) for x in (definition.position, definition.velocity)]
    everything = np.concatenate([t.values[:, columns] for t in recording.trials])
    seen = np.isfinite(everything).all(axis=0)
    if not np.isfinite(everything).any(axis=0).all():
        gone = (definition.position, definition.velocity)[int(np.argmin(seen))]
        raise DefinitionError(f"{gone} is missing at every sample.")
    low, high = np.nanquantile(everything, [_TAILS, 1 - _TAILS], axis=0)
    center = (low + high) / 2 if definition.center is None else np.asarray(definition.center)
    scale = (high - low) / 2 if definition.scale is None else np.asarray(definition.scale)
    if not (scale > 0).all():
        bad = (definition.position, definition.velocity)[int(np.argmin(scale))]
        raise DefinitionError(
            f"the phase needs a {bad} that varies, but its scale is {min(scale)}."
        )

    def angle(z):
        return np.angle((z[:, 0] + 1j * z[:, 1]) * np.exp(-1j * definition.start))

    found = []
    for trial in recording.trials:
        both = np.isfinite(trial.values[:, columns]).all(axis=1)
        if both.sum() < FEWEST:
            raise DefinitionError(
                f"trial '{trial.name}' has {int(both.sum())} samples of {definition.position} and "
                f"{definition.velocity}: too few for a phase."
            )
        found.append((trial.time[both], (trial.values[both][:, columns] - center) / scale))
    rough = [(time, angle(z)) for time, z in found]
    rate = abs(_turns_per_time(rough))
    if not smooth:
        return rough
    bandwidth = definition.bandwidth or _HARMONICS * rate
    return [
        (time, angle(np.stack([spline(time, x, bandwidth).values for x in z.T], axis=1)))
        for time, z in found
    ]


def _from_function(recording: Recording, trial: Trial, function):
    signals = dict(zip(recording.signals, trial.values.T, strict=True))
    angle = np.asarray(function(trial.time, signals), float)
    if angle.shape != trial.time.shape:
        raise DefinitionError(
            f"the phase function returned the shape {angle.shape} for {len(trial.time)} samples of "
            f"trial '{trial.name}'."
        )
    known = np.isfinite(angle)
    return trial.time[known], angle[known]


def _turns_per_time(angles) -> float:
    """Signed. **Raises:** `DefinitionError` if the angle does not wind."""
    turns = sum(float(np.unwrap(a)[-1] - a[0]) for _, a in angles if len(a)) / (2 * np.pi)
    duration = sum(float(t[-1] - t[0]) for t, _ in angles if len(t))
    if abs(turns) < 2:
        raise DefinitionError(
            f"the phase does not wind: {abs(turns):.2g} turns in {duration:.4g}; the center must "
            "lie within the loop of the two signals, and two cycles or more are needed."
        )
    return turns / duration


def _monotone(time, phase) -> Winding | None:
    low = np.maximum.accumulate(phase)
    high = np.minimum.accumulate(phase[::-1])[::-1]
    phase = (low + high) / 2
    rising = np.concatenate([[True], np.diff(phase) > 1e-12])
    if rising.sum() < 2:
        return None
    return Winding(time[rising], phase[rising], linear=False)


def _marked(recording: Recording, definition: CrossingPhase) -> tuple[Recording, EventPhase]:
    signal, about = definition.signal, {}
    about["level"], about["direction"] = definition.level, definition.direction
    event = f"{signal} {definition.direction}"
    bandwidth = definition.bandwidth
    if bandwidth is None:  # noise makes the crossings of the samples themselves more
        rough = _from_events(recording.mark(event, signal, **about), EventPhase(event), False)
        bandwidth = _OF_CROSSINGS / rough.period
    return recording.mark(event, signal, **about, bandwidth=bandwidth), EventPhase(event)


def _from_events(recording: Recording, definition: EventPhase, causal: bool) -> Phase:
    name, times = definition.event, []
    for trial in recording.trials:
        if name not in trial.events:
            there = ", ".join(trial.events) or "none"
            raise DefinitionError(
                f"trial '{trial.name}' has no event '{name}'; its events are: {there}."
            )
        times.append(trial.events[name])
    intervals = np.concatenate([np.diff(t) for t in times])
    if len(intervals) < 2:
        raise DefinitionError(f"there are too few events '{name}' for two cycles.")
    dropped, kept = 0, []
    # Doubled events make short intervals, missed ones long ones: both leave the median alone
    # once those shorter than a quarter of it are out.
    period = float(np.median(intervals))
    period = float(np.median(intervals[intervals > period / 4]))
    for t in times:
        good = []
        for x in t:
            if good and x - good[-1] < period / 2:
                dropped += 1
            else:
                good.append(x)
        kept.append(np.array(good))
    missed, stretches = 0, []
    for t in kept:
        wide = np.flatnonzero(np.diff(t) > 1.5 * period) + 1
        missed += sum(round(float(t[k] - t[k - 1]) / period) for k in wide)
        parts = [part for part in np.split(t, wide) if len(part) > 1]
        if causal:
            stretches.append(tuple(_extrapolated(p) for p in parts if len(p) > 2))
        else:
            stretches.append(tuple(Winding(p, np.arange(len(p), dtype=float), True) for p in parts))
    return _phase(stretches, 0.0, dropped, missed, lead=0 if causal else 1)


def _extrapolated(t: Float[np.ndarray, " n"]) -> Winding:
    """In each cycle the rate that would make the phase right at the next event, if that comes after
    as long a time as the last one did."""
    phase = [1.0]
    for k, (before, own) in enumerate(zip(np.diff(t[:-1]), np.diff(t[1:]), strict=True), 1):
        phase.append(phase[-1] + max(k + 1 - phase[-1], _SLOWEST) * own / before)
    return Winding(t[1:], np.array(phase), True)


def _phase(stretches, backwards, dropped=0, missed=0, lead=0) -> Phase:
    periods = []
    for parts in stretches:
        each = [np.zeros(0)]
        for part in parts:
            whole = np.arange(np.ceil(part.phase[0]), np.floor(part.phase[-1]) + 1)
            each.append(np.diff(part.when(whole)))
        periods.append(np.concatenate(each))
    everything = np.concatenate(periods)
    if len(everything) < 2:
        raise DefinitionError(
            f"the recording holds {len(everything)} whole cycles; at least two are needed to "
            "speak of a period."
        )
    return Phase(
        tuple(stretches),
        tuple(periods),
        float(np.median(everything)),
        backwards,
        dropped,
        missed,
        lead,
    )
