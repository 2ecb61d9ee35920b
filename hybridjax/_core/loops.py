"""A loop whose derivatives in forward mode run along with it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


Step = Callable[[Any, Int[Array, ""], Any], Any]
"""`carry = step(constants, k, carry)`."""
StepAlong = Callable[[Any, Any, Int[Array, ""], Any, Any], tuple[Any, Any]]
"""`carry, columns = step_along(constants, by_constants, k, carry, columns)`: a step and its
derivatives, in directions on the first axis of `by_constants` and `columns`. These are None for all
but floating-point numbers."""


def loop(
    step: Step,
    step_along: StepAlong,
    constants: Any,
    carry: Any,
    count: Int[Array, ""],
) -> Any:
    """`carry = step(constants, k, carry)` for k = 0, ..., count - 1.

    JAX differentiates a loop after passes over its body, several at each level of nesting, that
    find out what depends on what. Here everything does, and the body says how. Reverse mode cannot
    differentiate this loop.

    **Arguments:** both steps hold no numbers with derivatives of their own.
    """
    still, static = eqx.partition(
        eqx.filter((constants, carry), eqx.is_inexact_array, inverse=True), eqx.is_array
    )
    moving = eqx.filter((constants, carry), eqx.is_inexact_array)

    @jax.custom_jvp
    def run(moving, still, count):
        constants, carry = eqx.combine(moving, still, static)
        end = jax.lax.fori_loop(0, count, lambda k, x: step(constants, k, x), carry)
        return eqx.partition(end, eqx.is_inexact_array)

    def run_along(moving, still, count, along):
        (constants, carry), (by_constants, columns) = (
            eqx.combine(moving, still, static),
            along,
        )

        def again(k, both):
            return step_along(constants, by_constants, k, *both)

        carry, columns = jax.lax.fori_loop(0, count, again, (carry, columns))
        return eqx.partition(carry, eqx.is_inexact_array), columns

    @run.defjvp
    def rule(primals, tangents):
        end, columns = _of_directions(run_along)(*primals, tangents[0])
        return end, (columns, jax.tree_util.tree_map(_no_tangent, end[1]))

    end, rest = run(moving, still, jnp.asarray(count))
    return eqx.combine(end, rest, eqx.filter(carry, eqx.is_array, inverse=True))


def pushed(
    function: Callable, constants: Any, by_constants: Any, carry: Any, columns: Any
):
    """`function(constants, carry)`, and its derivatives in directions on the first axis."""
    (c_moving, x_moving), still = eqx.partition(
        (constants, carry), eqx.is_inexact_array
    )

    def of(c_moving, x_moving):
        end = function(*eqx.combine((c_moving, x_moving), still))
        return eqx.partition(end, eqx.is_inexact_array)

    def push(by_constants, column):
        primals, directions = (c_moving, x_moving), (by_constants, column)
        return jax.jvp(of, primals, directions, has_aux=True)

    each = jax.vmap(push, out_axes=(None, 0, None))
    end, columns, rest = each(by_constants, columns)
    return eqx.combine(end, rest), columns


def _no_tangent(x: Array) -> Any:
    return np.zeros(jnp.shape(x), jax.dtypes.float0)


def _of_directions(run_along: Callable) -> Callable:
    """A function of one direction, which takes all directions of a `vmap` at once."""

    def alone(moving, still, count, along):
        one = jax.tree_util.tree_map(lambda x: x[None], along)
        end, columns = run_along(moving, still, count, one)
        return end, jax.tree_util.tree_map(lambda x: x[0], columns)

    derived = jax.custom_batching.custom_vmap(alone)

    @derived.def_vmap
    def vectorized(size, batched, moving, still, count, along):
        if any(jax.tree_util.tree_leaves(batched[:3])):  # (lanes, not directions)
            axes = jax.tree_util.tree_map(lambda x: 0 if x else None, tuple(batched))
            out = jax.vmap(alone, in_axes=axes)(moving, still, count, along)
            return out, jax.tree_util.tree_map(lambda _: True, out)

        def spread(x, is_batched):
            return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

        along = jax.tree_util.tree_map(spread, along, batched[3])
        end, columns = run_along(moving, still, count, along)
        flags = jax.tree_util.tree_map(lambda _: False, end)
        return (end, columns), (flags, jax.tree_util.tree_map(lambda _: True, columns))

    return derived
