"""Kernels: small programs of users' functions, called by code that runs on the host.

A program depends on a user's system only through its functions. It is found again for everything of
the same structure: the same classes, static fields, functions, and shapes and types of arrays; the
arrays themselves are arguments. A class that is defined anew is another class, whatever its name.
"""

import functools as ft
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .compile import compiler_options


# Lanes of one call: more are done in several calls, fewer are filled up, so that one program serves
# all. Twice as many: linearizing a tape takes half as many calls, and each of them somewhat longer.
_LANES = 4
# Programs that are kept. Twice as many: twice as many systems can be taken turns with.
_KEPT = 1024


def kernel(function: Callable, static: tuple[Hashable, ...], trees: Any) -> Callable:
    """`function(*static, *trees, *arguments)`, compiled, as a function of NumPy's arrays.

    `function` belongs to a module, so that it is the same whenever it is asked for. Arguments and
    results have lanes on their last axis; an argument may have one lane where others have more.
    """
    arrays, rest = eqx.partition(trees, _is_array)
    leaves, structure = jax.tree_util.tree_flatten(rest)
    kinds = tuple(map(type, leaves))  # 1, 1.0 and True are equal, and not the same
    program = _program(function, static, structure, tuple(leaves), kinds)
    arrays = jax.device_put(arrays)

    def call(*arguments):
        lanes = max(x.shape[-1] for x in arguments)
        filled = -(-lanes // _LANES) * _LANES
        arguments = [_fill(x, lanes, filled) for x in arguments]
        if filled == _LANES:
            return np.asarray(program(arrays, *arguments))[..., :lanes]
        blocks = [slice(k, k + _LANES) for k in range(0, filled, _LANES)]
        parts = [program(arrays, *[x[..., block] for x in arguments]) for block in blocks]
        return np.concatenate(parts, axis=-1)[..., :lanes]

    return call


@ft.lru_cache(_KEPT)
def _program(function, static, structure, leaves, kinds):
    def run(arrays, *arguments):
        rest = jax.tree_util.tree_unflatten(structure, leaves)
        return function(*static, *eqx.combine(arrays, rest), *arguments)

    return jax.jit(run, compiler_options=compiler_options())


def _fill(x: np.ndarray, lanes: int, filled: int) -> np.ndarray:
    """x with so many lanes, those beyond its own copies of its first."""
    if x.shape[-1] == 1:
        return np.repeat(x, filled, axis=-1)
    if filled == lanes:
        return x
    return np.concatenate([x, np.repeat(x[..., :1], filled - lanes, axis=-1)], axis=-1)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)
