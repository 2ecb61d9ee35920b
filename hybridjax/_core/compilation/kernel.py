"""Kernels: small programs of users' functions, called by code that runs on the host.

A program depends on a user's system only through its functions. In this process it is found again
for everything of the same structure: the same classes, static fields, functions, and shapes and
types of arrays; the arrays themselves are arguments. A class that is defined anew is another class,
whatever its name.

With `enable_compilation_cache()` a later process finds it by what the user's function computes at a
single point (`fingerprint.py`): only that is traced, in a millisecond or two, and neither
derivatives nor steps, and nothing is compiled.
"""

import contextlib
import functools as ft
import uuid
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np

from ..lanes.per_lane import PerLane
from . import compilation_cache, kept
from .compile import compiler_options
from .fingerprint import IndescribableError, Program, digest, surroundings
from .portable import Executable, compiled


# Programs that are kept. Twice as many: twice as many systems can be taken turns with.
_KEPT = 1024


def kernel(
    function: Callable, form: Callable, static: tuple[Hashable, ...], trees: Any, lanes: int
) -> Callable:
    """`function(*static, *trees, *point)` of single points, brought to lanes by a `form` and
    compiled, as a function of NumPy's arrays.

    `form(function, *trees)` is a function of arrays with lanes on their last axis, as its result
    is (see `engine/kernels.py`). An argument may have one lane where others have more. Where only
    `some` lanes are needed (a mask), the others get the results of one of these. `function` and
    `form` belong to modules, so that they are the same whenever they are asked for.

    The program is for this number of `lanes`: more are done in several calls, fewer are filled up,
    so that it serves all. (XLA runs the smallest programs, of a thousand operations, in the thread
    that calls them, and hands others to another one, which takes longer than they do.)
    """
    leaves, structure = jax.tree_util.tree_flatten(trees)
    arrays = jax.device_put([x for x in leaves if _is_array(x)])
    # (1, 1.0 and True are equal, and not the same.)
    rest = tuple(None if _is_array(x) else (type(x), x) for x in leaves)
    program = _program(function, form, static, structure, rest, lanes)

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
def _program(function, form, static, structure, rest, lanes):
    def trees(arrays):
        arrays = iter(arrays)
        leaves = [next(arrays) if x is None else x[1] for x in rest]
        return jax.tree_util.tree_unflatten(structure, leaves)

    # (One for each number of lanes, as it is for arrays of one shape.)
    return _Kernel(ft.partial(function, *static), form, trees)


class _Kernel:
    """A program of arrays and arguments, chosen when it is first called."""

    def __init__(self, function: Callable, form: Callable, trees: Callable[[list], Any]):
        self._function, self._form, self._trees = function, form, trees
        self._chosen: Callable | None = None

    def __call__(self, arrays: list[jax.Array], *arguments: np.ndarray) -> jax.Array:
        if self._chosen is None:
            self._chosen = self._choose(arrays, arguments)
        return self._chosen(arrays, *arguments)

    def _choose(self, arrays, arguments) -> Callable:
        own = any(isinstance(x, PerLane) for x in self._trees(arrays))
        if compilation_cache.folder() is not None and kept.is_simple() and not own:
            with contextlib.suppress(IndescribableError):
                found = self._kept(arrays, arguments)
                return lambda arrays, *arguments: found(*arrays, *arguments)

        def run(arrays, *arguments):
            return self._form(self._function, *self._trees(arrays))(*arguments)

        return jax.jit(run, compiler_options=compiler_options())

    def _kept(self, arrays, arguments) -> Executable:
        """The program that is on disk, from now on at least."""

        def at_a_point(arrays, *point):
            return self._function(*self._trees(arrays), *point)

        points = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in arguments]
        program = Program(at_a_point, arrays, *points)
        name = f"{digest(self._form, program, arguments, surroundings())}-kernel"
        found = kept.find(name)
        if found is None:

            def run(*leaves):
                arrays, arguments = list(leaves[:count]), leaves[count:]
                return [self._form(program, arrays)(*arguments)]

            count = len(arrays)
            # (As in `portable.py`: no program in JAX's own cache has this name.)
            run.__name__ = f"run_{uuid.uuid4().hex}"
            lowered = jax.jit(run).lower(*arrays, *arguments)
            with kept.once():
                found = compiled(lowered, compiler_options(), 0)
            kept.store().write(name, found.to_bytes())
        return found


def _fill(x: np.ndarray, L: int, filled: int) -> np.ndarray:
    """x with so many lanes, those beyond L copies of its first."""
    if x.shape[-1] == 1:
        return x.repeat(filled, axis=-1)
    if filled == L:
        return x
    return np.concatenate([x, np.repeat(x[..., :1], filled - L, axis=-1)], axis=-1)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)
