"""A second integration along a cycle, which shares neither the method nor the steps of the first.

`verdict.py` calls `walk` with many *stretches* (pieces of the cycle without an event, each in one
chart), and gets their ends, derivatives, errors and points on the way. The flow is computed by
extrapolation: in explicit charts of the modified midpoint rule (W. B. Gragg, SIAM J. Numerical
Analysis 2, 1965), in implicit ones of the linearly implicit Euler method (P. Deuflhard, SIAM Review
27, 1985). Both, with their tables of differences, are in E. Hairer and G. Wanner, Solving Ordinary
Differential Equations, vol. I, sec. II.9, and vol. II, sec. IV.9.

If the verdict doubts a good cycle, compare the errors that `walk` returns with those of smaller
steps: if they are too small, look at `_extrapolate`; if points on the way are wrong, at `_between`.
The method must stay another one than that of the search.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..engine import kernels
from ..systems.structure import Structure
from .scale import is_implicit


# Error of a step, in sizes of the states, at which it is accepted. Larger: small faults of a cycle
# pass. Smaller: steps are shortened for errors that are only rounding.
_ACCURATE = 1e-8
# Largest error of a stretch whose end counts as known. Larger: errors of this integration count as
# faults of the cycle. Smaller: fields with kinks cannot be checked.
ROUGH = 1e-6
# Number of steps after which a stretch is given up. More: hopeless stretches take longer. Fewer:
# fast jumps of a neuron are not resolved.
_PATIENCE = 400
# Numbers of substeps into which a step is divided for extrapolation. More: each step costs more.
# Fewer: more steps are needed.
_MIDPOINT_STEPS = (2, 4, 6)
_EULER_STEPS = (1, 2, 3, 4, 5, 6)
# Largest and smallest change of the step length from step to step, and safety factor, as in Hairer
# and Wanner's codes ODEX and SEULEX.
_LONGER = 4.0
_SHORTER = 0.2
_SAFE = 0.8
# Points within a step at which the path is known, as fractions of the step; the last one is its
# end. More: guards cost more. Fewer: a guard that dips below zero and back is missed.
_FRACTIONS = np.linspace(0.0, 1.0, 9)[1:]


class Stretch(NamedTuple):
    """L pieces of flow without events. Each piece lies in one chart."""

    t: Float[np.ndarray, " L"]
    """Times at which they begin."""
    length: Float[np.ndarray, " L"]
    chart: Int[np.ndarray, " L"]
    q: Float[np.ndarray, "d L"]
    """States at the beginnings, padded to the largest chart."""


class Walked(NamedTuple):
    """The ends of L stretches, and P points on the way."""

    q: Float[np.ndarray, "d L"]
    by_state: Float[np.ndarray, "d d L"]
    """Derivatives of the ends with respect to the beginnings."""
    error: Float[np.ndarray, " L"]
    """Estimated errors of the ends, in sizes of the states."""
    lane: Int[np.ndarray, " P"]
    """The stretch of each point; points of a stretch stand in order of time."""
    t: Float[np.ndarray, " P"]
    points: Float[np.ndarray, "d P"]


def walk(s: Structure, stretch: Stretch, scale: Float[np.ndarray, "A d"]) -> Walked:
    """Integrate along stretches of flow, without inputs.

    **Arguments:** `scale`: sizes of the states by chart.
    """
    d, L = stretch.q.shape
    q = np.zeros((d, L))
    by_state = np.zeros((d, d, L))
    error = np.zeros(L)
    # Parts of the path. The first part is empty.
    lane = [np.zeros(0, int)]
    time = [np.zeros(0)]
    points = [np.zeros((d, 0))]
    for a in np.unique(stretch.chart).tolist():
        n = s.dims[a]
        lanes = np.flatnonzero(stretch.chart == a)
        x, error[lanes], path = _in_chart(
            s,
            a,
            stretch.t[lanes],
            stretch.length[lanes],
            stretch.q[:n, lanes],
            scale[a, :n],
        )
        ends = x[..., 0]
        derivatives = x[..., 1:]
        q[:n, lanes] = ends.T
        by_state[:n, :n, lanes] = np.moveaxis(derivatives, 0, -1)
        for within, t, states in path:
            lane.append(lanes[within])
            time.append(t)
            missing = [(0, d - n), (0, 0)]
            points.append(np.pad(states, missing))
    all_lanes = np.concatenate(lane)
    times = np.concatenate(time)
    all_points = np.concatenate(points, axis=1)
    order = np.lexsort((times, all_lanes))
    return Walked(
        q=q,
        by_state=by_state,
        error=error,
        lane=all_lanes[order],
        t=times[order],
        points=all_points[:, order],
    )


# In a chart with n states, x (L, n, 1 + n) has the states in its first column, and in the others
# the derivatives of the states by those at the beginning. Rates of x have the same form.


def _in_chart(s: Structure, a: int, begin, length, q, sizes):
    """The ends x of stretches in chart a, their errors, and the points on the way: lanes, times and
    states of each part of a step."""
    n, L = q.shape
    implicit = is_implicit(s, a)
    extrapolated = _linear_euler if implicit else _midpoint
    order = len(_EULER_STEPS) if implicit else 2 * len(_MIDPOINT_STEPS) - 1

    def field(t, x):
        u = np.zeros((s.nu, 1))
        states = x[..., 0].T
        rows = kernels.field(s, a, t, states, u)
        return np.moveaxis(rows, -1, 0)

    unit = np.tile(np.eye(n), (L, 1, 1))
    first_column = q.T[..., None]
    x = np.concatenate([first_column, unit], axis=2)
    past = np.zeros(L)
    h = length.copy()
    error = np.zeros(L)
    path = []
    with np.errstate(all="ignore"):
        by_field = field(begin, x).copy()
        for _ in range(_PATIENCE):
            going = np.flatnonzero(past < length)
            if not len(going):
                break
            t = begin[going] + past[going]
            end, change = extrapolated(field, by_field[going], t, h[going], x[going])
            off = np.max(np.abs(change) / sizes, axis=1, initial=0.0)
            off = np.where(np.isfinite(off), off, np.inf)
            better = _ACCURATE / np.maximum(off, 1e-300)
            longer = _SAFE * better ** (1 / order)
            # (Steps that are as short as the rounding error of the time are accepted with any
            # error.)
            longest_time = np.maximum(np.abs(t), length[going])
            shortest = h[going] <= 1e-13 * longest_time
            good = (off <= _ACCURATE) | shortest
            lanes = going[good]
            if len(lanes):
                left = length[lanes] - past[lanes]
                onward = past[lanes] + h[lanes]
                is_last = h[lanes] >= left
                ended = np.where(is_last, length[lanes], onward)
                by_end = field(begin[lanes] + ended, end[good])
                within = _between(
                    t[good], h[lanes], x[lanes], end[good], by_field[lanes], by_end
                )
                for time, state in within:
                    path.append((lanes, time, state.T))
                past[lanes] = ended
                x[lanes] = end[good]
                by_field[lanes] = by_end
                error[lanes] += off[good]
            h[going] *= np.clip(longer, _SHORTER, _LONGER)
            h = np.minimum(h, length - past)
    error = np.where(past < length, np.inf, error)
    return x, error, path


def _rates(by_field: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Rates of states and of their derivatives, from the field with its derivatives."""
    n = x.shape[1]
    rates = by_field[..., 2 : 2 + n] @ x
    rates[..., 0] = by_field[..., 0]
    return rates


def _midpoint(field: Callable, by_field, t, length, x) -> tuple[np.ndarray, np.ndarray]:
    """Ends of steps by the modified midpoint rule, extrapolated, and the last change of states."""
    table = []
    rates = _rates(by_field, x)
    for count in _MIDPOINT_STEPS:
        h = (length / count)[:, None, None]
        before = x
        now = x + h * rates
        for k in range(1, count):
            by_now = field(t + k * length / count, now)
            ahead = before + 2 * h * _rates(by_now, now)
            before = now
            now = ahead
        last = _rates(field(t + length, now), now)
        table.append((before + now + h * last) / 2)
    return _extrapolate(table, np.square(_MIDPOINT_STEPS))


def _linear_euler(
    field: Callable, by_field, t, length, x
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of steps by the linearly implicit Euler method, extrapolated, and the last change of
    states."""
    table = []
    n = x.shape[1]
    for count in _EULER_STEPS:
        h = (length / count)[:, None, None]
        by_state = by_field[..., 2 : 2 + n]
        implicit_part = np.eye(n) - h * by_state
        matrix = np.linalg.inv(implicit_part)
        now = x
        for k in range(1, count + 1):
            time = t + k * length / count
            rates = _rates(field(time, now), now)
            now = now + h * (matrix @ rates)
        table.append(now)
    return _extrapolate(table, np.array(_EULER_STEPS))


def _extrapolate(
    table: list[np.ndarray], divisors: Int[np.ndarray, " K"]
) -> tuple[np.ndarray, np.ndarray]:
    """Extrapolate values for several numbers of substeps to infinitely many (Aitken and Neville).
    Also returns the last change of the states."""
    column = table
    previous = column[-1]
    for order in range(1, len(table)):
        previous = column[-1]
        ratios = divisors[order:] / divisors[:-order]
        weights = ratios - 1
        refined = []
        for k, weight in enumerate(weights):
            coarser, finer = column[k : k + 2]
            refined.append(finer + (finer - coarser) / weight)
        column = refined
    limit = column[-1]
    change = limit[..., 0] - previous[..., 0]
    return limit, change


def _between(
    t, length, x0, x1, by_begin, by_end
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times and states within steps, by polynomials of degree 5 through the states, rates and
    accelerations at both ends."""
    n = x0.shape[1]
    h = length[:, None]

    def rate_and_bend(by_field):
        f = by_field[..., 0]
        by_time = by_field[..., 1]
        by_state = by_field[..., 2 : 2 + n]
        along = (by_state @ f[..., None])[..., 0]
        acceleration = by_time + along
        return h * f, h**2 * acceleration

    rate0, bend0 = rate_and_bend(by_begin)
    rate1, bend1 = rate_and_bend(by_end)
    q0 = x0[..., 0]
    whole = x1[..., 0] - q0
    rise = whole - rate0 - bend0 / 2
    slope = rate1 - rate0 - bend0
    bend = bend1 - bend0
    third = 10 * rise - 4 * slope + bend / 2
    fourth = -15 * rise + 7 * slope - bend
    fifth = 6 * rise - 3 * slope + bend / 2
    path = []
    for z in _FRACTIONS:
        lower = q0 + rate0 * z + bend0 / 2 * z**2
        higher = third * z**3 + fourth * z**4 + fifth * z**5
        path.append((t + z * length, lower + higher))
    return path
