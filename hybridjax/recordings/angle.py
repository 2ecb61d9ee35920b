"""Phase as an angle that winds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError
from ..orbits.crossing import Crossing
from ..sections.families import KinematicPhase
from .phase import LONGEST_GAP, Phase, Winding
from .recording import Recording
from .smoothing import FEWEST, Series, bridgeable, gaps, inside, spline, without_spikes


# Default bandwidth of the two signals of an angle, in harmonics of the cycle. Larger: the phase is
# noisier. Smaller: fast parts of the cycle, such as impacts, are smeared.
_ANGLE_HARMONICS = 32
# Least length of the mean of unit vectors at the angles where the anchor is crossed. Larger: an
# anchor that jitters is rejected. Smaller: one that happens anywhere in the cycle is accepted.
_UNITY = 0.5


class Angle(NamedTuple):
    """An angle of one trial in rad, modulo whole turns; section 0 lies at 0."""

    time: Series
    angle: Series


def from_angles(angles: Sequence[Angle], n_sections: int) -> Phase:
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
            backwards += int((np.diff(phase) < 0).sum())
            total += len(part)
            if (winding := _monotone(time[part], phase)) is not None:
                parts.append(winding)
        stretches.append(parts)
    return Phase(stretches, n_sections=n_sections, backwards=backwards / max(total, 1))


def kinematic_angles(
    recording: Recording, family: KinematicPhase, bandwidth: float | None
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

    turn = np.exp(-1j * first)

    def angle_of(time: np.ndarray, z: np.ndarray) -> Angle:
        return Angle(time, np.angle((z[:, 0] + 1j * z[:, 1]) * turn))

    rate = abs(_turns_per_time([angle_of(*sample) for sample in samples]))
    bandwidth = bandwidth or _ANGLE_HARMONICS * rate
    angles = []
    for time, z in samples:
        smooth = [spline(time, x, bandwidth).values for x in z.T]
        angles.append(angle_of(time, np.stack(smooth, axis=1)))
    if isinstance(anchor, Crossing):
        first = _angle_at(recording, anchor, bandwidth, angles)
        angles = [Angle(time, np.angle(np.exp(1j * (angle - first)))) for time, angle in angles]
    return angles


def _at_common_times(time: Series, signals: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Interpolate two signals with clocks of their own, each at the times of the other, not in
    gaps."""
    finite = np.isfinite(signals)
    fewest = finite.sum(axis=0).min()
    if finite.all(axis=1).sum() > fewest / 2 or fewest < FEWEST:
        return signals
    signals = signals.copy()
    for k, mine in enumerate(finite.T):
        holes = gaps(time, mine, bridgeable(time, mine))
        at = finite.any(axis=1) & ~mine & ~inside(holes, time, time)
        signals[at, k] = spline(time, signals[:, k], np.inf)(time[at])
    return signals


def _plane(
    recording: Recording, family: KinematicPhase
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return center and scale, by default from the middle 98 % of the signals over all trials."""
    names = family.position, family.velocity
    columns = [recording.column(x) for x in names]
    values = np.concatenate([t.values[:, columns] for t in recording.trials])
    finite = np.isfinite(values).any(axis=0)
    if not finite.all():
        raise DefinitionError(f"{names[int(np.argmin(finite))]} is missing at every sample.")
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


def _monotone(time: Series, phase: Series) -> Winding | None:
    finite = np.isfinite(time)
    unseen = gaps(time, finite, bridgeable(time, finite))[1:-1]
    low = np.maximum.accumulate(phase)
    high = np.minimum.accumulate(phase[::-1])[::-1]
    phase = (low + high) / 2
    rising = np.concatenate([[True], np.diff(phase) > 1e-12])  # more than rounding
    return Winding(time[rising], phase[rising], False, unseen) if rising.sum() > 1 else None
