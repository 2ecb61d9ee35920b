"""Functions of single states brought to many lanes; `jax.vmap` as more lanes; derivatives by lane.

A lane is one of many states that a program computes at once; lanes stand on the last axis of an
array. An argument that all lanes share (a system's parameters, say) is passed as it is. One that
differs from lane to lane is marked by `PerLane`. Called by the engine, systems, sections and
orbits, all of which rely on lanes that stand last. Constants here decide between two ways to the
same numbers, up to rounding.

If derivatives are right for one lane and wrong for several, look at `lane_jvp`; if `jax.vmap` gives
other values than a loop, at `vmap_to_lanes` and `_join`.
"""

import functools as ft
import operator
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Int

from .executor import Array, namespace, on_host
from .vector_math.rewrite import vectorized


# From this number of lanes on, trigonometric functions are computed for several at once. Twice as
# many: batches of 8 to 15 lanes wait for the C library's functions.
_VECTOR_LANES = 8


class PerLane(eqx.Module):
    """A pytree, some of whose arrays have one entry for each lane, on their last axis."""

    tree: Any
    split: tuple[bool, ...] = eqx.field(static=True)
    """Which of the tree's arrays, in the order of its leaves."""

    def axes(self) -> Any:
        """Return the axes of lanes in the form that `jax.vmap` takes: -1 or None for each array."""
        structure = jax.tree_util.tree_structure(eqx.filter(self.tree, eqx.is_array))
        return jax.tree_util.tree_unflatten(
            structure, [-1 if x else None for x in self.split]
        )


def shared(tree: Any) -> Any:
    """Return the tree itself, of a tree that may be marked as `PerLane`."""
    return tree.tree if isinstance(tree, PerLane) else tree


def one_lane(tree: Any) -> Any:
    """Return the part of a tree that belongs to a single lane, with shapes in place of arrays."""
    arrays, static = eqx.partition(shared(tree), eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(arrays)
    shapes = []
    for x, split in zip(leaves, _split_of(tree, len(leaves)), strict=True):
        shape = x.shape[:-1] if split else x.shape
        shapes.append(jax.ShapeDtypeStruct(shape, x.dtype))
    return eqx.combine(jax.tree_util.tree_unflatten(structure, shapes), static)


def _split_of(tree: Any, count: int) -> tuple[bool, ...]:
    """Which of a tree's `count` arrays have one entry for each lane."""
    return tree.split if isinstance(tree, PerLane) else (False,) * count


def by_lane(
    function: Callable,
    *trees: Any,
    quick: bool = False,
    by_row: bool = True,
) -> Callable:
    """Vectorize `function(*trees, *arguments)` over the lanes on the last axis of `arguments`.

    From a tree that is a `PerLane`, each lane gets its own part. An argument with a single lane is
    shared by all lanes of the other arguments; what depends on shared arguments alone is computed
    once. `quick`: to compile, instead of to run: without trigonometric functions of many lanes.
    `by_row`: as in `vectorized`.
    """
    arrays, static = eqx.partition([shared(x) for x in trees], eqx.is_array)
    axes = [x.axes() if isinstance(x, PerLane) else None for x in trees]

    def on_lane(arrays, *arguments):
        return function(*eqx.combine(arrays, static), *arguments)

    @ft.cache
    def program(common: tuple[bool, ...], many: bool):
        in_axes = (axes, *[None if c else -1 for c in common])
        work = vectorized(on_lane, trigonometry=many, by_row=by_row)
        # Traced once, however often it is called: a Runge-Kutta step has ten stages.
        return jax.jit(jax.vmap(work, in_axes=in_axes, out_axes=-1))

    def call(*arguments):
        lanes = max(x.shape[-1] for x in arguments)
        common = tuple(x.shape[-1] < lanes for x in arguments)
        points = []
        for x, is_common in zip(arguments, common, strict=True):
            points.append(x[..., 0] if is_common else x)
        many = lanes >= _VECTOR_LANES and not quick
        return program(common, many)(arrays, *points)

    return call


def vmap_to_lanes(function: Callable[[tuple, Any], Any]) -> Callable[[tuple, Any], Any]:
    """Make `function(common, lanes)` treat an axis that is mapped by `jax.vmap` as more lanes.

    `common` is a tuple of pytrees, each shared by all lanes or a `PerLane`; `lanes` and the result
    are pytrees whose arrays have the lanes on their last axis. No derivatives.
    """

    def call(common, lanes):
        arrays, static = eqx.partition((common, lanes), eqx.is_array)

        @jax.custom_batching.custom_vmap
        def run(arrays):
            return function(*eqx.combine(arrays, static))

        @run.def_vmap
        def rule(size, batched, arrays):
            (batched,) = batched
            common, lanes = eqx.combine(arrays, static)
            mapped_common, mapped_lanes = batched
            L = jax.tree_util.tree_leaves(lanes)[0].shape[-1]

            def join_common(tree, mapped):
                return _join_common(tree, mapped, size, L)

            def join(x, mapped):
                return _join(x, mapped, True, size, L)

            def split(x):
                return jnp.moveaxis(x.reshape(*x.shape[:-1], size, L), -2, 0)

            joined = tuple(map(join_common, common, mapped_common))
            more_lanes = jax.tree_util.tree_map(join, lanes, mapped_lanes)
            out = jax.tree_util.tree_map(split, call(joined, more_lanes))
            return out, jax.tree_util.tree_map(lambda _: True, out)

        return run(arrays)

    return call


def _join(x, mapped: bool, by_lane: bool, size: int, L: int):
    """Join a mapped axis (the first, if there is one) with the lanes' (the last, if there)."""
    if mapped:
        x = jnp.moveaxis(x, 0, -2 if by_lane else -1)
    elif by_lane:
        x = x[..., None, :]
    if not by_lane:
        x = x[..., None]
    shape = x.shape[:-2]
    return jnp.broadcast_to(x, (*shape, size, L)).reshape(*shape, size * L)


def _join_common(tree, mapped, size: int, L: int):
    """Join mapped axes of a tree (`mapped`: a mask of its arrays) with lanes; `PerLane` if any."""
    arrays, static = eqx.partition(shared(tree), eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(arrays)
    mapped = jax.tree_util.tree_leaves(mapped)
    split = _split_of(tree, len(leaves))
    either = tuple(map(operator.or_, mapped, split))
    if not any(either):
        return tree
    for k in np.flatnonzero(either):
        leaves[k] = _join(leaves[k], mapped[k], split[k], size, L)
    return PerLane(
        eqx.combine(jax.tree_util.tree_unflatten(structure, leaves), static), either
    )


# Up to this many numbers that a lane's result depends on, its Jacobian is computed. Twice as many:
# a Jacobian of 64 columns takes longer than the reverse mode that it spares. Fewer: reverse mode
# stores all that happens in more functions.
JACOBIAN_COLUMNS = 32


def lane_jvp(
    function: Callable, lane: tuple[Any, Any], shared: tuple[Any, Any]
) -> tuple[Any, Any]:
    """`function(lane, shared)` and its tangent; `lane` and `shared` are pairs (primal, tangent).
    (`shared` is not the function of this name.)

    Arrays of `lane`, and of the result, have the lanes on their last axis; all lanes share those of
    `shared`. Tangents are `None` where there are none.

    Where few numbers have tangents, the function's Jacobian is computed first, forwards, and then
    applied to them. Reverse mode then only transposes a product of small matrices: transposing the
    function itself would store and read again all that happens in it. And where JAX asks for
    several tangents, they all use one Jacobian.
    """

    moving, still, t_moving = _moving(*lane)
    common, still_common, t_common = _moving(*shared)

    def of(moving, common):
        return function(eqx.combine(moving, still), eqx.combine(common, still_common))

    leaves = jax.tree_util.tree_leaves
    point = jax.tree_util.tree_map(lambda x: x[..., 0], moving), common
    total = sum(x.size for x in leaves(point))
    if not 0 < total <= JACOBIAN_COLUMNS:
        return jax.jvp(of, (moving, common), (t_moving, t_common))

    _, parts = ravel_pytree(point)

    # The Jacobian: derivatives in the direction of each number, for all lanes at once.
    def push(direction):
        of_lane, of_all = parts(direction)

        def spread(t, x):
            return jnp.broadcast_to(t[..., None], x.shape)

        tangents = jax.tree_util.tree_map(spread, of_lane, moving), of_all
        return jax.jvp(of, (moving, common), tangents)

    end, columns = jax.vmap(push, out_axes=(None, 0))(jnp.eye(total))

    # The tangents, by which its columns are weighted: a row for each number, of shape (total, L)
    # if lanes have different values, otherwise (total, 1).
    rows = [t.reshape(-1, t.shape[-1]) for t in leaves(t_moving)]
    for leaf in leaves(t_common):
        rows.append(jnp.broadcast_to(leaf.reshape(-1, 1), (leaf.size, 1)))
    lanes = max(x.shape[-1] for x in leaves(columns))
    weights = jnp.concatenate([jnp.broadcast_to(r, (r.shape[0], lanes)) for r in rows])

    def contract(column):
        ones = (1,) * (column.ndim - 2)
        return jnp.sum(column * weights.reshape(total, *ones, lanes), axis=0)

    return end, jax.tree_util.tree_map(contract, columns)


def _moving(primal: Any, tangent: Any) -> tuple[Any, Any, Any]:
    """The part of a tree that has tangents, the other part, and the tangents."""

    def has_tangent(x, t):
        return t is not None and eqx.is_inexact_array(x)

    has = jax.tree_util.tree_map(
        has_tangent, primal, tangent, is_leaf=lambda x: x is None
    )
    return *eqx.partition(primal, has), eqx.filter(tangent, has)


def value_and_columns(
    function: Callable, moving: Any, still: Any, directions: Any
) -> tuple[Any, Any]:
    """The value of a function of a tree, and its derivatives in P directions: arrays (P, ...), in
    the form of the value.

    **Arguments:** `moving`: the part of the tree that has derivatives; `still`: the rest.
    `directions`: of the form of `moving`, with arrays (P, ...).
    """

    def of(moving):
        value = function(eqx.combine(moving, still))
        return eqx.partition(value, eqx.is_inexact_array)

    def push(direction):
        return jax.jvp(of, (moving,), (direction,), has_aux=True)

    smooth, columns, rest = jax.vmap(push, out_axes=(None, 0, None))(directions)
    return eqx.combine(smooth, rest), columns


def by_jacobian(function: Callable) -> Callable:
    """A function of a tree with few numbers, whose derivatives by these are computed forwards, all
    at once; so are derivatives of derivatives.

    Reverse mode then transposes a product with the Jacobian, and stores nothing of the function.
    """

    @eqx.filter_custom_jvp
    def derived(tree):
        return function(tree)

    @derived.def_jvp
    def rule(arguments, tangents):
        moving, still, t_moving = _moving(*arguments, *tangents)
        along, _ = ravel_pytree(t_moving)

        def with_columns(moving):
            numbers, back = ravel_pytree(moving)
            units = jnp.eye(len(numbers), dtype=numbers.dtype)
            return value_and_columns(function, moving, still, jax.vmap(back)(units))

        value, columns = by_jacobian(with_columns)(moving)

        def contract(column):
            return jnp.tensordot(along, column, 1)

        return value, jax.tree_util.tree_map(contract, columns)

    return derived


# Up to so many rows are selected one by one. Twice as many: programs of eight contacts compile for
# longer, and run a little faster.
_FEW = 8


def take_rows(x: Array, rows: Sequence[int]) -> Array:
    """Some rows of x (W, L)."""
    if list(rows) == list(range(len(x))):
        return x
    if on_host(x) or len(rows) > _FEW:
        return x[np.array(rows)]
    return namespace(x).stack([x[row] for row in rows])


def put_rows(
    x: Array,
    rows: Sequence[int],
    here: Bool[Array, " L"],
    new: Array,
) -> Array:
    """x (W, L) with these rows replaced by those of `new` for the lanes `here`."""
    xp = namespace(x)
    if list(rows) == list(range(len(x))):
        return xp.where(here, new, x)
    place = np.full(len(x), -1)
    place[np.array(rows, int)] = np.arange(len(rows))
    if on_host(x) or len(x) > _FEW:
        return xp.where(here & (place >= 0)[:, None], new[place], x)
    changed = list(x)
    for k, row in enumerate(rows):
        changed[row] = xp.where(here, new[k], x[row])
    return xp.stack(changed)


def pick(x: Array, rows: Sequence[int], which: Int[Array, " L"]) -> Array:
    """For each lane, its entry in one row of x. The rows of x belong to the functions `rows`, and
    the lane's row is that of its function `which`; 0 if `rows` does not have it."""
    xp = namespace(x)
    if on_host(x) or len(rows) > _FEW:
        place = np.full(max(rows, default=0) + 2, -1)  # the last for -1
        place[np.array(rows, int)] = np.arange(len(rows))
        last = len(place) - 1
        k = xp.asarray(place)[xp.minimum(which, last)]
        own = x[k, np.arange(x.shape[1])]
        return xp.where(k >= 0, own, 0.0)
    out = xp.zeros_like(x[0])
    for k, row in enumerate(rows):
        out = xp.where(which == row, x[k], out)
    return out
