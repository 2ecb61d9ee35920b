"""Checks of a system's clock and of conserved quantities; the reasons of a search that failed."""

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
from ..systems.system import HybridSystem, Output, OutputNames
from ..systems.transition import SAME_TIME, Scheduled
from .coincidence import SAME, coincident, events_of
from .cycle import LimitCycle, orbit
from .return_map import Turn
from .scale import ROUNDING, STIFF, fastest, is_implicit, points
from .verdict import verdict


# The time at which functions are compared with those a period later, in parts of the period after
# each point: fields that jump with a clock do not jump there.
_BASE = 0.0729
# Times of a period at which functions are compared that may have pulses. Fewer: short pulses of
# another period are missed. More: time.
_TIMES = 1024


# The distance, in sizes of the states, beyond which a turn does not nearly close. Smaller: searches
# that have come close are told that there is no cycle. Larger: those that found none are not.
_FAR = 1e-2


def check_periodic(system: HybridSystem) -> None:
    """Check a system of which limit cycles are wanted.

    **Raises:** `DefinitionError` for one that is not well formed, or uses the time although it
    states no period.
    """
    clocked = check_system(system)
    if clocked and system.period() is None:
        raise DefinitionError(_no_period(system, f"the {clocked[0]} depends on t"))


def check_clock(s: Structure) -> None:
    """**Raises:** `DefinitionError` for a clock that is none, or schedules that do not fit it."""
    given: Any = s.system.period()
    if given is not None and np.shape(given):
        raise DefinitionError(f"`period()` must return one number, not {given}.")
    period = np.nan if given is None else float(given)
    if given is not None and not (np.isfinite(period) and period > 0):
        raise DefinitionError(
            f"`period()` must return a positive number, not {period}."
        )
    for transition in s.transitions:
        if isinstance(transition.guard, Scheduled):
            if given is None:
                raise DefinitionError(
                    _no_period(s.system, f"'{transition.name}' is scheduled")
                )
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
        n, rows = s.dims[a], np.flatnonzero(chart == a)
        sizes = np.concatenate([[time], np.asarray(scale)[a, :n]])
        every = -(-_TIMES // len(rows)) if may_be_sudden(s, a, _all) else 1
        times = t[rows, None] + time * (_BASE + np.arange(every) / every)
        for name, function in _functions(s, a):
            _compare(
                s,
                name,
                function,
                times.ravel(),
                q[:n, rows].repeat(every, axis=1),
                sizes,
            )


def check_outputs(cycle: LimitCycle, outputs: OutputNames) -> Outputs:
    """Outputs of a cycle that are given to a call.

    **Raises:** `DefinitionError` for one that does not exist, or is not well formed; and for an
    `Output` that does not have the period of the clock, or depends on time without one.
    """
    s = cycle.structure
    z = s.resolve_outputs(outputs)
    given = [outputs] if isinstance(outputs, str | Output) else outputs
    for x in (x for x in given if isinstance(x, Output) and not is_traced(cycle)):
        clocked = list(check_output(s, x))
        if clocked and s.system.period() is None:
            raise DefinitionError(
                _no_period(s.system, f"the {clocked[0]} depends on t")
            )
        for a, t, q in points(s, cycle.legs) if clocked else ():
            if s.resolve_outputs(x).defined(a):
                size = np.append(
                    float(cycle.period), np.asarray(cycle.settings.scale)[a, : len(q)]
                )
                _compare(s, *_output(s, a, x), t, q, size)
    return z


def _compare(
    s: Structure, name: str, function, t, q, size: Float[np.ndarray, " 1+n"]
) -> None:
    """**Raises:** `DefinitionError` if a function of (t, q) differs one period of the clock later
    by more than rounding, for times and states of this `size`."""
    clock: Any = s.system.period()
    period = float(clock)
    now, later = function(t, q), [function(t + k * period, q) for k in (1, 2, 3)]
    change = np.abs(np.stack(later) - now).max(axis=0)
    slope = np.sum(np.abs(now[:, 1 : 1 + len(size)]) * size[:, None], axis=1)
    differs = change[:, 0] > SAME * np.abs(now[:, 0]) + ROUNDING * slope
    gains = slice(1 + len(size), None)  # derivatives by inputs
    if np.any(differs) or np.any(
        change[:, gains] > SAME * np.abs(now)[:, gains].max(initial=0.0)
    ):
        raise DefinitionError(
            f"{name} does not have the period {period:.6g} that {type(s.system).__name__}.period() "
            "states."
        )


def _all(s: Structure, a: int, *point: Array) -> list[Array]:
    """Values of all of the user's functions of chart a."""
    watched = [s.guard(g, *point) for g in s.guards(a)]
    after = [
        (s.reset(g, *point), s.enabled(g, *point)) for g in s.guards(a) + s.schedules(a)
    ]
    outputs = [s.resolve_outputs(x) for x in s.system.outputs()]
    values = [x(a, *point) for x in outputs if x.defined(a)]
    return [s.field(a, *point), *watched, *after, *values]


def _functions(s: Structure, a: int) -> Iterator:
    """The user's functions of chart a, by name, as functions (t, q) with derivatives."""
    u, index = np.zeros((s.nu, 1)), np.zeros(1, np.int32)
    yield (
        f"the field of chart '{s.names[a]}'",
        lambda t, q: kernels.field(s, a, t, q, u),
    )
    for k, g in enumerate(s.guards(a)):
        guard = lambda t, q, k=k: kernels.watched(s, a, None, t, q, u, index)[k : k + 1]  # noqa: E731
        yield f"the guard of '{s.transitions[g].name}'", guard
    for g in s.guards(a) + s.schedules(a):
        reset = lambda t, q, g=g: kernels.reset(s, s.member(g), t, q, u)  # noqa: E731
        yield f"the reset of '{s.transitions[g].name}'", reset

        def holds(t, q, g=g):  # with derivatives that are zero
            value = kernels.enabled(s, s.member(g), t, q, u) * 1.0
            return np.concatenate([value[None], np.zeros((1 + len(q), len(t)))])[None]

        if s.transitions[g].enabled is not None:
            yield f"the predicate of '{s.transitions[g].name}'", holds
    for output in s.system.outputs():
        if s.resolve_outputs(output).defined(a):
            yield _output(s, a, output)


def _output(s: Structure, a: int, output: Output) -> tuple[str, Callable]:
    u = np.zeros((s.nu, 1))
    return f"the output '{output.name}'", lambda t, q: kernels.outputs(
        s, a, (output,), t, q, u
    )


def _no_period(system: HybridSystem, problem: str) -> str:
    return (
        f"{problem}, but {type(system).__name__} states no period: give it a method `period()` "
        "that returns the time after which everything that depends on t repeats."
    )


def check_found(cycle: LimitCycle) -> None:
    """Check the functions of a system on its cycle.

    **Raises:** `DefinitionError` as `check_clock`, `check_claims` and `check_jumps`.
    """
    s, legs = cycle.structure, to_host(cycle.legs)
    check_clock(s)
    check_claims(
        s, legs.t, legs.chart, legs.q, cycle.settings.scale, float(cycle.period)
    )
    if int(cycle.result) in (Result.OK, Result.SINGULAR):
        check_jumps(cycle)


def check_jumps(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` if the field of a chart jumps on the cycle without an event, or
    has a pulse that is shorter than a step."""
    s, period = cycle.structure, float(cycle.period)
    charts = [a for a in range(len(s.charts)) if unresolved.may_have_pulses(s, a)]
    if not charts:
        return
    scale, path = np.asarray(cycle.settings.scale), orbit(cycle)
    pulse = passed_over(path, np.zeros(s.nu), to_host(cycle.settings), linear=True)
    if pulse is not None:
        a, begin = int(path.chart[pulse[0]]), path.t[pulse[0]]
        raise DefinitionError(
            f"the {pulse[1]} in chart '{s.names[a]}' has a pulse, a jump or another sudden change, "
            f"over which the step from t = {begin:.6g} on passes{','.join(lines_of_jumps(s, a))}. "
            "Begin and end a pulse by transitions (`hj.Scheduled` at known times); for a jump, "
            "write a chart for each side and a `Transition` between them."
        )
    t, chart, q = path.dense(16)  # (fewer: jumps are missed behind kinks; more: time)
    events = path.t[path.event >= 0]
    if path.event[-1] < 0:  # the cycle may begin where the field jumps
        t, chart, q = (np.concatenate([x, x[1:2]]) for x in (t, chart, q))
        t[-1] += period
    for a in (a for a in charts if unresolved.may_jump(s, a)):
        k = np.flatnonzero((chart[1:] == a) & (chart[:-1] == a) & (np.diff(t) > 0))
        points = np.column_stack([t, q[:, : s.dims[a]]])
        sizes = np.append(period, scale[a, : s.dims[a]])
        for time, j, jump in (
            jumps(s, a, points[k], points[k + 1], sizes) if len(k) else ()
        ):
            apart = np.abs(time - events + period / 2) % period - period / 2
            if np.abs(apart).min(initial=np.inf) > SAME * period:
                raise DefinitionError(
                    f"the {column_name(s, a, j)} in chart '{s.names[a]}' jumps by {jump:.3g} at "
                    f"t = {time:.6g}{','.join(lines_of_jumps(s, a))}, where the cycle has no "
                    "event: linearizations would lack the saltation. Write a chart for each side "
                    "and a `Transition` between them, or `hj.sliding` for a surface along which "
                    "the state may slide."
                )


def check_conserved(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` for a quantity in `conserved` that the system changes."""
    if lost := cycle.conserved.keys() - _conserved_outputs(
        cycle, tuple(cycle.conserved)
    ):
        raise DefinitionError(
            f"'{min(lost)}' is not conserved by {type(cycle.system).__name__}: neighbors of the "
            "cycle change it in one turn. Leave it out of `conserved`."
        )


def _conserved_outputs(cycle: LimitCycle, names: tuple[str, ...]) -> dict[str, float]:
    """The outputs that are conserved near the cycle, with their values: their gradients are left
    eigenvectors of the monodromy."""
    cycle = to_host(cycle)
    map = cycle.return_map
    values, gradients = map.outputs(cycle.anchor.q[:, 0], names)
    changes = gradients @ monodromy(cycle.factors) - gradients
    changes = np.abs(changes * map.sizes).max(axis=1)
    kept = changes <= SAME * np.abs(gradients * map.sizes).max(axis=1)
    return {
        name: float(x)
        for name, x, same in zip(names, values, kept, strict=True)
        if same
    }


def explain(cycle: LimitCycle, turn: Turn, expected: float, settle: float) -> str:
    """The reason why a search failed that expected this period and has settled, with advice."""
    name, code, s = (
        type(cycle.system).__name__,
        Result(int(cycle.result)),
        cycle.structure,
    )
    if code == Result.COINCIDENCE and (pair := coincident(cycle.return_map, turn)):
        first, second = (s.transitions[g].name for g in pair)
        return (
            f"on the limit cycle of {name} the events '{first}' and '{second}' coincide: beside it "
            "they come in one order or the other, and no linearization holds for both: "
            "`hj.coincidences` of the cycle, which `throw=False` returns, has the "
            "derivatives of each. Let them happen at different times, or write them as one event."
        )
    if code == Result.SINGULAR:
        kept = _conserved_outputs(
            cycle, tuple(output.name for output in cycle.system.outputs())
        )
        example = {name: float(f"{x:.4g}") for name, x in kept.items()} or {
            "energy": 1.0
        }
        return (
            f"the return map of {name} has a multiplier of exactly 1 (J - I is singular), so its "
            "cycles form a family: a quantity is conserved, or there is a symmetry. Say which one "
            "is wanted by the value of the quantity (an output of the system), e.g. "
            f"`conserved={example}`, or take the one nearest to the guess with `throw=False`."
        )
    if code in (Result.GUARD_BEYOND, Result.NOT_VERIFIED):
        faults = [finding.text for finding in verdict(cycle).refused]
        reason = " ".join(faults[:2]) or f"{code.message}."
        return f"no limit cycle of {name} was found: Newton's method converged, but {reason}"
    limit = f" from {cycle.settings.max_steps} (reached: {turn.period:.2g} of {expected:.3g})"
    reason = code.message + limit * (code == Result.STEP_LIMIT)
    if code == Result.EXTRA_TURNS and cycle.multiplicity > 1:
        return (
            f"the cycle of {name} that was found closes sooner than after the "
            f"{cycle.multiplicity} periods of `multiplicity`: leave that out, or give a guess "
            "nearer to the longer cycle, with `settle` if it is stable."
        )
    if code == Result.NOT_CONVERGED and np.isnan(cycle.residual):
        reason = "Newton came to a state from where one period ends in another chart"
    elif code == Result.NOT_CONVERGED and not np.all(np.isfinite(turn.factors)):
        reason = (
            "derivatives of the flow over one period are not finite: a function has none where the "
            "cycle meets it, such as `sqrt(x)` and `x**0.0` at 0"
        )
    elif code == Result.NOT_CONVERGED and float(cycle.residual) > _FAR:
        reason = (
            "Newton did not converge, and from where it was nearest to a cycle, one turn ends "
            f"{float(cycle.residual):.2g} of the sizes of the states away from its beginning: "
            "there may be no cycle near the guess, but an equilibrium, a torus or chaos"
        )
    elif code == Result.NOT_CONVERGED:
        reason = f"Newton did not converge (residual {float(cycle.residual):.2g})"
        if cycle.conserved:
            reason += f"; perhaps not all of {', '.join(cycle.conserved)} are conserved"
    better = (
        " Try a better guess, or if the cycle is stable let it settle for longer, e.g. "
        f"`settle={settle + 60 * expected:.3g}` (with a `Guess`, not a cycle)."
    )
    advice = _about_steps(s, cycle, turn, expected) + _about_guards(s, turn, better)
    if code in (Result.STEP_LIMIT, Result.STEP_COLLAPSE):
        advice += _about_decisions(s)
    return f"no limit cycle of {name} was found: {reason}.{advice or better}"


def _about_steps(s: Structure, cycle: LimitCycle, turn: Turn, expected: float) -> str:
    """The place where steps shrank to nothing, or the mode that keeps them short."""
    lanes = turn.legs
    if int(turn.result) == Result.STEP_COLLAPSE:
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
            return f" It stopped at t = {path.t[-1]:.6g} in chart '{s.names[path.chart[-1]]}'."
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
    """The rate of the mode because of which a turn has reached the limit on steps of explicit
    methods; 0 for none."""
    if int(turn.result) != Result.STEP_LIMIT:
        return 0.0
    explicit = (x for x in points(s, turn.legs) if not is_implicit(s, x[0]))
    rate = max((float(fastest(s, *x).max()) for x in explicit), default=0.0)
    return rate if rate * expected >= STIFF else 0.0


def _about_decisions(s: Structure) -> str:
    """The lines at which fields may jump."""
    lines = dict.fromkeys(x for a in range(len(s.charts)) for x in lines_of_jumps(s, a))
    if not lines:
        return ""
    return (
        f" The field may jump{','.join(lines)}: then write a chart for each side and a "
        "`Transition` between them, or `hj.sliding`."
    )


def _about_guards(s: Structure, turn: Turn, better: str) -> str:
    """The values of the guards, if none of them led to an event."""
    if events_of(turn) or not s.transitions:
        return ""
    values: dict[int, list[float]] = {}
    for a, t, q in points(s, turn.legs):
        if guards := s.guards(a):
            u, index = np.zeros((s.nu, 1)), np.zeros(1, np.int32)
            rows = kernels.watched(s, a, None, t, q, u, index)[:, 0]
            for g, row in zip(guards, rows, strict=True):
                values.setdefault(g, []).extend(s.transitions[g].sign * row)
    text = "; ".join(
        f"the guard of '{s.transitions[g].name}', which should be {s.transitions[g].direction}, "
        f"began {'past zero, ' * bool(s.transitions[g].sign * x[0] < 0)}at {x[0]:.3g} and stayed "
        f"between {min(x):.3g} and {max(x):.3g}"
        for g, x in values.items()
    )
    advice = "Check its direction, and that the system does not come to rest."
    return (
        f" In the last turn tried no event happened: {text}. {advice}{better}"
        * bool(text)
    )
