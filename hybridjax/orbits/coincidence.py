"""Events that coincide on a limit cycle: do all orders in which they may happen have the same
effect?

If two guards are crossed at the same time, some neighboring trajectories reach one of them first,
and some the other. The flow is then piecewise differentiable, with one derivative for each order
(S. A. Burden, S. S. Sastry, D. E. Koditschek, S. Revzen, Event-selected vector field
discontinuities yield piecewise-differentiable flows, SIAM J. Applied Dynamical Systems 15, 2016).
If these derivatives are equal, as for events that do not influence each other, the events
*commute*, and the flow is differentiable.

`find.py`, `limit_cycles.py` and `flow.py` call `commutes` or `groups_on`. Coinciding events are
found by `groups_on`, and every order of them is computed by `_orders`. `rivals.py` asks the same of
recorded turns, in programs, too: both must stay with the same limit, `TOGETHER`.

If events count as simultaneous and are not, look at `groups_on` and at `TOGETHER`
(`systems/transition.py`); if an event is not counted, at `_missed` and `_rivals`. If their effect
is judged wrongly, compare the orders in `_orders`, then look at `_commute` and `SAME`.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.members import leading_on
from .._core.compilation import host_first
from .._core.executor import to_host
from .._core.results import Result
from ..engine import kernels
from ..engine.events import falls_within
from ..engine.saltation import jump
from ..engine.settings import ROUNDING
from ..engine.target import until
from ..engine.trajectory import Trajectory
from ..errors import ComputationError
from ..systems.structure import Structure
from ..systems.transition import TOGETHER, Scheduled
from .crossing import AtEvent
from .return_map import ReturnMap
from .rivals import is_due


# Relative difference up to which two results count as the same: states and derivatives after events
# in two orders, functions at two times, the period and the durations between sections. Smaller:
# errors of the flow count as differences. Larger: small differences pass.
SAME = 1e-6
# Number of events at one time up to which all orders are compared. More: the 5040 orders of seven
# events take ten seconds, and each further event ten times as long. Fewer: more groups are refused.
_MOST_ORDERED = 6


@leading_on
class SimultaneousEvents(NamedTuple):
    """Events of a cycle that happen at the same time."""

    time: float
    orders: tuple[tuple[str, ...], ...]
    """The names of the events, in every order in which they can happen. (In some orders an event
    may be missing: the reset of another event has moved its guard away from zero.)"""
    derivatives: tuple[Float[np.ndarray, "m n"], ...]
    """For each order, the derivative of the state after all events by the state before all events,
    at the same time (a product of saltation matrices). It holds for neighbors of the cycle that
    reach the events in this order."""
    commute: bool
    """Whether all orders have the same number of events, and lead to the same state with the same
    derivative. Orders of more than six events are not compared: `orders` then has only the order on
    the cycle, `derivatives` is empty, and `commute` is False."""


class _Order(NamedTuple):
    events: tuple[int, ...]
    chart: int
    state: Float[np.ndarray, " m"]
    derivative: Float[np.ndarray, "m n"]


def simultaneous_events(cycle: Any) -> list[SimultaneousEvents]:
    """Return `LimitCycle.simultaneous_events`."""
    return [group for group in _groups(cycle) if group is not None]


def _groups(cycle: Any) -> list[SimultaneousEvents | None]:
    """The groups of events that happen at the same time; `None` for a group whose order is the same
    on all neighboring trajectories."""
    cycle = to_host(cycle)
    if cycle.result != Result.SIMULTANEOUS:
        cycle.require_found()
    # (A little more than one period, for events at its end; a second period may fail by rounding
    # where events coincide.)
    path = cycle.trajectory(1.01)
    period = float(cycle.period)
    rows = np.flatnonzero(path.event >= 0)
    since_begin = path.t[rows] - path.t[0]
    in_turn = since_begin > TOGETHER * period
    in_turn &= since_begin <= (1 + TOGETHER) * period
    scale = np.asarray(cycle.settings.scale)
    return groups_on(path, rows[in_turn], period, scale)


def groups_on(
    path: Trajectory,
    rows: Int[np.ndarray, " E"],
    period: float,
    scale: Float[np.ndarray, "A d"],
) -> list[SimultaneousEvents | None]:
    """The groups of events of a path that happen at the same time; `None` for a group whose order
    is the same on all neighboring trajectories. `rows`: rows of the path at which events happen.
    `period`: time relative to which differences of times are judged.

    **Arguments:** `scale`: sizes of the states by chart.
    """
    times = path.t[rows]
    steps = np.diff(times, prepend=-np.inf)
    starts = np.flatnonzero(steps > TOGETHER * period)
    groups: list[SimultaneousEvents | None] = []
    for first, after in itertools.pairwise([*starts, len(rows)]):
        group = rows[first:after].tolist()
        events = path.event[group].tolist()
        missed = _missed(path.structure, events, float(times[first]), period)
        missed |= _rivals(path, group[0], events, period)
        if len({*events, *missed}) < 2:
            continue
        before_last = range(group[0], group[-1])
        in_order = all(_follows_at_once(path, k, period) for k in before_last)
        if in_order and not missed:
            groups.append(None)
        elif len({*events, *missed}) > _MOST_ORDERED:
            groups.append(_not_compared(path, group))
        else:
            groups.append(_coincidence(path, group[0], period, scale))
    return groups


def _not_compared(path: Trajectory, group: list[int]) -> SimultaneousEvents:
    """A group with too many orders to compare them."""
    names = tuple(path.structure.transitions[g].name for g in path.event[group])
    return SimultaneousEvents(float(path.t[group[0]]), (names,), (), False)


def _coincidence(
    path: Trajectory, k: int, period: float, scale: Float[np.ndarray, "A d"]
) -> SimultaneousEvents:
    """The group of events of which event k of a path is the first."""
    s = path.structure
    t = float(path.t[k])
    a = int(path.chart[k - 1])
    n = s.dims[a]
    before = _Order(
        events=(),
        chart=a,
        state=path.before[k, :n],
        derivative=np.eye(n),
    )
    due = 10 * TOGETHER * period
    orders = list(_orders(s, t, before, due))
    names = tuple(
        tuple(s.transitions[g].name for g in order.events) for order in orders
    )
    derivatives = tuple(order.derivative for order in orders)
    commute = _commute(scale, a, orders)
    return SimultaneousEvents(
        time=t,
        orders=names,
        derivatives=derivatives,
        commute=commute,
    )


def _follows_at_once(path: Trajectory, k: int, period: float) -> bool:
    """True if event k + 1 of a path follows event k at once on all neighboring trajectories. This
    is so if both are scheduled, or if the reset of event k puts the guard of the next event below
    zero, or to zero on each of them.
    """
    s = path.structure
    g, later = path.event[k : k + 2].tolist()
    is_scheduled, next_is_scheduled = (
        isinstance(s.transitions[x].guard, Scheduled) for x in (g, later)
    )
    if next_is_scheduled or later < 0:
        return is_scheduled and next_is_scheduled
    n = s.dims[int(path.chart[k - 1])]
    chart = int(path.chart[k])
    m = s.dims[chart]
    time = path.t[[k]]
    u = np.zeros((s.nu, 1))
    before = path.before[k, :n, None]
    after = path.after[k, :m, None]
    first = np.zeros(1, np.int32)
    watched = kernels.watched(s, chart, None, time, after, u, first)
    guard = watched[s.guards(chart).index(later), :, 0]
    value = guard[0]
    by_t = guard[1]
    by_q = guard[2 : 2 + m]
    by_u = guard[2 + m :]
    field = kernels.field(s, chart, time, after, u)[:, 0, 0]
    rate = by_t + by_q @ field
    if value < -TOGETHER * period * abs(rate):
        return True
    # Derivatives of the guard after the reset by the time, the state before it and the inputs. They
    # are zero up to rounding if the guard is zero on each neighboring trajectory.
    expanded = kernels.reset(s, s.member(g), time, before, u)
    by_reset = expanded[:, 1:, 0]
    direct = np.concatenate([[by_t], np.zeros(n), by_u])
    change = direct + by_q @ by_reset
    by_rows = np.abs(by_q) @ np.abs(by_reset)
    size = np.abs(direct) + by_rows
    if is_scheduled:  # (its time is the same on all trajectories)
        change[0] = 0.0
    return bool((np.abs(change) <= ROUNDING * size).all())


def commutes(cycle: Any) -> bool:
    """True if events coincide on a cycle, and all of them commute or have the same order on all
    neighboring trajectories. False if no events coincide."""
    groups = _groups(cycle)
    return bool(groups) and all_commute(groups)


def all_commute(groups: list[SimultaneousEvents | None]) -> bool:
    """True if the orders of all groups commute, or are the same for all neighbors."""
    return all(group is None or group.commute for group in groups)


def _missed(s: Structure, group: list[int], t: float, period: float) -> set[int]:
    """The scheduled events that are due at the time of a group that contains an event of a
    guard."""
    if all(s.clocks[g] >= 0 for g in group):
        return set()
    happened = {int(s.clocks[g]) for g in group}
    codes = np.array(group)
    times = np.full(len(group), t)
    return {
        g
        for g in np.flatnonzero(s.clocks >= 0).tolist()
        if s.clocks[g] not in happened and is_due(s, g, codes, times, period).any()
    }


def _rivals(path: Trajectory, k: int, events: list[int], period: float) -> set[int]:
    """The guards, other than those of `events`, that fall to zero where event k of a path happens
    (see `Tape.rival`)."""
    s = path.structure
    a = int(path.chart[k - 1])
    n = s.dims[a]
    times = path.t[[k - 1, k]]
    begin = path.after[k - 1, :n]
    end = path.before[k, :n]
    states = np.stack([begin, end])
    u = np.zeros((s.nu, 1))
    found = set()
    for g in s.guards(a):
        event = jump(s, g, times, states, u)
        zero = TOGETHER * period * abs(event.rate[0])
        was_positive = event.level[0] > zero
        falls = falls_within(event.level[1], event.rate[1], TOGETHER * period)
        member = s.member(g)
        predicate = kernels.enabled(s, member, times[1:], states[1:].T, u)
        holds = predicate.all()
        if g not in events and was_positive and falls and holds:
            found.add(g)
    return found


def _scheduled_at(s: Structure, g: int, t: float, within: float) -> bool:
    """True if scheduled event g happens at t."""
    schedule = cast(Scheduled, s.transitions[g].guard)
    nearest = schedule.nearest(np.asarray(t))
    return abs(float(nearest) - t) <= within


def _commute(scale: Float[np.ndarray, "A d"], a: int, orders: list[_Order]) -> bool:
    """True if all orders lead from chart a through as many events to the same state, with the same
    derivative."""
    ends = {(order.chart, len(order.events)) for order in orders}
    if len(orders) < 2 or len(ends) > 1:
        return False
    m, n = orders[0].derivative.shape
    rows = []
    for order in orders:
        derivative = order.derivative * scale[a, :n]
        rows.append(np.column_stack([order.state, derivative]))
    of_states = scale[orders[0].chart, :m, None]
    apart = np.ptp(rows, axis=0) / of_states
    return bool(np.max(apart) < SAME)


def _orders(s: Structure, t: float, before: _Order, due: float) -> Iterator[_Order]:
    """Iterate over all orders in which events can happen at one time, after the events in `before`,
    until no further event is due."""
    a = before.chart
    q = before.state[None]
    u = np.zeros((s.nu, 1))
    time = np.array([t])
    happened = [s.clocks[g] for g in before.events]
    scheduled = [
        g
        for g in s.schedules(a)
        if _scheduled_at(s, g, t, due) and s.clocks[g] not in happened
    ]
    is_last = True
    for g in [*scheduled, *_guards_due(s, a, time, q, u, due)]:
        if g in before.events:
            continue
        if not kernels.enabled(s, s.member(g), time, q.T, u).all():
            continue
        event = jump(s, g, time, q, u)
        saltation = event.saltation[0]
        if g in scheduled:
            saltation = event.by_state[0]
        b = s.chart_index(s.transitions[g].target)
        events = (*before.events, g)
        order = _Order(
            events=events,
            chart=b,
            state=event.after[0],
            derivative=saltation @ before.derivative,
        )
        is_last = False
        yield from _orders(s, t, order, due)
    if is_last and before.events:
        yield before


def _guards_due(
    s: Structure,
    a: int,
    time: Float[np.ndarray, "1"],
    q: Float[np.ndarray, "1 n"],
    u: Float[np.ndarray, "nu 1"],
    due: float,
) -> list[int]:
    """The guards of chart a that fall, and are closer to zero than they move in a time `due`."""
    guards = s.guards(a)
    if not guards:
        return []
    first = np.zeros(1, np.int32)
    rows = kernels.watched(s, a, None, time, q.T, u, first)
    watched = rows[:, :, 0]
    field = kernels.field(s, a, time, q.T, u)[:, 0, 0]
    level = watched[:, 0]
    by_t = watched[:, 1]
    by_state = watched[:, 2 : 2 + len(field)]
    rate = by_t + by_state @ field
    return [guards[k] for k in np.flatnonzero(falls_within(level, rate, due))]


def check_begin(map: ReturnMap) -> None:
    """**Raises:** `ComputationError` if turns begin at an event that may or may not belong to
    them."""
    base = map.base
    if not (base is None or isinstance(base, AtEvent)):
        return
    guards, rates = jax.device_get(_at_anchor(map))
    # (At the end of sliding, the guard with which sliding began has the rate zero.)
    due = rates < -TOGETHER * np.abs(rates).max(initial=0.0)
    due &= falls_within(guards, rates, TOGETHER * float(map.expected))
    if base is not None:
        # (Events that follow at once have been armed by the event that led to the anchor.)
        armed = np.asarray(map.anchor.armed)[:, 0]
        due |= armed & (guards < 0)
        due[map.event] = False
    if due.any():
        raise ComputationError(about_begin(map, int(np.argmax(due))))


def about_begin(map: ReturnMap, g: int) -> str:
    """A sentence: the section of the return map cannot lie where event g happens, too."""
    name = map.structure.transitions[g].name
    begins = "the beginning of every turn"
    if isinstance(map.base, AtEvent):
        begins = f"'{map.base.name}', its beginning"
    return (
        f"the event '{name}' coincides with {begins}, so that it may or may not belong to the "
        "turn: take another section, or a guess at another time."
    )


@host_first
def _at_anchor(map: ReturnMap):
    """The guards (G,) at the anchor, and their rates."""
    watched = map.watch(map.anchor, until(map.anchor.t))
    guards = watched.value[:-1, 0]
    rates = watched.rate[:-1, 0]
    return guards, rates
