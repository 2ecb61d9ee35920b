"""Whether a system has the clock that it states: its functions are the same one period later, and
those of a system that states none are the same at all times."""

from collections.abc import Iterator

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


def check_times(
    system: HybridSystem,
    t: Float[np.ndarray, " K"],
    chart: Int[np.ndarray, " K"],
    q: Float[np.ndarray, "d K"],
    scale: Float[Array, "A d"],
    time: float,
) -> None:
    """Compare fields, guards and resets at different times, at some points.

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


def _no_period(system: HybridSystem, what: str) -> str:
    name = type(system).__name__
    return (
        f"{what}, but {name} states no period: give it a method `period()` that returns the time "
        "after which everything that depends on t repeats."
    )
