"""The position of the sections of a family on a limit cycle: located, and checked."""

import dataclasses
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.compilation import at_ease, host_first, quick_jit
from .._core.executor import (
    Array,
    is_traced,
    namespace,
    on_host,
    put,
    stop_gradient,
    to_host,
)
from .._core.host_derivatives import NotOnHostError, by_columns, require_program
from .._core.memo import Recent
from .._core.precision import require_x64
from .._core.results import Result, update_result
from ..engine import kernels
from ..engine.cubic import interpolate
from ..engine.lanes import IDLE, Lanes, Tape, for_each_chart, only, side_by_side
from ..engine.move import Options, stride, through
from ..engine.replay import Moves, Variation, recorded_moves
from ..engine.target import AbstractLevels, Target, toward
from ..engine.watch import slopes
from ..errors import ComputationError, DefinitionError
from ..orbits.checks import check_outputs
from ..orbits.coincidence import SAME
from ..orbits.crossing import Crossing, ListLevels, to_section
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import beginning, last_turn, of_flow
from ..orbits.return_map import PATIENCE, ReturnMap
from ..orbits.scale import has_implicit
from ..systems.structure import Structure
from ..systems.transition import Scheduled, at_one_time
from . import families
from .along import flow_along, levels_at
from .families import AbstractSections, BoundSections, FamilyLike, Orbit, as_family
from .placed import PlacedSections, SectionsLike, observe


# Parts of every step of the flow in which further crossings of a section are sought. Fewer: two
# crossings that are close are missed. More: the check takes longer.
_PARTS_OF_A_STEP = 16
# A section is tangent to the cycle if its level changes there at less than this fraction of its
# fastest rate on the cycle. Smaller: crossings that are lost by a perturbation are accepted.
# Larger: sections at a small angle are rejected.
_LEAST_STEEPNESS = 1e-4

# The last sections that were placed: `linearize`, then `run_experiments`, ask for the same ones.
_recent = Recent(4)


@checked
def place_sections(cycle: LimitCycle, sections: FamilyLike) -> PlacedSections:
    """Locate a family's sections on a cycle, and check them.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `sections`: a family (`ClockPhase`, `ArcLength`, `KinematicPhase`, `SectionList`), or a list
      of `Crossing` and `AtEvent`. The flow from each section to the next may take as many steps as
      the cycle's `settings` allow, and at least 1024.

    **Returns:** `PlacedSections`, which every function takes in place of a family: `lanes`, the N
    states on the cycle, and `duration` (N,), the times from section to section.

    **Raises:** `DefinitionError` for a family that does not fit the system; `ComputationError` that
    names the first section that the cycle does not cross, crosses more than once, touches
    tangentially, or crosses out of order.

    **Example:**

    ```python
    placed = hj.sections.place_sections(cycle, sections)
    print(placed.duration)
    ```

    **Before:** `hj.find_limit_cycle`, `hj.ClockPhase`. **After:** `hj.linearize`,
    `hj.run_experiments`.
    """
    family = as_family(sections)
    require_x64(cycle, family)
    cycle.require_found()
    traced = is_traced((cycle, family))
    if not traced:
        placed: PlacedSections | None = _recent.get(cycle, family)
        if placed is not None:
            return placed
    family.check(cycle.structure)
    if traced:
        require_program()
        on_walk = _on_walk(cycle, family)
        if on_walk is not None:
            return on_walk
    # (Programs of `_place` are for one number of moves: none are given where they do not help.)
    turn = None if traced or has_implicit(cycle.structure) else last_turn(cycle)
    first, fields = _place(_patient(cycle), family, turn)
    placed = PlacedSections(cycle, family, *fields)
    if not traced:
        _check(placed, int(first))
        _recent.keep(placed, cycle, family)
    return placed


def _on_walk(cycle: LimitCycle, family: AbstractSections) -> PlacedSections | None:
    """The sections of a traced cycle that was found beside a known one, on the walk of that; None
    if there is none."""
    from .walk import walk_beside, walked

    walk = walk_beside(cycle, family)
    return None if walk is None else walked(cycle, family, walk)[0]


def _patient(cycle: LimitCycle) -> ReturnMap:
    map = cycle.return_map
    steps = max(map.settings.max_steps, PATIENCE)
    return dataclasses.replace(
        map, settings=dataclasses.replace(map.settings, max_steps=steps)
    )


def as_placed(cycle: LimitCycle, sections: SectionsLike) -> PlacedSections:
    """`sections` placed on `cycle`: a family is placed, sections that were placed on it are kept.

    **Raises:** `DefinitionError` for sections that were placed on another one; otherwise as
    `place_sections`.
    """
    if not isinstance(sections, PlacedSections):
        return place_sections(cycle, sections)
    require_x64(cycle)
    cycle.require_found()
    if sections.cycle is cycle:
        return sections
    both = [(c.system, c.anchor, c.period) for c in (cycle, sections.cycle)]
    if is_traced(both):
        return place_sections(cycle, sections.family)
    if not eqx.tree_equal(*jax.device_get(both)):
        raise DefinitionError(
            "these sections were placed on another cycle: pass the family itself, e.g. "
            "`placed.family`, and it is placed on this one."
        )
    return sections


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
    """Do as `_place`; on the host `flows` gets the start, target and tape of every flow."""
    s = Structure(map.system)
    N = family.n_sections
    period = map.expected
    xp = namespace(period)

    def go(carry, targets, patience=np.inf):
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

    carry = map.anchor, stride((0.1 * period / N)[None]), xp.zeros(1, xp.int32)
    before = None
    if isinstance(family.anchor, Crossing):
        target = toward(xp.full(1, np.inf), -1, map.anchor.t + 1.5 * period)
        carry, before = go(carry, to_section(target, family.anchor))
        if not family.at_anchor:
            before = None
    bound = _bind(s, map, family, carry[0], go)
    targets = _all_sections(bound, period, begins_on_section=before is not None)
    _, pieces = go(carry, targets, 1.5 * period)
    if before is None:
        before = pieces
        pieces = jax.tree_util.tree_map(lambda x: x[1:], pieces)
    first = before[1].result[0, 0]
    lanes, moved, tape = side_by_side(pieces)
    duration = moved.lanes.t - lanes.t
    near = _near_events(map, bound, lanes, moved.lanes, tape)
    result = update_result(moved.result, near, Result.SIMULTANEOUS)
    if not on_host(period):  # (on the host `_check` says more)
        turns = xp.abs(xp.sum(duration) / period - 1) > SAME
        result = update_result(result, turns, Result.SECTION_MISSED)
    coordinates = coordinates_on(map, bound, lanes)
    return first, (bound, lanes, tape, duration, result, *coordinates)


def _all_sections(bound: BoundSections, period: Any, begins_on_section: bool) -> Target:
    """The targets on one section after the other, until section 0 is met again."""
    N, xp = len(bound.time), namespace(bound.time)
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
    """Test at which of N clock sections an event happens, but for those of the clock: rounding
    would decide on which side of it they lie."""
    xp, s = namespace(bound.time), map.structure
    is_scheduled = [isinstance(x.guard, Scheduled) for x in s.transitions]
    ignored = xp.asarray(
        [*is_scheduled, True]
    )  # (the last one is for moves without an event)
    when = xp.where(ignored[xp.maximum(tape.code, -1)], xp.nan, tape.t)
    at_start = at_one_time(when, starts.t, map.expected).any(axis=0)
    at_end = at_one_time(when, ends.t, map.expected).any(axis=0)
    return xp.isfinite(bound.time) & (at_start | xp.roll(at_end, 1))


def coordinates_on(
    map: ReturnMap, bound: BoundSections, lanes: Lanes
) -> tuple[Int[Array, " N"], Int[Array, " N"], Float[Array, "N n"]]:
    """The fields `drop`, `dims` and `normal` of `PlacedSections`."""
    s, xp = map.structure, namespace(lanes.t)
    N = len(lanes.t)
    normal = _normals(s, bound, lanes, xp.arange(N), xp.zeros((s.nu, 1)))
    field = slopes(s, lanes.t, lanes.chart, lanes.q, xp.zeros((s.nu, N)))
    flow = xp.concatenate([xp.ones((1, N)), field])
    share = xp.abs(normal.T * flow)
    is_flat = xp.max(share, axis=0) == 0
    drop = xp.where(is_flat, -1, xp.argmax(share, axis=0))
    time_is_state = xp.isinf(bound.time) & (map.base is None)
    states = xp.asarray(s.dims)[lanes.chart]
    return drop, states + time_is_state - ~is_flat, normal


def recorded_flows(placed: PlacedSections) -> tuple[Any, Any]:
    """Starts and steps, side by side, of the flow from a cycle's beginning to the anchor of the
    family (None if that is no `Crossing`), and from there to one section after the other."""
    cycle = placed.cycle
    flows: list[Any] = []
    turn = None if has_implicit(cycle.structure) else last_turn(cycle)
    map, family = to_host((_patient(cycle), placed.family))
    _locate(map, family, turn, flows)
    recorded = [side_by_side((lanes, tape)) for lanes, _, tape in flows]
    lead = recorded[0] if isinstance(family.anchor, Crossing) else None
    return lead, recorded[-1]


def place_along(
    cycle: LimitCycle,
    family: AbstractSections,
    turn: Any,
    by_cycle: LimitCycle,
    by_family: AbstractSections,
) -> tuple[PlacedSections, kernels.Tangents, np.ndarray]:
    """Sections placed on the host in P directions, as complex numbers of N P sections (see
    `kernels.Tangents`), the structure, and the Jacobians (N, P, n, m) of the flow."""
    flows: list[Any] = []
    map, N = _patient(cycle), family.n_sections
    placed = PlacedSections(cycle, family, *_locate(map, family, turn, flows)[1])
    if np.any(placed.result):
        raise NotOnHostError
    P = len(jax.tree_util.tree_leaves((by_cycle, by_family))[0])
    s, bound = map.structure, placed.bound
    x, longer = beginning(by_cycle, s.d, P)

    def follow(flow, by_levels, times, twice=False):
        starts, target, tapes = flow
        lanes, tape = side_by_side((starts, tapes))
        along = kernels.Tangents(s, by_cycle.structure, target.levels, by_levels, P)
        variation = Variation(along, lanes, target, tape, times, twice)
        return variation, variation.tangents(x), along

    if isinstance(family.anchor, Crossing):
        levels = ListLevels((cast(Crossing, by_family.anchor),))
        _, tangents, _ = follow(flows.pop(0), levels, np.zeros((P, 1)))
        x = tangents[-1]
    # The points of the orbit on which the family depends.
    M = family.points
    points, moved_points = side_by_side(flows[0][0]), x[None]
    orbit = Orbit(cycle.period, points.t[:M], points.chart[:M], points.q.T[:M])
    if M > 1:
        times = x[0][:, None] + longer[:, None] * np.arange(1, M + 1) / M
        variation, tangents, _ = follow(flows.pop(0), None, times)
        moved_points = tangents[variation.first]
    by_time = np.moveaxis(moved_points[:, 0], 1, 0)
    by_state = np.moveaxis(moved_points[:, 1:], 2, 0)
    directions = by_cycle.structure, by_family, (longer, by_time, by_state)
    raw, by_bound = to_host(_bind_along(s, family, orbit, directions))
    # The flow from section to section, with the times of the sections.
    is_clock = np.isfinite(bound.time)
    late = 0.0
    if is_clock[0]:
        late = np.rint((bound.time[0] - raw.time[0]) / cycle.period)
    k = np.arange(N + 1)[-len(flows[0][1].time) :]
    by_time = np.zeros((P, N)) if by_bound.time is None else by_bound.time
    later = (late + k // N) * longer[:, None]
    times = is_clock[k % N] * (by_time[:, k % N] + later)
    variation, tangents, along = follow(flows[0], by_bound.levels, times, True)
    t, chart, q, u = variation.points(tangents, variation.first[-N:])
    many = lambda y: np.repeat(y, P)  # noqa: E731
    lanes = placed.lanes._replace(t=t, chart=chart, q=q)
    bound = dataclasses.replace(bound, time=many(bound.time), event=many(bound.event))
    normal = _normals(along, bound, lanes, many(np.arange(N)), u)
    rows = dict(drop=many(placed.drop), dims=many(placed.dims), normal=normal)
    moved = dataclasses.replace(placed, bound=bound, lanes=lanes, **rows)
    return moved, along, variation.jacobians(tangents, placed.across)[-N:]


def _observed(
    cycle: LimitCycle, family: AbstractSections, outputs: tuple[str, ...], _: Any
):
    placed = place_sections(cycle, family)
    return placed.lanes.t, placed.observe(outputs) if outputs else None


def _observed_along(arguments: tuple, directions: tuple) -> tuple[tuple, tuple]:
    """`_observed` on the host, and its derivatives."""
    (cycle, family, outputs, turn), (by_cycle, by_family, *_) = arguments, directions
    placed, s, _ = place_along(cycle, family, turn, by_cycle, by_family)
    lanes, P = placed.lanes, s.directions
    u = s.pushed(np.arange(len(lanes.t)) % P)
    y = observe(s, check_outputs(cycle, outputs), lanes, u).T if outputs else None
    split = lambda x: x.reshape(-1, P, *x.shape[1:])  # noqa: E731
    return kernels.parted(jax.tree_util.tree_map(split, (lanes.t, y)))


_observed_by_columns = by_columns(_observed, _observed_along, of_flow)


def observed_at(
    cycle: LimitCycle, family: AbstractSections, outputs: tuple[str, ...], turn: Any
) -> tuple[Array, Array | None]:
    """Times (N,) at which a cycle crosses a family's sections, and outputs (N, ny) there."""
    from .walk import walk_beside

    arguments = cycle, family, outputs, turn
    if is_traced(cycle) and walk_beside(cycle, family) is not None:
        return _observed(*arguments)
    return _observed_by_columns(*arguments)


@quick_jit
def _bind_along(
    s: Structure, family: AbstractSections, orbit: Orbit, directions: tuple
):
    def bind(s, family, moving):
        period, t, q = moving
        return family.bind(s, Orbit(period, t, orbit.chart, q))

    begin = s, family, (orbit.period, orbit.t, orbit.q)
    push = lambda tangents: eqx.filter_jvp(bind, begin, tangents)  # noqa: E731
    return eqx.filter_vmap(push, out_axes=(None, 0))(directions)


def _bind(
    s: Structure, map: ReturnMap, family: AbstractSections, anchor: Lanes, go
) -> BoundSections:
    """The family evaluated on the cycle; clock sections in the period that begins at the anchor."""
    period, t, M = map.expected, anchor.t[0], family.points
    xp = namespace(period)

    lanes = anchor
    if M > 1:
        carry = anchor, stride((0.1 * period / M)[None]), xp.zeros(1, xp.int32)
        times = anchor.t + period * xp.arange(1, M + 1) / M
        lanes = side_by_side(go(carry, toward(times, -1, times))[1][0])
    bound = bind_at(map, family, lanes)
    late = xp.ceil((t - bound.time[0]) / period)
    late = xp.where(xp.isfinite(bound.time[0]), stop_gradient(late), 0.0)
    return dataclasses.replace(bound, time=bound.time + late * period)


def bind_at(map: ReturnMap, family: AbstractSections, points: Lanes) -> BoundSections:
    """The family evaluated on the cycle, from points at equal times."""
    orbit = Orbit(map.expected, points.t, points.chart, points.q.T)
    if on_host(map.expected):
        return to_host(_bind_program(map, family, orbit))
    return family.bind(map.structure, orbit)


@quick_jit
def _bind_program(
    map: ReturnMap, family: AbstractSections, orbit: Orbit
) -> BoundSections:
    return family.bind(map.structure, orbit)


def _normals(s: Structure, bound: BoundSections, lanes: Lanes, index, u) -> Array:
    """Gradients (N, n) of the levels with respect to (t, q)."""
    xp, levels = namespace(lanes.t), bound.levels
    out = xp.zeros((1 + s.d, len(index)), lanes.t.dtype)
    if levels is None:
        return out.T
    state_based = xp.isinf(bound.time) & (bound.event < 0)

    def work(a, mask, out):
        if not levels.present(s, a):
            return out
        point = [only(mask, x) for x in (lanes.t, lanes.q[: s.dims[a]], u, index)]
        by = kernels.watched(s, a, levels, *point)[-1, 1 : 2 + s.dims[a]]
        return xp.where(mask, put(out, slice(len(by)), by), out)

    return for_each_chart(s, lanes.chart, state_based, work, out).T


_AGAIN = "is crossed more than once in one period"


def _check(placed: PlacedSections, first: int) -> None:
    """**Raises:** `ComputationError` for the first section that is missed, tangent, out of order,
    crossed twice, or by the clock at the time of an event."""
    _require_reached(placed, [first, *np.asarray(placed.result).tolist()])
    name, anchor = placed.family.describe, placed.family.anchor
    if isinstance(anchor, Crossing) and len(_met(placed, 0).places) > 1:
        raise ComputationError(
            f"{name(0)} lies at {anchor}, which {_AGAIN}{_remedy(placed, 0)}"
        )
    moving = np.flatnonzero(np.asarray(placed.normal)[:, 0])
    if not placed.cycle.clocked and len(moving):
        raise ComputationError(
            f"{name(int(moving[0]))} depends on time, which has no meaning on the cycle of an "
            "autonomous system: use a function of the state, or ClockPhase."
        )
    _require_order(placed)
    assert placed.tape is not None
    events = np.sum(np.asarray(placed.tape.code) >= 0)
    # (By rounding, a round may hold the event at which it begins and ends twice, or not at all.)
    if events != len(placed.cycle.event_sequence):
        raise ComputationError(
            "a section coincides with an event (move it, or use `AtEvent`), or there were too few "
            "steps (find the cycle with `settings=Settings(max_steps=...)`)."
        )
    for i, (count, steepness) in enumerate(zip(*_crossings(placed), strict=True)):
        if steepness < _LEAST_STEEPNESS:
            raise ComputationError(
                f"{name(i)} is tangent to the cycle: its level changes there at "
                f"{steepness:.1g} of its fastest rate. Choose another level."
            )
        if count > 1:
            raise ComputationError(f"{name(i)} {_AGAIN}{_remedy(placed, i)}")


def _require_reached(placed: PlacedSections, results: list[int]) -> None:
    """**Raises:** `ComputationError` for the first result that is not OK: of the flow to section 0,
    and from each section to the next."""
    N, name, anchor = placed.n_sections, placed.family.describe, placed.family.anchor
    if isinstance(placed.family, families.KinematicPhase) and any(results):
        _check_center(placed.family, placed.cycle)
    for i, code in enumerate(results):
        if code == Result.OK:
            continue
        if code == Result.SIMULTANEOUS:
            raise ComputationError(
                f"{name(i - 1)} coincides with an event: move the sections, or use `AtEvent`."
            )
        if i:
            what = f"{name(i % N)} is not reached from section {i - 1} on the cycle"
        else:
            place = f" at its anchor, {anchor}" if isinstance(anchor, Crossing) else ""
            what = f"the cycle does not reach {name(0)}{place}"
        hint = "."
        if code == Result.SECTION_MISSED:
            hint = _remedy(placed, i % N)
        if code == Result.STEP_LIMIT:
            hint = ". Give them to the search for the cycle, or place more sections."
        raise ComputationError(f"{what}: {Result(code).message}{hint}")


def _require_order(placed: PlacedSections) -> None:
    """**Raises:** `ComputationError` for sections that are met twice in a round, at the same time,
    or in another order."""
    N, name = placed.n_sections, placed.family.describe
    period, duration = float(placed.cycle.period), np.asarray(placed.duration)
    rounds = float(duration.sum()) / period
    if rounds < 1 - SAME:
        raise ComputationError(f"{name(0)} {_AGAIN}{_remedy(placed, 0)}")
    whole = period * np.rint(duration / period)
    nearest = int(np.argmin(np.abs(duration - whole)))
    i, j = sorted((nearest, (nearest + 1) % N))
    if i < j and at_one_time(duration[nearest], whole[nearest], period):
        raise ComputationError(
            f"{name(j)} coincides with section {i} on the cycle: leave one out."
        )
    if rounds > 1 + SAME:
        late = int(np.argmax(duration))
        raise ComputationError(
            f"the sections are out of order: {name((late + 1) % N)} comes before section {late} on "
            f"the cycle, so that one round of all sections takes {rounds:.3g} periods."
        )


class _Met(NamedTuple):
    """Where the level of a section falls on its cycle, in parts of the steps."""

    section: Crossing | None
    """The section, if it is a `Crossing`."""
    high: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    """The level at the beginning and the end of each part."""
    places: list[str]
    """Times and charts of the parts in which the section is crossed."""


def _met(placed: PlacedSections, i: int) -> _Met:
    """Where the level of section i falls."""
    cycle = placed.cycle
    N, levels = placed.n_sections, placed.bound.levels
    items = getattr(placed.family, "items", (placed.family.anchor,))
    item = items[i] if i < len(items) else None
    section = item if isinstance(item, Crossing) else None
    if section is not None:
        i, N, levels = 0, 1, ListLevels((section,))
    s = cycle.structure
    t, chart, q = cycle.trajectory().dense()
    level = levels_at(s, levels, N, t, chart, q.T)[0, i]
    level[-1] = level[0]  # (the same point, but for rounding)
    falls = np.flatnonzero((np.diff(level) < 0) & (np.diff(t) > 0))
    high, low = level[falls], level[falls + 1]
    crossed = falls[(high > 0) & (low <= 0)]
    places = [f"t = {t[k]:.3g} in {s.names[chart[k]]}" for k in crossed]
    return _Met(section, high, low, places)


def _remedy(placed: PlacedSections, i: int) -> str:
    """Where the cycle crosses section i, the values through which the function of a `Crossing`
    goes in its direction, and what to change."""
    section, high, low, places = _met(placed, i)
    hint = f", at {' and '.join(places)}" if places else ""
    if section is None:
        return (
            f"{hint}. Choose a phase that rises through each section once in a period."
        )
    span = "nowhere"
    if len(high):
        sign = 1 if section.direction == "falling" else -1
        first, last = (float(section.value) + sign * x for x in (high.max(), low.min()))
        span = f"from {first:.4g} to {last:.4g}"
    return (
        f"{hint}. Values of {section} on the cycle: {span}; choose another function, `value`, "
        "`direction` or `charts`, not at an event."
    )


def _check_center(phase: families.KinematicPhase, cycle: LimitCycle) -> None:
    """**Raises:** `ComputationError` for an orbit that does not turn about the center."""
    names = phase.position, phase.velocity
    center = (0.0, 0.0) if phase.center is None else tuple(phase.center.tolist())
    p, v = (x[~np.isnan(x)] for x in cycle.trajectory()(*names)[1:])
    angle = np.unwrap(np.arctan2(v - center[1], p - center[0]))
    if abs(angle[-1] - angle[0]) < np.pi:
        raise ComputationError(
            f"the orbit does not turn about the `center` {center} of the KinematicPhase: it has "
            f"{names[0]} from {p.min():.4g} to {p.max():.4g} and {names[1]} from {v.min():.4g} to "
            f"{v.max():.4g}. Give a `center` inside of it, or another `position` and `velocity`."
        )


def _crossings(placed: PlacedSections) -> tuple[np.ndarray, np.ndarray]:
    """The number of crossings of each section in one period, and their steepness: the rate of a
    level on its section as a fraction of its fastest rate on the cycle."""
    event, levels = np.asarray(placed.bound.event), placed.bound.levels
    counts = np.array(
        [placed.cycle.event_sequence.count(g) if g >= 0 else 1 for g in event]
    )
    steepness = np.ones(placed.n_sections)
    if levels is None:
        return counts, steepness
    with at_ease():
        more, fastest, rate = _levels_along(to_host(placed), levels)
    state_based = np.isinf(np.asarray(placed.bound.time)) & (event < 0)
    counts = np.where(state_based, 1 + more, counts)
    np.divide(np.abs(rate), fastest, out=steepness, where=state_based)
    return counts, steepness


def _levels_along(placed: PlacedSections, levels: AbstractLevels):
    """The number of crossings of each section (N,) by the cycle's steps, besides its own, the
    fastest rate of its level (N,), and the rate on the section (N,)."""
    s = placed.structure()
    N = placed.n_sections
    lanes = placed.lanes
    assert placed.tape is not None
    moves = recorded_moves(lanes, placed.tape)
    value, rate = levels_at(s, levels, N, *_along_steps(s, moves, placed.tape))
    level = value.reshape(N, -1, len(moves.t))
    falls = (level[:, :-1] > 0) & (level[:, 1:] <= 0) & (moves.h > 0)

    # Around the section itself, rounding decides the signs.
    begins_at = np.where(moves.order == 0, moves.lane, -1)
    is_itself = np.arange(N)[:, None] == begins_at
    falls[:, 0] &= ~is_itself
    falls[:, -1] &= ~np.roll(is_itself, -1, axis=1)

    field = slopes(s, lanes.t, lanes.chart, lanes.q, np.zeros((s.nu, 1)))
    on_section = placed.normal[:, 0] + np.sum(placed.normal[:, 1:] * field.T, axis=1)
    count = np.sum(falls, axis=(1, 2))
    fastest = np.max(np.nan_to_num(np.abs(rate)), axis=1)
    return count, fastest, on_section


def _along_steps(s: Structure, moves: Moves, tape: Tape):
    """Times, charts and states at several points of every step, by its cubic interpolant: first the
    beginnings of all steps."""
    still = np.zeros((s.nu, 1))
    is_move = tape.code.T != IDLE
    end = tape.before.transpose(2, 0, 1)[is_move].T
    rate_at_start = slopes(s, moves.t, moves.chart, moves.q, still)
    rate_at_end = slopes(s, moves.t + moves.h, moves.chart, end, still)
    part = np.linspace(0.0, 1.0, _PARTS_OF_A_STEP + 1)[:, None]
    states = interpolate(
        part,
        moves.h,
        moves.q[:, None],
        end[:, None],
        rate_at_start[:, None],
        rate_at_end[:, None],
    )
    times = moves.t + moves.h * part
    charts = np.tile(moves.chart, len(part))
    return times.ravel(), charts, states.reshape(s.d, -1)
