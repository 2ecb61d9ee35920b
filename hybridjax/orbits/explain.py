"""Why a search for a limit cycle failed, in words."""

import numpy as np

from .._core.results import Result
from ..engine import kernels
from ..engine.trajectory import simulate
from ..systems.structure import Structure
from .coincidence import coincident, events_of
from .conserved import conserved_outputs
from .cycle import LimitCycle
from .return_map import LEGS, Turn
from .stiffness import fastest, points


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
