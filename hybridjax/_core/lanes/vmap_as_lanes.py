"""Under `jax.vmap`, more lanes.

Programs that branch on what a whole batch of lanes needs lose their branches when JAX vectorizes
them: `lax.cond` then computes both sides, and every loop waits at every level. Instead, the mapped
axis is joined with that of the lanes.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .per_lane import PerLane, shared


def vmap_to_lanes(function: Callable[[tuple, Any], Any]) -> Callable[[tuple, Any], Any]:
    """Make `function(common, lanes)` treat an axis that is mapped by `jax.vmap` as more lanes.

    `common` is a tuple of pytrees, each shared by all lanes or a `PerLane`; `lanes` and the result
    are pytrees whose arrays have the lanes on their last axis. No derivatives.
    """

    def call(common, lanes):
        arrays, rest = eqx.partition((common, lanes), eqx.is_array)

        @jax.custom_batching.custom_vmap
        def run(arrays):
            return function(*eqx.combine(arrays, rest))

        @run.def_vmap
        def rule(size, batched, arrays):
            (batched,) = batched
            common, lanes = eqx.combine(arrays, rest)
            L = jax.tree_util.tree_leaves(lanes)[0].shape[-1]
            joined = tuple(
                _join_common(tree, mapped, size, L)
                for tree, mapped in zip(common, batched[0], strict=True)
            )
            join = lambda x, mapped: _join(x, mapped, True, size, L)  # noqa: E731
            out = call(joined, jax.tree_util.tree_map(join, lanes, batched[1]))
            split = lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], size, L), -2, 0)  # noqa: E731
            out = jax.tree_util.tree_map(split, out)
            return out, jax.tree_util.tree_map(lambda _: True, out)

        return run(arrays)

    return call


def _join(x, mapped: bool, own: bool, size: int, L: int):
    """Join a mapped axis (the first, if there is one) with the lanes' (the last, if there)."""
    x = jnp.moveaxis(x, 0, -2 if own else -1) if mapped else (x[..., None, :] if own else x)
    x = x if own else x[..., None]
    return jnp.broadcast_to(x, (*x.shape[:-2], size, L)).reshape(*x.shape[:-2], size * L)


def _join_common(tree, mapped, size: int, L: int):
    mapped = jax.tree_util.tree_leaves(mapped)
    own = tree.own if isinstance(tree, PerLane) else (False,) * len(mapped)
    if not any(own) and not any(mapped):
        return tree
    arrays, rest = eqx.partition(shared(tree), eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(arrays)
    flags = zip(leaves, mapped, own, strict=True)
    joined = [_join(x, m, o, size, L) if m or o else x for x, m, o in flags]
    own = tuple(m or o for m, o in zip(mapped, own, strict=True))
    return PerLane(eqx.combine(structure.unflatten(joined), rest), own)
