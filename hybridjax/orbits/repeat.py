"""Newton's method for a cycle near a known one, along the recorded itinerary of the known cycle.

The *itinerary* of a turn is its sequence of charts, steps and events (`engine/itinerary`), and a
`Route` has the itineraries of a known cycle. `correct` repeats them from the states that Newton's
method takes, without a search: it is one program for all systems of a class, and is differentiable.
`judge` then tells from flags whether each trajectory has kept the itinerary, and `travel`
integrates once more, by another method, as a check. `near.py` (single cycles), `many.py` (sweeps)
and `fitting/` call these functions.

A *turn* is the flow once around the cycle, a *leg* a part of it between two events, and a *lane*
one of many systems side by side. No trajectory may leave its itinerary unnoticed: a further way to
do so needs a flag in `judge` (or in `Plan.code`), or its systems are excluded in `has_route`.

A wrong cycle comes from `_corrected`; wrong derivatives, from `_solved_jvp` or
`_root_and_period_jvp`; a cycle that is given up without need, from `judge` or `agrees`.
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
from ..engine.itinerary.course import Travelers
from ..engine.itinerary.recorded import recorded
from ..engine.itinerary.rows import PIECES, Form, Itinerary, Rows
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


# Newton steps (one turn each) before a lane is given up. Fewer: distant cycles are left to the
# search. More: lanes that do not converge keep the other lanes of their call waiting.
MOST_TURNS = 10


# Newton's method ends if its step, relative to the accuracy of a step of the flow, is below this.
# Larger: residuals stay near the tolerance. Smaller: one turn more for most lanes.
_SMALL = 0.5
# Number of steps of an itinerary, relative to those that the search took. The first number is for
# all systems of a sweep; the second for systems whose errors are too large, and for programs, which
# cannot divide steps later. More: turns take longer. Fewer: more systems need the second number,
# and fewer keep their itinerary in programs. For implicit methods the numbers are larger: their
# steps differ much in length, and the fast phases of relaxation oscillators move to other parts of
# the period.
_DENSITIES = 0.9, 1.35
_IMPLICIT_DENSITIES = 3.0, 6.0
# Number of steps of the second integration, relative to the first, so that the two share no node.
_OTHER = 0.83
# Largest distance between the beginning and the end of the second integration, in sizes of the
# states; and largest error of its steps, relative to the error that steps of the first may have.
# Larger: faults pass. Smaller: errors of the second integration refuse cycles.
_APART = 1e-6
_ROUGH = 1e3
# Largest allowed last correction of an event's time, as a part of the period. Larger: events pass
# whose corrections have not converged. Smaller: rounding errors of times do not pass.
_LAST_CORRECTION = 1e-10


# Which derivatives a result has: none; first derivatives of the state at the beginning and of the
# period; or all derivatives, for which the last turn is repeated.
Derivatives: TypeAlias = Literal["none", "first", "all"]


class Plan(eqx.Module):
    """An itinerary as an argument of programs."""

    form: Form = eqx.field(static=True)
    rows: Rows
    count: Int[Array, ""] | None
    """Number of rows of the table that are not empty; None for a loop over all rows, which reverse
    mode needs."""
    ends: Float[Array, " E"]
    """Times at which legs end, since the beginning of the recorded trajectory."""
    last: Int[Array, ""]
    """Number of the last leg."""
    charts: Int[Array, " K"]
    """Charts in which the pieces begin."""

    @classmethod
    def of(cls, itinerary: Itinerary) -> "Plan":
        """The plan of an itinerary, with a loop that ends at the last row that is not empty."""
        return cls(
            form=itinerary.form,
            rows=itinerary.rows,
            count=_number(itinerary.count),
            ends=itinerary.ends,
            last=_number(itinerary.last),
            charts=itinerary.charts,
        )

    def code(self, passage: Passage, begin: Array, period: Array) -> Int[Array, "*L"]:
        """The result codes of trajectories that began at the times `begin`, on cycles with these
        periods: whether they have kept the itinerary, with steps that are fine enough."""
        xp = namespace(passage.t)
        ends = passage.ends
        first = begin[..., None]
        begins = xp.concatenate([first, ends[..., :-1]], axis=-1)
        durations = ends - begins
        # (The duration of a leg without duration may be negative by rounding.)
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
    """A number as an array, made without compiling anything. It may be traced."""
    return x if isinstance(x, jax.Array) else np.asarray(x)


def on_device(tree: Any) -> Any:
    """`tree` with arrays of JAX."""

    def move(x):
        return jnp.asarray(x) if on_host(x) else x

    return jax.tree_util.tree_map(move, tree)


class Route(NamedTuple):
    """The itinerary of a known cycle."""

    map: ReturnMap
    """Return map of the known cycle."""
    first: Itinerary
    finer: Itinerary
    other: Itinerary
    """Itinerary of the second integration."""
    together: Bool[np.ndarray, " E"]
    """Which events of the known cycle have a rival (see `coincide_on`)."""


def has_route(map: ReturnMap) -> bool:
    """Test whether the flags of a route notice every way in which a nearby trajectory may leave it.

    Flags do not notice that a cycle of several turns closes sooner, that a scheduled event has
    become enabled, or that a field has a pulse shorter than a step. Systems in which this is
    possible have no route. (A pulse at a pole is wide enough to be seen by one of the two
    integrations.)
    """
    s = map.structure
    scheduled = [x for x in s.transitions if isinstance(x.guard, Scheduled)]
    if map.multiplicity > 1 or any(x.enabled is not None for x in scheduled):
        return False
    return not any(may_have_pulses(s, a) - POLES for a in range(len(s.charts)))


def route_of(map: ReturnMap, turn: tuple[Lanes, Tape] | None = None) -> Route:
    """The route of a cycle, the fixed point of a return map.

    **Arguments:** `turn`: recorded pieces of a turn, side by side. Default: a new turn is recorded.
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
    """Derivative of P(q) - q, less the steps back to given values of conserved quantities."""
    distance: Float[Array, ""]
    """Largest entry of P(q) - q, in sizes of the states."""
    excess: Float[Array, ""]
    """Length of the next Newton step, relative to the tolerance."""
    turns: Int[Array, ""]


def levels_of(map: ReturnMap) -> ListLevels | None:
    """The level function at whose zero a turn ends; None for a turn that ends at a time or with an
    event."""
    return ListLevels((map.base,)) if isinstance(map.base, Crossing) else None


class Maps(NamedTuple):
    """Return maps of one system, or of many in lanes on the first axis of arrays."""

    map: ReturnMap
    """The map, with the numbers that all lanes share. Numbers that differ between lanes are those
    of one lane."""
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
    """One turn: its passage, and P(q) - q less the step back to given values of conserved
    quantities.

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
    """The Jacobian of the residual, the Newton step, the length of the step relative to the
    tolerance, and the largest entry of the residual in sizes of the states."""
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
    """The loop of Newton's method: one turn and one step of all lanes, until all have settled. A
    lane that has settled keeps its last turn.

    **Arguments:** as of `correct`.
    """
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
        # (With multipliers of zero, the state converges before the times of events do.)
        closed = closed & (passage.last <= _LAST_CORRECTION * maps.expected)
        return found, _where(settled, q, q + step), settled | closed

    def going(carry):
        found, _, settled = carry
        return (~settled & (found.turns < MOST_TURNS)).any()

    # (With a turn before the loop, the turn would be compiled twice.)
    unsettled = jnp.zeros(q.shape[:-1], bool)
    begin = _nothing_yet(q, ends), q, unsettled
    return jax.lax.while_loop(going, again, begin)[0]


def _nothing_yet(q: Float[Array, "*L d"], ends) -> Corrected:
    """The initial value of the loop of Newton's method, before any turn."""
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
    """The implicit function theorem: from P(q, p) - q = 0, q changes by -(J - I)^-1 dP/dp.

    The derivative of a turn is taken twice, in a loop that is compiled once: first with q fixed,
    which gives dP/dp, then with q changing.
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
    """Derivatives of maps, without those of their settings."""
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
    """First derivatives of the state and of the time at the end of the turn, by the Jacobian of the
    last Newton step."""
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

    **Arguments:** `q`: states at the anchors. `ends`: guessed ends of legs. `derivatives`: which
    derivatives the result has. (Reverse mode needs a plan without a count of rows.)
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
    """The factors of the monodromy matrix. In an autonomous system, the direction of the flow is
    projected out."""
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

    # (With implicit methods, the second integration has other steps, but the same method.)
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
    """The result codes of lanes: whether Newton's method converged, whether the route was kept, and
    whether its steps were fine enough. `t`: times of the anchors."""
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
    """Whether cycles are isolated, are no equilibria, and have the period of the clock if there is
    one."""
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
    """Whether the second integration from states q closes and keeps the route, and whether
    functions have the period of the clock."""
    xp = namespace(q)
    other = check.passage
    difference = xp.abs(other.q - q)
    apart = xp.max(difference / route.map.sizes, axis=-1)
    same = xp.isfinite(apart) & (apart <= _APART)
    is_accurate = other.error <= _ROUGH
    return same & check.periodic & is_accurate & ~other.left
