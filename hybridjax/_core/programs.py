"""Digests of programs: short texts that are equal if two programs compute the same.

A program is what JAX traces of a function. Each of its results has its own digest, made from the
operations that lead to the result from the arguments and constants. Names do not enter, nor
operations whose results are not used, nor how the program is divided into functions of `jax.jit`.
Called by `meaning.py`.

All that changes a result must enter its digest, the same in every process: programs of equal
digests are taken for each other.

If a change of a function is not noticed, look at `_option` (what an operation is told beside its
arguments), and at `rules` and `hosted`, of which the caller must take account; if a function counts
as changed and is not, at the last line of `_option`, where `repr` may write an address.
"""

import hashlib
import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import jax_compat
from .executor import is_tracer
from .jax_compat import ClosedProgram, Equation, Program, is_variable
from .memo import Memory


_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


class Digests:
    """Digests of the results of a program.

    `rules` is true if one of them has a rule of its own for derivatives, and `hosted` if one calls
    a function of Python: both are not part of the program.
    """

    def __init__(self, program: ClosedProgram, arguments: Sequence[str]):
        self.rules = False
        self.hosted = False
        self._inner: dict[int, str] = {}
        given = [digest_of_words("argument", x) for x in arguments]
        self.results = self._of(program, given)

    def _of(self, closed: ClosedProgram, arguments: Sequence[str]) -> list[str]:
        program = closed.jaxpr
        known: dict[Any, str] = dict(zip(program.invars, arguments, strict=True))
        needed = _needed(program)
        for x, value in zip(program.constvars, closed.consts, strict=True):
            if x in needed:
                known[x] = digest_of_array(value)

        def digest(x: Any) -> str:
            if jax_compat.is_constant(x):
                # (Its text has eight digits.)
                return digest_of_array(x.val)
            return known[x]

        for equation in program.eqns:
            if any(x in needed for x in equation.outvars):
                values = self._apply(equation, [digest(x) for x in equation.invars])
                known.update(zip(equation.outvars, values, strict=True))
        return [digest(x) for x in program.outvars]

    def _apply(self, equation: Equation, arguments: list[str]) -> list[str]:
        """Digests of the results of an operation."""
        options = equation.params
        if jax_compat.is_call(equation):
            called = jax_compat.closed(options["jaxpr"])
            if len(called.in_avals) == len(arguments):
                return self._of(called, arguments)
        self.rules |= jax_compat.has_rule(equation)
        self.hosted |= jax_compat.is_hosted(equation)
        words = [f"{key}={self._option(options[key])}" for key in sorted(options)]
        whole = digest_of_words(equation.primitive.name, *words, *arguments)
        if len(equation.outvars) == 1:
            return [whole]
        return [f"{whole}.{k}" for k in range(len(equation.outvars))]

    def _option(self, x: Any) -> str:
        if jax_compat.is_program(x):
            return self._program(jax_compat.closed(x))
        if isinstance(x, tuple | list):
            return f"({','.join(map(self._option, x))})"
        if hasattr(x, "dtype") and hasattr(x, "shape"):
            if not isinstance(x, jax.ShapeDtypeStruct) and hasattr(x, "__array__"):
                return digest_of_array(x)
        if callable(x) and not isinstance(x, type | np.dtype):
            return "function"  # (see `rules` and `hosted`)
        return _ADDRESS.sub("", repr(x))

    def _program(self, x: ClosedProgram) -> str:
        """The digest of a program that is part of an operation, as of a loop."""
        if id(x.jaxpr) not in self._inner:
            places = [f"{k}:{aval}" for k, aval in enumerate(x.in_avals)]
            results = self._of(x, places)
            self._inner[id(x.jaxpr)] = digest_of_words("program", *places, *results)
        return self._inner[id(x.jaxpr)]


def digest_of_words(*words: str) -> str:
    """A digest of words, the same in every process."""
    return hashlib.blake2b("\0".join(words).encode(), digest_size=12).hexdigest()


def _needed(program: Program) -> set[Any]:
    """Variables of a program on which its results depend."""
    needed = set(filter(is_variable, program.outvars))
    for equation in reversed(program.eqns):
        if not needed.isdisjoint(equation.outvars):
            needed.update(filter(is_variable, equation.invars))
    return needed


_constants = Memory()


def digest_of_array(x: Any) -> str:
    """The digest of the values of an array, computed once for one that cannot change."""
    if is_tracer(x):
        return digest_of_words("traced", str(x.aval))
    if isinstance(x, jax.Array):
        return _constants.recall(x, None, lambda: _digest_of_values(x))
    return _digest_of_values(x)


def _digest_of_values(x: Any) -> str:
    is_key = isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    if is_key:
        x = jax.random.key_data(x)
    values = np.asarray(x)
    flat = np.ascontiguousarray(values).reshape(-1)
    # (Where processors have instructions for it, SHA-1 takes a third of the time of BLAKE2.)
    numbers: Any = flat.view(np.uint8)  # (mypy knows no array as a buffer)
    digest = hashlib.sha1(numbers, usedforsecurity=False)
    return digest_of_words(str(values.dtype), str(values.shape), digest.hexdigest())
