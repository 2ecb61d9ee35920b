"""Phase as an angle that winds."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from ...orbits.crossing import Crossing
from ...sections.families import KinematicPhase
from ..recording import Recording
from ..smoothing import FEWEST, bridgeable, gaps, inside, spline
from ..spikes import without_spikes
from .tracker import track
from .winding import LONGEST_GAP, Phase, Winding


AngleFunction = Callable[[Float[np.ndarray, " n"], Mapping[str, Float[np.ndarray, " n"]]], Any]

# Bandwidth of the two signals, in cycles per cycle. Doubled: the phase is sharper and noisier.
_ANGLE_HARMONICS = 32
# The share of the samples at either end that says nothing of a signal's range. Doubled: outliers
# matter less, center and scale move by little.
_TAIL = 0.01
# Turns that a phase must make. Doubled: recordings of up to four cycles are refused.
_FEWEST_TURNS = 2
# Of 1, the length of the mean of unit vectors at the angles where the anchor is crossed. Doubled:
# all crossings must lie at one angle but for rounding.
_ANCHOR_UNITY = 0.5
# Of two signals, the share of samples at common times, up to which they have clocks of their own.
# (Not to be doubled: it would be all of them.)
_APART = 0.5
# Growth of the phase, in cycles, that counts as growth. Doubled: nothing changes, this is rounding.
_GROWTH = 1e-12


class Angle(NamedTuple):
    """An angle of one trial, modulo whole turns."""

    time: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " n"]
    """In rad; section 0 lies at 0."""


def from_angles(angles: Sequence[Angle], n_sections: int | None, causal: bool) -> Phase:
    """The phase of all trials: their angles in the sense in which they turn.

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
                phase = track(time[part], angle[part], rate)
            backwards += int((np.diff(phase) < 0).sum())
            total += len(part)
            if (winding := _monotone(time[part], phase)) is not None:
                parts.append(winding)
        stretches.append(tuple(parts))
    return Phase(stretches, n_sections=n_sections, backwards=backwards / max(total, 1))


def kinematic_angles(
    recording: Recording, family: KinematicPhase, bandwidth: float | None, smooth: bool
) -> list[Angle]:
    """The angle of two signals about a center, in each trial; `bandwidth` of the splines in Hz."""
    names = family.position, family.velocity
    columns = [recording.column(x) for x in names]
    center, scale = _plane(recording, family)
    samples = []
    for trial in recording.trials:
        signals = np.stack([without_spikes(trial.values[:, k]) for k in columns], axis=1)
        signals = _brought_together(trial.time, signals)
        both = np.isfinite(signals).all(axis=1)
        if both.sum() < FEWEST:
            raise DefinitionError(
                f"trial '{trial.name}' has {int(both.sum())} samples of {names[0]} and "
                f"{names[1]}: too few for a phase."
            )
        samples.append((trial.time[both], (signals[both] - center) / scale))
    anchor = family.anchor
    first = 0.0 if isinstance(anchor, Crossing) else float(anchor)
    angles = [Angle(time, _angle(z, first)) for time, z in samples]
    rate = abs(_turns_per_time(angles))
    bandwidth = bandwidth or _ANGLE_HARMONICS * rate
    if smooth:
        angles = []
        for time, z in samples:
            z = np.stack([spline(time, x, bandwidth).values for x in z.T], axis=1)
            angles.append(Angle(time, _angle(z, first)))
    if not isinstance(anchor, Crossing):
        return angles
    first = _angle_at(recording, anchor, bandwidth, angles)
    return [Angle(time, np.angle(np.exp(1j * (angle - first)))) for time, angle in angles]


def _brought_together(
    time: Float[np.ndarray, " n"], signals: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Of two signals that were hardly ever sampled at the same times, each also where the other one
    was, by interpolation; not in gaps."""
    seen = np.isfinite(signals)
    if seen.all(axis=1).sum() > _APART * seen.sum(axis=0).min() or seen.sum(axis=0).min() < FEWEST:
        return signals
    signals = signals.copy()
    for k, known in enumerate(seen.T):
        holes = gaps(time, known, bridgeable(time, known))
        at = seen.any(axis=1) & ~known & ~inside(holes, time, time)
        signals[at, k] = spline(time, signals[:, k], np.inf)(time[at])
    return signals


def function_angles(recording: Recording, function: AngleFunction) -> list[Angle]:
    """What a function of times and signals returns for each trial, where it is known."""
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
    """Center and scale, from the ranges of the signals over all trials where they are not given."""
    names = family.position, family.velocity
    columns = [recording.column(x) for x in names]
    everything = np.concatenate([t.values[:, columns] for t in recording.trials])
    seen = np.isfinite(everything).all(axis=0)
    if not np.isfinite(everything).any(axis=0).all():
        raise DefinitionError(f"{names[int(np.argmin(seen))]} is missing at every sample.")
    low, high = np.nanquantile(everything, [_TAIL, 1 - _TAIL], axis=0)
    center = (low + high) / 2 if family.center is None else np.asarray(family.center)
    scale = (high - low) / 2 if family.scale is None else np.asarray(family.scale)
    if not (scale > 0).all():
        raise DefinitionError(
            f"the phase needs a {names[int(np.argmin(scale))]} that varies, but its scale is "
            f"{min(scale)}."
        )
    return center, scale


def _angle(z: Float[np.ndarray, "n 2"], first: float) -> Float[np.ndarray, " n"]:
    return np.angle((z[:, 0] + 1j * z[:, 1]) * np.exp(-1j * first))


def _angle_at(
    recording: Recording, crossing: Crossing, bandwidth: float, angles: Sequence[Angle]
) -> float:
    """The mean angle at which a signal crosses a level."""
    name, found = str(crossing), []
    marked = recording.mark(name, crossing, bandwidth=bandwidth)
    for trial, (time, angle) in zip(marked.trials, angles, strict=True):
        at = trial.events[name]
        at = at[(at >= time[0]) & (at <= time[-1])]
        found.append(np.interp(at, time, np.unwrap(angle)))
    mean = np.exp(1j * np.concatenate(found)).mean()
    if not abs(mean) > _ANCHOR_UNITY:
        raise DefinitionError(
            f"{name}, the anchor of section 0, happens all around the cycle: choose a crossing "
            "that comes once in each."
        )
    return float(np.angle(mean))


def _turns_per_time(angles: Sequence[Angle]) -> float:
    """Signed. **Raises:** `DefinitionError` if the angle does not wind."""
    turns = sum(float(np.unwrap(a)[-1] - a[0]) for _, a in angles if len(a)) / (2 * np.pi)
    duration = sum(float(t[-1] - t[0]) for t, _ in angles if len(t))
    if abs(turns) < _FEWEST_TURNS:
        raise DefinitionError(
            f"the phase does not wind: {abs(turns):.2g} turns in {duration:.4g}; the center must "
            "lie within the loop of the two signals, and two cycles or more are needed."
        )
    return turns / duration


def _monotone(time: Float[np.ndarray, " n"], phase: Float[np.ndarray, " n"]) -> Winding | None:
    seen = np.isfinite(time)
    unseen = gaps(time, seen, bridgeable(time, seen))[1:-1]
    low = np.maximum.accumulate(phase)
    high = np.minimum.accumulate(phase[::-1])[::-1]
    phase = (low + high) / 2
    rising = np.concatenate([[True], np.diff(phase) > _GROWTH])
    if rising.sum() < 2:
        return None
    return Winding(time[rising], phase[rising], linear=False, gaps=unseen)
