"""A loop that carries its forward-mode derivatives along in the same iterations.

`engine/itinerary/turn.py` calls it for trajectories that follow an itinerary. The carry is what an
iteration changes and what has derivatives; notes (flags, say) have none. Columns are the
derivatives of the carry in several directions, which stand on the first axis.

`step` and `step_along` must compute the same carry and notes; `pushed` makes a part of `step_along`
of a function. If a derivative is wrong, compare `step_along` with `jax.jvp` of `step`; if it is
wrong for several lanes only, look at `_of_directions`. That reverse mode is refused is no fault: a
`jax.lax.scan` is needed for it, as in `turn.py`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


Step = Callable[[Any, Int[Array, ""], Any, Any], tuple[Any, Any]]
"""`carry, notes = step(constants, k, carry, notes)`."""
StepAlong = Callable[[Any, Any, Int[Array, ""], Any, Any, Any], tuple[Any, Any, Any]]
"""`carry, columns, notes = step_along(constants, by_constants, k, carry, columns, notes)`: a step
and its derivatives, in directions on the first axis of `by_constants` and `columns`. These are None
for all but floating-point numbers."""


def loop(
    step: Step,
    step_along: StepAlong,
    constants: Any,
    carry: Any,
    notes: Any,
    count: Int[Array, ""],
) -> tuple[Any, Any]:
    """`carry, notes = step(constants, k, carry, notes)` for k = 0, ..., count - 1.

    To differentiate a loop, JAX first goes through its body several times, at each level of
    nesting, to find out what depends on what. Here all of the carry does, and the body says how;
    notes have no derivatives. Reverse mode cannot differentiate this loop.

    **Arguments:** both steps hold no numbers with derivatives of their own.
    """
    still, static = eqx.partition(
        eqx.filter((constants, carry), eqx.is_inexact_array, inverse=True), eqx.is_array
    )
    moving = eqx.filter((constants, carry), eqx.is_inexact_array)
    notes = jax.lax.stop_gradient(notes)

    @jax.custom_jvp
    def run(moving, still, notes, count):
        constants, carry = eqx.combine(moving, still, static)

        def again(k, both):
            return step(constants, k, *both)

        end, notes = jax.lax.fori_loop(0, count, again, (carry, notes))
        return *eqx.partition(end, eqx.is_inexact_array), notes

    def run_along(moving, still, notes, count, along):
        constants, carry = eqx.combine(moving, still, static)
        by_constants, columns = along

        def again(k, all):
            return step_along(constants, by_constants, k, *all)

        all = carry, columns, notes
        carry, columns, notes = jax.lax.fori_loop(0, count, again, all)
        end, rest = eqx.partition(carry, eqx.is_inexact_array)
        return (end, rest, notes), columns

    @run.defjvp
    def rule(primals, tangents):
        end, columns = _of_directions(run_along)(*primals, tangents[0])
        _, rest, notes = end
        none = jax.tree_util.tree_map(_no_tangent, (rest, notes))
        return end, (columns, *none)

    end, rest, notes = run(moving, still, notes, jnp.asarray(count))
    carry = eqx.combine(end, rest, eqx.filter(carry, eqx.is_array, inverse=True))
    return carry, notes


def pushed(
    function: Callable,
    constants: Any,
    by_constants: Any,
    carry: Any,
    columns: Any,
    notes: Any,
) -> tuple[Any, Any, Any]:
    """`function(constants, carry, notes)`, which returns a carry and notes, with the derivatives of
    the carry in directions on the first axis."""
    (c_moving, x_moving), still = eqx.partition(
        (constants, carry), eqx.is_inexact_array
    )

    def of(c_moving, x_moving):
        constants, carry = eqx.combine((c_moving, x_moving), still)
        end, noted = function(constants, carry, notes)
        end, rest = eqx.partition(end, eqx.is_inexact_array)
        return end, (rest, noted)

    def push(by_constants, column):
        primals = (c_moving, x_moving)
        directions = (by_constants, column)
        return jax.jvp(of, primals, directions, has_aux=True)

    each = jax.vmap(push, out_axes=(None, 0, None))
    end, columns, (rest, noted) = each(by_constants, columns)
    return eqx.combine(end, rest), columns, noted


def _no_tangent(x: Array) -> Any:
    if jnp.issubdtype(jnp.result_type(x), jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(jnp.shape(x), jax.dtypes.float0)


def _of_directions(run_along: Callable) -> Callable:
    """A function of one direction, which takes all directions of a `vmap` at once."""

    def alone(moving, still, notes, count, along):
        one = jax.tree_util.tree_map(lambda x: x[None], along)
        end, columns = run_along(moving, still, notes, count, one)
        return end, jax.tree_util.tree_map(lambda x: x[0], columns)

    derived = jax.custom_batching.custom_vmap(alone)

    @derived.def_vmap
    def vectorized(size, batched, *arguments):
        *common, along = arguments
        if any(jax.tree_util.tree_leaves(batched[:-1])):  # (lanes, not directions)
            axes = jax.tree_util.tree_map(lambda x: 0 if x else None, tuple(batched))
            out = jax.vmap(alone, in_axes=axes)(*arguments)
            return out, jax.tree_util.tree_map(lambda _: True, out)

        def spread(x, is_batched):
            return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

        along = jax.tree_util.tree_map(spread, along, batched[-1])
        end, columns = run_along(*common, along)
        flags = jax.tree_util.tree_map(lambda _: False, end)
        return (end, columns), (flags, jax.tree_util.tree_map(lambda _: True, columns))

    return derived
