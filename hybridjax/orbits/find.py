"""Finding a limit cycle, by Newton's method on the return map with its exact Jacobian."""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Duration, Positive, Scalar, Wait
from .._core.executor import is_traced, to_host
from .._core.precision import real, require_x64
from .._core.progress import say, working
from .._core.results import Result
from ..engine.settings import LIMIT_CYCLE, Settings
from ..errors import ComputationError, DefinitionError
from ..systems.check import check_system
from ..systems.solver import Radau
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem, integrated
from .checks import check_clock, check_conserved, check_times, explain
from .coincidence import check_begin, coincident, commutes, events_of
from .crossing import AtEvent, Crossing
from .cycle import LimitCycle
from .guess import begin, check_section, guessed_lane, own_guess
from .newton import Solution, solve, solve_damped
from .return_map import ReturnMap
from .scale import (
    Sizes,
    given_sizes,
    has_implicit,
    scale_of,
    sizes_near,
    sizes_of,
    sizes_on,
    slow_time,
    stiff_charts,
)


# An autonomous system is given up if it does not return within so many of the times in which the
# states change by their sizes at the guess. Doubled, a search in vain takes twice as long.
_PATIENCE = 1000.0
# With an implicit method, a piece of a turn may take so many steps at least, since there may be a
# fast jump in it. Doubled, faster ones than that of van der Pol's oscillator at mu = 1000.
_JUMP = 1024
# A cycle is computed anew in the sizes that states have on it if a rough one was larger by more
# than this factor. Doubled, errors may be twice as large.
_OFF = 4.0
# A state keeps its rough size if on the cycle it is smaller than this part of it: it rests.
# Doubled, so do states that move twice as far.
_VANISHING = 1e-6


@checked
@working("find_limit_cycle")
def find_limit_cycle(
    system: HybridSystem,
    guess: Guess | LimitCycle | None = None,
    *,
    section: Crossing | AtEvent | None = None,
    multiplicity: Count | None = None,
    conserved: Mapping[str, Scalar] | None = None,
    settle: Wait = 0.0,
    max_period: Duration | None = None,
    scale: Mapping[str, Positive] | None = None,
    settings: Settings | None = None,
    throw: bool = True,
) -> LimitCycle:
    """Find a limit cycle by Newton on the return map; stable or not makes no difference.

    Where Newton fails, as it does if it steps out of the domain of the return map, the search is
    repeated with the smaller steps of Levenberg and Marquardt.

    A clocked system has its clock's period, and the return map is taken at the guess's phase of
    the clock. The period of an autonomous one is found; its return map lives on `section`.

    **Arguments:**

    - `guess`: a rough `Guess`, by default the model's own. A `LimitCycle` of a similar system is
        the best guess: a clocked system begins at the same phase of its own clock. It goes without
        `settle` and `max_period`.
    - `section`: for autonomous systems: where the return map is taken, e.g. `Crossing("v",
        "falling")` or `AtEvent("heelstrike")`. By default right after the event that the guess
        names (`Guess(..., after="heelstrike")`), or else on the plane through the guess across the
        flow. Newton starts at the guess if it lies on the section, else where the flow from the
        guess first meets it.
    - `multiplicity`: periods of the clock, or returns to the section, until the cycle closes: 2
        for the cycle that a period doubling leaves behind. By default 1, or the guess's.
    - `conserved`: the values at which conserved quantities are wanted, by the names of outputs,
        e.g. `{"energy": 1784.8}`. Cycles then come in families, with a multiplier of exactly 1 for
        each quantity, and this picks one of them. By default none, or the guess's.
    - `settle`: time to simulate before Newton begins, so that transients die out (the paper
        takes 60 s). No help where the cycle is unstable.
    - `max_period`: for autonomous systems: give up if no return is seen in this time, by default a
        thousand times that in which the states change at the guess (in charts with an implicit
        method, the slowest of them).
    - `scale`: sizes of states by name, such as `{"y": 1e-6}`: errors that are small compared to
        them do not matter. By default each state's largest modulus on the cycle, so that results
        do not depend on units (under a JAX transformation, on the guess).
    - `settings`: accuracy of the flow, 1e-12 by default, how many steps it may take, which
        `linearize` takes over, and its `solver`; "auto" takes an implicit one in those charts that
        are stiff on the cycle.
    - `throw`: raise on failure; otherwise the cycle's `result` says what went wrong.

    **Raises:** `DefinitionError` for bad arguments, and for functions that depend on time otherwise
    than `system.period()` states; `ComputationError` if no isolated cycle is found: no
    convergence, an event or section that does not come, events that coincide, grazing, an
    equilibrium in place of a cycle, or a singular J - I (there is a whole family of cycles, from a
    conserved quantity or a symmetry; see `conserved`).

    Under a JAX transformation of `system`, give a `LimitCycle` as the guess: the cycle is then
    followed by implicit differentiation. Its `result` says whether it was found; derivatives of a
    cycle that was not found mean nothing, and are NaN as a rule.
    """
    settings = Settings() if settings is None else settings
    if settings.solver == "auto":
        options = {
            "section": section, "multiplicity": multiplicity, "conserved": conserved,
            "scale": scale, "throw": throw,
        }  # fmt: skip
        return _find_by_itself(system, guess, settle, max_period, settings, options)
    system = settings.system(system)
    traced = is_traced((system, conserved))
    if not traced:
        require_x64(system, guess, section, settings)
        check_system(system)
    s = Structure(system)
    settings = settings.filled(LIMIT_CYCLE)
    if has_implicit(s):
        settings = dataclasses.replace(settings, max_steps=max(settings.max_steps, _JUMP))
    given = {} if settings.scale is None else sizes_of(s, settings.scale)
    given |= given_sizes(s, scale)
    check_section(s, section)
    if not traced:
        check_clock(system)
    if isinstance(guess, LimitCycle):
        _check_fits(guess, s, multiplicity, settle, max_period)
        conserved = guess.conserved if conserved is None else conserved
        settings = _in_sizes(settings, s, given, guess.settings.scale)
        map = guess.return_map.at_phase_of(system)
        map = dataclasses.replace(
            map, settings=settings, base=map.base if section is None else section
        )
    elif traced:
        raise DefinitionError(
            "under a JAX transformation find_limit_cycle needs a LimitCycle as its guess: find "
            "one outside, and pass it as `guess`."
        )
    else:
        multiplicity = 1 if multiplicity is None else multiplicity
        guess = own_guess(system) if guess is None else guess
        lane, period = guessed_lane(system, guess), system.period()
        near = sizes_near(
            system, int(np.asarray(lane.chart)[0]), np.asarray(lane.t)[0], np.asarray(lane.q)[:, 0],
            None if period is None else float(period),
        )  # fmt: skip
        settings = _in_sizes(settings, s, near.sizes | given)
        charts = np.arange(len(s.charts))
        times = np.full(len(charts), float(np.asarray(lane.t)[0]))
        check_times(system, times, charts, near.points.T, settings.scale, near.time)
        if max_period is None:
            max_period = _PATIENCE * max(near.time, slow_time(s, times[0], near.points))
        anchor, base, expected = begin(
            system, lane, guess.after, section, multiplicity, settle, max_period, settings,
            near.time,
        )  # fmt: skip
        map = ReturnMap(system, settings, anchor, base, expected, {}, multiplicity)
    conserved = {k: real(v) for k, v in (conserved or {}).items()}
    map = dataclasses.replace(map, conserved=conserved)
    if traced:
        return _cycle(map, solve(map, True), guess.event_sequence)
    s.resolve_outputs(tuple(conserved)).require(int(np.asarray(map.anchor.chart)[0]))
    if isinstance(map.base, AtEvent):
        check_begin(map)
    map, solution = _in_own_sizes(map, _solve(map), given)
    cycle = _cycle(map, solution, tuple(g for g, _ in events_of(solution.turn)))
    found = int(solution.result) in (Result.OK, Result.SINGULAR)
    if found and coincident(map, solution.turn):
        if commutes(cycle):
            say("events coincide, in either order with the same outcome")
        else:
            code = jax.device_put(np.int32(Result.COINCIDENCE))
            cycle = dataclasses.replace(cycle, result=code)
    code, legs = Result(int(cycle.result)), to_host(cycle.legs)
    check_times(system, legs.t, legs.chart, legs.q, map.settings.scale, float(cycle.period))
    if code in (Result.OK, Result.SINGULAR):
        check_begin(cycle.return_map)
        if conserved:
            check_conserved(cycle)
    if throw and code != Result.OK:
        raise ComputationError(explain(cycle, solution.turn, float(map.expected)))
    return cycle


def _find_by_itself(system, guess, settle, max_period, settings, options) -> LimitCycle:
    """The cycle with an implicit method in those charts that are stiff on it."""
    settings = dataclasses.replace(settings, solver=None)
    everywhere = integrated(system, Radau())
    cycle = find_limit_cycle(
        everywhere, guess, settle=settle, max_period=max_period, settings=settings, **options
    )
    s = Structure(integrated(system, None))
    stiff = stiff_charts(s, to_host(cycle.legs), float(cycle.period))
    if cycle.result != Result.OK or len(stiff) == len(s.names):
        return cycle
    fitting = integrated(system, dict.fromkeys(stiff, Radau()))
    return find_limit_cycle(fitting, cycle, settings=settings, **options)


def _in_sizes(
    settings: Settings,
    s: Structure,
    sizes: Sizes,
    otherwise: Float[Array, "A d"] | None = None,
) -> Settings:
    return dataclasses.replace(settings, scale=scale_of(s, sizes, otherwise))


def _solve(map: ReturnMap) -> Solution:
    """Newton's method, with smaller steps or another period where it fails."""
    say("Newton's method")
    solution = solve(map)
    if int(solution.result) == Result.EXTRA_TURNS:
        turn = solution.turn
        expected = turn.period * map.multiplicity / turn.meetings
        solution = solve(dataclasses.replace(map, anchor=solution.anchor, expected=expected))
    if int(solution.result) not in (Result.OK, Result.SINGULAR, Result.EQUILIBRIUM):
        # Newton may have stepped out of the domain of the return map: smaller steps.
        say("steps of Levenberg and Marquardt")
        second = solve_damped(map)
        solution = second if int(second.result) == Result.OK else solution
    return solution


def _in_own_sizes(map: ReturnMap, solution: Solution, given: Sizes) -> tuple[ReturnMap, Solution]:
    """A cycle in the sizes that states have on it, for one that was found in rough ones."""
    if int(solution.result) not in (Result.OK, Result.SINGULAR):
        return map, solution
    s, legs, period = map.structure, solution.turn.legs, float(solution.turn.period)
    rough = sizes_of(s, map.settings.scale)
    sizes = sizes_on(map.system, legs.t, legs.chart, legs.q, period)
    sizes = {k: x if x > _VANISHING * rough[k] else rough[k] for k, x in sizes.items()} | given
    expected = map.expected if map.base is None else solution.turn.period
    own = dataclasses.replace(
        map, settings=_in_sizes(map.settings, s, sizes), anchor=solution.anchor, expected=expected
    )
    if all(rough[name] <= _OFF * size for name, size in sizes.items()):  # more accurate than asked
        size = np.asarray(own.settings.scale)[np.asarray(map.anchor.chart)[0]]
        distance = real(np.max(np.abs(solution.turn.residual) / size))
        return own, solution._replace(turn=solution.turn._replace(distance=distance))
    say("Newton's method, in the sizes of the cycle")
    again = solve(own)
    if int(again.result) not in (Result.OK, Result.SINGULAR):
        return map, solution
    return own, again._replace(steps=solution.steps)


def _cycle(map: ReturnMap, solution: Solution, event_sequence: tuple[int, ...]) -> LimitCycle:
    turn = solution.turn
    period = map.expected if map.base is None else turn.period
    return LimitCycle(
        map.system, map.base, period, solution.anchor, turn.legs, turn.factors, turn.distance,
        solution.steps, solution.result, event_sequence, map.settings, map.conserved,
        map.multiplicity,
    )  # fmt: skip


def _check_fits(
    guess: LimitCycle,
    s: Structure,
    multiplicity: int | None,
    settle: float,
    max_period: float | None,
) -> None:
    """Raise for what makes no sense where a cycle is the guess."""
    if multiplicity not in (None, guess.multiplicity):
        raise DefinitionError(
            f"the guess has multiplicity {guess.multiplicity}, not {multiplicity}: give a Guess."
        )
    if guess.clocked != (s.system.period() is not None):
        raise DefinitionError("of the guess and the system, only one has a clock: give a Guess.")
    if max_period is not None or settle:
        raise DefinitionError(
            "the search begins on the cycle that is the guess, and knows its period: leave out "
            "`settle` and `max_period`, or give a Guess."
        )
