r"""The phase model of an oscillator with a reset, from one event to the next.

$$\dot\varphi = w + Z(\varphi)\, I(t), \qquad \varphi = 0 \text{ at an event}, \quad
\text{the next one where } \varphi = 1.$$

The end of an interval depends on the input, so that durations are those of the model's own
intervals: the equation is integrated until the phase is 1, whenever that is, and never up to the
measured end (whose noise would be part of the regressors).

Noise in the rhythm spreads the phase: after a part $\varphi$ of the cycle its variance is
$s^2 \varphi$, with s the standard deviation at the end. What acts on the mean phase is the curve
averaged over that distribution. A phase that has come to 1 has left the interval, and the others
may not have: the curve goes on beyond 1 as in a mirror. So it is a series of
$\cos(\pi k \varphi)$, which need not be the same at 0 and at 1, and of which term k is weaker by
$\exp(-\pi^2 k^2 s^2 \varphi / 2)$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.execution import on_all_cores
from .intervals import Intervals


# Points in a cycle at which curves are tabulated; linear in between. Doubled: a quarter of the
# error (1e-5 of the twentieth half wave).
_POINTS = 1024
# How far tables reach, in cycles: the step in which an interval ends goes beyond 1. Doubled:
# nothing changes.
_REACH = 1.5
# Largest logarithm of what a difference in phase grows by in a step. Doubled: nothing changes but
# where curves jump, whose slope is not known there.
_LARGEST_GROWTH = 0.5
# Iterations of Newton's method for the end of an interval within a step. Doubled: nothing changes.
_NEWTON = 4


def basis(
    phase: Float[np.ndarray, " n"], waves: int, jitter: float = 0.0
) -> Float[np.ndarray, "n p"]:
    """1 and so many half waves, cos(pi k phase), as they act on a phase with so much jitter."""
    angle = np.pi * np.arange(waves + 1)
    spread = (jitter * angle) ** 2 / 2
    return np.cos(angle * phase[:, None]) * np.exp(-spread * phase[:, None])


class Table(NamedTuple):
    """A basis of curves and what they are, at equal steps of the phase from 0 on."""

    basis: Float[np.ndarray, "M p"]

    @classmethod
    def of(cls, waves: int, jitter: float) -> "Table":
        return cls(basis(_grid(), waves, jitter))

    @classmethod
    def of_curve(cls, curve: Float[np.ndarray, " n"]) -> "Table":
        """Of one curve, given at n equal steps from phase 0 on; linear in between."""
        places = np.arange(len(curve)) / len(curve)
        return cls(np.interp(_grid(), places, curve, period=1.0)[:, None])


def _grid() -> Float[np.ndarray, " M"]:
    return np.arange(int(_REACH * _POINTS) + 1) / _POINTS


class Forecast(NamedTuple):
    """What a phase model says of intervals that begin when they did."""

    duration: Float[np.ndarray, " L"]
    rate: Float[np.ndarray, " L"]
    """At which the phase comes to 1, in cycles per second."""
    by_curve: Float[np.ndarray, "L p"]
    """Derivatives of the durations by the coefficients of the curve."""
    by_rate: Float[np.ndarray, " L"]
    """... and by the rate without input."""


def forecast(
    intervals: Intervals,
    table: Table,
    coefficients: Float[np.ndarray, " p"],
    rates: Float[np.ndarray, " trials"],
    slopes: bool = True,
) -> Forecast:
    """Durations of all intervals; `slopes`: whether derivatives are wanted."""
    L, p = len(intervals.start), table.basis.shape[1] if slopes else 0
    found = Forecast(np.zeros(L), np.zeros(L), np.zeros((L, p)), np.zeros(L))
    curve = table.basis @ coefficients
    per_rate = rates[intervals.trial]

    def chunk(item):
        rows, inputs = item
        one = _Chunk(inputs, intervals.step[rows], per_rate[rows], curve, table.basis[:, :p])
        parts = one.run(slopes)
        for whole, part in zip(found, parts, strict=True):
            whole[rows] = part

    on_all_cores(chunk, intervals.chunks())
    return found


def _exp(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Of what changes in a step; where a curve jumps, it is no larger than that."""
    return np.exp(np.clip(x, -_LARGEST_GROWTH, _LARGEST_GROWTH))


class _Chunk:
    """Intervals that are integrated together."""

    def __init__(self, inputs, step, rate, curve, basis):
        self.inputs, self.step, self.rate = inputs, step, rate
        self.curve, self.basis = curve, basis
        self.slope = np.gradient(curve) * _POINTS

    def run(self, slopes: bool) -> Forecast:
        """By the classical Runge-Kutta method; derivatives by the trapezoidal rule."""
        L, p = len(self.step), self.basis.shape[1]
        found = Forecast(np.zeros(L), np.zeros(L), np.zeros((L, p)), np.zeros(L))
        rows = np.arange(L)
        u, h, w = self.inputs, self.step, self.rate
        phase, drift = np.zeros(L), np.zeros((L, p + 1))
        u0 = u[0]
        force = self._force(phase, u0) if slopes else drift
        growth = self._at(self.slope, phase) * u0
        steps = (len(u) - 1) // 2
        for j in range(steps):
            u1, u2 = u[2 * j + 1][rows], u[2 * j + 2][rows]
            k1 = w + self._at(self.curve, phase) * u0
            k2 = w + self._at(self.curve, phase + h / 2 * k1) * u1
            k3 = w + self._at(self.curve, phase + h / 2 * k2) * u1
            k4 = w + self._at(self.curve, phase + h * k3) * u2
            after = phase + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            done = after >= 1
            if j == steps - 1:
                done[:] = True  # what is left goes on at its own rate
            if slopes:
                after_force = self._force(after, u2)
                after_growth = self._at(self.slope, after) * u2
            if done.any():
                part, rate = self._end(phase, after, k1, k4, h, w, done)
                found.duration[rows[done]] = (j + part) * h[done]
                found.rate[rows[done]] = rate
                if slopes:
                    short = np.minimum(part, 1.0)[:, None]
                    gain = (1 - short) * growth[done, None] + short * after_growth[done, None]
                    gain = _exp(short * h[done, None] * (growth[done, None] + gain) / 2)
                    last = (1 - short) * force[done] + short * after_force[done]
                    half = short * h[done, None] / 2
                    at_end = gain * (drift[done] + half * force[done]) + half * last
                    at_end = -at_end / rate[:, None]
                    found.by_curve[rows[done]] = at_end[:, :p]
                    found.by_rate[rows[done]] = at_end[:, p]
            if slopes:
                gain = _exp(h * (growth + after_growth) / 2)[:, None]
                half = h[:, None] / 2
                drift = gain * (drift + half * force) + half * after_force
                force, growth = after_force, after_growth
            phase, u0 = after, u2
            if done.all():
                break
            if not done.any():
                continue
            keep: Bool[np.ndarray, " l"] = ~done
            rows, u0, h, w, phase = rows[keep], u0[keep], h[keep], w[keep], phase[keep]
            drift, growth = drift[keep], growth[keep]
            force = force[keep] if slopes else drift
        return found

    def _end(self, phase, after, k1, k4, h, w, done):
        """The part of the step at whose end the phase is 1, and the rate there: the root of the
        cubic with these values and slopes."""
        a, b, m0, m1 = phase[done], after[done], (k1 * h)[done], (k4 * h)[done]
        beyond = b >= 1
        s = np.clip((1 - a) / np.where(b > a, b - a, 1.0), 0.0, 1.0)
        rate = b - a
        for _ in range(_NEWTON):
            value = a * (1 + 2 * s) * (1 - s) ** 2 + m0 * s * (1 - s) ** 2
            value += b * s * s * (3 - 2 * s) + m1 * s * s * (s - 1)
            rate = 6 * s * (1 - s) * (b - a) + m0 * (1 - 4 * s + 3 * s * s) + m1 * s * (3 * s - 2)
            rate = np.where(rate > 0, rate, b - a)
            s = np.clip(s - (value - 1) / np.where(rate > 0, rate, 1.0), 0.0, 1.0)
        own = w[done]
        s = np.where(beyond, s, 1 + (1 - b) / (own * h[done]))
        return s, np.where(beyond, rate / h[done], own)

    def _place(
        self, phase: Float[np.ndarray, " l"]
    ) -> tuple[Int[np.ndarray, " l"], Float[np.ndarray, " l"]]:
        x = np.clip(phase, 0.0, _REACH - 1e-6) * _POINTS
        k = x.astype(np.int64)
        return k, x - k

    def _at(self, values: Float[np.ndarray, " M"], phase: Float[np.ndarray, " l"]):
        k, part = self._place(phase)
        return values[k] + part * (values[k + 1] - values[k])

    def _force(self, phase: Float[np.ndarray, " l"], u: Float[np.ndarray, " l"]):
        """What changes the phase: by each curve of the basis, and by the rate."""
        k, part = self._place(phase)
        nearest = k + (part > 0.5)
        return np.concatenate([self.basis[nearest] * u[:, None], np.ones((len(u), 1))], axis=1)
