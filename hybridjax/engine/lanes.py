"""Lanes: the hybrid states of many trajectories that move side by side."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, cond, lane, namespace, on_host
from ..systems.structure import Structure


class Lanes(NamedTuple):
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


def for_each_chart(
    s: Structure, chart: Int[Array, " L"], mask: Bool[Array, " L"], work: Callable, out
):
    """Let every chart that some lane of `mask` is in update `out` by `work(a, lanes_in_a, out)`.

    Charts without lanes cost nothing: the branch is on a scalar of the whole batch. The branch
    also keeps XLA from computing its contents once for every use of its results.
    """
    for a in range(len(s.charts)):
        here = mask & (chart == a)

        def present(out, a=a, here=here):
            return work(a, here, out)

        out = cond(here.any(), present, lambda out: out, out)
    return out


def only(mask: Bool[Array, " L"], x: Array) -> Array:
    """`x`, with the lanes outside `mask` replaced by one lane of it; itself if it is one for all.

    A chart's functions are thus never evaluated at another chart's states, where they might be
    undefined; NaN there would poison reverse-mode derivatives even if it is masked afterwards.
    """
    if x.shape[-1] < mask.shape[0] or (on_host(mask) and mask.all()):
        return x
    xp = namespace(x)
    return xp.where(mask, x, lane(x, xp.argmax(mask)))


def constant(tree):
    """The same numbers without derivatives."""
    return jax.tree_util.tree_map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, tree
    )


def needed(mask: Bool[Array, " L"], tree):
    """`tree` itself, without derivatives if `mask` has no lanes.

    Where `jax.vmap` maps a branch, both of its sides are computed, the one that is not taken with
    zero cotangents. At another chart's states these may meet infinite derivatives, and zero times
    infinity is NaN: it must not reach states or parameters.
    """
    if on_host(mask):
        return tree
    some = mask.any()

    def cut(x):
        return jnp.where(some, x, jax.lax.stop_gradient(x)) if eqx.is_inexact_array(x) else x

    return jax.tree_util.tree_map(cut, tree)
