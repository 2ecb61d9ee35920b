"""A cycle near a known one, along its recorded itinerary instead of by a search.

`find.py` calls this file if the guess is a cycle that has a `Route`: its recorded sequence of
charts, steps and events (`repeat.py`). There are four functions: `traced_cycle` inside of programs
of users; `derived_cycle` for derivatives outside of programs; `repeated_cycle` for calls that
repeat with other parameters; `first_order_cycle` for fits. Each follows the route by Newton's
method, in one compiled program. A cycle that leaves the route has a result code inside of programs,
and is left to the search outside of them. `traced_cycle` and `first_order_cycle` must not ask for
values of the system, which JAX hides.

If a cycle is wrong here and right from a search, look at `repeat.py`; if there is a search although
the route would suit, at `route_near` and at the two constants; if derivatives are wrong, at
`correct` (`repeat.py`) and at which of them `_found` asks for.
"""

import collections
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.compilation import at_ease, identity, whole
from .._core.executor import (
    from_host,
    is_traced,
    is_tracer,
    on_the_cpu,
)
from .._core.host_derivatives import along_program, by_columns
from .._core.jax_compat import outside
from .._core.lanes import JACOBIAN_COLUMNS, by_jacobian
from .._core.memo import Memory
from .._core.results import Result, update_result
from ..engine.itinerary.rows import Itinerary
from ..engine.itinerary.turn import Passage
from ..engine.lanes import Lanes, pace_of
from ..systems.system import copies_of
from .cycle import LimitCycle, derived_if_found
from .linear_flow import hosted, last_turn
from .repeat import (
    Check,
    Corrected,
    Derivatives,
    Plan,
    Route,
    agrees,
    correct,
    factors_across,
    has_route,
    judge,
    leaves_of,
    maps_of,
    periodic,
    route_of,
    travel,
)
from .return_map import ReturnMap
from .rivals import coincide_on
from .verdict import verdict


# Seconds that searches near known cycles of one class take in all before the program is compiled:
# about as long as compiling takes. Less: who changes a constant a few times waits for a program
# that is hardly used. More: repeated calls stay slow for longer.
_WORTH_COMPILING = 4.0
# Number of derivatives outside of programs after which their program is compiled, which takes as
# long as these. Fewer: the same wait. More: derivatives stay slow for longer.
_DERIVATIVES_WORTH_COMPILING = 24
# Routes by cycle; known cycles by those that were found beside them; numbers of derivatives and CPU
# seconds of searches, by class of systems.
_routes = Memory()
_beside = Memory()
_calls: collections.Counter = collections.Counter()
_searching: dict[tuple, float] = collections.defaultdict(float)


def route_near(guess: LimitCycle) -> Route | None:
    """The route of a cycle. None if the cycle has no route (see `has_route`), has a fault, or is
    traced."""
    if is_traced(guess) or int(guess.result) != Result.OK:
        return None
    if not has_route(guess.return_map):
        return None
    with outside(), on_the_cpu(), at_ease():  # (also while a program is traced)
        guess = hosted(guess)
        if verdict(guess).refused:  # (flags compare with what was recorded)
            return None

        def make():
            return route_of(guess.return_map, last_turn(guess))

        route = _routes.recall(guess, None, make)
        return route if route.first.certain else None


def _beginning(route: Route, map: ReturnMap) -> tuple:
    """The state and the ends of legs from which Newton's method begins."""
    grown = map.expected / route.map.expected
    ends = map.anchor.t + route.first.ends * grown
    return jnp.asarray(route.map.anchor.q[:, 0]), ends


def known_beside(cycle: LimitCycle) -> LimitCycle | None:
    """The known cycle on whose route a traced cycle was found; None for cycles that were found
    otherwise."""
    return _beside.get(cycle, None)


def traced_cycle(known: LimitCycle, route: Route, map: ReturnMap) -> LimitCycle:
    """The cycle of a return map whose system is traced inside of a program, with derivatives, on
    the route of a known cycle.

    A cycle that leaves the route has a result code.
    """
    traced = [x.size for x in leaves_of(map) if is_tracer(x)]

    # (The beginning depends on traced values, so that it is made inside of the differentiated
    # function.)
    def find(map: ReturnMap, **options: Any) -> Corrected:
        return _found(route, "all", _beginning(route, map), map, **options)

    few = sum(traced) <= JACOBIAN_COLUMNS
    found = by_jacobian(find)(map) if few else find(map, reverse=True)
    return _beside_known(known, route, map, found, _result(route, map, found))


def derived_cycle(known: LimitCycle, route: Route, map: ReturnMap) -> LimitCycle | None:
    """As `traced_cycle`, outside of programs.

    None if the search is to find the cycle: for the first derivatives, which are not worth
    compiling a program; if the cycle leaves the route; for derivatives by many parameters; and
    where JAX hides values, as in `vmap`.
    """
    key = "derivatives", route.first.form, identity((map.structure,))
    _calls[key] += 1
    traced = [x.size for x in leaves_of(map) if is_tracer(x)]
    if _calls[key] <= _DERIVATIVES_WORTH_COMPILING or sum(traced) > JACOBIAN_COLUMNS:
        return None
    try:
        found, result = _outside(map, with_numbers(route))
    except _SearchError:
        return None
    return _beside_known(known, route, map, found, result)


def _beside_known(
    known: LimitCycle, route: Route, map: ReturnMap, found: Corrected, result: Any
) -> LimitCycle:
    cycle = derived_if_found(_cycle(route.finer, route, map, found, result))
    _beside.recall(cycle, None, lambda: known)
    return cycle


class _SearchError(Exception):
    """The search is to find a cycle."""


def _on_route(map: ReturnMap, route: Route) -> tuple[Corrected, Int[Array, ""]]:
    """The cycle on a route, with its code."""
    found = _found(route, "all", _beginning(route, map), map)
    return found, _result(route, map, found)


def _on_route_along(arguments: tuple, directions: tuple) -> tuple[tuple, tuple]:
    """`_on_route` and its derivatives.

    **Raises:** `_SearchError` for a cycle that leaves the route.
    """
    cycle, columns = along_program(_on_route)(arguments, directions)
    _, result = cycle
    if result != Result.OK:
        raise _SearchError
    return cycle, columns


def _hidden(*_: Any) -> Any:
    """**Raises:** `_SearchError`: the value of the code is hidden, so that it could not be decided
    whether the search is needed."""
    raise _SearchError


_outside = by_columns(_hidden, _on_route_along)


def with_numbers(route: Route) -> Route:
    """The route with counts of rows as arrays, so that other counts do not compile another
    program."""
    finer = route.finer._replace(count=np.asarray(route.finer.count))
    return route._replace(first=finer, finer=finer, other=finer)


def first_order_cycle(
    route: Route, map: ReturnMap, q: Float[Array, " d"]
) -> LimitCycle:
    """The cycle of a return map whose system is traced, on the route of a known cycle, from a state
    near the cycle. The anchor and the period have first derivatives in forward mode; other numbers
    have none.

    A cycle that leaves the route has a result code.
    """
    begin = q, _beginning(route, map)[1]
    found = _found(route, "first", begin, map)
    return _cycle(route.finer, route, map, found, _result(route, map, found))


def _found(
    route: Route,
    derivatives: Derivatives,
    begin: tuple,
    map: ReturnMap,
    reverse: bool = False,
) -> Corrected:
    plan = Plan.of(route.finer)  # (steps cannot be divided later)
    if reverse:
        plan = dataclasses.replace(plan, count=None)
    return correct(maps_of(map), plan, *begin, derivatives=derivatives)


def _result(route: Route, map: ReturnMap, found: Corrected):
    """The code of a cycle."""
    still = jax.lax.stop_gradient
    t = still(map.anchor.t[0])
    expected = still(map.expected)
    result = judge(route, still(found), t, expected)
    together = _coincide(route, map, still(found.passage))
    result = update_result(result, together, Result.SIMULTANEOUS)
    repeats = periodic(maps_of(map), route.finer.charts, still(found.passage))
    return update_result(result, ~repeats, Result.NOT_VERIFIED)


def _coincide(route: Route, map: ReturnMap, passage: Passage):
    """Whether events coincide that do not coincide on the known cycle."""
    begin = passage.pieces_t[0]
    together = coincide_on(map, route.first.events, passage.ends, begin, passage.t)
    return (together & ~route.together).any()


def _kind(route: Route, map: ReturnMap) -> tuple:
    """What a program is compiled for."""
    return route.first.form, identity((map,))


def note_search(guess: LimitCycle, map: ReturnMap, seconds: float) -> None:
    """Remember how long a search near a known cycle has taken, for `repeated_cycle`."""
    route = route_near(guess)
    if route is not None:
        _searching[_kind(route, map)] += seconds


def repeated_cycle(guess: LimitCycle, map: ReturnMap) -> LimitCycle | None:
    """The cycle of a return map near a known cycle. None if a search is needed: the cycle leaves
    the route, Newton's method does not converge, or the program is not compiled yet."""
    route = route_near(guess)
    if route is None:
        return None
    if _searching[_kind(route, map)] < _WORTH_COMPILING:
        return None
    begin = [np.asarray(x) for x in _beginning(route, map)]
    t = np.asarray(map.anchor.t[0])
    expected = np.asarray(map.expected)
    with on_the_cpu():
        for itinerary in (route.first, route.finer):
            program = whole(_correct, (), (map,), loops=True)
            found = program(Plan.of(itinerary), *begin)
            code = judge(route, found, t, expected)
            if code != Result.STEP_LIMIT:
                break
            begin = [found.q, found.passage.ends]
        if code != Result.OK:
            return None
        program = whole(_travel, (), (map,), loops=True)
        check = program(Plan.of(route.other), found.q, found.passage.ends)
    if not agrees(route, found.q, check):
        return None
    if _coincide(route, map, found.passage):
        return None
    return from_host(_cycle(itinerary, route, map, found, np.int32(Result.OK)))


def _correct(map: ReturnMap, plan: Plan, q, ends) -> Corrected:
    return correct(maps_of(map), plan, q, ends)


def _travel(map: ReturnMap, plan: Plan, q, ends) -> Check:
    return travel(maps_of(map), plan, q, ends)


def _cycle(
    itinerary: Itinerary, route: Route, map: ReturnMap, found: Corrected, result
) -> LimitCycle:
    """The cycle that Newton's method has found on an itinerary of a route."""
    passage = found.passage
    pieces = Lanes(
        t=passage.pieces_t,
        chart=itinerary.charts,
        q=passage.pieces_q.T,
        armed=itinerary.armed,
        events=itinerary.begins,
        pace=pace_of(itinerary.begins),
    )
    anchor = map.anchor._replace(q=found.q[:, None])
    return LimitCycle(
        map.system,
        map.base,
        map.expected if map.base is None else passage.t - map.anchor.t[0],
        anchor,
        pieces,
        factors_across(route.map, itinerary, passage),
        found.distance,
        found.turns,
        result,
        itinerary.events,
        map.settings,
        map.conserved,
        map.multiplicity,
        copies_of(map.system),
    )
