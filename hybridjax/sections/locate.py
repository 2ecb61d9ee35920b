"""Locate the sections of a family on a limit cycle.

`place.py` calls `place_in_order` or `place_on_host` (outside of programs of JAX) or
`place_in_program` (inside), and gets `PlacedSections`. `_place` does the work: it binds the family
to the cycle (`_bind`), flows to section 0, and then from each section to the next. On the host, the
recorded steps of the cycle are used if they are known (`along.py`); otherwise there is a search.
Both must give the same. Results are checked in `checks.py`.

If a section is placed at a wrong time, look at `_bind` (clock sections), and at `along.py` or the
search (others); if the order is wrong, at `place_in_order`; if a good section is refused, at
`checks.py`, or for a clock section at an event, at `_near_events`.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import host_first, quick_jit
from .._core.executor import (
    Array,
    namespace,
    on_host,
    put,
    stop_gradient,
    to_host,
)
from .._core.memo import Recent
from .._core.results import Result, update_result
from ..engine import kernels
from ..engine.lanes import Lanes, for_each_chart, only, side_by_side
from ..engine.move import Options, stride, through
from ..engine.target import Target, toward
from ..engine.watch import slopes
from ..orbits.coincidence import SAME
from ..orbits.crossing import Crossing, to_section
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import last_turn
from ..orbits.return_map import PATIENCE, ReturnMap
from ..orbits.scale import has_implicit
from ..systems.structure import Structure
from ..systems.transition import Scheduled, at_one_time
from .along import flow_along
from .checks import OutOfOrderError, check_placed
from .families import AbstractSections, BoundSections, Orbit, SectionList
from .placed import PlacedSections, followed_at_once


# The sections that were placed last, since `linearize` and `run_experiments` ask for the same ones.
_recent = Recent(4)
# The same for lists that were not in order.
_sorted = Recent(4)


def _patient(cycle: LimitCycle) -> ReturnMap:
    """The return map of a cycle, with at least `PATIENCE` steps from section to section."""
    map = cycle.return_map
    steps = max(map.settings.max_steps, PATIENCE)
    return dataclasses.replace(
        map, settings=dataclasses.replace(map.settings, max_steps=steps)
    )


def place_on_host(cycle: LimitCycle, family: AbstractSections) -> PlacedSections:
    """The sections of a family on a cycle that JAX does not trace.

    **Raises:** as `place_sections`.
    """
    placed: PlacedSections | None = _recent.get(cycle, family)
    if placed is not None:
        return placed
    family.check(cycle.structure)
    # (Compiled functions depend on the number of moves: for implicit methods, whose moves are not
    # used, none are given.)
    turn = None if has_implicit(cycle.structure) else last_turn(cycle)
    first, fields = _place(_patient(cycle), family, turn)
    placed = PlacedSections(cycle, family, *fields)
    check_placed(placed, int(first))
    return _recent.keep(placed, cycle, family)


def place_in_order(cycle: LimitCycle, family: AbstractSections) -> PlacedSections:
    """The sections of a family on a cycle whose values are known (JAX traces none). Sections of a
    list are in the order in which the cycle meets them.

    **Raises:** as `place_sections`.
    """
    if not isinstance(family, SectionList):
        return place_on_host(cycle, family)
    known: PlacedSections | None = _sorted.get(cycle, family)
    if known is not None:
        return known
    try:
        return place_on_host(cycle, family)
    except OutOfOrderError as error:
        later = np.argsort(error.phases, kind="stable")
    listed = SectionList([family.items[k] for k in later])
    return _sorted.keep(place_on_host(cycle, listed), cycle, family)


def place_in_program(cycle: LimitCycle, family: AbstractSections) -> PlacedSections:
    """The sections of a family on a traced cycle, with a result code for each section."""
    _, fields = _place(_patient(cycle), family, None)
    return PlacedSections(cycle, family, *fields)


def place_by_turn(
    cycle: LimitCycle, family: AbstractSections, turn: Any
) -> tuple[PlacedSections, list]:
    """The sections of a family on a cycle, from its recorded steps, on the host; and the start,
    target and tape of the flow to each section."""
    flows: list[Any] = []
    _, fields = _locate(_patient(cycle), family, turn, flows)
    return PlacedSections(cycle, family, *fields), flows


@host_first
def _place(
    map: ReturnMap, family: AbstractSections, turn: Any
) -> tuple[Int[Array, ""], tuple]:
    """The `Result` of the flow to section 0, which lies at the anchor if that is a crossing, and
    the fields of `PlacedSections` from `bound` on. The host begins with the last `turn`."""
    return _locate(map, family, turn, [])


def _locate(
    map: ReturnMap, family: AbstractSections, turn: Any, flows: list
) -> tuple[Any, Any]:
    """As `_place`. On the host, the start, target and tape of every flow are appended to
    `flows`."""
    s = Structure(map.system)
    N = family.n_sections
    period = map.expected
    xp = namespace(period)

    def go(carry, targets, patience=np.inf):
        """Flow to the targets one after the other, from recorded steps or by a search; in the form
        that `through` returns."""
        found = None
        if turn is not None and on_host(period):
            found = flow_along(map, turn, carry, targets)
        if found is None:
            options = Options(tape=True, tangents=True)
            u = xp.zeros((s.nu, 1))
            found = through(s, carry, u, targets, map.settings, options, patience)
        carry, flow = found
        flows.append((flow[0], targets, flow[2]))
        return carry, flow

    # From the beginning of the cycle to the anchor.
    first_step = stride((0.1 * period / N)[None])
    carry = map.anchor, first_step, xp.zeros(1, xp.int32)
    before = None
    if isinstance(family.anchor, Crossing):
        no_time = xp.full(1, np.inf)
        target = toward(no_time, -1, map.anchor.t + 1.5 * period)
        carry, before = go(carry, to_section(target, family.anchor))
        if not family.at_anchor:
            before = None
    # From the anchor to all sections. (The first piece leads to section 0, unless that is the
    # anchor.)
    bound = _bind(s, map, family, carry[0], go)
    targets = _all_sections(bound, period, begins_on_section=before is not None)
    _, pieces = go(carry, targets, 1.5 * period)
    if before is None:
        before = pieces
        pieces = jax.tree_util.tree_map(lambda x: x[1:], pieces)
    first = before[1].result[0, 0]
    # Result codes of the flow from each section to the next.
    lanes, moved, tape = side_by_side(pieces)
    duration = moved.lanes.t - lanes.t
    near = _near_events(map, bound, lanes, moved.lanes, tape)
    result = update_result(moved.result, near, Result.SIMULTANEOUS)
    # (If an event on a section was missed, it is the cause of a failure of the flow that starts
    # there.)
    still = xp.zeros((s.nu, 1))
    missed = followed_at_once(s, lanes, still, bound.event >= 0, period)
    result = xp.where(missed >= 0, xp.int32(Result.EVENT_ORDER), result)
    if not on_host(period):  # (on the host `check_placed` says more)
        turns = xp.abs(xp.sum(duration) / period - 1) > SAME
        result = update_result(result, turns, Result.SECTION_MISSED)
    coordinates = coordinates_on(map, bound, lanes)
    return first, (bound, lanes, tape, duration, result, *coordinates)


def _all_sections(bound: BoundSections, period: Any, begins_on_section: bool) -> Target:
    """The targets of a flow from section to section, until section 0 is met again."""
    N = len(bound.time)
    xp = namespace(bound.time)
    k = xp.arange(int(begins_on_section), N + 1)
    index = k % N
    return Target(
        time=bound.time[index] + (k // N) * period,
        index=index,
        event=bound.event[index],
        limit=xp.full(k.shape, np.inf),
        event_sequence=None,
        levels=bound.levels,
        missed=Result.SECTION_MISSED,
    )


def _near_events(
    map: ReturnMap, bound: BoundSections, starts: Lanes, ends: Lanes, tape: Any
) -> Array:
    """Test at which of N clock sections an event of a guard happens: rounding would decide on which
    side of the event such a section lies."""
    xp = namespace(bound.time)
    s = map.structure
    is_scheduled = [isinstance(x.guard, Scheduled) for x in s.transitions]
    ignored = xp.asarray(
        [*is_scheduled, True]
    )  # (the last one is for moves without an event)
    is_ignored = ignored[xp.maximum(tape.code, -1)]
    when = xp.where(is_ignored, xp.nan, tape.t)
    at_start = at_one_time(when, starts.t, map.expected).any(axis=0)
    at_end = at_one_time(when, ends.t, map.expected).any(axis=0)
    return xp.isfinite(bound.time) & (at_start | xp.roll(at_end, 1))


def coordinates_on(
    map: ReturnMap, bound: BoundSections, lanes: Lanes
) -> tuple[Int[Array, " N"], Int[Array, " N"], Float[Array, "N n"]]:
    """The fields `drop`, `dims` and `normal` of `PlacedSections`."""
    s = map.structure
    xp = namespace(lanes.t)
    N = len(lanes.t)
    no_input = xp.zeros((s.nu, 1))
    normal = normals(s, bound, lanes, xp.arange(N), no_input)
    no_inputs = xp.zeros((s.nu, N))
    field = slopes(s, lanes.t, lanes.chart, lanes.q, no_inputs)
    flow = xp.concatenate([xp.ones((1, N)), field])
    share = xp.abs(normal.T * flow)
    is_flat = xp.max(share, axis=0) == 0
    drop = xp.where(is_flat, -1, xp.argmax(share, axis=0))
    time_is_state = xp.isinf(bound.time) & (map.base is None)
    states = xp.asarray(s.dims)[lanes.chart]
    return drop, states + time_is_state - ~is_flat, normal


def recorded_flows(placed: PlacedSections) -> tuple[Any, Any]:
    """Starts and recorded steps of two flows: from the cycle's beginning to the anchor of the
    family (None if the anchor is no `Crossing`), and from there to one section after the other."""
    cycle = placed.cycle
    flows: list[Any] = []
    turn = None if has_implicit(cycle.structure) else last_turn(cycle)
    map, family = to_host((_patient(cycle), placed.family))
    _locate(map, family, turn, flows)
    recorded = [side_by_side((lanes, tape)) for lanes, _, tape in flows]
    lead = recorded[0] if isinstance(family.anchor, Crossing) else None
    return lead, recorded[-1]


def _bind(
    s: Structure, map: ReturnMap, family: AbstractSections, anchor: Lanes, go
) -> BoundSections:
    """The family bound to the cycle. Times of clock sections lie in the period that begins at the
    anchor."""
    period = map.expected
    t = anchor.t[0]
    M = family.points
    xp = namespace(period)

    lanes = anchor
    if M > 1:
        first_step = stride((0.1 * period / M)[None])
        carry = anchor, first_step, xp.zeros(1, xp.int32)
        times = anchor.t + period * xp.arange(1, M + 1) / M
        _, begun = go(carry, toward(times, -1, times))
        lanes = side_by_side(begun[0])
    bound = bind_at(map, family, lanes)
    late = xp.ceil((t - bound.time[0]) / period)
    late = xp.where(xp.isfinite(bound.time[0]), stop_gradient(late), 0.0)
    return dataclasses.replace(bound, time=bound.time + late * period)


def bind_at(map: ReturnMap, family: AbstractSections, points: Lanes) -> BoundSections:
    """The family bound to the cycle, from points at equal times."""
    orbit = Orbit(
        period=map.expected,
        t=points.t,
        chart=points.chart,
        q=points.q.T,
    )
    if on_host(map.expected):
        return to_host(_bind_program(map, family, orbit))
    return family.bind(map.structure, orbit)


@quick_jit
def _bind_program(
    map: ReturnMap, family: AbstractSections, orbit: Orbit
) -> BoundSections:
    return family.bind(map.structure, orbit)


def normals(s: Structure, bound: BoundSections, lanes: Lanes, index, u) -> Array:
    """Gradients (N, n) of the levels with respect to (t, q)."""
    xp = namespace(lanes.t)
    levels = bound.levels
    out = xp.zeros((1 + s.d, len(index)), lanes.t.dtype)
    if levels is None:
        return out.T
    state_based = xp.isinf(bound.time) & (bound.event < 0)

    def work(a, mask, out):
        if not levels.present(s, a):
            return out
        point = [only(mask, x) for x in (lanes.t, lanes.q[: s.dims[a]], u, index)]
        expanded = kernels.watched(s, a, levels, *point)[-1]
        by = expanded[1 : 2 + s.dims[a]]
        return xp.where(mask, put(out, slice(len(by)), by), out)

    return for_each_chart(s, lanes.chart, state_based, work, out).T
