"""The position of the sections of a family on a limit cycle: located, and checked."""

import collections
import dataclasses
from typing import Any, cast

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
from .._core.precision import require_x64
from .._core.results import Result, update_result
from ..engine import kernels
from ..engine.cubic import interpolate
from ..engine.lanes import IDLE, Lanes, for_each_chart, only, side_by_side
from ..engine.move import Options, stride, through
from ..engine.replay import Variation, recorded_moves
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
from ..systems.transition import TOGETHER, Scheduled
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
_recent: collections.deque[PlacedSections] = collections.deque(maxlen=4)


@checked
def place_sections(cycle: LimitCycle, sections: FamilyLike) -> PlacedSections:
    """Locate a family's sections on a cycle, and check them.

    **Arguments:** `sections`, a family (`ClockPhase`, `ArcLength`, `KinematicPhase`,
    `SectionList`), or a list of `Crossing` and `AtEvent`. The flow from each section to the next
    may take as many steps as the cycle's `settings` allow, and at least 1024.

    **Raises:** `DefinitionError` for a family that does not fit the system; `ComputationError` that
    names the first section that the cycle does not cross, crosses more than once, touches
    tangentially, or crosses out of order.
    """
    family = as_family(sections)
    require_x64(cycle, family)
    cycle.require_found()
    for placed in () if is_traced((cycle, family)) else list(_recent):
        if placed.cycle is cycle and eqx.tree_equal(
            *jax.device_get((placed.family, family))
        ):
            return placed
    family.check(cycle.structure)
    if traced := is_traced((cycle, family)):
        require_program()
    # (Programs of `_place` are for one number of moves: none are given where they do not help.)
    turn = None if traced or has_implicit(cycle.structure) else last_turn(cycle)
    first, fields = _place(_patient(cycle), family, turn)
    placed = PlacedSections(cycle, family, *fields)
    if not traced:
        _check(placed, int(first))
        _recent.append(placed)
    return placed


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
    s, N = Structure(map.system), family.n_sections
    period, begin, xp = map.expected, map.anchor, namespace(map.expected)
    u = xp.zeros((s.nu, 1))

    def go(carry, targets, patience=np.inf):
        options = Options(tape=True, tangents=True)
        beside = (
            turn is not None
            and on_host(period)
            and flow_along(map, turn, carry, targets)
        )
        carry, flow = beside or through(
            s, carry, u, targets, map.settings, options, patience
        )
        flows.append((flow[0], targets, flow[2]))
        return carry, flow

    carry, before = (
        (begin, stride((0.1 * period / N)[None]), xp.zeros(1, xp.int32)),
        None,
    )
    if isinstance(family.anchor, Crossing):
        target = toward(xp.full(1, np.inf), -1, begin.t + 1.5 * period)
        carry, before = go(carry, to_section(target, family.anchor))
        before = before if family.at_anchor else None
    bound = _bind(s, map, family, carry[0], go)
    k = xp.arange(int(before is not None), N + 1)
    i = k % N
    time, never = bound.time[i] + (k // N) * period, xp.full(k.shape, np.inf)
    targets = Target(
        time, i, bound.event[i], never, None, bound.levels, Result.SECTION_MISSED
    )
    _, pieces = go(carry, targets, 1.5 * period)
    if before is None:
        before = pieces
        pieces = jax.tree_util.tree_map(lambda x: x[1:], pieces)
    first = before[1].result[0, 0]
    lanes, moved, tape = side_by_side(pieces)
    drop, dims, normal = coordinates_on(map, bound, lanes)
    duration, result = moved.lanes.t - lanes.t, moved.result
    # Rounding would decide on which side of an event a clock section lies. (Not of the clock's.)
    by_clock = xp.asarray(
        [*(isinstance(x.guard, Scheduled) for x in s.transitions), True]
    )
    when = xp.where(by_clock[xp.maximum(tape.code, -1)], xp.nan, tape.t)
    near = [
        (abs(when - x.t) <= TOGETHER * period).any(axis=0) for x in (lanes, moved.lanes)
    ]
    near = xp.isfinite(bound.time) & (near[0] | xp.roll(near[1], 1))
    result = update_result(result, near, Result.COINCIDENCE)
    if not on_host(period):  # (on the host `_check` says more)
        turns = xp.abs(xp.sum(duration) / period - 1) > SAME
        result = update_result(result, turns, Result.SECTION_MISSED)
    return first, (bound, lanes, tape, duration, result, drop, dims, normal)


def coordinates_on(
    map: ReturnMap, bound: BoundSections, lanes: Lanes
) -> tuple[Int[Array, " N"], Int[Array, " N"], Float[Array, "N n"]]:
    """The fields `drop`, `dims` and `normal` of `PlacedSections`."""
    s, N, xp = map.structure, len(lanes.t), namespace(lanes.t)
    normal = _normals(s, bound, lanes, xp.arange(N), xp.zeros((s.nu, 1)))
    field = slopes(s, lanes.t, lanes.chart, lanes.q, xp.zeros((s.nu, N)))
    share = xp.abs(normal.T * xp.concatenate([xp.ones((1, N)), field]))
    flat = xp.max(share, axis=0) == 0
    drop = xp.where(flat, -1, xp.argmax(share, axis=0))
    time_is_state = xp.isinf(bound.time) & (map.base is None)
    dims = xp.asarray(s.dims)[lanes.chart] + time_is_state - ~flat
    return drop, dims, normal


def recorded_flows(placed: PlacedSections) -> tuple[Any, Any]:
    """Starts and steps, side by side, of the flow from a cycle's beginning to the anchor of the
    family (None if that is no `Crossing`), and from there to one section after the other."""
    cycle, flows = placed.cycle, []
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
    map, N, M = _patient(cycle), family.n_sections, family.points
    placed = PlacedSections(cycle, family, *_locate(map, family, turn, flows)[1])
    if np.any(placed.result):
        raise NotOnHostError
    P = len(jax.tree_util.tree_leaves((by_cycle, by_family))[0])
    s, bound = map.structure, placed.bound
    x, longer = beginning(by_cycle, s.d, P)

    def follow(flow, by_levels, times, twice=False):
        lanes, tape = side_by_side((flow[0], flow[2]))
        target, levels = flow[1], flow[1].levels
        along = kernels.Tangents(s, by_cycle.structure, levels, by_levels, P)
        flow = Variation(along, lanes, target, tape, times, twice)
        return flow, flow.tangents(x), along

    if isinstance(family.anchor, Crossing):
        levels = ListLevels((cast(Crossing, by_family.anchor),))
        x = follow(flows.pop(0), levels, np.zeros((P, 1)))[1][-1]
    lanes, points = side_by_side(flows[0][0]), x[None]
    orbit = Orbit(cycle.period, lanes.t[:M], lanes.chart[:M], lanes.q.T[:M])
    if M > 1:
        times = x[0][:, None] + longer[:, None] * np.arange(1, M + 1) / M
        flow, points, _ = follow(flows.pop(0), None, times)
        points = points[flow.first]
    moving = longer, np.moveaxis(points[:, 0], 1, 0), np.moveaxis(points[:, 1:], 2, 0)
    raw, by_bound = to_host(
        _bind_along(s, family, orbit, (by_cycle.structure, by_family, moving))
    )
    clock = np.isfinite(bound.time)
    late = np.rint((bound.time[0] - raw.time[0]) / cycle.period) if clock[0] else 0.0
    k = np.arange(N + 1)[-len(flows[0][1].time) :]
    by_time = np.zeros((P, N)) if by_bound.time is None else by_bound.time
    times = clock[k % N] * (by_time[:, k % N] + (late + k // N) * longer[:, None])
    flow, tangents, along = follow(flows[0], by_bound.levels, times, True)
    t, chart, q, u = flow.points(tangents, flow.first[-N:])
    many = lambda y: np.repeat(y, P)  # noqa: E731
    lanes = placed.lanes._replace(t=t, chart=chart, q=q)
    bound = dataclasses.replace(bound, time=many(bound.time), event=many(bound.event))
    normal = _normals(along, bound, lanes, many(np.arange(N)), u)
    rows = dict(drop=many(placed.drop), dims=many(placed.dims), normal=normal)
    moved = dataclasses.replace(placed, bound=bound, lanes=lanes, **rows)
    return moved, along, flow.jacobians(tangents, placed.across)[-N:]


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


observed_at = by_columns(_observed, _observed_along, of_flow)
"""Times (N,) at which a cycle crosses a family's sections, and outputs (N, ny) there."""


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


def _check(placed: PlacedSections, first: int) -> None:
    """**Raises:** `ComputationError` for the first section that is missed, tangent, out of order,
    crossed twice, or by the clock at the time of an event."""
    N, name, anchor = placed.n_sections, placed.family.describe, placed.family.anchor
    again = "is crossed more than once in one period"
    results = [first, *np.asarray(placed.result).tolist()]
    if isinstance(placed.family, families.KinematicPhase) and any(results):
        _check_center(placed.family, placed.cycle)
    place = f" at its anchor, {anchor}" if isinstance(anchor, Crossing) else ""
    for i, code in enumerate(results):
        if code == Result.COINCIDENCE:
            raise ComputationError(
                f"{name(i - 1)} coincides with an event: move the sections, or use `AtEvent`."
            )
        if code != Result.OK:
            text = f"{name(i % N)} is not reached from section {i - 1} on the cycle"
            text = text if i else f"the cycle does not reach {name(0)}{place}"
            hint = _remedy(placed, i % N) if code == Result.SECTION_MISSED else "."
            if code == Result.STEP_LIMIT:
                hint = (
                    ". Give them to the search for the cycle, or place more sections."
                )
            raise ComputationError(f"{text}: {Result(code).message}{hint}")
    if isinstance(anchor, Crossing) and len(_met(placed, 0)[2]) > 1:
        raise ComputationError(
            f"{name(0)} lies at {anchor}, which {again}{_remedy(placed, 0)}"
        )
    moving = np.flatnonzero(np.asarray(placed.normal)[:, 0])
    if not placed.cycle.clocked and len(moving):
        raise ComputationError(
            f"{name(int(moving[0]))} depends on time, which has no meaning on the cycle of an "
            "autonomous system: use a function of the state, or ClockPhase."
        )
    period, duration = float(placed.cycle.period), np.asarray(placed.duration)
    rounds = float(duration.sum()) / period
    if rounds < 1 - SAME:
        raise ComputationError(f"{name(0)} {again}{_remedy(placed, 0)}")
    apart = np.abs(duration - period * np.rint(duration / period))
    i, j = sorted((k := int(np.argmin(apart)), (k + 1) % N))
    if i < j and apart[k] <= TOGETHER * period:
        raise ComputationError(
            f"{name(j)} coincides with section {i} on the cycle: leave one out."
        )
    if rounds > 1 + SAME:
        late = int(np.argmax(duration))
        raise ComputationError(
            f"the sections are out of order: {name((late + 1) % N)} comes before section {late} on "
            f"the cycle, so that one round of all sections takes {rounds:.3g} periods."
        )
    # (By rounding, a round may hold the event at which it begins and ends twice, or not at all.)
    if np.sum(np.asarray(placed.tape.code) >= 0) != len(placed.cycle.event_sequence):
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
            raise ComputationError(f"{name(i)} {again}{_remedy(placed, i)}")


def _met(placed: PlacedSections, i: int) -> tuple[Any, np.ndarray, np.ndarray, str]:
    """Section i as a `Crossing`, if it is one; the ends (2, n) of parts of the cycle in which its
    level falls; and which of these cross it, and where."""
    cycle, N, levels = placed.cycle, placed.n_sections, placed.bound.levels
    items = getattr(placed.family, "items", (placed.family.anchor,))
    section = items[i] if i < len(items) and isinstance(items[i], Crossing) else None
    if section is not None:
        i, N, levels = 0, 1, ListLevels((section,))
    s, (t, chart, q) = cycle.structure, cycle.trajectory().dense()
    level = levels_at(s, levels, N, t, chart, q.T)[0, i]
    level[-1] = level[0]  # (the same point, but for rounding)
    falls = np.flatnonzero((np.diff(level) < 0) & (np.diff(t) > 0))
    high, low = ends = np.stack([level[falls], level[falls + 1]])
    crossed = falls[(high > 0) & (low <= 0)]
    points = " and ".join(f"t = {t[k]:.3g} in {s.names[chart[k]]}" for k in crossed)
    return section, ends, crossed, points


def _remedy(placed: PlacedSections, i: int) -> str:
    """Where the cycle crosses section i, the values through which the function of a `Crossing`
    goes in its direction, and what to change."""
    section, ends, _, points = _met(placed, i)
    hint = f", at {points}" * bool(points)
    if section is None:
        return (
            f"{hint}. Choose a phase that rises through each section once in a period."
        )
    sign, span = 1 if section.direction == "falling" else -1, "nowhere"
    if ends.size:
        ends = ends[0].max(), ends[1].min()
        span = "from {:.4g} to {:.4g}".format(
            *(float(section.value) + sign * x for x in ends)
        )
    change = (
        "choose another function, `value`, `direction` or `charts`, not at an event"
    )
    return f"{hint}. Values of {section} on the cycle: {span}; {change}."


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
    s, N, tape, lanes = placed.structure(), placed.n_sections, placed.tape, placed.lanes
    still = np.zeros((s.nu, 1))
    # The steps of one period, and the section at their start or -1.
    t, chart, q, h, _, lane, order, _ = recorded_moves(lanes, tape)
    section, after = np.where(order == 0, lane, -1), tape.before.transpose(2, 0, 1)
    after = after[tape.code.T != IDLE].T
    f0, f1 = slopes(s, t, chart, q, still), slopes(s, t + h, chart, after, still)
    x = np.linspace(0.0, 1.0, _PARTS_OF_A_STEP + 1)[:, None]
    q = interpolate(x, h, q[:, None], after[:, None], f0[:, None], f1[:, None])
    t, chart, q = (t + h * x).ravel(), np.tile(chart, len(x)), q.reshape(s.d, -1)
    value, rate = levels_at(s, levels, N, t, chart, q)
    level = value.reshape(N, len(x), -1)
    falls = (level[:, :-1] > 0) & (level[:, 1:] <= 0) & (h > 0)
    # Around the section itself, rounding decides the signs.
    itself = np.arange(N)[:, None] == section
    falls[:, 0] &= ~itself
    falls[:, -1] &= ~np.roll(itself, -1, axis=1)
    f = slopes(s, lanes.t, lanes.chart, lanes.q, still)
    on_section = placed.normal[:, 0] + np.sum(placed.normal[:, 1:] * f.T, axis=1)
    return (
        np.sum(falls, axis=(1, 2)),
        np.max(np.nan_to_num(np.abs(rate)), axis=1),
        on_section,
    )
