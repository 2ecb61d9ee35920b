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

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.execution import on_all_cores
from ...errors import DefinitionError
from ..phase import Phase
from ..recording import Recording
from ..smoothing import bridgeable, gaps, inside


# Integration steps in a median interval of a trial. More: time. Fewer: errors of durations approach
# the jitter of fast curves.
_STEPS = 32
# Length, in longest intervals of the trial, over which the input is kept. Longer: memory. Shorter:
# slow models are extrapolated at their own rate.
_REACH = 1.5
# Intervals that are integrated together. More: memory. Fewer: more calls of NumPy.
_CHUNK = 4096
# Points per cycle at which curves are tabulated, up to 1.5 cycles (the step in which an interval
# ends goes beyond 1); linear in between. More: memory. Fewer: errors of the finest half wave (1e-5
# of it at 1024).
_POINTS = 1024
# Fewest intervals of a trial that is used. More: short trials are left out. Fewer: its rate is all
# that they determine.
_FEWEST = 3


Lanes = Float[np.ndarray, " l"]
Table = Float[np.ndarray, "M p"]
"""A basis of curves at equal steps of the phase from 0 on."""


class Intervals(NamedTuple):
    """All intervals of a recording between events that nothing interrupts, trial by trial."""

    start: Float[np.ndarray, " L"]
    """Start of each, in s."""
    duration: Float[np.ndarray, " L"]
    trial: Int[np.ndarray, " L"]
    """Index among the trials that have intervals."""
    names: tuple[str, ...]
    """Names of these trials."""
    step: Float[np.ndarray, " L"]
    """Step of integration, in s."""
    inputs: list[Float[np.ndarray, "nodes chunk"]]
    """Inputs at half steps since the start of each interval, for `_CHUNK` intervals at a time."""

    @property
    def trials(self) -> int:
        return len(self.names)

    def chunks(self) -> Iterator[tuple[slice, Float[np.ndarray, "nodes chunk"]]]:
        """Yield places of intervals, and their inputs."""
        for k, values in enumerate(self.inputs):
            yield slice(k * _CHUNK, k * _CHUNK + values.shape[1]), values

    def sums(self, values: Float[np.ndarray, " L"]) -> Float[np.ndarray, " trials"]:
        """Return sums over each trial."""
        return np.bincount(self.trial, values, self.trials)

    def blocks(self, length: int) -> Int[np.ndarray, " L"]:
        """Return the block of each interval: successive intervals of one trial."""
        counts = np.bincount(self.trial)
        place = np.concatenate([np.arange(n) for n in counts])
        block = np.minimum(place // length, np.maximum(counts[self.trial] // length, 1) - 1)
        return np.unique(self.trial * (block.max() + 1) + block, return_inverse=True)[1]


def intervals_of(recording: Recording, phase: Phase, name: str) -> Intervals:
    """Return the intervals between events, with the input of that name, linear between samples.

    **Raises:** `DefinitionError` for a phase that is an angle or has other trials, an input that is
    missing or constant, and too few intervals during which it is finite.
    """
    pairs = phase.by_trial(recording)
    if not all(w.linear for _, parts in pairs for w in parts):
        raise DefinitionError(
            "`phase` must be one of events (`AtEvent`) or crossings: an angle has no intervals."
        )
    column, trials, outside = recording.column(name), [], 0
    for trial, parts in pairs:
        x = trial.values[:, column]
        finite = np.isfinite(x)
        if finite.sum() < 2:
            raise DefinitionError(f"trial '{trial.name}' has no samples of the input {name}.")
        start = np.concatenate([np.zeros(0), *(w.time[:-1] for w in parts)])
        duration = np.concatenate([np.zeros(0), *(np.diff(w.time) for w in parts)])
        holes = gaps(trial.time, finite, bridgeable(trial.time, finite))
        # An interval may begin or end just where the input does.
        used = ~inside(holes, start + 1e-9 * duration, start + (1 - 1e-9) * duration)
        outside += int((~used).sum())
        if used.sum() >= _FEWEST:
            trials.append((trial.name, trial.time[finite], x[finite], start[used], duration[used]))
    if not trials:
        lost = f"; {outside} lie where {name} was not recorded" if outside else ""
        raise DefinitionError(
            f"the recording holds too few intervals between events during which {name} is known: "
            f"a trial needs {_FEWEST} or more{lost}."
        )
    names, times, inputs, starts, durations = zip(*trials, strict=True)
    if not any(np.ptp(x) > 0 for x in inputs):
        raise DefinitionError(f"the input {name} is constant in all trials.")
    counts = list(map(len, durations))
    trial = np.repeat(np.arange(len(trials)), counts)
    step = np.repeat([float(np.median(d)) / _STEPS for d in durations], counts)
    steps = np.repeat([_REACH * d.max() for d in durations], counts) / step
    start, duration, chunks = np.concatenate(starts), np.concatenate(durations), []
    for first in range(0, len(start), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(start)))
        nodes = np.arange(2 * int(np.ceil(steps[rows].max())) + 1) / 2
        values = np.empty((len(nodes), len(rows)))
        for k in np.unique(trial[rows]):
            chosen = trial[rows] == k
            at = start[rows[chosen]] + nodes[:, None] * step[rows[chosen]]
            values[:, chosen] = np.interp(at, times[k], inputs[k])
        chunks.append(values)
    return Intervals(start, duration, trial, names, step, chunks)


def basis(
    phase: Float[np.ndarray, " n"], waves: int, jitter: float = 0.0
) -> Float[np.ndarray, "n p"]:
    """Return 1 and half waves cos(pi k phase), as they act on a phase with this jitter."""
    angle = np.pi * np.arange(waves + 1)
    spread = (jitter * angle) ** 2 / 2
    return np.cos(angle * phase[:, None]) * np.exp(-spread * phase[:, None])


def tabulated(waves: int, jitter: float) -> Table:
    """Return the basis at equal steps of the phase from 0 on."""
    return basis(np.arange(3 * _POINTS // 2 + 1) / _POINTS, waves, jitter)


class Forecast(NamedTuple):
    """Intervals of a phase model that begin at the measured events."""

    duration: Float[np.ndarray, " L"]
    rate: Float[np.ndarray, " L"]
    """Rate at which the phase reaches 1, in cycles per second."""
    by_curve: Float[np.ndarray, "L p"]
    """Derivatives of the durations with respect to the coefficients of the curve."""
    by_rate: Float[np.ndarray, " L"]
    """Derivatives with respect to the rate without input."""

    @classmethod
    def empty(cls, L: int, p: int) -> "Forecast":
        return cls(np.zeros(L), np.zeros(L), np.zeros((L, p)), np.zeros(L))


def forecast(
    intervals: Intervals,
    table: Table,
    coefficients: Float[np.ndarray, " p"],
    rates: Float[np.ndarray, " trials"],
) -> Forecast:
    """Return durations of all intervals, and their derivatives."""
    whole = Forecast.empty(len(intervals.start), table.shape[1])
    curve, rate = table @ coefficients, rates[intervals.trial]

    def chunk(item):
        rows, inputs = item
        part = _integrate(inputs, intervals.step[rows], rate[rows], curve, table)
        for target, values in zip(whole, part, strict=True):
            target[rows] = values

    on_all_cores(chunk, intervals.chunks())
    return whole


def _integrate(
    inputs: Float[np.ndarray, "nodes L"],
    h: Float[np.ndarray, " L"],
    w: Float[np.ndarray, " L"],
    curve: Float[np.ndarray, " M"],
    table: Table,
) -> Forecast:
    """Integrate by the classical Runge-Kutta method, and derivatives by the trapezoidal rule."""
    L, p = len(h), table.shape[1]
    result, rows = Forecast.empty(L, p), np.arange(L)
    slope = np.gradient(curve) * _POINTS

    def at(values, phase):
        x = np.clip(phase, 0.0, 1.5 - 1e-6) * _POINTS
        k = x.astype(np.int64)
        return values[k] + (x - k) * (values[k + 1] - values[k])

    def force(phase, u):
        """Return derivatives of the rate with respect to each coefficient, and to w."""
        x = np.clip(phase, 0.0, 1.5 - 1e-6) * _POINTS
        nearest = np.ceil(x - 0.5).astype(np.int64)
        return np.concatenate([table[nearest] * u[:, None], np.ones((len(u), 1))], axis=1)

    def growth_of(x):
        """Return exp(x), limited where a curve jumps and its slope is unknown."""
        return np.exp(np.clip(x, -0.5, 0.5))

    phase, drift, u0 = np.zeros(L), np.zeros((L, p + 1)), inputs[0]
    forced, growth = force(phase, u0), at(slope, phase) * u0
    steps = (len(inputs) - 1) // 2
    for j in range(steps):
        u1, u2 = inputs[2 * j + 1][rows], inputs[2 * j + 2][rows]
        k1 = w + at(curve, phase) * u0
        k2 = w + at(curve, phase + h / 2 * k1) * u1
        k3 = w + at(curve, phase + h / 2 * k2) * u1
        k4 = w + at(curve, phase + h * k3) * u2
        after = phase + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        done = after >= 1
        if j == steps - 1:
            done[:] = True  # the rest of the interval passes at its own rate
        forced_after, growth_after = force(after, u2), at(slope, after) * u2
        if done.any():
            d = done
            part, rate = _end(phase[d], after[d], (k1 * h)[d], (k4 * h)[d], w[d] * h[d])
            rate = rate / h[d]
            result.duration[rows[d]] = (j + part) * h[d]
            result.rate[rows[d]] = rate
            short = np.minimum(part, 1.0)[:, None]
            gain = (1 - short) * growth[d, None] + short * growth_after[d, None]
            gain = growth_of(short * h[d, None] * (growth[d, None] + gain) / 2)
            last = (1 - short) * forced[d] + short * forced_after[d]
            half = short * h[d, None] / 2
            at_end = -(gain * (drift[d] + half * forced[d]) + half * last) / rate[:, None]
            result.by_curve[rows[d]], result.by_rate[rows[d]] = at_end[:, :p], at_end[:, p]
        gain, half = growth_of(h * (growth + growth_after) / 2)[:, None], h[:, None] / 2
        drift = gain * (drift + half * forced) + half * forced_after
        if done.all():
            break
        keep: Bool[np.ndarray, " l"] = ~done
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
        rate = 6 * s * (1 - s) * (b - a) + m0 * (1 - 4 * s + 3 * s * s) + m1 * s * (3 * s - 2)
        rate = np.where(rate > 0, rate, b - a)
        s = np.clip(s - (value - 1) / np.where(rate > 0, rate, 1.0), 0.0, 1.0)
    return np.where(beyond, s, 1 + (1 - b) / own), np.where(beyond, rate, own)
