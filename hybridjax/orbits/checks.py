"""Whether a system has the clock that it states: its functions are the same one period later, and
those of a system that states none are the same at all times."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Int

from .._core.executor import Array, to_host
from .._core.results import Result
from ..engine import kernels
from ..engine.trajectory import simulate
from ..errors import DefinitionError
from ..linear.time_response import monodromy
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled
from .coincidence import coincident, events_of
from .cycle import LimitCycle
from .return_map import LEGS, Turn
from .scale import fastest, points


# A schedule divides the clock's period if the quotient is this near to a whole number. Doubled,
# turns that differ twice as much from the last one are taken for equal.
_WHOLE = 1e-6
# A function is the same at two times up to this part of its value, and up to this part of what the
# states' sizes and the period make of its derivatives. Doubled, half as large an error of a stated
# period is noticed.
_SAME, _SAME_SLOPE = 1e-6, 1e-9
# Times at which functions are seen, after that of each point, in parts of the period: not those at
# which fields may jump with a clock, and for a system that states none, no multiples of each other.
# More of them see functions of time that are constant most of the time.
_BASE, _LATER = 0.0729, np.array([0.1459, 0.3820, 0.6180, 1.4142])


def check_clock(system: HybridSystem) -> None:
    """**Raises:** `DefinitionError` for a clock that is none, or schedules that do not fit it."""
    s = Structure(system)
    period = None if system.period() is None else float(system.period())
    if period is not None and not (np.isfinite(period) and period > 0):
        raise DefinitionError(f"the clock's period must be positive; it is {period}.")
    for transition in s.transitions:
        if isinstance(transition.guard, Scheduled):
            if period is None:
                raise DefinitionError(_no_period(system, f"'{transition.name}' is scheduled"))
            ratio = period / float(transition.guard.period)
            if not abs(ratio - round(min(ratio, 1e9))) < _WHOLE:
                raise DefinitionError(
                    f"the schedule of '{transition.name}' must divide the clock's period, which is "
                    f"{period}: otherwise no turn is like the last one."
                )
    for a in range(len(s.charts)):
        _check_schedules(s, a, period)


def _check_schedules(s: Structure, a: int, period: float | None) -> None:
    """**Raises:** `DefinitionError` for two events of a chart that are scheduled for one time."""
    times: dict[str, np.ndarray] = {}
    for x in (s.transitions[g] for g in s.schedules(a)):
        every, offset = float(x.guard.period), float(x.guard.offset)
        times[x.name] = (offset + every * np.arange(round(period / every))) % period
    for (one, first), (other, second) in itertools.combinations(times.items(), 2):
        apart = np.abs(first[:, None] - second + period / 2) % period - period / 2
        if np.min(np.abs(apart)) < _WHOLE * period:
            raise DefinitionError(
                f"'{one}' and '{other}' are scheduled for the same time in chart '{s.names[a]}': "
                "write them as one event, or let one lead to a chart that the other leaves."
            )


def check_times(
    system: HybridSystem,
    t: Float[np.ndarray, " K"],
    chart: Int[np.ndarray, " K"],
    q: Float[np.ndarray, "d K"],
    scale: Float[Array, "A d"],
    time: float,
) -> None:
    """Compare fields, guards, resets, predicates and outputs at different times, at some points.

    **Arguments:** `scale`, sizes of the states by chart; `time`, the period, as far as it is known.

    **Raises:** `DefinitionError` where they do not have the period that the system states, or
    depend on time although it states none; NaN is passed over.
    """
    s, period, scale = Structure(system), system.period(), np.asarray(scale)
    later = time * _LATER if period is None else np.array([float(period)])
    for a in np.unique(chart):
        n, here = s.dims[a], np.flatnonzero(chart == a)
        first, states = t[here] + _BASE * time, q[:n, here]
        for name, function in _functions(s, int(a)):
            seen = function(first, states)
            size = np.concatenate([[time], scale[a, :n]])[:, None]
            slope = np.sum(np.abs(seen[:, 1 : 2 + n]) * size, axis=1)
            same = _SAME * np.abs(seen[:, 0]) + _SAME_SLOPE * slope
            for shift in later:
                if np.any(np.abs(function(first + shift, states)[:, 0] - seen[:, 0]) > same):
                    if period is None:
                        raise DefinitionError(_no_period(system, f"{name} depends on t"))
                    raise DefinitionError(
                        f"{name} does not have the period {float(period):.6g} that "
                        f"{type(system).__name__}.period() states."
                    )


def _functions(s: Structure, a: int) -> Iterator:
    """What a user wrote for chart a, by name, as functions (t, q) of the host with derivatives."""
    u = np.zeros((s.nu, 1))
    yield f"the field of chart '{s.names[a]}'", lambda t, q: kernels.field(s, a, t, q, u)
    index = np.zeros(1, np.int32)
    for row, g in enumerate(s.guards(a)):
        guard = lambda t, q, k=row: kernels.watched(s, a, None, t, q, u, index)[k : k + 1]  # noqa: E731
        yield f"the guard of '{s.transitions[g].name}'", guard
    for g in s.guards(a) + s.schedules(a):
        reset = lambda t, q, g=g: kernels.reset(s, s.member(g), t, q, u)  # noqa: E731
        yield f"the reset of '{s.transitions[g].name}'", reset
        if s.transitions[g].enabled is not None:
            yield f"the predicate of '{s.transitions[g].name}'", _predicate(s, g, u)
    for output in s.system.outputs():
        if s.resolve_outputs(output).defined(a):
            value = lambda t, q, x=output: kernels.outputs(s, a, (x.name,), t, q, u)  # noqa: E731
            yield f"the output '{output.name}'", value


def _predicate(s: Structure, g: int, u) -> Callable:
    """1 where transition g may happen, else 0, as a function whose derivatives are zero."""

    def holds(t, q):
        value = kernels.enabled(s, s.member(g), t, q, u) * 1.0
        return np.concatenate([value[None], np.zeros((1 + len(q), len(t)))])[None]

    return holds


def _no_period(system: HybridSystem, what: str) -> str:
    name = type(system).__name__
    return (
        f"{what}, but {name} states no period: give it a method `period()` that returns the time "
        "after which everything that depends on t repeats."
    )


# The gradient of a conserved quantity, in sizes of the states, is a left eigenvector of the
# monodromy up to this part of it. Doubled, half as much loss is noticed.
_CONSERVED = 1e-6


def check_conserved(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` where a quantity that should be conserved is not."""
    kept = conserved_outputs(cycle, tuple(cycle.conserved))
    lost = [name for name in cycle.conserved if name not in kept]
    if lost:
        raise DefinitionError(
            f"'{lost[0]}' is not conserved by {type(cycle.system).__name__}: neighbors of the "
            "cycle change it in one turn. Leave it out of `conserved`."
        )


def conserved_outputs(cycle: LimitCycle, names: tuple[str, ...]) -> dict[str, float]:
    """Those outputs that are conserved near the cycle, with their values: their gradients are left
    eigenvectors of the monodromy."""
    cycle = to_host(cycle)
    s, t = Structure(cycle.system), cycle.anchor.t
    a = int(cycle.anchor.chart[0])
    n = s.dims[a]
    returned, sizes = monodromy(cycle.factors)[:n, :n], cycle.settings.scale[a, :n]
    items = tuple(s.resolve_outputs(names).items)
    seen = kernels.outputs(s, a, items, t, cycle.anchor.q[:n], np.zeros((s.nu, 1)))[..., 0]
    values, gradients = seen[:, 0], seen[:, 2 : 2 + n]
    changes = np.abs((gradients @ returned - gradients) * sizes).max(axis=1)
    kept = changes <= _CONSERVED * np.abs(gradients * sizes).max(axis=1)
    return {name: float(x) for name, x, same in zip(names, values, kept, strict=True) if same}


# A system is stiff if a mode decays to this power of e within one piece of a turn. Doubled, modes
# that decay twice as fast are not blamed for the limit on steps.
_STIFF = 20.0


def explain(cycle: LimitCycle, turn: Turn, expected: float) -> str:
    """What is wrong with a cycle whose result is not OK, in a search that expected this period."""
    name, code = type(cycle.system).__name__, Result(int(cycle.result))
    if code == Result.COINCIDENCE and (pair := coincident(cycle.return_map, turn)):
        first, second = (Structure(cycle.system).transitions[g].name for g in pair)
        return (
            f"on the limit cycle of {name} the events '{first}' and '{second}' coincide: beside it "
            "they come in one order or the other, and no linearization holds for both: "
            "`hj.orbits.coincidences` of the cycle, which `throw=False` returns, has the "
            "derivatives of each. Let them happen at different times, or write them as one event."
        )
    if code == Result.SINGULAR:
        kept = conserved_outputs(cycle, tuple(output.name for output in cycle.system.outputs()))
        example = {name: float(f"{x:.4g}") for name, x in kept.items()} or {"energy": 1.0}
        return (
            f"the return map of {name} has a multiplier of exactly 1 (J - I is singular), so its "
            "cycles form a family: a quantity is conserved, or there is a symmetry. Say which one "
            "is wanted by the value of the quantity (an output of the system), e.g. "
            f"`conserved={example}`, or take the one nearest to the guess with "
            "`throw=False`."
        )
    reason = code.message
    if code == Result.NOT_CONVERGED and np.isnan(cycle.residual):
        reason = "Newton came to a state from where one period ends in another chart"
    elif code == Result.NOT_CONVERGED:
        reason = f"Newton did not converge (residual {float(cycle.residual):.2g})"
        if cycle.conserved:
            reason += f"; perhaps not all of {', '.join(cycle.conserved)} are conserved"
    advice = _about_stops(cycle, turn, expected) + _about_stiffness(cycle, turn, expected)
    advice += _about_guards(cycle, turn)
    if not advice:
        advice = (
            " Try a better guess, or let it settle first if the cycle is stable, e.g. "
            "`settle=60 * period`."
        )
    return f"no limit cycle of {name} was found: {reason}.{advice}"


def _about_stops(cycle: LimitCycle, turn: Turn, expected: float) -> str:
    """Where the flow stopped, if its steps shrank to nothing."""
    if turn.result != Result.STEP_COLLAPSE:
        return ""
    s, lanes = Structure(cycle.system), turn.legs
    a = int(lanes.chart[0])
    way = simulate(
        cycle.system, s.names[a], np.asarray(lanes.q)[: s.dims[a], 0], expected,
        time=float(lanes.t[0]), settings=cycle.settings, throw=False,
    )  # fmt: skip
    if way.result == Result.OK:
        return ""
    return f" It stopped at t = {way.t[-1]:.6g} in chart '{s.names[way.chart[-1]]}'."


def _about_stiffness(cycle: LimitCycle, turn: Turn, expected: float) -> str:
    """Which mode asks for so many steps, if one does."""
    s, rate = Structure(cycle.system), 0.0
    if turn.result != Result.STEP_LIMIT:
        return ""
    for a, t, q in points(s, turn.legs):
        if (method := s.method(a)) and method.implicit:
            continue
        rate = max(rate, float(fastest(s, a, t, q).max()))
    if rate * expected / LEGS < _STIFF:
        return ""
    return (
        f" The system is stiff: a mode decays in a time of {1 / rate:.2g}, in a period of "
        f"{expected:.3g}, and steps of explicit methods are as short as that also where it is at "
        'rest. Use an implicit one, e.g. `settings=Settings(solver="auto")`, or allow more steps, '
        "e.g. `settings=Settings(max_steps=20_000)`."
    )


def _about_guards(cycle: LimitCycle, turn: Turn) -> str:
    """What the guards did, if none of them fired."""
    s = Structure(cycle.system)
    if events_of(turn) or not s.transitions:
        return ""
    seen: dict[int, list[float]] = {}
    for a, t, q in points(s, turn.legs):
        if guards := s.guards(a):
            u, index = np.zeros((s.nu, 1)), np.zeros(1, np.int32)
            rows = kernels.watched(s, a, None, t, q, u, index)[:, 0]
            for g, values in zip(guards, rows, strict=True):
                seen.setdefault(g, []).extend(s.transitions[g].sign * values)
    told = "; ".join(
        f"the guard of '{s.transitions[g].name}', which should be {s.transitions[g].direction}, "
        f"went from {values[0]:.3g} to {values[-1]:.3g} (between {min(values):.3g} and "
        f"{max(values):.3g})"
        for g, values in seen.items()
    )
    return f" No event happened: {told}. Check its direction, and the guess." if told else ""
