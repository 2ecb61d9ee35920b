r"""The phase model of an oscillator with a reset, from one event to the next.

$$\dot\varphi = w + Z(\varphi)\, I(t), \qquad \varphi = 0 \text{ at an event}, \quad
\text{the next one where } \varphi = 1.$$

The end of an interval depends on the input. So the equation is integrated until the phase is 1, and
not until the measured end, whose noise would enter the regressors. `estimation.py` and
`response.py` call `intervals_of` (data) and `forecast` (durations and their derivatives). Inputs
are given at half steps, as the Runge-Kutta method needs them, and the last of the derivatives is
the one by the rate: both must stay.

If durations are wrong, look at `_PhaseModel.integrate`; if a fit takes wrong steps, at
`_PhaseModel._derivatives`; if intervals are lost, at `_of_trial`, which leaves out those with gaps
of the input.

Noise in the rhythm spreads the phase: after a part $\varphi$ of the cycle its variance is $s^2
\varphi$, with s the standard deviation at the end. The curve averaged over that distribution acts
on the mean phase. Near the end of an interval, a part of this distribution lies beyond 1, where the
curve is continued by reflection. So the curve is a series of $\cos(\pi k \varphi)$, which need not
have the same value at 0 and at 1. The average over the distribution reduces term k by the factor
$\exp(-\pi^2 k^2 s^2 \varphi / 2)$.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.execution import on_all_cores
from ...errors import DefinitionError
from ..phase import Phase, Winding
from ..recording import Recording
from ..smoothing import bridgeable, gaps, inside


# Integration steps in a median interval of a trial. More: time. Fewer: errors of durations approach
# the jitter of fast curves.
_STEPS = 32
# Intervals that are integrated together. More: memory. Fewer: more calls of NumPy.
_CHUNK = 4096
# Number of points per cycle at which curves are tabulated, with linear interpolation. Tables end at
# 1.5 cycles, since the step in which an interval ends goes beyond 1. More: memory. Fewer: errors of
# the finest half wave (1e-5 at 1024 points).
_POINTS = 1024


Lanes = Float[np.ndarray, " l"]
Curve = Float[np.ndarray, " _"]
Nodes = Float[np.ndarray, "nodes l"]
Table = Float[np.ndarray, "M p"]
"""A basis of curves at equal steps of the phase from 0 on."""


class Intervals(NamedTuple):
    """All uninterrupted intervals between events of a recording, trial by trial."""

    start: Float[np.ndarray, " L"]
    """Start of each interval, in s."""
    duration: Float[np.ndarray, " L"]
    trial: Int[np.ndarray, " L"]
    """Index among the trials that have intervals."""
    step: Float[np.ndarray, " L"]
    """Step of integration, in s."""
    inputs: Float[np.ndarray, "nodes L"]
    """Inputs without their mean, at half steps since the start of each interval."""

    def sums(self, values: Float[np.ndarray, " L"]) -> Float[np.ndarray, " trials"]:
        """Return sums over each trial."""
        return np.bincount(self.trial, values)


def intervals_of(recording: Recording, phase: Phase, name: str) -> Intervals:
    """Return the intervals between events, with the input of that name. The input is linear between
    samples, and its mean in each trial is subtracted.

    **Raises:** `DefinitionError` for a phase that is an angle or has other trials, an input that is
    missing or constant, and too few intervals during which it is finite.
    """
    trials: list[Intervals] = []
    for trial, x, parts in phase.samples(recording, name):
        if not all(part.linear for part in parts):
            raise DefinitionError(
                "`sections` must be of events or a Crossing, not a KinematicPhase."
            )
        known = np.isfinite(x)
        if known.sum() < 2:
            raise DefinitionError(
                f"trial '{trial.name}' has no samples of {name}: leave it out."
            )
        found = _of_trial(trial.time[known], x[known], parts, len(trials))
        if found is not None:
            trials.append(found)
    if not trials:
        raise DefinitionError(f"{name} has no samples between two events: record both.")
    if not any(np.ptp(x.inputs) > 0 for x in trials):
        raise DefinitionError(
            f"the input {name} is constant: name the signal that acted."
        )
    return _joined(trials)


def _joined(trials: Sequence[Intervals]) -> Intervals:
    """Return the intervals of all trials. Inputs that end earlier keep their last value."""
    longest = max(len(x.inputs) for x in trials)
    inputs = [
        np.pad(x.inputs, ((0, longest - len(x.inputs)), (0, 0)), "edge") for x in trials
    ]
    return Intervals(
        start=np.concatenate([x.start for x in trials]),
        duration=np.concatenate([x.duration for x in trials]),
        trial=np.concatenate([x.trial for x in trials]),
        step=np.concatenate([x.step for x in trials]),
        inputs=np.concatenate(inputs, axis=1),
    )


def _of_trial(
    time: Lanes,
    x: Lanes,
    stretches: Sequence[Winding],
    number: int,
) -> Intervals | None:
    """Return those intervals of a trial during which its input x was sampled; None if there are
    none."""
    nothing = np.zeros(0)
    starts = [w.time[:-1] for w in stretches]
    durations = [np.diff(w.time) for w in stretches]
    start = np.concatenate([nothing, *starts])
    duration = np.concatenate([nothing, *durations])
    holes = gaps(time, bridgeable(time))
    # An interval may begin or end just where the input does.
    margin = 1e-9 * duration
    used = ~inside(holes, start + margin, start + duration - margin)
    if not used.any():
        return None
    start = start[used]
    duration = duration[used]
    step = float(np.median(duration)) / _STEPS
    steps = int(np.ceil(1.5 * duration.max() / step))
    numbers = np.arange(2 * steps + 1)[:, None]
    half_steps = numbers * step / 2
    # The phase advances evenly under the mean input.
    inputs = np.interp(start + half_steps, time, x - x.mean())
    trial = np.full(len(start), number)
    return Intervals(
        start=start,
        duration=duration,
        trial=trial,
        step=np.full(len(start), step),
        inputs=inputs,
    )


def basis(phase: Lanes, waves: int, jitter: float = 0.0) -> Table:
    """Return 1 and half waves cos(pi k phase), as they act on a phase with this jitter."""
    angle = np.pi * np.arange(waves + 1)
    variance = (jitter * angle) ** 2 / 2
    left_by_jitter = np.exp(-variance * phase[:, None])
    return np.cos(angle * phase[:, None]) * left_by_jitter


def tabulated(waves: int, jitter: float) -> Table:
    """Return the basis at equal steps of the phase from 0 on."""
    points = np.arange(3 * _POINTS // 2 + 1)
    return basis(points / _POINTS, waves, jitter)


class Forecast(NamedTuple):
    """Intervals of a phase model that begin at the measured events."""

    duration: Float[np.ndarray, " L"]
    rate: Float[np.ndarray, " L"]
    """Rate at which the phase reaches 1, in cycles per second."""
    slopes: Float[np.ndarray, "L p1"]
    """Derivatives of the durations with respect to the coefficients of the curve, and to the rate
    without input."""


def forecast(
    intervals: Intervals,
    table: Table,
    coefficients: Curve,
    rates: Curve,
) -> Forecast:
    """Return durations of all intervals, and their derivatives."""
    phase_model = _PhaseModel(table, coefficients)
    rate = rates[intervals.trial]

    def of_chunk(first: int) -> Forecast:
        rows = slice(first, first + _CHUNK)
        return phase_model.integrate(
            intervals.inputs[:, rows], intervals.step[rows], rate[rows]
        )

    parts = on_all_cores(of_chunk, range(0, len(rate), _CHUNK))
    return Forecast(
        duration=np.concatenate([x.duration for x in parts]),
        rate=np.concatenate([x.rate for x in parts]),
        slopes=np.concatenate([x.slopes for x in parts]),
    )


class _Running(NamedTuple):
    """Intervals that have not ended yet, at the start of a step."""

    rows: Int[np.ndarray, " l"]
    """Indices of these intervals among all."""
    step: Lanes
    rate: Lanes
    """Rates without input."""
    phase: Lanes
    u: Lanes
    drift: Float[np.ndarray, "l p1"]
    """Derivatives of the phase with respect to coefficients and rate."""
    force: Float[np.ndarray, "l p1"]
    """Derivatives of the rate of the phase with respect to coefficients and rate."""
    growth: Lanes
    """Derivative of the rate of the phase with respect to the phase."""

    def of(self, lanes: Bool[np.ndarray, " l"]) -> "_Running":
        return _Running(*(x[lanes] for x in self))


class _PhaseModel:
    """A curve, tabulated, and the steps of its phase model."""

    def __init__(self, table: Table, coefficients: Curve):
        self.table = table
        self.curve = table @ coefficients
        self.slope = np.gradient(self.curve) * _POINTS

    def _place(self, phase: Lanes) -> Lanes:
        """Return places in the table, counted from 0."""
        return np.clip(phase, 0.0, 1.5 - 1e-6) * _POINTS

    def _at(self, values: Curve, phase: Lanes) -> Lanes:
        """Interpolate tabulated values linearly."""
        place = self._place(phase)
        k = place.astype(np.int64)
        rise = values[k + 1] - values[k]
        return values[k] + (place - k) * rise

    def _force(self, phase: Lanes, u: Lanes) -> Float[np.ndarray, "l p1"]:
        nearest = np.ceil(self._place(phase) - 0.5).astype(np.int64)
        by_coefficients = self.table[nearest] * u[:, None]
        by_rate = np.ones((len(u), 1))
        return np.concatenate([by_coefficients, by_rate], axis=1)

    def integrate(self, inputs: Nodes, step: Lanes, rate: Lanes) -> Forecast:
        """Integrate until all phases are 1: the phase by the classical Runge-Kutta method, and its
        derivatives by the trapezoidal rule."""
        L = len(step)
        p = self.table.shape[1] + 1
        slopes = np.zeros((L, p))
        result = Forecast(np.zeros(L), np.zeros(L), slopes)
        phase = np.zeros(L)
        u = inputs[0]
        now = _Running(
            rows=np.arange(L),
            step=step,
            rate=rate,
            phase=phase,
            u=u,
            drift=np.zeros((L, p)),
            force=self._force(phase, u),
            growth=self._at(self.slope, phase) * u,
        )
        steps = (len(inputs) - 1) // 2
        for j in range(steps):
            middle = inputs[2 * j + 1][now.rows]
            end = inputs[2 * j + 2][now.rows]
            phase, first, last = self._runge_kutta(now, middle, end)
            # After the last step, a phase grows at its rate without input.
            ended = (phase >= 1) | (j == steps - 1)
            part = np.ones(len(phase))
            part[ended], per_step = _end(
                now.phase[ended],
                phase[ended],
                first[ended],
                last[ended],
                (now.rate * now.step)[ended],
            )
            after = self._derivatives(now, phase, end, np.minimum(part, 1.0))
            rows = now.rows[ended]
            result.duration[rows] = (j + part[ended]) * now.step[ended]
            result.rate[rows] = per_step / now.step[ended]
            result.slopes[rows] = -after.drift[ended] / result.rate[rows, None]
            if ended.all():
                break
            now = after.of(~ended)
        return result

    def _runge_kutta(
        self,
        now: _Running,
        middle: Lanes,
        end: Lanes,
    ) -> tuple[Lanes, Lanes, Lanes]:
        """Return the phase after a step, and its rates per step at both ends.

        **Arguments:** `middle`, `end`: inputs in the middle and at the end of the step.
        """

        def advance(phase: Lanes, u: Lanes) -> Lanes:
            return now.step * (now.rate + self._at(self.curve, phase) * u)

        k1 = advance(now.phase, now.u)
        k2 = advance(now.phase + k1 / 2, middle)
        k3 = advance(now.phase + k2 / 2, middle)
        k4 = advance(now.phase + k3, end)
        slopes = k1 + 2 * k2 + 2 * k3 + k4
        phase = now.phase + slopes / 6
        return phase, k1, k4

    def _derivatives(
        self,
        now: _Running,
        phase: Lanes,
        u: Lanes,
        part: Lanes,
    ) -> _Running:
        r"""Return the state after a step, or, where an interval ends, after a part of it.

        The derivatives d of the phase obey $\dot d = Z'(\varphi)\, u\, d + F$, with $Z' u$ the
        `growth` and F the `force`.
        """
        force = self._force(phase, u)
        growth = self._at(self.slope, phase) * u
        half = part * now.step / 2
        exponent = half * ((2 - part) * now.growth + part * growth)
        # Where a curve jumps, its slope is unknown.
        gain = np.exp(np.clip(exponent, -0.5, 0.5))
        drift = now.drift + half[:, None] * now.force
        drift *= gain[:, None]
        drift += (half * (1 - part))[:, None] * now.force
        drift += (half * part)[:, None] * force
        return _Running(
            rows=now.rows,
            step=now.step,
            rate=now.rate,
            phase=phase,
            u=u,
            drift=drift,
            force=force,
            growth=growth,
        )


def _end(
    before: Lanes,
    after: Lanes,
    first: Lanes,
    last: Lanes,
    own: Lanes,
) -> tuple[Lanes, Lanes]:
    """Return the part of a step after which the phase is 1, and the rate of the phase at this point
    (per step).

    The part is the root of the cubic through the given phases and rates (per step) at both ends of
    the step. Beyond the step, the phase grows at its `own` rate.
    """
    rise = after - before
    cubic = first + last - 2 * rise
    quadratic = 3 * rise - 2 * first - last
    divisor = np.where(rise > 0, rise, 1.0)
    part = np.clip((1 - before) / divisor, 0.0, 1.0)
    rate = rise
    for _ in range(4):  # Newton's iterations: to rounding
        value = before + part * (first + part * (quadratic + part * cubic))
        rate = first + part * (2 * quadratic + part * 3 * cubic)
        rate = np.where(rate > 0, rate, rise)
        correction = (value - 1) / np.where(rate > 0, rate, 1.0)
        part = np.clip(part - correction, 0.0, 1.0)
    reached = after >= 1
    part = np.where(reached, part, 1 + (1 - after) / own)
    return part, np.where(reached, rate, own)
