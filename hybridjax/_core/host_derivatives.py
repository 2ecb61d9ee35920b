"""Derivatives of compiled functions that come from the host, outside of programs.

A function of `by_columns` is compiled by JAX, but has a rule for its derivatives: outside of
programs and for few numbers, `along` computes them on the host, which needs no compilation of the
derivative. Inside of programs, and where `along` raises `NotOnHostError`, JAX derives the compiled
function. Both must give the same numbers: compare them first if a derivative is wrong. Below
`only_on_host`, a caller that would rather do without gets the `NotOnHostError` instead.

If a derivative is compiled without need, look at the conditions in `rule`: hidden values, or more
than `most` numbers that move. The third cause is a `NotOnHostError` of `along`.
"""

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from . import jax_compat
from .compilation import at_ease, uncollected, whole
from .exceptions import DefinitionError
from .executor import from_host, is_hidden, is_inside_program, on_the_cpu, to_host
from .lanes import JACOBIAN_COLUMNS, value_and_columns


class NotOnHostError(Exception):
    """The host has no derivatives for these arguments."""


_only_on_host = contextvars.ContextVar("only on host", default=False)


@contextlib.contextmanager
def only_on_host() -> Iterator[None]:
    """A context in which derivatives that the host does not have raise `NotOnHostError`."""
    before = _only_on_host.set(True)
    try:
        yield
    finally:
        _only_on_host.reset(before)


def must_be_on_host() -> bool:
    """Return whether a derivative must come from the host."""
    return _only_on_host.get() and not is_inside_program()


def require_program() -> None:
    """**Raises:** `NotOnHostError` where a derivative must come from the host."""
    if must_be_on_host():
        raise NotOnHostError


def by_columns(
    compiled: Callable,
    along: Callable,
    relevant: Callable = lambda t: t,
    most: float = JACOBIAN_COLUMNS,
) -> Callable:
    """`compiled`, whose derivatives outside of programs come from the host.

    `along(arguments, directions)` returns the result and its derivatives in P directions. A
    direction moves a single number of the arguments: `directions` is a tree of their form with
    arrays (P, ...), and `None` for what does not move; so is the second result. Values are concrete
    there, also where JAX hides tangents: in reverse mode, and below `vmap`. Where `along` raises
    `NotOnHostError`, or more than `most` numbers move, derivatives are compiled, as inside of
    programs. `relevant` replaces tangents of the first argument by `None` if the result does not
    depend on them.
    """
    derived = eqx.filter_custom_jvp(lambda *arguments: compiled(*arguments))

    @derived.def_jvp
    def rule(arguments, tangents):
        moved = relevant(tangents[0]), *tangents[1:]

        def still(t):
            return t is None

        def values(t, x):
            return None if still(t) else x

        # The numbers that move. Unless they are few and known, JAX derives the program.
        moving = jax.tree_util.tree_map(values, moved, arguments, is_leaf=still)
        leaves, structure = jax.tree_util.tree_flatten(moving)
        ends = np.cumsum([x.size for x in leaves])
        is_small = len(leaves) and ends[-1] <= most
        if is_hidden(arguments) or not is_small:
            return _compiled_derivatives(compiled, arguments, tangents)
        # A direction for each of them, in the form of the arguments.
        parts = np.split(np.eye(ends[-1]), ends[:-1], axis=1)
        parts = [y.reshape(-1, *x.shape) for x, y in zip(leaves, parts, strict=True)]
        directions = jax.tree_util.tree_unflatten(structure, parts)
        try:
            with on_the_cpu(), jax_compat.outside(), uncollected(), at_ease():
                result, columns = along(to_host(arguments), directions)
        except NotOnHostError:
            require_program()
            return _compiled_derivatives(compiled, arguments, tangents)
        return from_host(result), _combined(
            from_host(columns), jax.tree_util.tree_leaves(moved)
        )

    return derived


def along_program(function: Callable) -> Callable:
    """`function(*arguments)` and its derivatives in given directions (see `by_columns`), as one
    program for all arguments of a kind."""

    def along(arguments: tuple, directions: tuple) -> tuple[Any, Any]:
        return whole(_with_columns, (function,), arguments, loops=True)(directions)

    return along


def _with_columns(function: Callable, *arguments_and_directions: Any) -> tuple:
    """The value of `function(*arguments)`, and its derivatives in P directions."""
    *arguments, directions = arguments_and_directions

    def of(arguments):
        return function(*arguments)

    def is_none(x):
        return x is None

    def has_direction(by, _):
        return by is not None

    everything = tuple(arguments)
    moves = jax.tree_util.tree_map(
        has_direction, directions, everything, is_leaf=is_none
    )
    moving, still = eqx.partition(everything, moves)
    return value_and_columns(of, moving, still, directions)


def _compiled_derivatives(compiled: Callable, arguments: tuple, tangents: tuple):
    """**Raises:** `DefinitionError` where JAX would transpose the flow, whose loops end by
    themselves: in a derivative of a derivative in reverse mode."""
    try:
        return eqx.filter_jvp(compiled, arguments, tangents)
    except (AssertionError, ValueError) as error:
        if not jax_compat.lacks_transpose(error):
            raise
        raise DefinitionError(
            "second derivatives are available with forward mode inside: instead of `jax.hessian` "
            "or `jax.jacrev(jax.jacrev(f))`, take `jax.jacrev(jax.jacfwd(f))` or "
            "`jax.jacfwd(jax.jacfwd(f))`."
        ) from error


@jax.jit
def _combined(columns, tangents):
    """Tangents by the columns of derivatives. (One product: one for each array compiles longer.)"""
    _, parts = ravel_pytree(jax.tree_util.tree_map(lambda x: x[0], columns))
    matrix = jnp.concatenate(
        [x.reshape(len(x), -1) for x in jax.tree_util.tree_leaves(columns)], 1
    )
    return parts(jnp.concatenate([jnp.ravel(x) for x in tangents]) @ matrix)
