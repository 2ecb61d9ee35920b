"""Checks of what users state about a system (clock, symmetry, conserved quantities, outputs), and
the texts that explain why a search for a limit cycle failed.

Before a search, `find.py` calls `check_periodic` and `check_clock`, and `guess.py` calls
`check_claims`; after it, `find.py` calls `check_found` and `check_conserved`. All of them raise
`DefinitionError`. `check_claims` compares each function of the user with the same function one to
three periods later (a further function is added in `_functions` and `_all`), relative to its values
and to rounding, so that units have no effect: this must stay. `check_outputs` is for results that
take outputs, as those of sections and experiments. `explain` is called by `find.py` with the last
*turn* of a search that failed (the flow from the section back to it), and returns the sentences of
the error. *Sizes* of states are their characteristic magnitudes (`scale.py`).

If a good system is refused, look at `_compare` (its period), `check_jumps` (a field that jumps) or
`_conserved_outputs`; if a wrong period passes, at `_functions` and the times in `check_claims`; if
an error has the wrong reason, at `_about_orbit` and `_why_not_converged`.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._core.executor import Array, is_traced, to_host
from .._core.results import Result
from ..engine import kernels, unresolved
from ..engine.trajectory import simulate
from ..engine.unresolved import (
    column_name,
    jumps,
    lines_of_jumps,
    may_be_sudden,
    passed_over,
)
from ..errors import DefinitionError
from ..linear.time_response import monodromy
from ..systems.check import check_output, check_schedules, check_system
from ..systems.quotient import check_symmetry
from ..systems.structure import Outputs, Structure
from ..systems.system import HybridSystem, Output, OutputNames, name_of
from ..systems.transition import SAME_TIME, Scheduled
from .coincidence import SAME, about_begin
from .cycle import LimitCycle, orbit
from .return_map import Turn
from .rivals import coincident
from .scale import ROUNDING, STIFF, fastest, is_implicit, points
from .verdict import verdict


# Functions are compared with those one period later at times this part of the period after each
# point, where fields that jump with a clock do not jump.
_BASE = 0.0729
# Number of times within a period at which functions that may have pulses are compared. Fewer: short
# pulses of another period are missed. More: time.
_TIMES = 1024


# A turn nearly closes if its ends are closer than this, in sizes of the states. Smaller: the
# message says that there is no cycle although the search came close. Larger: the message does not
# say so although there is none.
_FAR = 1e-2


def check_periodic(system: HybridSystem) -> None:
    """Check a system before a search for its limit cycle.

    **Raises:** `DefinitionError` for a system that is not well formed, or that uses the time
    although it states no period.
    """
    clocked = check_system(system)
    if clocked and system.period() is None:
        raise DefinitionError(_no_period(system, f"the {clocked[0]} depends on t"))


def check_clock(s: Structure) -> None:
    """**Raises:** `DefinitionError` for a clock without a positive period, or schedules that do not
    fit the clock."""
    given: Any = s.system.period()
    if given is not None and np.shape(given):
        raise DefinitionError(f"`period()` must return one number, not {given}.")
    period = np.nan if given is None else float(given)
    if given is not None and not (np.isfinite(period) and period > 0):
        raise DefinitionError(
            f"`period()` must return a positive number, not {period}."
        )
    for transition in s.transitions:
        if not isinstance(transition.guard, Scheduled):
            continue
        if given is None:
            problem = f"'{transition.name}' is scheduled"
            raise DefinitionError(_no_period(s.system, problem))
        ratio = period / float(transition.guard.period)
        if not abs(ratio - round(min(ratio, 1e9))) < SAME_TIME * ratio:
            raise DefinitionError(
                f"the schedule of '{transition.name}' must divide the clock's period, which is "
                f"{period}: otherwise events do not repeat in each period."
            )
    check_schedules(s)


def check_claims(
    s: Structure,
    t: Float[np.ndarray, " K"],
    chart: Int[np.ndarray, " K"],
    q: Float[np.ndarray, "d K"],
    scale: Float[Array, "A d"],
    time: float,
) -> None:
    """Check the symmetry that a system states; compare fields, guards, resets, predicates and
    outputs with those one to three periods of the clock later, at K points.

    **Arguments:** `scale`, sizes of the states by chart; `time`, a rough period.

    **Raises:** `DefinitionError` if they do not have the period or the symmetry that the system
    states; NaN is passed over.
    """
    check_symmetry(s.system, s.sizes(scale))
    if s.system.period() is None:
        return
    for a in np.unique(chart).tolist():
        n = s.dims[a]
        rows = np.flatnonzero(chart == a)
        of_states = np.asarray(scale)[a, :n]
        sizes = np.concatenate([[time], of_states])
        # (With pulses, all points together have `_TIMES` times.)
        every = -(-_TIMES // len(rows)) if may_be_sudden(s, a, _all) else 1
        parts = _BASE + np.arange(every) / every
        times = t[rows, None] + time * parts
        states = q[:n, rows].repeat(every, axis=1)
        for name, function in _functions(s, a):
            _compare(s, name, function, times.ravel(), states, sizes)


def default_outputs(s: Structure) -> tuple[str, ...]:
    """The states that all charts have.

    **Raises:** `DefinitionError` for none.
    """
    names = tuple(s.states_everywhere())
    if not names:
        raise DefinitionError(
            f"no state is in all charts of {name_of(s.system)}, to be recorded by default: "
            "give `outputs`, names of states or `hj.Output`s that exist at the sections."
        )
    return names


def check_outputs(cycle: LimitCycle, outputs: OutputNames) -> Outputs:
    """Outputs of a cycle that are given to a call.

    **Raises:** `DefinitionError` for an output that does not exist or is not well formed; for an
    `Output` that does not have the period of the clock, or depends on time without a clock.
    """
    s = cycle.structure
    z = s.resolve_outputs(outputs)
    given = [outputs] if isinstance(outputs, str | Output) else outputs
    if is_traced(cycle):
        return z
    for output in given:
        if isinstance(output, Output):
            _check_output_period(cycle, output)
    return z


def _check_output_period(cycle: LimitCycle, output: Output) -> None:
    """**Raises:** `DefinitionError` in the cases of `check_outputs`."""
    s = cycle.structure
    clocked = list(check_output(s, output))
    if not clocked:
        return
    if s.system.period() is None:
        problem = f"the {clocked[0]} depends on t"
        raise DefinitionError(_no_period(s.system, problem))
    scale = np.asarray(cycle.settings.scale)
    for a, t, q in points(s, cycle.pieces):
        if s.resolve_outputs(output).defined(a):
            of_states = scale[a, : len(q)]
            sizes = np.append(float(cycle.period), of_states)
            name, function = _output(s, a, output)
            _compare(s, name, function, t, q, sizes)


def _compare(
    s: Structure, name: str, function, t, q, size: Float[np.ndarray, " 1+n"]
) -> None:
    """**Raises:** `DefinitionError` if a function of (t, q) differs one period of the clock later
    by more than rounding, for times and states of this `size`."""
    clock: Any = s.system.period()
    period = float(clock)
    now = function(t, q)
    later = [function(t + k * period, q) for k in (1, 2, 3)]
    change = np.abs(np.stack(later) - now).max(axis=0)
    by_point = np.abs(now[:, 1 : 1 + len(size)])
    rounding = ROUNDING * np.sum(by_point * size[:, None], axis=1)
    tolerance = SAME * np.abs(now[:, 0]) + rounding
    values_differ = change[:, 0] > tolerance
    by_inputs = np.abs(now[:, 1 + len(size) :])
    largest = by_inputs.max(initial=0.0)
    gains_differ = change[:, 1 + len(size) :] > SAME * largest
    if np.any(values_differ) or np.any(gains_differ):
        raise DefinitionError(
            f"{name} does not have the period {period:.6g} that {name_of(s.system)}.period() "
            "states."
        )


def _all(s: Structure, a: int, *point: Array) -> list[Array]:
    """Values of all of the user's functions of chart a."""
    guards = [s.guard(g, *point) for g in s.guards(a)]
    events = s.guards(a) + s.schedules(a)
    after = [(s.reset(g, *point), s.enabled(g, *point)) for g in events]
    outputs = [s.resolve_outputs(output) for output in s.system.outputs()]
    values = [output(a, *point) for output in outputs if output.defined(a)]
    return [s.field(a, *point), *guards, *after, *values]


def _functions(s: Structure, a: int) -> Iterator[tuple[str, Callable]]:
    """The user's functions of chart a, by name, as functions (t, q) with derivatives."""
    u = np.zeros((s.nu, 1))

    def field(t, q):
        return kernels.field(s, a, t, q, u)

    yield f"the field of chart '{s.names[a]}'", field
    for k, g in enumerate(s.guards(a)):
        yield f"the guard of '{s.transitions[g].name}'", _guard(s, a, k)
    for g in s.guards(a) + s.schedules(a):
        name = s.transitions[g].name
        yield f"the reset of '{name}'", _reset(s, g)
        if s.transitions[g].enabled is not None:
            yield f"the predicate of '{name}'", _predicate(s, g)
    for output in s.system.outputs():
        if s.resolve_outputs(output).defined(a):
            yield _output(s, a, output)


def _guard(s: Structure, a: int, k: int) -> Callable:
    """Guard k of chart a, as a function (t, q) with derivatives."""
    u = np.zeros((s.nu, 1))
    index = np.zeros(1, np.int32)

    def guard(t, q):
        rows = kernels.watched(s, a, None, t, q, u, index)
        return rows[k : k + 1]

    return guard


def _reset(s: Structure, g: int) -> Callable:
    """The reset of transition g, as a function (t, q) with derivatives."""
    u = np.zeros((s.nu, 1))

    def reset(t, q):
        return kernels.reset(s, s.member(g), t, q, u)

    return reset


def _predicate(s: Structure, g: int) -> Callable:
    """The predicate of transition g, as a function (t, q) with derivatives, which are zero."""
    u = np.zeros((s.nu, 1))

    def predicate(t, q):
        rows = kernels.enabled(s, s.member(g), t, q, u)
        holds = rows.astype(float)
        derivatives = np.zeros((1 + len(q), len(t)))
        return np.concatenate([holds[None], derivatives])[None]

    return predicate


def _output(s: Structure, a: int, output: Output) -> tuple[str, Callable]:
    """The name of an output, and its function (t, q) with derivatives."""
    u = np.zeros((s.nu, 1))

    def values(t, q):
        return kernels.outputs(s, a, (output,), t, q, u)

    return f"the output '{output.name}'", values


def _no_period(system: HybridSystem, problem: str) -> str:
    return (
        f"{problem}, but {name_of(system)} states no period: give it a method `period()` "
        "that returns the time after which everything that depends on t repeats."
    )


def check_found(cycle: LimitCycle) -> None:
    """Check the functions of a system on its cycle.

    **Raises:** `DefinitionError` in the cases of `check_clock`, `check_claims` and `check_jumps`.
    """
    s = cycle.structure
    pieces = to_host(cycle.pieces)
    check_clock(s)
    check_claims(
        s, pieces.t, pieces.chart, pieces.q, cycle.settings.scale, float(cycle.period)
    )
    if int(cycle.result) in (Result.OK, Result.SINGULAR):
        check_jumps(cycle)


def check_jumps(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` if the field of a chart jumps on the cycle without an event, or
    has a pulse that is shorter than a step."""
    s = cycle.structure
    charts = [a for a in range(len(s.charts)) if unresolved.may_have_pulses(s, a)]
    if not charts:
        return
    path = orbit(cycle)
    pulse = passed_over(path, np.zeros(s.nu), to_host(cycle.settings), linear=True)
    if pulse is not None:
        row, function = pulse
        a = int(path.chart[row])
        raise DefinitionError(
            f"the {function} in chart '{s.names[a]}' has a pulse, a jump or another sudden change, "
            f"over which the step from t = {path.t[row]:.6g} on passes"
            f"{','.join(lines_of_jumps(s, a))}. "
            "Begin and end a pulse by transitions (`hj.systems.Scheduled` at known times); for a "
            "jump, write a chart for each side and a `Transition` between them."
        )
    period = float(cycle.period)
    t, chart, q = path.dense(16)  # (fewer: jumps are missed behind kinks; more: time)
    events = path.t[path.event >= 0]
    if path.event[-1] < 0:  # the cycle may begin where the field jumps
        t = np.concatenate([t, t[1:2]])
        chart = np.concatenate([chart, chart[1:2]])
        q = np.concatenate([q, q[1:2]])
        t[-1] += period
    scale = np.asarray(cycle.settings.scale)
    for a in charts:
        if not unresolved.may_jump(s, a):
            continue
        in_chart = (chart[1:] == a) & (chart[:-1] == a)
        inside = in_chart & (np.diff(t) > 0)
        before = np.flatnonzero(inside)
        if not len(before):
            continue
        samples = np.column_stack([t, q[:, : s.dims[a]]])
        sizes = np.append(period, scale[a, : s.dims[a]])
        for time, column, jump in jumps(
            s, a, samples[before], samples[before + 1], sizes
        ):
            shifted = np.abs(time - events + period / 2)
            apart = shifted % period - period / 2
            if np.abs(apart).min(initial=np.inf) > SAME * period:
                raise DefinitionError(
                    f"the {column_name(s, a, column)} in chart '{s.names[a]}' jumps by {jump:.3g} "
                    f"at t = {time:.6g}{','.join(lines_of_jumps(s, a))}, where the cycle has no "
                    "event: linearizations would lack the saltation. Write a chart for each side "
                    "and a `Transition` between them, or `hj.systems.filippov` for a surface along "
                    "which the state may slide."
                )


def check_conserved(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` for a quantity in `conserved` that the system changes."""
    kept = _conserved_outputs(cycle, tuple(cycle.conserved))
    lost = cycle.conserved.keys() - kept.keys()
    if lost:
        raise DefinitionError(
            f"'{min(lost)}' is not conserved by {name_of(cycle.system)}: neighbors of the "
            "cycle change it in one turn. Leave it out of `conserved`."
        )


def _conserved_outputs(cycle: LimitCycle, names: tuple[str, ...]) -> dict[str, float]:
    """The named outputs that are conserved near the cycle, with their values. (The gradient of a
    conserved output is a left eigenvector of the monodromy matrix.)"""
    cycle = to_host(cycle)
    map = cycle.return_map
    values, gradients = map.outputs(cycle.anchor.q[:, 0], names)
    changes = gradients @ monodromy(cycle.factors) - gradients
    changes = np.abs(changes * map.sizes).max(axis=1)
    largest = np.abs(gradients * map.sizes).max(axis=1)
    kept = changes <= SAME * largest
    conserved = np.flatnonzero(kept).tolist()
    return {names[k]: float(values[k]) for k in conserved}


def explain(cycle: LimitCycle, turn: Turn, expected: float, settle: float) -> str:
    """The reason why a search failed, with advice. `expected`: period that the search expected.
    `settle`: time for which it had simulated before."""
    code = Result(int(cycle.result))
    about_orbit = _about_orbit(cycle, code, turn)
    if about_orbit:
        return about_orbit
    name = name_of(cycle.system)
    reason = code.message
    if code == Result.STEP_LIMIT:
        reached = f"(reached: {turn.period:.2g} of {expected:.3g})"
        reason = f"{reason} from {cycle.settings.max_steps} {reached}"
    if code == Result.NOT_CONVERGED:
        reason = _why_not_converged(cycle, turn)
    better = (
        " Try a better guess, or if the cycle is stable let it settle for longer, e.g. "
        f"`settle={settle + 60 * expected:.3g}` (with a `Guess`, not a cycle)."
    )
    s = cycle.structure
    advice = _about_steps(s, cycle, turn, expected) + _about_guards(s, turn, better)
    if code in (Result.STEP_LIMIT, Result.STEP_COLLAPSE):
        advice += _about_decisions(s)
    return f"no limit cycle of {name} was found: {reason}.{advice or better}"


def _about_orbit(cycle: LimitCycle, code: Result, turn: Turn) -> str:
    """If a search ended on an orbit that is no isolated cycle, the reason; otherwise an empty
    text."""
    map = cycle.return_map
    if code == Result.EVENT_ORDER and map.event >= 0:
        follows = int(map.followed(turn.end))
        if follows >= 0:
            return about_begin(map, follows)
    if code == Result.SIMULTANEOUS:
        pair = coincident(map, turn)
        if pair is not None:
            return _about_coincidence(cycle, pair)
    if code == Result.SINGULAR:
        return _about_family(cycle)
    name = name_of(cycle.system)
    if code in (Result.GUARD_BEYOND, Result.NOT_VERIFIED):
        faults = [finding.text for finding in verdict(cycle).refused]
        reason = " ".join(faults[:2]) or f"{code.message}."
        return f"no limit cycle of {name} was found: Newton's method converged, but {reason}"
    if code == Result.EXTRA_TURNS and cycle.multiplicity > 1:
        return (
            f"the cycle of {name} that was found closes sooner than after the "
            f"{cycle.multiplicity} periods of `multiplicity`: leave that out, or give a guess "
            "nearer to the longer cycle, with `settle` if it is stable."
        )
    return ""


def _about_coincidence(cycle: LimitCycle, pair: tuple[int, int]) -> str:
    """The reason for a search that ended where two events coincide."""
    name = name_of(cycle.system)
    first, second = (cycle.structure.transitions[g].name for g in pair)
    return (
        f"on the limit cycle of {name} the events '{first}' and '{second}' coincide: beside it "
        "they come in one order or the other, and no linearization holds for both: "
        "`simultaneous_events()` of the cycle, which `throw=False` returns, has the "
        "derivatives of each. Let them happen at different times, or write them as one event."
    )


def _about_family(cycle: LimitCycle) -> str:
    """The reason for a search that ended on a cycle of a family."""
    name = name_of(cycle.system)
    outputs = tuple(output.name for output in cycle.system.outputs())
    conserved = _conserved_outputs(cycle, outputs)
    example = {output: float(f"{value:.4g}") for output, value in conserved.items()}
    first = ""
    if not example:
        example = {"energy": 1.0}
        first = ", after `outputs()` of the system has an `hj.Output` of this name"
    return (
        f"the return map of {name} has a multiplier of exactly 1 (J - I is singular), so its "
        "cycles form a family: a quantity is conserved, or there is a symmetry. Say which one "
        "is wanted by the value of the quantity (an output of the system), e.g. "
        f"`conserved={example}`{first}; or take the one nearest to the guess with `throw=False`."
    )


def _why_not_converged(cycle: LimitCycle, turn: Turn) -> str:
    """The reason for Newton's method that did not converge, from where it ended."""
    residual = float(cycle.residual)
    if np.isnan(residual):
        return "Newton came to a state from where one period ends in another chart"
    if not np.all(np.isfinite(turn.factors)):
        return (
            "derivatives of the flow over one period are not finite: a function has none where the "
            "cycle meets it, such as `sqrt(x)` and `x**0.0` at 0"
        )
    if residual > _FAR:
        return (
            "Newton did not converge, and from where it was nearest to a cycle, one turn ends "
            f"{residual:.2g} of the sizes of the states away from its beginning: "
            "there may be no cycle near the guess, but an equilibrium, a torus or chaos"
        )
    reason = f"Newton did not converge (residual {residual:.2g})"
    if cycle.conserved:
        reason += f"; perhaps not all of {', '.join(cycle.conserved)} are conserved"
    return reason


def _about_steps(s: Structure, cycle: LimitCycle, turn: Turn, expected: float) -> str:
    """The place where steps became too short, or the rate of the mode that keeps steps short."""
    if int(turn.result) == Result.STEP_COLLAPSE:
        lanes = turn.pieces
        a = int(lanes.chart[0])
        path = simulate(
            cycle.system,
            s.names[a],
            np.asarray(lanes.q)[: s.dims[a], 0],
            expected,
            time=float(lanes.t[0]),
            settings=cycle.settings,
            throw=False,
        )
        if path.result != Result.OK:
            where = s.names[path.chart[-1]]
            return f" It stopped at t = {path.t[-1]:.6g} in chart '{where}'."
    rate = rate_of_short_steps(s, turn, expected)
    if rate == 0.0:
        return ""
    return (
        f" The system is stiff: a mode decays in a time of {1 / rate:.2g}, in a period of "
        f"{expected:.3g}, and steps of explicit methods are as short as that also where it is at "
        'rest. Use an implicit one, e.g. `settings=Settings(solver="auto")`, or allow more steps, '
        "e.g. `settings=Settings(max_steps=20_000)`."
    )


def rate_of_short_steps(s: Structure, turn: Turn, expected: float) -> float:
    """The rate of the fast mode that made a turn reach the limit on steps of explicit methods; 0 if
    there is no such mode."""
    if int(turn.result) != Result.STEP_LIMIT:
        return 0.0
    rate = 0.0
    for a, times, states in points(s, turn.pieces):
        if not is_implicit(s, a):
            rate = max(rate, float(fastest(s, a, times, states).max()))
    return rate if rate * expected >= STIFF else 0.0


def _about_decisions(s: Structure) -> str:
    """The lines at which fields may jump."""
    lines = dict.fromkeys(x for a in range(len(s.charts)) for x in lines_of_jumps(s, a))
    if not lines:
        return ""
    return (
        f" The field may jump{','.join(lines)}: then write a chart for each side and a "
        "`Transition` between them, or `hj.systems.filippov`."
    )


def _about_guards(s: Structure, turn: Turn, better: str) -> str:
    """A sentence with the values of the guards, if no guard led to an event."""
    if turn.events or not s.transitions:
        return ""
    values: dict[int, list[float]] = {}
    for a, t, q in points(s, turn.pieces):
        guards = s.guards(a)
        if not guards:
            continue
        u = np.zeros((s.nu, 1))
        index = np.zeros(1, np.int32)
        rows = kernels.watched(s, a, None, t, q, u, index)[:, 0]
        for g, row in zip(guards, rows, strict=True):
            values.setdefault(g, []).extend(s.transitions[g].sign * row)
    if not values:
        return ""
    text = "; ".join(_range_of_guard(s, g, x) for g, x in values.items())
    advice = "Check its direction, and that the system does not come to rest."
    return f" In the last turn tried no event happened: {text}. {advice}{better}"


def _range_of_guard(s: Structure, g: int, values: list[float]) -> str:
    """A phrase on the values of a guard along a turn without events."""
    transition = s.transitions[g]
    past = "past zero, " if transition.sign * values[0] < 0 else ""
    return (
        f"the guard of '{transition.name}', which should be {transition.direction}, "
        f"began {past}at {values[0]:.3g} and stayed "
        f"between {min(values):.3g} and {max(values):.3g}"
    )
