"""Whether a system has the clock that it states: its functions are the same one period later, and
those of a system that states none are the same at all times."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Int

from .._core.executor import Array
from ..engine import kernels
from ..errors import DefinitionError
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled


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
