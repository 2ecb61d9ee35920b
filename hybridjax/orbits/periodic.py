"""Test whether the functions of a clocked system have the period of its clock.

`has_period` is called by searches, verdicts and programs that repeat a cycle. It compares fields,
guards, resets, predicates and schedules at some points with those one period later, and returns one
truth value (`checks.py` names the function that differs, outside of programs). A further function
of users is added in `_values`. The test must not ask for values, since JAX traces it, too.

If a system is refused whose functions repeat, look at the differences that `has_period` allows; if
one passes whose functions do not repeat, at `_values`, `LATER`, and `_schedules_fit` for schedules.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..systems.structure import Structure
from ..systems.transition import SAME_TIME, Scheduled
from .scale import ROUNDING


# At each point (t, q), functions are compared at the times t + `LATER` periods and one period after
# that. (Clocks switch at simple fractions of the period; this number keeps away from them.)
LATER = 0.0729
# Largest allowed difference, relative to the largest value at all points. Smaller: rounding errors
# of times are taken for another period. Larger: functions of another period pass.
_SAME = 1e-6


def has_period(
    s: Structure,
    period: Float[Array, ""],
    t: Float[Array, " K"],
    chart: Int[Array, " K"],
    q: Float[Array, "d K"],
) -> Bool[Array, ""]:
    """Test whether fields, guards, resets, predicates and schedules repeat after a period, at
    points of a turn. (Points at which a function is NaN are skipped.)"""
    times = t + LATER * period
    same = _schedules_fit(s, period)
    for a in range(len(s.charts)):

        def values(t, q, a=a):
            return _values(s, a, t, q)

        n = s.dims[a]
        points = jax.vmap(lambda t, q, f=values: _with_rate(f, t, q))
        twice = jnp.concatenate([times, times + period])
        states = jnp.tile(q[:n].T, (2, 1))
        both, rates = points(twice, states)
        now, later = jnp.split(both, 2)
        rate, _ = jnp.split(rates, 2)
        here = (chart == a)[:, None]
        known = here & ~jnp.isnan(now)
        size = jnp.max(jnp.where(known, jnp.abs(now), 0.0), axis=0)
        largest_time = (jnp.abs(times) + period)[:, None]
        rounding = ROUNDING * jnp.abs(rate) * largest_time
        differs = jnp.abs(later - now) > _SAME * size + rounding
        same = same & ~(here & differs).any()
    return same


def _values(s: Structure, a: int, t, q: Float[Array, " n"]) -> Float[Array, " v"]:
    """The values of all functions of chart a that determine its motion."""
    u = jnp.zeros(s.nu)
    guards = s.guards(a)
    parts = [s.field(a, t, q, u)]
    parts += [s.guard(g, t, q, u) for g in guards]
    for g in guards + s.schedules(a):
        parts += [s.reset(g, t, q, u)]
        if s.transitions[g].enabled is not None:
            parts += [s.enabled(g, t, q, u)]
    return jnp.concatenate([jnp.ravel(x).astype(float) for x in parts])


def _with_rate(function, t, q) -> tuple[Array, Array]:
    """Values and their derivatives by the time."""
    return jax.jvp(lambda t: function(t, q), (t,), (jnp.ones_like(t),))


def _schedules_fit(s: Structure, period: Float[Array, ""]) -> Bool[Array, ""]:
    """Test whether the period of the clock is a multiple of the period of each schedule."""
    fit = jnp.asarray(True)
    for transition in s.transitions:
        if isinstance(transition.guard, Scheduled):
            ratio = period / transition.guard.period
            off = jnp.abs(ratio - jnp.round(ratio))
            fit = fit & (off < SAME_TIME * ratio)
    return fit
