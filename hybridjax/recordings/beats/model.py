r"""The phase model of an oscillator with a reset, from one event to the next.

$$\dot\varphi = w + Z(\varphi)\, I(t), \qquad \varphi = 0 \text{ at an event}, \quad
\text{the next one where } \varphi = 1.$$

The end of an interval depends on the input, so the equation is integrated until the phase is 1,
whenever that is, and never up to the measured end (whose noise would enter the regressors).

Noise in the rhythm spreads the phase: after a part $\varphi$ of the cycle its variance is
$s^2 \varphi$, with s the standard deviation at the end. The curve averaged over that distribution
acts on the mean phase. A phase that has reached 1 has left the interval, and others may not have:
the curve is continued beyond 1 by reflection. So it is a series of $\cos(\pi k \varphi)$, which
need not be the same at 0 and at 1, and of which term k is weaker by
$\exp(-\pi^2 k^2 s^2 \varphi / 2)$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..._core.execution import on_all_cores
from ...errors import DefinitionError
from ..phase import Phase
from ..recording import Recording
from ..smoothing import bridgeable, gaps, inside


# Integration steps in a median interval of a trial. More: time. Fewer: errors of durations approach
# the jitter of fast curves.
_STEPS = 32
# Intervals that are integrated together. More: memory. Fewer: more calls of NumPy.
_CHUNK = 4096
# Points per cycle at which curves are tabulated, up to 1.5 cycles (the step in which an interval
# ends goes beyond 1; inputs are kept for 1.5 of the longest interval), linear in between. More:
# memory. Fewer: errors of the finest half wave (1e-5 of it at 1024).
_POINTS = 1024


Lanes = Float[np.ndarray, " l"]
Curve = Float[np.ndarray, " _"]
Nodes = Float[np.ndarray, "nodes l"]
Table = Float[np.ndarray, "M p"]
"""A basis of curves at equal steps of the phase from 0 on."""


class Intervals(NamedTuple):
    """All intervals of a recording between events that nothing interrupts, trial by trial."""

    start: Float[np.ndarray, " L"]
    """Start of each, in s."""
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
    """Return the intervals between events, with the input of that name, linear between samples,
    without its mean in each trial.

    **Raises:** `DefinitionError` for a phase that is an angle or has other trials, an input that is
    missing or constant, and too few intervals during which it is finite.
    """
    samples, pairs = recording.samples(name), phase.by_trial(recording)
    if not all(w.linear for _, parts in pairs for w in parts):
        raise DefinitionError(
            "`phase` must be of events or a Crossing, not a KinematicPhase."
        )
    starts, durations, steps, inputs = [], [], [], []
    for (trial, x), (_, parts) in zip(samples, pairs, strict=True):
        finite = np.isfinite(x)
        if finite.sum() < 2:
            raise DefinitionError(
                f"trial '{trial.name}' has no samples of {name}: leave it out."
            )
        start = np.concatenate([np.zeros(0), *(w.time[:-1] for w in parts)])
        duration = np.concatenate([np.zeros(0), *(np.diff(w.time) for w in parts)])
        holes = gaps(trial.time[finite], bridgeable(trial.time[finite]))
        # An interval may begin or end just where the input does.
        used = ~inside(holes, start + 1e-9 * duration, start + (1 - 1e-9) * duration)
        if not used.any():
            continue
        start, duration = start[used], duration[used]
        step = float(np.median(duration)) / _STEPS
        nodes = np.arange(2 * int(np.ceil(1.5 * duration.max() / step)) + 1) / 2
        x = x[finite] - x[finite].mean()  # (under which the phase advances evenly)
        inputs.append(np.interp(start + nodes[:, None] * step, trial.time[finite], x))
        starts.append(start)
        durations.append(duration)
        steps.append(np.full(len(start), step))
    if not starts:
        raise DefinitionError(f"{name} has no samples between two events: record both.")
    if not any(np.ptp(x) > 0 for x in inputs):
        raise DefinitionError(
            f"the input {name} is constant: name the signal that acted."
        )
    longest = max(map(len, inputs))
    inputs = [np.pad(x, ((0, longest - len(x)), (0, 0)), "edge") for x in inputs]
    trial = np.repeat(np.arange(len(starts)), list(map(len, starts)))
    start, duration, step = map(np.concatenate, (starts, durations, steps))
    return Intervals(start, duration, trial, step, np.concatenate(inputs, axis=1))


def basis(
    phase: Float[np.ndarray, " n"], waves: int, jitter: float = 0.0
) -> Float[np.ndarray, "n p"]:
    """Return 1 and half waves cos(pi k phase), as they act on a phase with this jitter."""
    angle = np.pi * np.arange(waves + 1)
    return np.cos(angle * phase[:, None]) * np.exp(
        -((jitter * angle) ** 2) / 2 * phase[:, None]
    )


def tabulated(waves: int, jitter: float) -> Table:
    """Return the basis at equal steps of the phase from 0 on."""
    return basis(np.arange(3 * _POINTS // 2 + 1) / _POINTS, waves, jitter)


class Forecast(NamedTuple):
    """Intervals of a phase model that begin at the measured events."""

    duration: Float[np.ndarray, " L"]
    rate: Float[np.ndarray, " L"]
    """Rate at which the phase reaches 1, in cycles per second."""
    slopes: Float[np.ndarray, "L p1"]
    """Derivatives of the durations with respect to the coefficients of the curve, and to the rate
    without input."""


def forecast(
    intervals: Intervals, table: Table, coefficients: Curve, rates: Curve
) -> Forecast:
    """Return durations of all intervals, and their derivatives."""
    curve, rate = table @ coefficients, rates[intervals.trial]

    def chunk(first: int) -> Forecast:
        rows = slice(first, first + _CHUNK)
        return _integrate(
            intervals.inputs[:, rows], intervals.step[rows], rate[rows], curve, table
        )

    parts = on_all_cores(chunk, range(0, len(rate), _CHUNK))
    return Forecast(*map(np.concatenate, zip(*parts, strict=True)))


def _integrate(
    inputs: Nodes, h: Lanes, w: Lanes, curve: Curve, table: Table
) -> Forecast:
    """Integrate by the classical Runge-Kutta method, and derivatives by the trapezoidal rule."""
    L, p = len(h), table.shape[1] + 1
    result, rows = Forecast(np.zeros(L), np.zeros(L), np.zeros((L, p))), np.arange(L)
    slope = np.gradient(curve) * _POINTS

    def at(values, phase):
        x = np.clip(phase, 0.0, 1.5 - 1e-6) * _POINTS
        k = x.astype(np.int64)
        return values[k] + (x - k) * (values[k + 1] - values[k])

    def force(phase, u):
        """Return derivatives of the rate with respect to each coefficient, and to w."""
        nearest = np.ceil(np.clip(phase, 0.0, 1.5 - 1e-6) * _POINTS - 0.5).astype(
            np.int64
        )
        return np.concatenate(
            [table[nearest] * u[:, None], np.ones((len(u), 1))], axis=1
        )

    phase, drift, u0 = np.zeros(L), np.zeros((L, p)), inputs[0]
    forced, growth = force(phase, u0), at(slope, phase) * u0
    steps = (len(inputs) - 1) // 2
    for j in range(steps):
        u1, u2 = inputs[2 * j + 1][rows], inputs[2 * j + 2][rows]
        k1 = h * (w + at(curve, phase) * u0)
        k2 = h * (w + at(curve, phase + k1 / 2) * u1)
        k3 = h * (w + at(curve, phase + k2 / 2) * u1)
        k4 = h * (w + at(curve, phase + k3) * u2)
        after = phase + (k1 + 2 * k2 + 2 * k3 + k4) / 6
        done = (after >= 1) | (j == steps - 1)  # what is left passes at its own rate
        part, ended = np.ones(len(h)), rows[done]
        if len(ended):
            part[done], speed = _end(*(x[done] for x in (phase, after, k1, k4, w * h)))
            result.rate[ended] = speed / h[done]
        short = np.minimum(part, 1.0)
        forced_after, growth_after = force(after, u2), at(slope, after) * u2
        half = short * h / 2
        exponent = half * ((2 - short) * growth + short * growth_after)
        gain = np.exp(
            np.clip(exponent, -0.5, 0.5)
        )  # where a curve jumps, its slope is unknown
        drift += half[:, None] * forced
        drift *= gain[:, None]
        drift[done] += (half * (1 - short))[done, None] * forced[done]
        drift += (half * short)[:, None] * forced_after
        result.duration[ended] = (j + part[done]) * h[done]
        result.slopes[ended] = -drift[done] / result.rate[ended, None]
        if done.all():
            break
        keep = ~done
        rows, u0, h, w, phase = rows[keep], u2[keep], h[keep], w[keep], after[keep]
        drift, forced, growth = drift[keep], forced_after[keep], growth_after[keep]
    return result


def _end(a: Lanes, b: Lanes, m0: Lanes, m1: Lanes, own: Lanes) -> tuple[Lanes, Lanes]:
    """Return the part of a step at whose end the phase is 1, and the rate there per step.

    It is the root of the cubic with the values a, b and slopes m0, m1 at both ends of the step.
    Beyond the step, the phase grows at its own rate.
    """
    beyond = b >= 1
    s = np.clip((1 - a) / np.where(b > a, b - a, 1.0), 0.0, 1.0)
    rate = b - a
    for _ in range(4):  # Newton's iterations: to rounding
        value = a * (1 + 2 * s) * (1 - s) ** 2 + m0 * s * (1 - s) ** 2
        value += b * s * s * (3 - 2 * s) + m1 * s * s * (s - 1)
        rate = (
            6 * s * (1 - s) * (b - a)
            + m0 * (1 - 4 * s + 3 * s * s)
            + m1 * s * (3 * s - 2)
        )
        rate = np.where(rate > 0, rate, b - a)
        s = np.clip(s - (value - 1) / np.where(rate > 0, rate, 1.0), 0.0, 1.0)
    return np.where(beyond, s, 1 + (1 - b) / own), np.where(beyond, rate, own)
