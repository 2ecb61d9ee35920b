"""Functions of single states, brought to many lanes at once.

Lanes stand on the last axis of an array. What all lanes share (a system's parameters, say) is
passed as it is; where each lane has its own, it is marked by `PerLane`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from ..vector_math.rewrite import vectorized


# From this number of lanes on, trigonometric functions are computed for several at once. Twice as
# many: batches of 8 to 15 lanes wait for the C library's functions.
_VECTOR_LANES = 8


class PerLane(eqx.Module):
    """A pytree, some of whose arrays have one entry for each lane, on their last axis."""

    tree: Any
    own: tuple[bool, ...] = eqx.field(static=True)
    """Which of the tree's arrays, in the order of its leaves."""

    def axes(self) -> Any:
        """Where the lanes are, in the form that `jax.vmap` takes: -1 or None for each array."""
        arrays = eqx.filter(self.tree, eqx.is_array)
        structure = jax.tree_util.tree_structure(arrays)
        return structure.unflatten([-1 if own else None for own in self.own])


def shared(tree: Any) -> Any:
    """The tree itself, of what may be marked as `PerLane`."""
    return tree.tree if isinstance(tree, PerLane) else tree


def one_lane(tree: Any) -> Any:
    """What a single lane has of a tree: shapes in place of its arrays."""
    arrays, rest = eqx.partition(shared(tree), eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(arrays)
    own = tree.own if isinstance(tree, PerLane) else (False,) * len(leaves)
    shapes = [
        jax.ShapeDtypeStruct(x.shape[:-1] if o else x.shape, x.dtype)
        for x, o in zip(leaves, own, strict=True)
    ]
    return eqx.combine(structure.unflatten(shapes), rest)


def by_lane(function: Callable, *trees: Any) -> Callable:
    """Vectorize `function(*trees, *arguments)` over the lanes on the last axis of `arguments`.

    Of a tree that is a `PerLane`, each lane gets its own part. An argument with a single lane where
    others have more is the same for all of them, and what depends on nothing else is computed once.
    """
    arrays, rest = eqx.partition([shared(x) for x in trees], eqx.is_array)
    axes = [x.axes() if isinstance(x, PerLane) else None for x in trees]

    def one(arrays, *arguments):
        return function(*eqx.combine(arrays, rest), *arguments)

    @ft.cache
    def program(common: tuple[bool, ...], many: bool):
        in_axes = (axes, *[None if c else -1 for c in common])
        work = vectorized(one, trigonometry=many)
        # Traced once, however often it is called: a Runge-Kutta step has ten stages.
        return jax.jit(jax.vmap(work, in_axes=in_axes, out_axes=-1))

    def call(*arguments):
        lanes = max(x.shape[-1] for x in arguments)
        common = tuple(x.shape[-1] < lanes for x in arguments)
        arguments = [x[..., 0] if c else x for x, c in zip(arguments, common, strict=True)]
        return program(common, lanes >= _VECTOR_LANES)(arrays, *arguments)

    return call
