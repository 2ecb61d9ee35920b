"""Phase as an angle that winds, from whole recordings and sample by sample."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive
from .._core.boundary.values import Number
from ..errors import DefinitionError
from ..orbits.crossing import Crossing
from ..sections.families import KinematicPhase
from .phase import LONGEST_GAP, Phase, Winding
from .recording import Recording
from .smoothing import FEWEST, bridgeable, gaps, inside, spline, without_spikes


AngleFunction = Callable[[Float[np.ndarray, " n"], Mapping[str, Float[np.ndarray, " n"]]], Any]
Sample = Annotated[float, Number("a finite number or NaN", missing=True)]

# Default bandwidth of the two signals of an angle, in harmonics of the cycle. Larger: the phase is
# noisier. Smaller: fast parts of the cycle, such as impacts, are smeared.
_ANGLE_HARMONICS = 32
# Default bandwidth of the loop that tracks a phase, in harmonics of the cycle. Larger: more noise.
# Smaller: changes of the rate are followed late.
_LOOP_HARMONICS = 5
# Least length of the mean of unit vectors at the angles where the anchor is crossed. Larger: an
# anchor that jitters is rejected. Smaller: one that happens anywhere in the cycle is accepted.
_UNITY = 0.5


class Angle(NamedTuple):
    """An angle of one trial in rad, modulo whole turns; section 0 lies at 0."""

    time: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " n"]


def from_angles(angles: Sequence[Angle], n_sections: int | None, causal: bool) -> Phase:
    """Return the phase of all trials: their angles in the sense in which they turn.

    Where noise makes an angle run backwards, it is replaced by the mean of two monotone envelopes,
    one from below and one from above.
    """
    rate = _turns_per_time(angles)
    backwards, total, stretches = 0, 0, []
    for time, angle in angles:
        parts = []
        edges = np.flatnonzero(np.diff(time) > LONGEST_GAP / abs(rate)) + 1
        for part in np.split(np.arange(len(time)), edges):
            if len(part) < FEWEST:
                continue
            phase = np.sign(rate) * np.unwrap(angle[part]) / (2 * np.pi)
            if causal:
                tracker = PhaseTracker((0.0, 0.0), (1.0, 1.0), rate)
                x = np.column_stack([time[part], np.cos(angle[part]), np.sin(angle[part])])
                phase = np.array([tracker.update(*row) for row in x.tolist()], float)
            backwards += int((np.diff(phase) < 0).sum())
            total += len(part)
            if (winding := _monotone(time[part], phase)) is not None:
                parts.append(winding)
        stretches.append(parts)
    return Phase(stretches, n_sections=n_sections, backwards=backwards / max(total, 1))


def kinematic_angles(
    recording: Recording, family: KinematicPhase, bandwidth: float | None, smooth: bool
) -> list[Angle]:
    """Return the angle of two signals about a center in each trial; `bandwidth` of the splines in
    Hz."""
    names = family.position, family.velocity
    columns = [recording.column(x) for x in names]
    center, scale = _plane(recording, family)
    samples = []
    for trial in recording.trials:
        signals = np.stack([without_spikes(trial.values[:, k]) for k in columns], axis=1)
        signals = _at_common_times(trial.time, signals)
        both = np.isfinite(signals).all(axis=1)
        if both.sum() < FEWEST:
            raise DefinitionError(
                f"trial '{trial.name}' has {int(both.sum())} samples of {names[0]} and "
                f"{names[1]}: too few for a phase."
            )
        samples.append((trial.time[both], (signals[both] - center) / scale))
    anchor = family.anchor
    first = 0.0 if isinstance(anchor, Crossing) else float(anchor)

    def angles_of(samples) -> list[Angle]:
        turn = np.exp(-1j * first)
        return [Angle(time, np.angle((z[:, 0] + 1j * z[:, 1]) * turn)) for time, z in samples]

    angles = angles_of(samples)
    bandwidth = bandwidth or _ANGLE_HARMONICS * abs(_turns_per_time(angles))
    if smooth:
        angles = angles_of(
            (time, np.stack([spline(time, x, bandwidth).values for x in z.T], axis=1))
            for time, z in samples
        )
    if isinstance(anchor, Crossing):
        first = _angle_at(recording, anchor, bandwidth, angles)
        angles = [Angle(time, np.angle(np.exp(1j * (angle - first)))) for time, angle in angles]
    return angles


def _at_common_times(
    time: Float[np.ndarray, " n"], signals: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Interpolate two signals with clocks of their own, each at the times of the other, not in
    gaps."""
    known = np.isfinite(signals)
    fewest = known.sum(axis=0).min()
    if known.all(axis=1).sum() > fewest / 2 or fewest < FEWEST:
        return signals
    signals = signals.copy()
    for k, mine in enumerate(known.T):
        holes = gaps(time, mine, bridgeable(time, mine))
        at = known.any(axis=1) & ~mine & ~inside(holes, time, time)
        signals[at, k] = spline(time, signals[:, k], np.inf)(time[at])
    return signals


def function_angles(recording: Recording, function: AngleFunction) -> list[Angle]:
    """Return the finite values of a function of times and signals for each trial."""
    angles = []
    for trial in recording.trials:
        signals = dict(zip(recording.signals, trial.values.T, strict=True))
        angle = np.asarray(function(trial.time, signals))
        if angle.shape != trial.time.shape or angle.dtype.kind not in "fiu":
            raise DefinitionError(
                f"the phase function must return an angle for each of {len(trial.time)} samples of "
                f"trial '{trial.name}', not {angle.dtype} of shape {angle.shape}."
            )
        known = np.isfinite(angle)
        angles.append(Angle(trial.time[known], angle[known]))
    return angles


def _plane(
    recording: Recording, family: KinematicPhase
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return center and scale, by default from the middle 98 % of the signals over all trials."""
    names = family.position, family.velocity
    columns = [recording.column(x) for x in names]
    values = np.concatenate([t.values[:, columns] for t in recording.trials])
    known = np.isfinite(values).any(axis=0)
    if not known.all():
        raise DefinitionError(f"{names[int(np.argmin(known))]} is missing at every sample.")
    low, high = np.nanquantile(values, [0.01, 0.99], axis=0)
    center = (low + high) / 2 if family.center is None else np.asarray(family.center)
    scale = (high - low) / 2 if family.scale is None else np.asarray(family.scale)
    if not (scale > 0).all():
        raise DefinitionError(
            f"the phase needs a {names[int(np.argmin(scale))]} that varies, but its scale is "
            f"{min(scale)}."
        )
    return center, scale


def _angle_at(
    recording: Recording, crossing: Crossing, bandwidth: float, angles: Sequence[Angle]
) -> float:
    """Return the mean angle at which a signal crosses a level."""
    name, crossed = str(crossing), []
    marked = recording.mark(name, crossing, bandwidth=bandwidth)
    for trial, (time, angle) in zip(marked.trials, angles, strict=True):
        at = trial.events[name]
        at = at[(at >= time[0]) & (at <= time[-1])]
        crossed.append(np.interp(at, time, np.unwrap(angle)))
    mean = np.exp(1j * np.concatenate(crossed)).mean()
    if not abs(mean) > _UNITY:
        raise DefinitionError(
            f"{name}, the anchor of section 0, happens all around the cycle: choose a crossing "
            "that comes once in each."
        )
    return float(np.angle(mean))


def _turns_per_time(angles: Sequence[Angle]) -> float:
    """Return the signed rate. **Raises:** `DefinitionError` if the angle does not wind twice."""
    turns = sum(float(np.unwrap(a)[-1] - a[0]) for _, a in angles if len(a)) / (2 * np.pi)
    duration = sum(float(t[-1] - t[0]) for t, _ in angles if len(t))
    if abs(turns) < 2:
        raise DefinitionError(
            f"the phase does not wind: {abs(turns):.2g} turns in {duration:.4g}; the center must "
            "lie within the loop of the two signals, and two cycles or more are needed."
        )
    return turns / duration


def _monotone(time: Float[np.ndarray, " n"], phase: Float[np.ndarray, " n"]) -> Winding | None:
    known = np.isfinite(time)
    unseen = gaps(time, known, bridgeable(time, known))[1:-1]
    low = np.maximum.accumulate(phase)
    high = np.minimum.accumulate(phase[::-1])[::-1]
    phase = (low + high) / 2
    rising = np.concatenate([[True], np.diff(phase) > 1e-12])  # more than rounding
    return Winding(time[rising], phase[rising], False, unseen) if rising.sum() > 1 else None


@checked
class PhaseTracker:
    """Follows a phase sample by sample, for hardware that acts at phases.

    A phase-locked loop of second order: phase and rate are predicted, and corrected by the
    difference from the measured angle, critically damped. It follows a constant rate without
    lag, and never runs backwards. In a gap it continues at its rate.
    """

    def __init__(
        self,
        center: tuple[float, float],
        scale: tuple[Positive, Positive],
        rate: float,
        *,
        anchor: float = 0.0,
        bandwidth: Positive | None = None,
    ):
        """**Arguments:** `center`, `scale` and `anchor` (rad) as in `KinematicPhase`. `rate`:
        initial rate in cycles per second, negative if the angle decreases. `bandwidth`: bandwidth
        of the loop in Hz. Default: five times the rate.

        **Raises:** `DefinitionError` for a rate of zero.
        """
        if rate == 0:
            raise DefinitionError("`rate` must not be 0: a tracker needs to know the direction.")
        self.center, self.scale, self.anchor = center, scale, anchor
        self.sense = math.copysign(1.0, rate)
        self.rate = abs(rate)
        self.gain = 2 * math.pi * (_LOOP_HARMONICS * abs(rate) if bandwidth is None else bandwidth)
        self.time: float | None = None
        self.phase: float | None = None
        self._loop = 0.0

    def update(self, time: float, position: Sample, velocity: Sample) -> float | None:
        """Return the phase in cycles, counted from the first sample; NaN are skipped.

        **Returns:** None before the first finite sample.

        **Raises:** `DefinitionError` if time does not increase.
        """
        x = (position - self.center[0]) / self.scale[0]
        y = (velocity - self.center[1]) / self.scale[1]
        if math.isnan(x + y):
            return self.phase
        measured = self.sense * (math.atan2(y, x) - self.anchor) / (2 * math.pi)
        if self.time is None or self.phase is None:
            self.time, self.phase, self._loop = time, measured % 1.0, measured % 1.0
            return self.phase
        step = time - self.time
        if not step > 0:
            raise DefinitionError(f"time must grow from sample to sample; {time} came late.")
        ahead = self._loop + self.rate * step
        error = (measured - ahead + 0.5) % 1.0 - 0.5
        damp = math.exp(-self.gain * step)  # critically damped, for any step
        self._loop = ahead + (1 - damp * damp) * error
        self.rate += (1 - damp) ** 2 * error / step
        self.time, self.phase = time, max(self.phase, self._loop)
        return self.phase
