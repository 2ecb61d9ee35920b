"""Derivatives of functions whose lanes do not see each other, cheap in both modes."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


# Up to this many numbers that a lane's result depends on, its Jacobian is computed. Twice as many:
# a Jacobian of 64 columns takes longer than the reverse mode that it spares.
_JACOBIAN_COLUMNS = 32


def lane_jvp(function: Callable, lane: tuple[Any, Any], shared: tuple[Any, Any]) -> tuple[Any, Any]:
    """`function(lane, shared)` and its tangent; `lane` and `shared` are pairs (primal, tangent).

    Arrays of `lane`, and of the result, have the lanes on their last axis; all lanes share those of
    `shared`. Tangents are `None` where there are none.

    Where few numbers have tangents, the function's Jacobian is computed first, forwards, and then
    applied to them. Reverse mode then only transposes a product of small matrices: transposing the
    function itself would store and read again all that happens in it. And where JAX asks for
    several tangents, they all use one Jacobian.
    """
    moving = eqx.is_inexact_array
    has = [
        jax.tree_util.tree_map(lambda x, t: t is not None and moving(x), x, t, is_leaf=_none)
        for x, t in (lane, shared)
    ]
    own, fixed_lane = eqx.partition(lane[0], has[0])
    common, fixed_shared = eqx.partition(shared[0], has[1])
    t_own, t_common = (eqx.filter(t, h) for t, h in ((lane[1], has[0]), (shared[1], has[1])))

    def of(own, common):
        return function(eqx.combine(own, fixed_lane), eqx.combine(common, fixed_shared))

    leaves = jax.tree_util.tree_leaves
    sizes = [math.prod(x.shape[:-1]) for x in leaves(own)] + [x.size for x in leaves(common)]
    if not sizes or sum(sizes) > _JACOBIAN_COLUMNS:
        return jax.jvp(of, (own, common), (t_own, t_common))

    basis, start = [], 0
    total = sum(sizes)
    for x, size in zip([*leaves(own), *leaves(common)], sizes, strict=True):
        directions = jnp.zeros((total, size)).at[start : start + size].set(jnp.eye(size))
        by_lane = len(basis) < len(leaves(own))
        shape = x.shape[:-1] if by_lane else x.shape
        directions = directions.reshape(total, *shape)
        if by_lane:
            directions = jnp.broadcast_to(directions[..., None], (total, *x.shape))
        basis.append(directions.astype(x.dtype))
        start += size
    basis = jax.tree_util.tree_unflatten(jax.tree_util.tree_structure((own, common)), basis)
    push = jax.vmap(lambda tangent: jax.jvp(of, (own, common), tangent), out_axes=(None, 0))
    end, columns = push(basis)

    # One row for each direction: (total, L) for what lanes have of their own, (total, 1) else.
    rows = [t.reshape(-1, t.shape[-1]) for t in leaves(t_own)]
    rows += [jnp.broadcast_to(t.reshape(-1, 1), (t.size, 1)) for t in leaves(t_common)]
    lanes = max(x.shape[-1] for x in leaves(columns))
    weights = jnp.concatenate([jnp.broadcast_to(r, (r.shape[0], lanes)) for r in rows])

    def contract(column):
        w = weights.reshape(total, *[1] * (column.ndim - 2), lanes)
        return jnp.sum(column * w, axis=0)

    return end, jax.tree_util.tree_map(contract, columns)


def _none(x):
    return x is None
