"""The search for a limit cycle, by Newton's method on the return map with its exact Jacobian:
`find_limit_cycle`.

`_near_cycle` starts from a known cycle, `_from_guess` from a state. Where Newton's method fails,
further attempts follow in this order:

1. `newton.search`: another period, and the smaller steps of Levenberg and Marquardt;
2. `_solution`: another phase of the clock, a plane that the cycle meets once, more steps;
3. `_judged`: the same cycle in the sizes that states have on it, and a shorter period if it closes
   sooner;
4. `_found_later`: attempts 1 to 3 from the state to which the flow leads after some periods.

A further attempt is added in `_searched`, or in the function of its number. `check_found` must stay
behind all attempts, since it checks the cycle that is returned. A *turn* is one application of the
return map, and *sizes* of states are their magnitudes, relative to which errors are measured
(`scale.py`).

If a search fails without need, look at these attempts in turn. A cycle that is refused or accepted
wrongly has its cause in `verdict.py` and `checks.py`; one that is inaccurate in a single state, in
`_in_own_sizes`; one that belongs to an earlier call, in `same_call.py`.
"""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Duration, Positive, Scalar, Wait
from .._core.compilation import uncollected
from .._core.executor import is_inside_program, is_traced, is_tracer, to_host
from .._core.precision import real, require_x64
from .._core.progress import say, working
from .._core.results import Result, update_result
from ..engine.lanes import side_by_side
from ..engine.settings import LIMIT_CYCLE, Settings
from ..engine.unresolved import has_kinks
from ..errors import ComputationError, DefinitionError
from ..systems.check import check_system
from ..systems.quotient import check_symmetry
from ..systems.solver import Radau
from ..systems.start import StateLike, SystemLike, guess_of, own_guess, system_of
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem, arrays_of, copies_of, integrated
from . import checks
from .coincidence import SAME, check_begin, commutes
from .crossing import AtEvent, Crossing, SectionLike, as_section
from .curve import away_from_events
from .cycle import LimitCycle, derived_if_found
from .guess import (
    after_rarest_event,
    is_default,
    met_once,
    require_similar,
    return_map_near,
)
from .linear_flow import keep_turn, last_turn, remembering
from .near import (
    derived_cycle,
    note_search,
    repeated_cycle,
    route_near,
    traced_cycle,
)
from .newton import Solution, search, solve
from .periodic import has_period
from .return_map import ENOUGH, PATIENCE, ReturnMap, Turn
from .rivals import coincident, meet
from .same_call import once
from .scale import (
    Sizes,
    given_sizes,
    has_implicit,
    scale_of,
    sizes_of,
    sizes_on,
    stiff_charts,
)
from .verdict import verdict


# Sizes are estimated before the cycle is known. If an estimate was too large by more than this
# factor, the cycle is computed again. Larger: errors of the cycle are larger. Smaller: most cycles
# are computed twice.
_OFF = 4.0
# If a search ends beyond a guard or in another chart, it begins again after the numbers `_LATER` of
# periods of flow; if Newton's method may have left the neighborhood of the cycle, after `_LATEST`
# periods. Fewer: slow transients remain. More: a vain search takes longer.
_LATER = (8, 40)
_LATEST = 40
# Periods within which an event is chosen as the section, in place of a plane. Fewer: rare events
# are missed. More: time.
_EVENTFUL = 8
# Results of a search that has found a cycle (an isolated one, or one of a family); and results
# after which the search begins again from a later state.
_FOUND = Result.OK, Result.SINGULAR
_STRAYED = (
    Result.NOT_CONVERGED,
    Result.EQUILIBRIUM,
    Result.GRAZING,
    Result.ZENO,
    Result.BLOW_UP,
    Result.SECTION_MISSED,
    Result.STEP_LIMIT,
    Result.STEP_COLLAPSE,
    Result.EXTRA_TURNS,
)
# If the guess was far from the cycle, the estimated size of a state that does not move is reduced
# this many times. Then the state counts as being at rest. More: searches take longer. Fewer: states
# of a guess that is more than 1e18 times too large keep their errors.
_SHRINKS = 3
# A guess is far from the cycle if a state of the guess is this many times larger than on the cycle.
# Larger: sizes that are too large are kept. Smaller: searches with states at rest take longer.
_DISTANT = 1e3


@checked
@working("find_limit_cycle")
@uncollected()
def find_limit_cycle(
    system: SystemLike,
    guess: Guess | LimitCycle | StateLike | None = None,
    *,
    section: SectionLike | None = None,
    multiplicity: Count | None = None,
    conserved: Mapping[str, Scalar] | None = None,
    settle: Wait = 0.0,
    max_period: Duration | None = None,
    scale: Mapping[str, Positive] | None = None,
    settings: Settings | None = None,
    throw: bool = True,
) -> LimitCycle:
    """Find a stable or unstable limit cycle by Newton's method on the return map.

    Newton's method fails, for example, if a step leaves the domain of the return map.
    Then the search is repeated with the smaller steps of the Levenberg-Marquardt
    method. If this fails, too, the guess is simulated for 40 periods, and the search
    begins at the final state.

    A clocked system has the period of its clock, and the return map is taken at the guess's phase
    of the clock. The period of an autonomous system is computed; its return map is taken on
    `section`.

    **Arguments:**

    - `system`: a `HybridSystem`: one of `hj.models`, or your own. If `guess` is a
        state, the system may also be the vector field (t, q) of a single chart without
        events (`hj.HybridSystem.from_functions`).
    - `guess`: a rough `Guess`, or the `LimitCycle` of a similar system, which is the
        best guess. If only one chart has such states, a state suffices: `(1.0, 0.0)` or
        `{"y": 1.0, "v": 0.0}`. With a cycle, leave out `settle` and `max_period`; the
        search begins at the same phase of the clock as that cycle, or, if an event has
        passed this phase, far from events. Default: the model's own guess.
    - `section`: the section of the return map of an autonomous system, e.g.
        `Crossing("v", "falling")`, or the name of an event. Newton's method starts at
        the guess if it lies on the section, else where the flow from the guess first
        crosses it. Default: the section right after the event that the guess names
        (`Guess(..., after="heelstrike")`), or else the plane through the guess that is
        orthogonal to the flow (in scaled states). If the flow does not return to this
        plane, the section is such a plane through a later state.
    - `multiplicity`: number of periods of the clock, or returns to the section, after which the
        cycle closes: 2 for the cycle that is born in a period doubling. Default: 1, or that of the
        cycle that is the guess.
    - `conserved`: values of conserved quantities, by the names of outputs, e.g.
        `{"energy": 1784.8}`. A conserved quantity gives a family of cycles and a multiplier of
        exactly 1; its value selects one cycle. Default: none, or those of the cycle that is the
        guess.
    - `settle`: time to simulate before Newton's method begins, so that transients decay (the paper
        takes 60 s). It does not help if the cycle is unstable. Default: 0.
    - `max_period`: for autonomous systems, the time after which the search for a return to the
        section is given up. Default: 1000 times the time scale of the states. It is computed at the
        guess and at the end of this search, and the longer one is taken. In charts with an implicit
        method, the time scale is that of the slowest mode.
    - `scale`: characteristic magnitudes of states by name, such as `{"y": 1e-6}`; errors are
        relative to these. Default: each state's largest modulus on the cycle, so that results do
        not depend on units. Under a JAX transformation, the default is the `scale` of the guess.
    - `settings`: accuracy of the integration (default: 1e-12), largest number of steps (also of
        `linearize`), and `solver`; "auto" uses an implicit method in the charts that are stiff on
        the cycle.
    - `throw`: raise an error on failure; otherwise the cycle's `result` holds the reason.
        Default: True.

    **Returns:** a `LimitCycle`: `period` in the system's unit of time, `multipliers` (d,),
    `is_stable`, `state` and `trajectory()`, and `result`, a code of `hj.errors.Result`.

    **Raises:** `DefinitionError` for bad arguments, and for functions whose dependence on time
    contradicts `system.period()`; `ComputationError` if no isolated cycle is found: no
    convergence, an event or section that is not reached, events that coincide, grazing, an
    equilibrium in place of a cycle, or a singular J - I (cycles form a family, because of a
    conserved quantity or a symmetry; see `conserved`).

    Under a JAX transformation of `system`, give a `LimitCycle` as the guess: the cycle is then
    differentiated implicitly. Its `result` reports success; derivatives of a cycle that was not
    found are meaningless, and usually NaN.

    **Example:**

    ```python
    cycle = hj.find_limit_cycle(hopper)
    oscillator = hj.models.VanDerPol(mu=1.0)
    free = hj.find_limit_cycle(oscillator, section=hj.Crossing("v", "falling"))
    print(cycle.period, free.multipliers)
    ```

    **Before:** a model, `hj.models` or `hj.HybridSystem`. **After:** `hj.linearize`,
    `hj.run_experiments`, `hj.continuation`, `hj.plot.cycle`.
    """
    settings = Settings() if settings is None else settings
    system = system_of(system, guess)
    section = None if section is None else as_section(section)
    if not isinstance(guess, Guess | LimitCycle | None):
        check_system(system)
        guess = guess_of(Structure(system), guess, "`guess`")
    if settings.solver == "auto":
        explicit = dataclasses.replace(settings, solver=None)
        first: dict[str, Any] = dict(settle=settle, max_period=max_period)
        each: dict[str, Any] = dict(
            section=section,
            multiplicity=multiplicity,
            conserved=conserved,
            scale=scale,
            settings=explicit,
            throw=throw,
        )
        return _find_with_auto(system, guess, first, each)
    system = settings.system(system)
    traced = is_traced((system, conserved))
    if not traced:
        require_x64(system, guess, section, settings)
        checks.check_periodic(system)
    s = Structure(system)
    settings = settings.filled(LIMIT_CYCLE)
    patient = settings.max_steps == Settings().max_steps
    settings = _with_enough_steps(s, settings)
    given = _sizes_that_are_given(s, settings, scale)
    _check_section(s, section)
    if not traced:
        checks.check_clock(s)
    if isinstance(guess, LimitCycle):
        _check_fits(guess, s, multiplicity, bool(settle) or max_period is not None)
        map = _map_near_cycle(guess, s, section, settings, given)
        values = guess.conserved if conserved is None else conserved
        map = dataclasses.replace(map, conserved=_numbers(values))
        request = _Request(map, guess, section, given, patient, settle, throw)
        return _near_cycle(request, guess, traced)
    if traced:
        raise DefinitionError(
            "under a JAX transformation find_limit_cycle needs a LimitCycle as its guess: find "
            "one outside, and pass it as `guess`."
        )
    guess = own_guess(system) if guess is None else guess
    begin = guess, section, multiplicity or 1, settle, max_period, settings, given
    values = _numbers(conserved or {})

    def search() -> LimitCycle:
        map = return_map_near(s, *begin)
        map = dataclasses.replace(map, conserved=values)
        request = _Request(map, None, section, given, patient, settle, throw)
        return _from_guess(request)

    return once(system, (begin, values, patient), search)


def _numbers(conserved: Mapping[str, Any]) -> dict[str, Any]:
    return {name: real(value) for name, value in conserved.items()}


class _Request(NamedTuple):
    """A search for a limit cycle that is asked for, with its arguments checked and prepared."""

    map: ReturnMap
    """The return map at which the search begins, with estimated sizes of the states."""
    known: LimitCycle | None
    """The cycle, if the guess is a cycle."""
    section: Crossing | AtEvent | None
    """The section that the user gives; None for the default section."""
    given: Sizes
    """Sizes of states that the user gives."""
    patient: bool
    """Whether more steps may follow: the user has not limited them."""
    settle: float
    throw: bool


def _with_enough_steps(s: Structure, settings: Settings) -> Settings:
    """Settings with a larger limit on steps, where steps are shorter than usual."""
    if not (has_implicit(s) or has_kinks(s)):
        return settings
    return dataclasses.replace(settings, max_steps=max(settings.max_steps, PATIENCE))


def _sizes_that_are_given(
    s: Structure, settings: Settings, scale: Mapping[str, float] | None
) -> Sizes:
    """Sizes of states that users give, by name or in the settings.

    **Raises:** `DefinitionError` for a state that does not exist.
    """
    of_settings = {} if settings.scale is None else sizes_of(s, settings.scale)
    return of_settings | given_sizes(s, scale)


def _check_section(s: Structure, section: Crossing | AtEvent | None) -> None:
    """**Raises:** `DefinitionError` for a section that does not fit the system, or that is given
    for a clocked system."""
    if section is None:
        return
    if s.system.period() is not None:
        raise DefinitionError(
            "a clocked system returns to itself after its clock's period: leave out `section` "
            "(sections of any kind are for linearize and run_experiments)."
        )
    section.check(s)


def _map_near_cycle(
    known: LimitCycle,
    s: Structure,
    section: Crossing | AtEvent | None,
    settings: Settings,
    given: Sizes,
) -> ReturnMap:
    """The return map of a system, at the anchor of a cycle of a similar one.

    **Raises:** `DefinitionError` if a traced number has derivatives that a symmetry, which the
    known cycle's system states, does not have.
    """
    if not is_traced(known):
        sizes = known.structure.sizes(known.settings.scale)
        for name, value in arrays_of(s.system).items():
            if is_tracer(value):
                check_symmetry(known.system, sizes, name)
    map = known.return_map.at_phase_of(s.system)
    scale = scale_of(s, given, known.settings.scale)
    return dataclasses.replace(
        map,
        settings=dataclasses.replace(settings, scale=scale),
        base=map.base if section is None else section,
    )


def _near_cycle(request: _Request, known: LimitCycle, traced: bool) -> LimitCycle:
    """The cycle of a system that is similar to the system of a known cycle.

    If the known cycle has a *route* (its recorded sequence of events and steps, see `repeat.py`),
    Newton's method follows it without a search. There are three ways: inside of programs
    (`traced_cycle`), for derivatives outside of them (`derived_cycle`), and for repeated calls
    (`repeated_cycle`). Without a route, there is a search.
    """
    map = request.map
    if request.section is None and (is_inside_program() or traced):
        route = route_near(known)
        if route is not None and is_inside_program():
            return traced_cycle(known, route, map)
        beside = None if route is None else derived_cycle(known, route, map)
        if beside is not None:
            return beside
    if traced:
        return _traced_without_route(known, map)
    _require_conserved(map)
    if request.section is None:
        cycle = repeated_cycle(known, map)
        if cycle is not None and _sizes_hold(map, cycle):
            if map.conserved:
                checks.check_conserved(cycle)
            return cycle
    begin = time.thread_time()
    cycle = _searched(request)
    if request.section is None:
        note_search(known, map, time.thread_time() - begin)
    return cycle


def _traced_without_route(known: LimitCycle, map: ReturnMap) -> LimitCycle:
    """The cycle of a traced system near a known cycle, by Newton's method, with derivatives."""
    near = last_turn(known)
    solution = solve(map, True, True, near)
    # (If the events coincide on the guess, too, their orders were compared when the guess was
    # found.)
    if near is None or not meet(known.return_map, near[1], known.period):
        assert solution.turn.tapes is not None
        together = meet(map, solution.turn.tapes, solution.turn.period)
        code = update_result(solution.result, together, Result.SIMULTANEOUS)
        solution = solution._replace(result=code)
    if map.base is None:
        pieces = solution.turn.pieces
        points = pieces.t, pieces.chart, pieces.q
        clock = map.expected / map.multiplicity
        repeats = has_period(map.structure, clock, *points)
        code = update_result(solution.result, ~repeats, Result.NOT_VERIFIED)
        solution = solution._replace(result=code)
    cycle = derived_if_found(_cycle(map, solution, known.event_sequence))
    keep_turn(cycle, solution.turn)
    return cycle


def _from_guess(request: _Request) -> LimitCycle:
    """The cycle near a guess that is a state."""
    _require_conserved(request.map)
    if isinstance(request.map.base, AtEvent):
        check_begin(request.map)
    return _searched(request)


def _require_conserved(map: ReturnMap) -> None:
    """**Raises:** `DefinitionError` if conserved quantities do not exist where a map begins."""
    chart = int(np.asarray(map.anchor.chart)[0])
    map.structure.resolve_outputs(tuple(map.conserved)).require(chart)


def _searched(request: _Request) -> LimitCycle:
    """The cycle to which a search leads, with the result of all checks.

    **Raises:** `ComputationError` for none, with the reason, unless errors are not to be raised.
    """
    solution, map = _solution(request)
    cycle, turn = _judged(map, solution, request.given)
    later_fault = ""
    if not request.settle and not _is_slow(map, turn):
        later, later_fault = _found_later(request, map, cycle)
        if later is not None:
            cycle, turn = later
    checks.check_found(cycle)
    if map.conserved and int(cycle.result) in _FOUND:
        checks.check_conserved(cycle)
    if request.throw and int(cycle.result) != Result.OK:
        reason = checks.explain(cycle, turn, float(map.expected), request.settle)
        raise ComputationError(reason + later_fault)
    return cycle


def _found_later(
    request: _Request, map: ReturnMap, failed: LimitCycle
) -> tuple[tuple[LimitCycle, Turn] | None, str]:
    """Search again from the states to which the flow leads after some periods, where the search
    from the guess has failed. (The flow may lead to a stable cycle, or to one on which events
    coincide.) Returns the cycle and its turn, or None; and a sentence for the message if the flow
    fails."""
    for periods in _times_later(failed, request.known):
        say(f"the same after {periods} periods")
        try:
            later = _map_after(map, request.section, periods, request.given)
            solution = solve(later, False, True, None)
            if request.section is None and not isinstance(map.base, AtEvent):
                solution, later = _met_once(later, solution)
            cycle, turn = _judged(later, solution, request.given)
        except ComputationError as error:
            fault = f" From the guess the flow leads to no cycle either: {error}"
            return None, fault
        if int(cycle.result) in (*_FOUND, Result.SIMULTANEOUS):
            return (cycle, turn), ""
    return None, ""


def _sizes_hold(map: ReturnMap, cycle: LimitCycle) -> bool:
    """Test whether the sizes of a return map are close to those of a cycle."""
    rough = sizes_of(map.structure, map.scale)
    own = sizes_on(map.structure, to_host(cycle.pieces), float(cycle.period))
    return all(
        rough[name] <= _OFF * max(size, SAME * rough[name])
        for name, size in own.items()
    )


def _solution(request: _Request) -> tuple[Solution, ReturnMap]:
    """The solution of Newton's method, and the return map on which it was found. This is another
    map than the given one if an event has passed the phase of the guess (another phase is tried),
    or if more steps are allowed."""
    map = request.map
    known = request.known
    patient = request.patient
    near = None if known is None else last_turn(known)
    solution = search(map, patient, near)
    if int(solution.result) == Result.NOT_CONVERGED and known is not None:
        distant = away_from_events(known).return_map.at_phase_of(map.system)
        if float(distant.anchor.t[0]) != float(map.anchor.t[0]):
            say("the same from a phase far from events")
            map = dataclasses.replace(map, anchor=distant.anchor)
            solution = search(map, patient)
    if is_default(map.base):
        solution, map = _met_once(map, solution)
    # (If even steps 256 times as long would not reach the end, more steps do not help.)
    reach = float(solution.turn.period) * ENOUGH
    short = patient and int(solution.result) == Result.STEP_LIMIT
    if short and reach > float(map.expected):
        say("the same with more steps")
        settings = dataclasses.replace(map.settings, max_steps=ENOUGH)
        map = dataclasses.replace(map, settings=settings)
        solution = search(map)
    return solution, map


def _met_once(map: ReturnMap, solution: Solution) -> tuple[Solution, ReturnMap]:
    """If a solution meets the default section more than once, the same cycle on a plane that it
    meets once. Otherwise the solution as it is."""
    several = int(solution.result) == Result.EXTRA_TURNS
    if not several or map.multiplicity > 1 or not solution.turn.closed:
        return solution, map
    once = met_once(map, solution.turn)
    if once is None:
        return solution, map
    say("the same on a plane that the cycle meets once")
    again = solve(once)
    if not again.is_fixed_point:
        return solution, map
    return again._replace(steps=solution.steps), once


def _judged(
    map: ReturnMap, solution: Solution, given: Sizes
) -> tuple[LimitCycle, Turn]:
    """The cycle of a solution, in its own sizes, with the result of all checks; and its turn."""
    map, solution = _in_own_sizes(map, solution, given)
    cycle = kept(map, solution)
    if not solution.is_fixed_point:
        return cycle, solution.turn
    check_begin(cycle.return_map)
    if coincident(map, solution.turn) and not commutes(cycle):
        return _with_result(cycle, Result.SIMULTANEOUS), solution.turn
    checked = verdict(cycle)
    # (A solution that runs four times around the cycle closes after half of its period, and then
    # again after half of that.)
    while checked.sooner is not None and map.base is not None and map.multiplicity == 1:
        say("Newton's method, with the shorter period at which the cycle closes")
        expected = real(checked.sooner)
        shorter = dataclasses.replace(map, anchor=solution.anchor, expected=expected)
        again = solve(shorter)
        if not again.is_fixed_point or again.turn.period > 1.5 * checked.sooner:
            break
        solution = again._replace(steps=solution.steps)
        cycle = kept(shorter, solution)
        checked = verdict(cycle)
    if checked.refused:
        cycle = _with_result(cycle, checked.result)
    return cycle, solution.turn


def kept(map: ReturnMap, solution: Solution) -> LimitCycle:
    """The cycle of a solution, which remembers its last turn."""
    cycle = _cycle(map, solution, solution.turn.events)
    keep_turn(cycle, solution.turn)
    return cycle


def _with_result(cycle: LimitCycle, result: Result) -> LimitCycle:
    """The cycle with another result. What is remembered with the cycle is kept."""
    other = dataclasses.replace(cycle, result=jax.device_put(np.int32(result)))
    return remembering(other, cycle)


def _is_slow(map: ReturnMap, turn: Turn) -> bool:
    """Test whether a flow over many periods would take too long: the system is stiff, or a turn has
    reached even the larger limit on steps."""
    if int(turn.result) != Result.STEP_LIMIT:
        return False
    stiff = checks.rate_of_short_steps(map.structure, turn, float(map.expected)) > 0
    return stiff or map.settings.max_steps >= ENOUGH


def _times_later(cycle: LimitCycle, known: LimitCycle | None) -> tuple[int, ...]:
    """The numbers of periods of flow after which a search that failed begins again. `known`: the
    cycle from which the search began, if it began from a cycle."""
    strays = cycle.result == Result.NOT_CONVERGED and np.isnan(cycle.residual)
    if strays or cycle.result == Result.GUARD_BEYOND:
        return _LATER
    if int(cycle.result) in _STRAYED and known is None:
        return (_LATEST,)
    return ()


def _map_after(
    map: ReturnMap, section: Crossing | AtEvent | None, periods: int, given: Sizes
) -> ReturnMap:
    """The return map at the state to which the flow leads within some periods, with the sizes of
    states at that place. `given`: sizes that users give.

    **Raises:** `ComputationError` if the flow fails.
    """
    s = map.structure
    rough = sizes_of(s, map.scale)
    wait = periods * float(map.expected)
    if isinstance(map.base, AtEvent):  # (also of a guess that names it)
        section = map.base

    def begun(guess: Guess, settle: float, sizes: Sizes) -> ReturnMap:
        return return_map_near(
            s, guess, section, map.multiplicity, settle, None, map.settings, sizes
        )

    later = begun(_guess_at(map), wait, rough)
    begin = None
    if is_default(later.base):
        begin = after_rarest_event(later, _EVENTFUL)
    if begin is None:
        begin = _guess_at(later)
    later = begun(begin, 0.0, given)
    return dataclasses.replace(later, conserved=map.conserved)


def _guess_at(map: ReturnMap) -> Guess:
    """The anchor of a map, as a guess."""
    s = map.structure
    anchor = to_host(map.anchor)
    a = int(anchor.chart[0])
    name = map.base.name if isinstance(map.base, AtEvent) else None
    state = anchor.q[: s.dims[a], 0]
    return Guess(s.names[a], state, time=float(anchor.t[0]), after=name)


def _find_with_auto(
    system: HybridSystem,
    guess: Guess | LimitCycle | None,
    first: dict[str, Any],
    each: dict[str, Any],
) -> LimitCycle:
    """The cycle, with an implicit method in the charts that are stiff on the cycle.

    **Arguments:** `first`: options of `find_limit_cycle` for the first search only. `each`: options
    for both searches.
    """
    cycle = find_limit_cycle(integrated(system, Radau()), guess, **first, **each)
    explicit = dataclasses.replace(cycle, system=integrated(system, None))
    stiff = stiff_charts(explicit.structure, to_host(cycle.pieces), float(cycle.period))
    if cycle.result != Result.OK or len(stiff) == len(cycle.system.charts()):
        return cycle
    fitting = integrated(system, dict.fromkeys(stiff, Radau()))
    settings = each["settings"]
    steps = max(settings.max_steps, PATIENCE)
    settings = dataclasses.replace(settings, max_steps=steps)
    options = each | dict(settings=settings, throw=False)
    faster = find_limit_cycle(fitting, cycle, **options)
    return faster if faster.result == Result.OK else cycle


def _in_own_sizes(
    map: ReturnMap, solution: Solution, given: Sizes
) -> tuple[ReturnMap, Solution]:
    """Compute a cycle again that was found with estimated sizes, in the sizes that states have on
    it."""
    s = map.structure
    at_rest = sizes_of(s, map.scale)
    shrinks_left = _SHRINKS if _is_distant(map, solution) else 0
    while solution.is_fixed_point:
        turn = solution.turn
        rough = sizes_of(s, map.scale)
        own = sizes_on(s, turn.pieces, float(turn.period))
        # A state at rest keeps its estimated size, since on the cycle it has only rounding errors.
        # (If all states are at rest, the guess was far too large.)
        moving = {name: x for name, x in own.items() if x > SAME * rough[name]}
        sizes = at_rest | moving if moving else own
        # The sizes of a distant guess are useless: they are reduced until states move.
        shrinks = shrinks_left > 0 and 0 < len(moving) < len(own)
        if shrinks:
            shrinks_left -= 1
            smaller = {name: max(own[name], SAME * x) for name, x in rough.items()}
            sizes = smaller | moving
        sizes = sizes | given
        fine = _with_sizes(map, solution, sizes)
        accurate = all(rough[name] <= _OFF * size for name, size in sizes.items())
        if accurate:
            return fine, _with_distance_in(solution, map, fine)
        say("Newton's method, in the sizes of the cycle")
        pieces = turn.pieces, side_by_side(to_host(turn.tapes))
        again = solve(fine, False, True, pieces)
        if again.is_fixed_point:
            map = fine
            solution = again._replace(steps=solution.steps)
        elif not shrinks:
            break
        elif int(again.result) in (Result.STEP_LIMIT, Result.STEP_COLLAPSE):
            shrinks_left = 0  # (rounding errors of states at rest make steps short)
        else:
            return fine, again
    return map, solution


def _with_sizes(map: ReturnMap, solution: Solution, sizes: Sizes) -> ReturnMap:
    """The return map at the anchor of a solution, in other sizes of the states."""
    scale = scale_of(map.structure, sizes)
    return dataclasses.replace(
        map,
        settings=dataclasses.replace(map.settings, scale=scale),
        anchor=solution.anchor,
        expected=map.expected if map.base is None else solution.turn.period,
    )


def _with_distance_in(solution: Solution, map: ReturnMap, fine: ReturnMap) -> Solution:
    """The solution of one return map, with its distance expressed in the sizes of another return
    map."""
    turn = solution.turn
    residual = np.abs(turn.residual)
    before = to_host(map).sizes
    after = to_host(fine).sizes
    # (The distance also contains the gaps between moves.)
    gap = np.asarray(turn.distance) - np.max(residual / before)
    by_gap = gap * np.max(before / after)
    distance = np.max(residual / after) + by_gap
    return solution._replace(turn=turn._replace(distance=real(distance)))


def _is_distant(map: ReturnMap, solution: Solution) -> bool:
    """Test whether a state at the guess is far larger than on the cycle that was found."""
    if not solution.is_fixed_point:
        return False
    s = map.structure
    a = int(np.asarray(map.anchor.chart)[0])
    own = sizes_on(s, solution.turn.pieces, float(solution.turn.period))
    q = np.asarray(map.anchor.q)
    guess = np.abs(q[: s.dims[a], 0])
    names = s.charts[a].states
    return any(
        size > _DISTANT * own[str(name)]
        for name, size in zip(names, guess, strict=True)
    )


def _cycle(
    map: ReturnMap, solution: Solution, event_sequence: tuple[int, ...]
) -> LimitCycle:
    """The cycle of a solution, with its numbers and its result as they are."""
    turn = solution.turn
    period = map.expected if map.base is None else turn.period
    return LimitCycle(
        map.system,
        map.base,
        period,
        solution.anchor,
        turn.pieces,
        turn.factors,
        turn.distance,
        solution.steps,
        solution.result,
        event_sequence,
        map.settings,
        map.conserved,
        map.multiplicity,
        copies_of(map.system),
    )


def _check_fits(
    guess: LimitCycle, s: Structure, multiplicity: int | None, waits: bool
) -> None:
    """**Raises:** `DefinitionError` for arguments that contradict a cycle as the guess."""
    require_similar(guess.return_map, s.system)
    if multiplicity not in (None, guess.multiplicity):
        raise DefinitionError(
            f"the guess has multiplicity {guess.multiplicity}, not {multiplicity}: give a Guess."
        )
    if guess.clocked != (s.system.period() is not None):
        raise DefinitionError(
            "of the guess and the system, only one has a clock: give a Guess."
        )
    if waits:
        raise DefinitionError(
            "the search begins on the cycle that is the guess, and knows its period: leave out "
            "`settle` and `max_period`, or give a Guess."
        )
