"""Kernels: small programs of users' functions, called by code that runs on the host.

A program depends on a user's system only through its functions. It is found again for everything of
the same structure: the same classes, static fields, functions, and shapes and types of arrays; the
arrays themselves are arguments. A class that is defined anew is another class, whatever its name.
"""

import functools as ft
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np

from .compile import compiler_options


# Programs that are kept. Twice as many: twice as many systems can be taken turns with.
_KEPT = 1024


def kernel(function: Callable, static: tuple[Hashable, ...], trees: Any, lanes: int) -> Callable:
    """`function(*static, *trees, *arguments)`, compiled, as a function of NumPy's arrays.

    `function` belongs to a module, so that it is the same whenever it is asked for. Arguments and
    results have lanes on their last axis; an argument may have one lane where others have more.
    Where only `some` lanes are needed (a mask), the others get the results of one of these.

    The program is for this number of `lanes`: more are done in several calls, fewer are filled up,
    so that it serves all. (XLA runs the smallest programs, of a thousand operations, in the thread
    that calls them, and hands others to another one, which takes longer than they do.)
    """
    leaves, structure = jax.tree_util.tree_flatten(trees)
    arrays = jax.device_put([x for x in leaves if _is_array(x)])
    # (1, 1.0 and True are equal, and not the same.)
    rest = tuple(None if _is_array(x) else (type(x), x) for x in leaves)
    program = _program(function, static, structure, rest)

    def call(*arguments, some=None):
        if some is not None:
            found = call(*(x[..., some] if x.shape[-1] == len(some) else x for x in arguments))
            return found[..., np.maximum(np.cumsum(some) - 1, 0)]
        L = max(x.shape[-1] for x in arguments)
        if L == lanes == 1:
            return np.asarray(program(arrays, *arguments))
        filled = -(-L // lanes) * lanes
        arguments = [_fill(x, L, filled) for x in arguments]
        if filled == lanes:
            return np.asarray(program(arrays, *arguments))[..., :L]
        blocks = [slice(k, k + lanes) for k in range(0, filled, lanes)]
        parts = [program(arrays, *[x[..., block] for x in arguments]) for block in blocks]
        return np.concatenate(parts, axis=-1)[..., :L]

    return call


@ft.lru_cache(_KEPT)
def _program(function, static, structure, rest):
    def run(arrays, *arguments):
        arrays = iter(arrays)
        leaves = [next(arrays) if x is None else x[1] for x in rest]
        trees = jax.tree_util.tree_unflatten(structure, leaves)
        return function(*static, *trees, *arguments)

    return jax.jit(run, compiler_options=compiler_options())


def _fill(x: np.ndarray, L: int, filled: int) -> np.ndarray:
    """x with so many lanes, those beyond L copies of its first."""
    if x.shape[-1] == 1:
        return x.repeat(filled, axis=-1)
    if filled == L:
        return x
    return np.concatenate([x, np.repeat(x[..., :1], filled - L, axis=-1)], axis=-1)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)
