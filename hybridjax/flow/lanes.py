"""Lanes: the hybrid states of many trajectories that move side by side."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..systems.structure import Structure


# A guard counts as zero within this fraction of the sizes of the terms that make it up.
ZERO = 1e-12


class Lanes(eqx.Module):
    """L hybrid states. States are padded with zeros to the largest chart's dimension d."""

    t: Float[Array, " L"]
    chart: Int[Array, " L"]
    q: Float[Array, "d L"]
    armed: Bool[Array, "G L"]
    """Which transitions (rows, by index) would fire at their guard's next falling zero."""
    events: Int[Array, " L"]
    """Number of events so far."""
    pace: Float[Array, "4 L"]
    """For Zeno: time since the last event, the last interval between events, number of intervals
    in a row that shrank, and their sum."""


def by_lane(function: Callable) -> Callable:
    """Vectorise a function of single states over the lanes on the last axis."""
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def for_each_chart(
    s: Structure, chart: Int[Array, " L"], mask: Bool[Array, " L"], work: Callable, out
):
    """Let every chart that some lane of `mask` is in update `out` by `work(a, lanes_in_a, out)`.

    Charts without lanes cost nothing: the branch is on a scalar of the whole batch.
    """
    for a in range(len(s.charts)):
        here = mask & (chart == a)

        def present(out, a=a, here=here):
            return work(a, here, out)

        out = jax.lax.cond(here.any(), present, lambda out: out, out)
    return out


def only(mask: Bool[Array, " L"], x: Array) -> Array:
    """`x`, with the lanes outside `mask` replaced by one lane of it.

    A chart's functions are thus never evaluated at another chart's states, where they might be
    undefined; NaN there would poison reverse-mode derivatives even if it is masked afterwards.
    """
    return jnp.where(mask, x, x[..., jnp.argmax(mask)][..., None])


def guard_rate(function: Callable, t, q, f):
    """Value and time derivative of `function(t, q)` along the flow f, for one lane."""
    return jax.jvp(function, (t, q), (jnp.ones_like(t), f))


def zero_width(function: Callable, t, q):
    """How far from zero rounding alone may leave `function(t, q)`, for one lane."""
    gradient = jax.grad(function, argnums=1)(t, q)
    return ZERO * jnp.sum(jnp.abs(gradient * q))


def start_lanes(
    s: Structure, t: Float[Array, " L"], chart: Int[Array, " L"], q: Float[Array, "d L"], u
) -> Lanes:
    """Lanes at rest in their bookkeeping; guards that are positive are armed."""
    L = t.shape[0]
    pace = jnp.zeros((4, L)).at[1].set(jnp.inf)
    lanes = Lanes(
        t, chart, q, jnp.zeros((len(s.transitions), L), bool), jnp.zeros(L, jnp.int32), pace
    )
    return rearm(s, lanes, jnp.ones(L, bool), u, jnp.full(L, -1), jnp.zeros(L, bool))


def rearm(
    s: Structure,
    lanes: Lanes,
    mask: Bool[Array, " L"],
    u: Float[Array, "nu L"],
    fired: Int[Array, " L"],
    together: Bool[Array, " L"],
) -> Lanes:
    """Arm the guards of the chart that the lanes of `mask` have just entered.

    A guard that is zero there waits until it has left zero. The one exception are events at the
    same instant: where another guard of the old chart was at its zero too (`together`), a guard
    other than the one that fired, at zero and falling, is still due.
    """

    def work(a, here, armed):
        q = only(here, lanes.q[: s.dims[a]])
        t, uu = only(here, lanes.t), only(here, u)
        for g in s.guards(a):

            def state(t, q, u, g=g, a=a):
                def guard(t, q):
                    return s.guard(g, t, q, u)

                value, rate = guard_rate(guard, t, q, s.field(a, t, q, u))
                return value, rate, zero_width(guard, t, q)

            value, rate, width = by_lane(state)(t, q, uu)
            due = together & (jnp.abs(value) <= width) & (rate < 0) & (fired != g)
            armed = armed.at[g].set(jnp.where(here, (value > width) | due, armed[g]))
        return armed

    start = jnp.where(mask, False, lanes.armed)
    armed = for_each_chart(s, lanes.chart, mask, work, start)
    return eqx.tree_at(lambda x: x.armed, lanes, armed)
