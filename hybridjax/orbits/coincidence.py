"""Events that coincide on a limit cycle: what each of their orders does to neighbors of the cycle.

Where two guards are crossed at the same time, neighbors of the cycle meet one or the other first.
The flow is then piecewise differentiable, with one derivative for each order (S. A. Burden, S. S.
Sastry, D. E. Koditschek, S. Revzen, Event-selected vector field discontinuities yield
piecewise-differentiable flows, SIAM J. Applied Dynamical Systems 15, 2016). Where these are equal,
as for events that have nothing to do with each other, it is differentiable after all.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.executor import to_host
from ..engine import kernels
from ..systems.structure import Structure
from .cycle import LimitCycle


# Events coincide if no more than this part of the period lies between them. Doubled, so do events
# twice as far apart.
TOGETHER = 1e-9
# A guard is due if it would be at zero within this part of the period. Ten times as much as lies
# between events that coincide.
_DUE = 1e-8
# Orders commute if states after them, and derivatives, differ by less than this, in sizes of the
# states. Doubled, so do orders that differ twice as much.
_COMMUTE = 1e-6


class Coincidence(NamedTuple):
    """Events of a cycle that happen at the same time."""

    time: float
    orders: tuple[tuple[str, ...], ...]
    """The names of the events, in every order in which they can happen."""
    derivatives: tuple[Float[np.ndarray, "m n"], ...]
    """For each order, that of the state after all events by the state before them, at the same time
    (a product of saltation matrices). It holds for neighbors of the cycle that meet the events in
    this order."""
    commute: bool
    """Whether all orders lead to the same state, with the same derivative."""


class _Way(NamedTuple):
    events: tuple[int, ...]
    chart: int
    state: Float[np.ndarray, " m"]
    derivative: Float[np.ndarray, "m n"]


@checked
def coincidences(cycle: LimitCycle) -> list[Coincidence]:
    """Groups of events that coincide on a limit cycle, with one-sided derivatives for each order.

    `find_limit_cycle` asks for them: where orders commute it goes on, otherwise the result is
    `Result.COINCIDENCE` (have the cycle by `throw=False`). Scheduled events are not looked at.
    """
    cycle = to_host(cycle)
    s, period, found = Structure(cycle.system), float(cycle.period), []
    way = cycle.trajectory(2.0)
    at = np.flatnonzero(way.event >= 0)
    times = way.t[at]
    starts = np.flatnonzero(np.diff(times, prepend=-np.inf) > TOGETHER * period)
    for first, after in zip(starts, [*starts[1:], len(at)], strict=True):
        t, k = float(times[first]), at[first]
        inside = TOGETHER * period < t - way.t[0] <= (1 + TOGETHER) * period
        if after - first > 1 and inside:
            a = int(way.chart[k - 1])
            n = s.dims[a]
            here = _Way((), a, way.before[k, :n], np.eye(n))
            ways = list(_ways(s, t, here, int(after - first), _DUE * period))
            found.append(_coincidence(s, t, a, ways, cycle.settings.scale))
    return found


def _coincidence(s: Structure, t: float, a: int, ways: list[_Way], scale) -> Coincidence:
    size, one = scale[a, : s.dims[a]], ways[0]
    m = len(one.state)
    commute = len(ways) > 1
    for other in ways[1:]:
        if other.chart != one.chart:
            commute = False
            break
        own = scale[one.chart, :m]
        apart = np.abs(other.state - one.state) / own
        tilted = np.abs(other.derivative - one.derivative) * size / own[:, None]
        commute = commute and max(apart.max(), tilted.max()) < _COMMUTE
    names = tuple(tuple(s.transitions[g].name for g in way.events) for way in ways)
    return Coincidence(t, names, tuple(way.derivative for way in ways), bool(commute))


def _ways(s: Structure, t: float, way: _Way, left: int, due: float) -> Iterator[_Way]:
    """All orders in which `left` more events can happen at once."""
    if not left:
        yield way
        return
    a, q, u = way.chart, way.state[:, None], np.zeros((s.nu, 1))
    time = np.array([t])
    field = kernels.field(s, a, time, q, u)[:, 0, 0]
    if not (guards := s.guards(a)):
        return
    rows = kernels.watched(s, a, None, time, q, u, np.zeros(1, np.int32))[..., 0]
    for g, row in zip(guards, rows, strict=True):
        value, slope = row[0], row[2 : 2 + len(q)]
        rate = row[1] + slope @ field
        fires = rate < 0 and abs(value) <= -due * rate and g not in way.events
        if fires and kernels.enabled(s, s.member(g), time, q, u).all():
            new = kernels.reset(s, s.member(g), time, q, u)[..., 0]
            b = s.chart_index(s.transitions[g].target)
            state, by_t, by_q = new[:, 0], new[:, 1], new[:, 2 : 2 + len(q)]
            after = kernels.field(s, b, time, state[:, None], u)[:, 0, 0]
            saltation = by_q + np.outer(after - by_q @ field - by_t, slope) / rate
            found = _Way((*way.events, g), b, state, saltation @ way.derivative)
            yield from _ways(s, t, found, left - 1, due)
