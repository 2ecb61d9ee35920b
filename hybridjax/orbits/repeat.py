"""Cycles near one that is known: Newton's method on its itinerary, without a search.

The charts, events and steps of a turn are an `Itinerary` (`engine/itinerary`). `correct` repeats it
from the states that Newton's method takes, and says whether all stayed as recorded. It is one
program for all systems of a class, and is differentiable.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import namespace, on_host, svdvals, to_host
from .._core.results import Result, update_result
from .._core.vector_math.factorizations import solve_by_columns
from ..engine.arrays import Array
from ..engine.itinerary.bodies import Travelers
from ..engine.itinerary.rows import PIECES, Form, Itinerary, Rows, recorded
from ..engine.itinerary.turn import Passage, follow
from ..engine.lanes import Lanes, Tape, side_by_side
from ..engine.unresolved import POLES, may_have_pulses
from ..linear.time_response import monodromy
from ..systems.transition import Scheduled
from .crossing import Crossing, ListLevels
from .periodic import has_period
from .return_map import CLOSED, SINGULAR, ReturnMap, across
from .rivals import coincide_on
from .scale import ROUNDING, has_implicit, in_sizes
from .shooting import ATOL, RTOL


# Turns before a lane is given up. Fewer: distant cycles are left to the search. More: lanes that
# will not converge keep the others of their call waiting.
MOST_TURNS = 10


# Size of a Newton step, relative to the accuracy of a step of the flow, at which no further turn is
# taken. Larger: residuals stay near the tolerance. Smaller: one turn more for most lanes.
_SMALL = 0.5
# Steps of an itinerary for each one that the search took: first for all systems, then for those
# whose errors are too large, and in programs, which cannot divide steps later. More: turns last
# longer. Fewer: more systems need the second, and fewer keep their itinerary in programs. Implicit
# steps differ much in length, and the fast phases of relaxation oscillators lie in other parts of
# the period beside the known cycle.
_DENSITIES = 0.9, 1.35
_IMPLICIT_DENSITIES = 3.0, 6.0
# Steps of the second integration for each one of the first: they share no node.
_OTHER = 0.83
# Largest distance, in sizes of the states, of the end of the second integration from its beginning,
# and largest error of its steps, relative to what is allowed in the first. Larger: faults pass.
# Smaller: errors of the second integration refuse cycles.
_APART = 1e-6
_ROUGH = 1e3
# Largest last correction of an event's time, as a part of the period. Larger: an event that the
# corrections have not reached passes. Smaller: rounding errors of times do not.
_LAST_CORRECTION = 1e-10


# Derivatives of a cycle: none; first ones, of the state at its beginning and of the period; all,
# for which the last turn is repeated.
Derivatives: TypeAlias = Literal["none", "first", "all"]


class Plan(eqx.Module):
    """An itinerary as an argument of programs: what a trajectory repeats."""

    form: Form = eqx.field(static=True)
    rows: Rows
    count: Int[Array, ""] | None
    """Of rows that do something; None for a loop over all of them, which reverse mode needs."""
    ends: Float[Array, " E"]
    """Ends of legs, from the beginning of the recorded trajectory."""
    last: Int[Array, ""]
    """Number of the last leg."""
    charts: Int[Array, " K"]
    """Charts in which the pieces begin."""

    @classmethod
    def of(cls, itinerary: Itinerary) -> "Plan":
        """That of a loop that ends with the last row."""
        return cls(
            form=itinerary.form,
            rows=itinerary.rows,
            count=_number(itinerary.count),
            ends=itinerary.ends,
            last=_number(itinerary.last),
            charts=itinerary.charts,
        )

    def code(self, passage: Passage, begin: Array, period: Array) -> Int[Array, "*L"]:
        """The codes of trajectories that began at these times, on cycles with these periods:
        whether they have kept the itinerary, with steps that are fine enough."""
        xp = namespace(passage.t)
        ends = passage.ends
        first = begin[..., None]
        begins = xp.concatenate([first, ends[..., :-1]], axis=-1)
        durations = ends - begins
        # (Rounding makes legs that last no time negative.)
        shortest = -ROUNDING * period[..., None]
        forwards = durations >= shortest
        unused = np.arange(ends.shape[-1]) > self.last
        in_order = (forwards | unused).all(axis=-1)
        kept = ~passage.left & in_order
        has_converged = passage.last <= _LAST_CORRECTION * period
        kept = kept & has_converged
        is_fine = passage.error <= 1
        code = xp.zeros_like(passage.left, dtype=xp.int32)
        code = update_result(code, ~kept, Result.EVENT_ORDER)
        return update_result(code, ~is_fine, Result.STEP_LIMIT)


def _number(x: Any) -> Array:
    """A number as an array, of which nothing is compiled; in programs it may be traced."""
    return x if isinstance(x, jax.Array) else np.asarray(x)


def on_device(tree: Any) -> Any:
    """`tree` with arrays of JAX."""

    def move(x):
        return jnp.asarray(x) if on_host(x) else x

    return jax.tree_util.tree_map(move, tree)


class Route(NamedTuple):
    """The itinerary of a known cycle."""

    map: ReturnMap
    """Of the known cycle."""
    first: Itinerary
    finer: Itinerary
    other: Itinerary
    """Of the second integration."""
    together: Bool[np.ndarray, " E"]
    """Which events of the known cycle have a rival (see `coincide_on`)."""


def has_route(map: ReturnMap) -> bool:
    """Test whether the flags of a route tell all that may happen beside it.

    They do not tell whether a cycle of several turns closes sooner, a scheduled event has become
    enabled, or a field has a pulse that is shorter than a step. (A pulse at a pole reaches the
    nodes of the two integrations.)
    """
    s = map.structure
    scheduled = [x for x in s.transitions if isinstance(x.guard, Scheduled)]
    if map.multiplicity > 1 or any(x.enabled is not None for x in scheduled):
        return False
    return not any(may_have_pulses(s, a) - POLES for a in range(len(s.charts)))


def route_of(map: ReturnMap, turn: tuple[Lanes, Tape] | None = None) -> Route:
    """The route of a cycle, the fixed point of a return map.

    **Arguments:** `turn`: the recorded pieces, side by side. Default: those of another turn.
    """
    map = to_host(map)
    pieces = side_by_side(to_host(map.pieces())) if turn is None else turn
    s = map.structure
    levels = levels_of(map)
    densities = _IMPLICIT_DENSITIES if has_implicit(s) else _DENSITIES
    densities = *densities, densities[0] * _OTHER
    first, finer, other = (recorded(s, pieces, levels, x) for x in densities)
    begin = map.anchor.t[0]
    ends = begin + first.ends
    together = coincide_on(map, first.events, ends, begin, ends[first.last])
    return Route(
        map=map,
        first=first,
        finer=finer,
        other=other,
        together=together,
    )


class Corrected(NamedTuple):
    """The end of Newton's method on an itinerary."""

    q: Float[Array, " d"]
    """The state at the beginning of the last turn."""
    passage: Passage
    """The last turn."""
    jacobian: Float[Array, "d d"]
    """Of P(q) - q, less the steps back to values of conserved quantities."""
    distance: Float[Array, ""]
    """Largest part of P(q) - q in sizes of the states."""
    excess: Float[Array, ""]
    """Size of the Newton step that would follow, relative to the tolerance."""
    turns: Int[Array, ""]


def levels_of(map: ReturnMap) -> ListLevels | None:
    """The level on which a turn ends; None for one that ends at a time, or with an event."""
    return ListLevels((map.base,)) if isinstance(map.base, Crossing) else None


class Maps(NamedTuple):
    """Return maps of one system, or of many in lanes on the first axis of arrays."""

    map: ReturnMap
    """With the numbers that all share; in place of the others, those of some lane."""
    numbers_of_system: tuple[Array, ...]
    """The arrays of the systems, as leaves."""
    t: Float[Array, "*L"]
    """Times of anchors."""
    expected: Float[Array, "*L"]

    @property
    def many(self) -> bool:
        return self.t.ndim > 0

    def of(self, numbers: Any) -> ReturnMap:
        """The map of one lane."""
        leaves, t, expected = numbers
        arrays, static = eqx.partition(self.map.system, eqx.is_array)
        structure = jax.tree_util.tree_structure(arrays)
        arrays = jax.tree_util.tree_unflatten(structure, leaves)
        system = eqx.combine(arrays, static)
        anchor = self.map.anchor._replace(t=t[None])
        return dataclasses.replace(
            self.map, system=system, anchor=anchor, expected=expected
        )

    @property
    def numbers(self) -> Any:
        return self.numbers_of_system, self.t, self.expected

    def each(self, function: Callable, *arrays: Array) -> Any:
        """`function(map, *arrays)` of each lane."""

        def one(numbers, *lane):
            return function(self.of(numbers), *lane)

        return (jax.vmap(one) if self.many else one)(self.numbers, *arrays)


def maps_of(map: ReturnMap) -> Maps:
    """The return map of one system."""
    return Maps(
        map=map,
        numbers_of_system=leaves_of(map.system),
        t=map.anchor.t[0],
        expected=map.expected,
    )


def leaves_of(system: Any) -> tuple[Array, ...]:
    """The arrays of a system, or of many."""
    return tuple(jax.tree_util.tree_leaves(eqx.filter(system, eqx.is_array)))


def turn(maps: Maps, plan: Plan, q, ends, **options: Any):
    """One turn: its passage, and P(q) - q less the step back to conserved values.

    **Arguments:** `options`: of `follow`.
    """
    known = None
    if maps.map.base is None:
        end = (maps.t + maps.expected)[..., None]
        is_last = jnp.arange(ends.shape[-1]) >= plan.last
        known = jnp.where(is_last, end, jnp.inf)
    travelers = Travelers(
        of=lambda numbers: maps.of(numbers).structure,
        numbers=maps.numbers,
        many=maps.many,
        structure=maps.map.structure,
    )
    passage = follow(
        travelers,
        levels_of(maps.map),
        maps.map.settings,
        plan.form,
        plan.rows,
        plan.count,
        (maps.t, q),
        ends,
        known=known,
        **options,
    )

    def residual(map: ReturnMap, end, q):
        returned = jnp.where(map.valid, end, 0.0)
        return returned - q - map.held(q)[0]

    return passage, maps.each(residual, passage.q, q)


def _newton(map: ReturnMap, factors, residual, q):
    """The Jacobian of the residual, the Newton step, its size relative to the tolerance, and that
    of the residual in sizes of the states."""
    whole = monodromy(factors)
    product = jnp.where(map.valid[:, None], whole, 0.0)
    unit = jnp.eye(len(q))
    jacobian = product - unit - map.held(q)[1]
    sizes = map.sizes
    step = -solve_by_columns(in_sizes(jacobian, sizes), residual / sizes)
    tolerance = ATOL + RTOL * jnp.abs(q / sizes)
    excess = jnp.max(jnp.abs(step) / tolerance)
    distance = jnp.max(jnp.abs(residual) / sizes)
    return jacobian, step * sizes, excess, distance


def _corrected(maps: Maps, plan: Plan, q, ends) -> Corrected:
    # (Steps are judged relative to `RTOL`.)
    rtol = maps.map.settings.rtol
    assert rtol is not None
    enough = jnp.minimum(_SMALL * rtol / RTOL, 1.0)

    def again(carry):
        before, q, settled = carry
        passage, residual = turn(maps, plan, q, before.passage.ends)
        steps = maps.each(_newton, passage.factors, residual, q)
        jacobian, step, excess, distance = steps
        found = Corrected(
            q=q,
            passage=passage,
            jacobian=jacobian,
            distance=distance,
            excess=excess,
            turns=before.turns + 1,
        )
        found = jax.tree_util.tree_map(ft.partial(_where, settled), before, found)
        # (Once the tolerance is met, one more turn reaches rounding, where that is below.)
        is_small = excess <= enough
        stays_small = (excess <= 1) & (before.excess <= 1)
        closed = is_small | stays_small
        # (Where multipliers are zero, the state converges before the times of events do.)
        closed = closed & (passage.last <= _LAST_CORRECTION * maps.expected)
        return found, _where(settled, q, q + step), settled | closed

    def going(carry):
        found, _, settled = carry
        return (~settled & (found.turns < MOST_TURNS)).any()

    # (A first turn before the loop would be compiled twice.)
    unsettled = jnp.zeros(q.shape[:-1], bool)
    begin = _nothing_yet(q, ends), q, unsettled
    return jax.lax.while_loop(going, again, begin)[0]


def _nothing_yet(q: Float[Array, "*L d"], ends) -> Corrected:
    """The beginning of Newton's method."""
    lanes = q.shape[:-1]
    d = q.shape[-1]
    K = PIECES

    def zeros(*shape):
        return jnp.zeros((*lanes, *shape))

    passage = Passage(
        t=zeros(),
        q=q,
        ends=ends,
        pieces_t=zeros(K),
        pieces_q=zeros(K, d),
        rates=zeros(K, d),
        factors=zeros(K, d, d),
        delay=zeros(d),
        error=zeros(),
        last=zeros(),
        left=jnp.zeros(lanes, bool),
    )
    return Corrected(
        q=q,
        passage=passage,
        jacobian=zeros(d, d),
        distance=zeros(),
        excess=jnp.full(lanes, jnp.inf),
        turns=jnp.zeros(lanes, int),
    )


def _where(mask: Bool[Array, "*L"], yes: Array, no: Array) -> Array:
    missing = (1,) * (yes.ndim - mask.ndim)
    return jnp.where(mask.reshape(mask.shape + missing), yes, no)


@eqx.filter_custom_jvp
def _solved(maps: Maps, plan: Plan, q, ends) -> Corrected:
    return _corrected(maps, plan, q, ends)


@_solved.def_jvp
def _solved_jvp(primals, tangents):
    """0 = P(q, p) - q moves q by -(J - I)^-1 dP/dp.

    The derivative of a turn is taken twice, in a loop that is compiled once: first where q stands,
    for dP/dp, then where it moves.
    """
    maps, plan, *_ = primals
    by_maps = _without_settings(tangents[0])
    found = _solved(*primals)
    q = found.q
    factors = found.passage.factors
    ends = jax.lax.stop_gradient(found.passage.ends)

    def around(maps, q):
        return turn(maps, plan, q, ends)

    def along(by_q, _):
        _, (by_passage, moved) = eqx.filter_jvp(around, (maps, q), (by_maps, by_q))
        _, step, *_ = maps.each(_newton, factors, moved, q)
        return by_q + step, by_passage

    start = jnp.zeros_like(q)
    by_q, by_passages = jax.lax.scan(along, start, length=2)
    by_passage = jax.tree_util.tree_map(lambda x: x[-1], by_passages)
    nothing = jax.tree_util.tree_map(lambda _: None, found)
    return found, nothing._replace(q=by_q, passage=by_passage)


def _without_settings(by_maps: Any) -> Any:
    """Derivatives of maps, whose settings have none."""
    fixed = jax.tree_util.tree_map(lambda _: None, by_maps.map.settings)
    return eqx.tree_at(
        lambda x: x.map.settings, by_maps, fixed, is_leaf=lambda x: x is None
    )


def _at_fixed_state(maps: Maps, by_maps: Any, plan: Plan, q, ends):
    """Derivatives of the time at the end of a turn from q, and of P(q) - q."""
    by_maps = _without_settings(by_maps)

    def end(maps):
        passage, residual = turn(maps, plan, q, ends, columns=False)
        return passage.t, residual

    return eqx.filter_jvp(end, (maps,), (by_maps,))[1]


@eqx.filter_custom_jvp
def _root_and_period(maps: Maps, plan: Plan, q, ends) -> Corrected:
    return _corrected(maps, plan, q, ends)


@_root_and_period.def_jvp
def _root_and_period_jvp(primals, tangents):
    """First derivatives of the state, and of the time at the end of the turn, from the Jacobian
    that Newton's method has used."""
    maps, plan, *_ = primals
    found = _root_and_period(*primals)
    q = found.q
    passage = found.passage
    late, moved = _at_fixed_state(maps, tangents[0], plan, q, passage.ends)
    _, step, *_ = maps.each(_newton, passage.factors, moved, q)
    before = monodromy(passage.factors[:-1])
    late = late + passage.delay @ (before @ step)
    nothing = jax.tree_util.tree_map(lambda _: None, found)
    return found, nothing._replace(q=step, passage=nothing.passage._replace(t=late))


def correct(
    maps: Maps,
    plan: Plan,
    q,
    ends,
    *,
    derivatives: Derivatives = "none",
) -> Corrected:
    """Newton's method on an itinerary.

    **Arguments:** `q`: states at the anchors. `ends`: guessed ends of legs. `derivatives`: those of
    the result. (Reverse mode needs a plan without a count of rows.)
    """
    still = jax.lax.stop_gradient
    if derivatives == "none":
        return _corrected(maps, plan, q, ends)
    if derivatives == "first":
        return _root_and_period(maps, plan, still(q), still(ends))
    return _solved(maps, plan, still(q), still(ends))


def factors_across(
    map: ReturnMap, itinerary: Itinerary, passage: Passage
) -> Float[Array, "*L K d d"]:
    """The factors of the monodromy matrix; of an autonomous system, on the states modulo the
    direction of the flow."""
    if map.base is None:
        return passage.factors
    xp = namespace(passage.q)
    lanes = passage.q.ndim - 1
    sizes = xp.asarray(map.scale)[itinerary.charts]
    sizes = xp.broadcast_to(sizes, passage.rates.shape)

    def first(x):
        return xp.moveaxis(x, lanes, 0)

    rates = first(passage.rates)
    size = first(sizes)
    factors = across(rates, size, first(passage.factors))
    return xp.moveaxis(factors, 0, lanes)


class Check(NamedTuple):
    """The check of cycles that were found on an itinerary."""

    passage: Passage
    """The second integration of turns: by another method, with other steps."""
    periodic: Bool[Array, "*L"]
    """Whether functions have the period of the clock; True without one."""


def travel(maps: Maps, plan: Plan, q, ends) -> Check:
    """Check cycles by a second integration."""
    import diffrax

    # (Implicit methods of diffrax need Jacobians of all columns: only the steps are others.)
    implicit = has_implicit(maps.map.structure)
    solver = None if implicit else diffrax.Dopri8(scan_kind="lax")
    passage, _ = turn(maps, plan, q, ends, solver=solver, columns=False)
    return Check(passage, periodic(maps, plan.charts, passage))


def periodic(maps: Maps, charts: Int[Array, " K"], passage: Passage):
    """Whether the functions of clocked systems have the period of the clock, where the pieces of a
    turn begin; True without one."""
    if maps.map.base is not None:
        return jnp.ones(maps.t.shape, bool)

    def of_lane(map: ReturnMap, t, q):
        period = map.expected / map.multiplicity
        return has_period(map.structure, period, t, charts, q.T)

    return maps.each(of_lane, passage.pieces_t, passage.pieces_q)


def judge(route: Route, found: Corrected, t, expected) -> Int[Array, "*L"]:
    """The codes of lanes with these times of the anchor and expected periods: whether Newton's
    method converged, whether the route was kept, and whether its steps were fine enough."""
    passage = found.passage
    xp = namespace(found.q)
    converged = xp.isfinite(found.excess) & (found.excess <= 1)
    converged = converged & (found.distance <= CLOSED)
    code = xp.zeros_like(found.turns, dtype=xp.int32)
    code = update_result(code, ~converged, Result.NOT_CONVERGED)
    code = update_result(
        code, ~_is_alone(route, found, t, expected), Result.EVENT_ORDER
    )
    on_plan = Plan.of(route.first).code(passage, t, expected)
    return xp.where(code == Result.OK, on_plan, code)


def _is_alone(route: Route, found: Corrected, t, expected) -> Bool[Array, "*L"]:
    """Whether cycles are isolated, last as long as expected if a clock drives them, and are no
    equilibria."""
    passage = found.passage
    xp = namespace(found.q)
    # (On a cycle that is not isolated, Newton's method ends anywhere.)
    sizes = route.map.sizes
    defect = in_sizes(found.jacobian, sizes)
    isolated = xp.min(svdvals(defect), axis=-1) >= SINGULAR
    if route.map.base is None:
        # (The last event of a turn that ends with one may come later than the turn ends.)
        late = xp.abs(passage.t - (t + expected))
        return isolated & (late <= ROUNDING * expected)
    if not route.first.events:
        difference = passage.pieces_q - found.q[..., None, :]
        apart = xp.abs(difference) / sizes
        return isolated & (apart.max(axis=(-2, -1)) > _APART)
    return isolated


def agrees(route: Route, q, check: Check) -> Bool[Array, "*L"]:
    """Whether a second integration from states q closes, and keeps the route, and functions have
    the period of the clock."""
    xp = namespace(q)
    other = check.passage
    difference = xp.abs(other.q - q)
    apart = xp.max(difference / route.map.sizes, axis=-1)
    same = xp.isfinite(apart) & (apart <= _APART)
    is_accurate = other.error <= _ROUGH
    return same & check.periodic & is_accurate & ~other.left
