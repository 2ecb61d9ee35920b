"""Events that coincide on a limit cycle: what each of their orders does to neighbors of the cycle.

Where two guards are crossed at the same time, neighbors of the cycle meet one or the other first.
The flow is then piecewise differentiable, with one derivative for each order (S. A. Burden, S. S.
Sastry, D. E. Koditschek, S. Revzen, Event-selected vector field discontinuities yield
piecewise-differentiable flows, SIAM J. Applied Dynamical Systems 15, 2016). Where these are equal,
as for events that have nothing to do with each other, it is differentiable after all.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from .._core.boundary.checked import checked
from .._core.compilation import at_ease, host_first
from .._core.executor import namespace, to_host
from .._core.results import Result
from ..engine import kernels
from ..engine.chain import chain
from ..engine.lanes import start_lanes
from ..engine.move import record
from ..engine.target import toward, until
from ..engine.watch import watch
from ..errors import ComputationError
from ..systems.structure import Structure
from ..systems.transition import Scheduled
from .crossing import AtEvent
from .cycle import LimitCycle
from .return_map import ReturnMap, Turn


# Events coincide if no more than this part of the period lies between them. Doubled, so do events
# twice as far apart.
TOGETHER = 1e-9
# A guard is due if it would be at zero within this part of the period. Ten times as much as lies
# between events that coincide.
_DUE = 1e-8
# Orders commute if states after them, and derivatives, differ by less than this, in sizes of the
# states. Doubled, so do orders that differ twice as much.
_COMMUTE = 1e-6


# A turn is followed up to this part of the period before the events, and continued by the field
# there; the error is its cube. Doubled, that grows by 8, but events half as close are told apart.
_SHORT = 1e-5
# Steps of a turn at most. Doubled, turns of twice as many are followed.
_STEPS = 20_000


class Coincidence(NamedTuple):
    """Events of a cycle that happen at the same time."""

    time: float
    orders: tuple[tuple[str, ...], ...]
    """The names of the events, in every order in which all of them can happen."""
    derivatives: tuple[Float[np.ndarray, "m n"], ...]
    """For each order, that of the state after all events by the state before them, at the same time
    (a product of saltation matrices). It holds for neighbors of the cycle that meet the events in
    this order."""
    commute: bool
    """Whether all orders lead to the same state, with the same derivative."""
    multipliers: tuple[Complex[np.ndarray, " r"], ...]
    """For each order, the largest first: those that the cycle would have if all its neighbors met
    the events in this order; none where it leads to another state than the cycle's. (Neighbors may
    change from one order to the other, so that they need not tell whether a cycle is stable.)"""


class _Way(NamedTuple):
    events: tuple[int, ...]
    chart: int
    state: Float[np.ndarray, " m"]
    derivative: Float[np.ndarray, "m n"]


@checked
def coincidences(cycle: LimitCycle) -> list[Coincidence]:
    """Groups of events that coincide on a limit cycle, with one-sided derivatives for each order.

    `find_limit_cycle`, sweeps and `continuation` ask for them: where orders commute the cycle is
    ok, otherwise its result is `Result.COINCIDENCE` (`find_limit_cycle` returns it by
    `throw=False`). Scheduled events are among them, if they coincide with one of a guard.
    """
    cycle = to_host(cycle)
    s, period, found = Structure(cycle.system), float(cycle.period), []
    way = cycle.trajectory(2.0)
    at = np.flatnonzero(way.event >= 0)
    times = way.t[at]
    starts = np.flatnonzero(np.diff(times, prepend=-np.inf) > TOGETHER * period)
    for first, after in zip(starts, [*starts[1:], len(at)], strict=True):
        t, k = float(times[first]), at[first]
        group = way.event[at[first:after]].tolist()
        if not TOGETHER * period < t - way.t[0] <= (1 + TOGETHER) * period:
            continue
        events = {*group, *_missed(s, group, t, period)}
        if len(events) > 1:
            a = int(way.chart[k - 1])
            n = s.dims[a]
            here = _Way((), a, way.before[k, :n], np.eye(n))
            ways = list(_ways(s, t, here, len(events), _DUE * period))
            end = at[after - 1]
            goes_on = int(way.chart[end]), way.after[end]
            found.append(_coincidence(cycle, t, a, ways, goes_on))
    return found


def commutes(cycle: LimitCycle) -> bool:
    """Whether all events that coincide on a cycle, of which there are some, may come in either
    order."""
    groups = coincidences(cycle)
    return bool(groups) and all(group.commute for group in groups)


def events_of(turn: Turn) -> list[tuple[int, float]]:
    """The transitions of a turn by index, with their times."""
    codes, times = (np.ravel(x) for x in (turn.codes, turn.times))
    return [(int(g), float(t)) for g, t in zip(codes, times, strict=True) if g >= 0]


def coincident(map: ReturnMap, turn: Turn) -> tuple[int, int] | None:
    """Two transitions of a turn, by index, that are due at the same time; a scheduled one may be
    passed over by the turn."""
    s, period, events = map.structure, float(turn.period), events_of(turn)
    if isinstance(map.base, AtEvent):  # the turn begins with the event that ends it
        events = [(s.transition_index(map.base.name), float(turn.legs.t[0])), *events]
    for (g, t), (other, later) in itertools.pairwise(events):
        if later - t <= TOGETHER * period:
            return g, other
    for g, t in events:
        for other in _missed(s, [g], t, period):
            return g, other
    return None


def together(
    codes: Int[np.ndarray, "S R"],
    times: Float[np.ndarray, "S R"],
    begin: Float[np.ndarray, " S"],
    period: Float[np.ndarray, " S"],
) -> Bool[np.ndarray, " S"]:
    """In which of many turns two events, or an event and the one with which the turn begins,
    coincide.

    **Arguments:** `codes`, negative where there is no event, and `times`, of the events in order;
    `begin`, when the turns begin, minus infinity for one that begins with no event.
    """
    found = np.zeros(len(codes), bool)
    row, column = np.nonzero(codes >= 0)
    t, first = times[row, column], np.diff(row, prepend=-1) > 0
    before = np.where(first, begin[row], np.roll(t, 1))
    found[row[t - before <= TOGETHER * period[row]]] = True
    return found


def _missed(s: Structure, group: list[int], t: float, period: float) -> set[int]:
    """The scheduled events that are due together with a group in which there is one of a guard."""
    if all(_is_scheduled(s, g) for g in group):
        return set()
    ends = ((s.transitions[g].source, s.transitions[g].target) for g in group)
    charts = {s.chart_index(name) for pair in ends for name in pair}
    due = {g for a in charts for g in s.schedules(a) if _scheduled_at(s, g, t, TOGETHER * period)}
    return due - set(group)


def _is_scheduled(s: Structure, g: int) -> bool:
    return isinstance(s.transitions[g].guard, Scheduled)


def _scheduled_at(s: Structure, g: int, t: float, within: float) -> bool:
    """Whether scheduled event g happens at t."""
    schedule = s.transitions[g].guard
    turns = (t - float(schedule.offset)) / float(schedule.period)
    return abs(turns - round(turns)) * float(schedule.period) <= within


def _coincidence(cycle: LimitCycle, t: float, a: int, ways: list[_Way], goes_on) -> Coincidence:
    """`goes_on`: the chart and state in which the cycle does."""
    s, values = Structure(cycle.system), tuple(_multipliers(cycle, t, a, ways, *goes_on))
    scale, derivatives = np.asarray(cycle.settings.scale), tuple(way.derivative for way in ways)
    names = tuple(tuple(s.transitions[g].name for g in way.events) for way in ways)
    if len(ways) < 2:  # in the other order one of them does not happen
        return Coincidence(t, names, derivatives, False, values)
    size, one, commute = scale[a, : s.dims[a]], ways[0], True
    m = len(one.state)
    for other in ways[1:]:
        if other.chart != one.chart:
            commute = False
            break
        after = scale[one.chart, :m]
        apart = np.abs(other.state - one.state) / after
        tilted = np.abs(other.derivative - one.derivative) * size / after[:, None]
        commute = commute and max(apart.max(), tilted.max()) < _COMMUTE
    return Coincidence(t, names, derivatives, bool(commute), values)


def _multipliers(cycle, t, a, ways, chart: int, state) -> Iterator[np.ndarray]:
    """The multipliers of each order; the cycle goes on in this chart and state."""
    s, period = Structure(cycle.system), float(cycle.period)
    n, m, u = s.dims[a], s.dims[chart], np.zeros((s.nu, 1))
    # (Steps of an explicit method end shortly before the events.)
    short, last = _SHORT * period, t + (1 - _SHORT) * period
    lanes = start_lanes(s, np.array([t]), np.array([chart], np.int32), state[:, None])
    target = toward(np.array([last]), -1, np.array([t + 2 * period]))
    settings = dataclasses.replace(cycle.settings, max_steps=_STEPS)
    with at_ease():
        moved, tape = record(s, lanes, u, target, settings, tangents=True)
        around, _ = chain(s, lanes, target, tape, of_states=True)
    before = moved.lanes.q[:n]
    field = kernels.field(s, a, np.array([last]), before, u)[:, 2 : 2 + n, 0]
    rest = np.eye(n) + short * field + short**2 / 2 * field @ field
    for way in ways:
        size = np.asarray(cycle.settings.scale)[chart, :m]
        same = way.chart == chart and np.max(np.abs(way.state - state[:m]) / size) < _COMMUTE
        if not same or moved.result[0] != Result.OK or moved.lanes.chart[0] != a:
            yield np.zeros(0, complex)
            continue
        values = np.linalg.eigvals(rest @ around[0, 1 : 1 + n, :m] @ way.derivative).astype(complex)
        if not cycle.clocked:  # less that of the flow's own direction
            values = np.delete(values, np.argmin(np.abs(values - 1)))
        yield values[np.argsort(-np.abs(values), kind="stable")]


def _ways(s: Structure, t: float, way: _Way, left: int, due: float) -> Iterator[_Way]:
    """All orders in which `left` more events can happen at once."""
    if not left:
        yield way
        return
    a, q, u = way.chart, way.state[:, None], np.zeros((s.nu, 1))
    time = np.array([t])
    field = kernels.field(s, a, time, q, u)[:, 0, 0]

    def after(g: int, slope, rate) -> Iterator[_Way]:
        """The ways on after event g, which a guard with this slope and rate brings about."""
        if g in way.events or not kernels.enabled(s, s.member(g), time, q, u).all():
            return
        new = kernels.reset(s, s.member(g), time, q, u)[..., 0]
        b = s.chart_index(s.transitions[g].target)
        state, by_t, saltation = new[:, 0], new[:, 1], new[:, 2 : 2 + len(q)]
        if rate < 0:
            there = kernels.field(s, b, time, state[:, None], u)[:, 0, 0]
            saltation = saltation + np.outer(there - saltation @ field - by_t, slope) / rate
        found = _Way((*way.events, g), b, state, saltation @ way.derivative)
        yield from _ways(s, t, found, left - 1, due)

    for g in s.schedules(a):
        if _scheduled_at(s, g, t, due):
            yield from after(g, np.zeros(len(q)), 0.0)
    if not (guards := s.guards(a)):
        return
    rows = kernels.watched(s, a, None, time, q, u, np.zeros(1, np.int32))[..., 0]
    for g, row in zip(guards, rows, strict=True):
        value, slope = row[0], row[2 : 2 + len(q)]
        rate = row[1] + slope @ field
        if rate < 0 and abs(value) <= -due * rate:
            yield from after(g, slope, rate)


def check_begin(map: ReturnMap) -> None:
    """**Raises:** `ComputationError` where turns begin at an event that may or may not belong to
    them."""
    s, at_event = map.structure, isinstance(map.base, AtEvent)
    if not (at_event or map.base is None):
        return
    guards, rates = jax.device_get(_at_anchor(map))
    due = (rates < 0) & (np.abs(guards) <= -TOGETHER * float(map.expected) * rates)
    if at_event:
        due[s.transition_index(map.base.name)] = False
    if due.any():
        name = s.transitions[int(np.argmax(due))].name
        if at_event:
            raise ComputationError(
                f"the event '{name}' coincides with '{map.base.name}', at which every turn begins "
                "and ends, so that it may or may not belong to the turn: take another section."
            )
        raise ComputationError(
            f"the search begins exactly at the event '{name}', which may or may not belong to the "
            "turn: give a guess at another time."
        )


@host_first
def _at_anchor(map: ReturnMap):
    """The guards (G,) at the anchor, and their rates."""
    s, anchor, xp = Structure(map.system), map.anchor, namespace(map.expected)
    u = xp.zeros((s.nu, 1))
    seen = watch(s, anchor.t, anchor.chart, anchor.q, u, until(anchor.t), xp.ones(1, bool))
    return seen.value[:-1, 0], seen.rate[:-1, 0]
