"""Charts of a cycle whose fastest mode, not the motion, sets the steps of explicit methods."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ..engine import kernels
from ..engine.lanes import Lanes
from ..systems.structure import Structure


# A chart is stiff if its fastest mode decays to more than this power of e in one turn: an explicit
# method, stable for about 4 of them in a step, then takes hundreds of steps wherever the motion is
# slow. Doubled, charts are called stiff from twice as many steps on.
_STIFF = 1000.0
# Modes that are slower than the fastest one by more than this stand still, up to rounding. Doubled,
# a search waits half as long at most.
_ROUNDING = 1e-9


def stiff_charts(s: Structure, legs: Lanes, period: float) -> dict[str, float]:
    """The charts with explicit methods that are stiff on a cycle, each with the rate of its fastest
    mode. `legs`: states at equal distances in time, of a turn in this period."""
    found, step = {}, period / len(np.ravel(legs.t))
    for a, t, q in points(s, legs):
        rates = fastest(s, a, t, q)
        method = s.method(a)
        if step * rates.sum() > _STIFF and not (method and method.implicit):
            found[s.names[a]] = float(rates.max())
    return found


def fastest(
    s: Structure, a: int, t: Float[np.ndarray, " P"], q: Float[np.ndarray, "n P"]
) -> Float[np.ndarray, " P"]:
    """The rates at which the fastest modes of chart a decay; 0 where none does."""
    derivative = kernels.field(s, a, t, q, np.zeros((s.nu, 1)))[:, 2 : 2 + len(q)]
    rates = -np.linalg.eigvals(np.moveaxis(derivative, -1, 0)).real
    return np.maximum(rates.max(axis=1, initial=0.0), 0.0)


def has_implicit(s: Structure) -> bool:
    """Whether an implicit method goes through a chart."""
    methods = map(s.method, range(len(s.charts)))
    return any(method is not None and method.implicit for method in methods)


def slow_time(s: Structure, t: float, states: Float[np.ndarray, "A d"]) -> float:
    """The time in which the slowest mode changes, of the charts with implicit methods: steps of
    these need not be as short as the fastest one. 0 where there are none.

    **Arguments:** `states`, one in every chart; NaN where none is known.
    """
    times = [0.0]
    for a, state in enumerate(states):
        q = state[: s.dims[a]]
        if (method := s.method(a)) and method.implicit and np.isfinite(q).all():
            times.append(1 / _slowest_and_fastest(s, a, t, q)[0])
    return max(times)


def stiff_mode(s: Structure, a: int, t: float, q: Float[np.ndarray, " n"]) -> float | None:
    """The rate of the fastest mode of a chart with an explicit method, if the slowest one is slower
    by far."""
    method = s.method(a)
    slowest, fastest = _slowest_and_fastest(s, a, t, q)
    stiff = fastest > _STIFF * slowest > 0 and not (method and method.implicit)
    return fastest if stiff else None


def _slowest_and_fastest(s: Structure, a: int, t: float, q) -> tuple[float, float]:
    """Rates of the modes at a state, without those that stand still."""
    derivative = kernels.field(s, a, np.array([t]), q[:, None], np.zeros((s.nu, 1)))
    rates = np.abs(np.linalg.eigvals(derivative[:, 2 : 2 + len(q), 0]))
    moving = rates[rates > _ROUNDING * rates.max()]
    return float(moving.min(initial=np.inf)), float(moving.max(initial=0.0))


def points(s: Structure, legs: Lanes) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Charts, times and states at the beginnings of the pieces of a turn, as far as it came."""
    t, chart, q = map(np.asarray, (legs.t, legs.chart, legs.q))
    for a in np.unique(chart):
        here = (chart == a) & np.isfinite(q).all(axis=0)
        if here.any():
            yield int(a), t[here], q[: s.dims[a], here]
