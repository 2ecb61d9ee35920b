"""One source for two executors: compiled programs of JAX, and the host (Python with NumPy).

Code that decides (step sizes, events, Newton's method) is written once, on arrays. If the arrays
are JAX's, the code is traced and compiled. That pays for many lanes (states computed at once), and
below `jit`, `vmap` and `grad`. If they are NumPy's, the code runs at once, and only users'
functions are compiled, in small programs (`compilation.kernel`). That gives a first answer sooner
for a few lanes.

There is no other switch between the two than the type of the arrays. `namespace` returns the
library that belongs to an array, and the functions here do whatever NumPy and JAX write
differently.

If values on the host and in programs differ, look in the code that was run for a function that
NumPy and JAX call alike and compute differently (as `svd` of NaN): it needs a function of its own
here, as `svdvals`. If a program is traced where values were expected, look at `is_traced` and
`is_hidden`.
"""

import contextlib
import contextvars
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import jax_compat


if TYPE_CHECKING:
    Array: TypeAlias = Any  # of JAX or NumPy: type checkers know no array of both
else:
    Array = jax.Array | np.ndarray | np.generic
    """An array of either executor."""


class Definition(eqx.Module):
    """What users write: functions, and numbers that they compute with. Its arrays are always JAX's,
    also where the code around it runs on the host.

    `code_digest` is set where a public function takes the object (`meaning.current`), so that
    compiled programs belong to the code as it was then.
    """

    code_digest: str = eqx.field(static=True, default="", init=False, repr=False)


class OutOfTimeError(Exception):
    """The host has looped for longer than it may."""


_deadline = contextvars.ContextVar("deadline", default=float("inf"))


@contextlib.contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """A context in which loops of the host end after so many seconds of this thread.

    **Raises:** `OutOfTimeError`, where they do.
    """
    before = _deadline.set(time.thread_time() + seconds)
    try:
        yield
    finally:
        _deadline.reset(before)


def on_host(x: Any) -> bool:
    """Return whether x is an array of the host."""
    return isinstance(x, np.ndarray | np.generic)


def namespace(x: Array) -> Any:
    """`numpy` for the host's arrays, `jax.numpy` for JAX's."""
    return x.__array_namespace__()


def to_host(tree: Any) -> Any:
    """`tree` with its arrays on the host, except those in a `Definition`. If JAX traces any array
    of the tree, it is returned unchanged."""
    traced = is_traced(tree)
    return jax.tree_util.tree_map(
        lambda x: np.asarray(x) if isinstance(x, jax.Array) and not traced else x,
        tree,
        is_leaf=lambda x: isinstance(x, Definition),
    )


def from_host(tree: Any) -> Any:
    """`tree` with copies of its arrays as JAX's. (`jnp.array` compiles a program for each shape,
    and `jax.device_put` alone may share memory, and is slow for one array after the other.)"""
    hosted = [np.array(x) for x in jax.tree_util.tree_leaves(tree) if on_host(x)]
    arrays = iter(jax.device_put(hosted))
    return jax.tree_util.tree_map(lambda x: next(arrays) if on_host(x) else x, tree)


def some(mask: Array) -> Any:
    """Whether a mask holds for any lane, also among those that `jax.vmap` maps: a condition for
    branches that lanes pass through unchanged if they are not in the mask."""
    return mask.any() if on_host(mask) else jax_compat.some_of_all(mask)


def cond(some: Any, yes: Callable, no: Callable, *operands: Any) -> Any:
    """`jax.lax.cond`."""
    if on_host(some):
        return yes(*operands) if some else no(*operands)
    return jax.lax.cond(some, yes, no, *operands)


def while_loop(going: Callable, body: Callable, carry: Any) -> Any:
    """`jax.lax.while_loop`."""
    if not on_host(jax.tree_util.tree_leaves(carry)[0]):
        return jax.lax.while_loop(going, body, carry)
    deadline = _deadline.get()
    while going(carry):
        if time.thread_time() > deadline:
            raise OutOfTimeError
        carry = body(carry)
    return carry


def scan(
    body: Callable,
    carry: Any,
    xs: Any,
    stack: Callable = np.stack,
) -> tuple[Any, Any]:
    """`jax.lax.scan`; on the host results are joined by `stack`."""
    first = jax.tree_util.tree_leaves(xs)[0]
    if not on_host(first):
        return jax.lax.scan(body, carry, xs)
    rows = []
    for k in range(len(first)):
        carry, row = body(carry, jax.tree_util.tree_map(lambda x, k=k: x[k], xs))
        rows.append(row)
    return carry, jax.tree_util.tree_map(lambda *x: stack(x), *rows)


def for_each_row(function: Callable, rows: Any) -> Any:
    """`jax.vmap` of a function of one row."""
    if on_host(rows):
        return np.stack([function(x) for x in rows])
    return jax.vmap(function)(rows)


def put(x: Array, index: Any, value: Any) -> Array:
    """x with other values at an index: `x.at[index].set(value)`."""
    if not on_host(x):
        return x.at[index].set(value)
    x = x.copy()
    x[index] = value
    return x


def lane(x: Array, i: Array) -> Array:
    """Lane i of x, as the only one."""
    if on_host(x):
        return x[..., i : i + 1]
    return jax.lax.dynamic_slice_in_dim(x, i, 1, axis=-1)


def solve(matrices: Array, right: Array) -> Array:
    """`linalg.solve` of a stack of matrices, with one right side for each or for all.

    A program solves one matrix after the other. Otherwise XLA divides the stack among its threads,
    and one of these threads waits for the rest: on two cores, two stacks at once wait for ever (JAX
    0.10).
    """
    if on_host(matrices):
        return np.linalg.solve(matrices, right)
    columns = right.shape[-2:]
    shape = (*matrices.shape[:-2], *columns)
    right = jnp.broadcast_to(right, shape)
    rows = [x.reshape(-1, *x.shape[-2:]) for x in (matrices, right)]
    solutions = jax.lax.map(lambda row: jnp.linalg.solve(*row), rows)
    return solutions.reshape(right.shape)


def svdvals(x: Any) -> Any:
    """`jnp.linalg.svd(x, compute_uv=False)`: NaN where x is not finite."""
    if not on_host(x):
        return jnp.linalg.svd(x, compute_uv=False)
    finite = np.isfinite(x).all(axis=(-2, -1), keepdims=True)
    values = np.linalg.svd(np.where(finite, x, 0.0), compute_uv=False)
    return np.where(finite[..., 0], values, np.nan)


def stop_gradient(x: Array) -> Array:
    """`jax.lax.stop_gradient`."""
    return x if on_host(x) else jax.lax.stop_gradient(x)


def is_tracer(x: Any) -> bool:
    """Return whether JAX traces x."""
    return jax_compat.is_tracer(x)


def is_traced(*trees: Any) -> bool:
    """Return whether JAX traces some leaf of `trees`, so that its value is not known."""
    return any(map(is_tracer, jax.tree_util.tree_leaves(trees)))


def is_inside_program() -> bool:
    """Return whether JAX traces a program (of `jit`, `scan`, `cond` ...) at the moment: whatever is
    computed then becomes part of it, even a constant."""
    if jax_compat.is_outside():
        return False
    # (`vmap` and `jvp` compute values: an operation tells whether they belong to a program.)
    return is_tracer(jax.device_put(0.0))


def is_hidden(*trees: Any) -> bool:
    """Return whether a transformation of JAX hides the values of `trees`, or of all that is
    computed."""
    return is_traced(*trees) or is_inside_program()


def default_device() -> Any:
    """Return the device of `jax.default_device`: a device, the name of a platform, or None."""
    return jax_compat.default_device()


def on_cpu() -> bool:
    """Return whether JAX computes on the CPU, by default or as `jax.default_device` says."""
    device = default_device()
    return (getattr(device, "platform", device) or jax.default_backend()) == "cpu"


_AS_IT_IS = contextlib.nullcontext()


def as_numpy() -> contextlib.AbstractContextManager:
    """A context in which JAX combines arrays of different ranks and types as NumPy does, on which
    this package relies. (Users may forbid it for their own lines, which are outside.)"""
    if jax_compat.combines_as_numpy():
        return _AS_IT_IS
    both = contextlib.ExitStack()
    both.enter_context(jax.numpy_rank_promotion("allow"))
    both.enter_context(jax.numpy_dtype_promotion("standard"))
    return both


def on_the_cpu() -> contextlib.AbstractContextManager:
    """A context in which JAX computes on the CPU. (On an accelerator a few lanes take longer: a
    program there starts hundreds of small kernels, one by one.)"""
    if on_cpu():
        return contextlib.nullcontext()
    return jax.default_device(jax.local_devices(backend="cpu")[0])
