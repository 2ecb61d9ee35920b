"""Digests of programs: of what JAX traces of functions, in a form that does not depend on names.

Each result of a program has a digest of its own: of the operations by which it is computed from
the arguments and from constants. Operations whose results are not used do not count, nor how a
program is divided into functions of `jax.jit`.
"""

import hashlib
import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from .executor import is_tracer
from .memo import Memory


# Operations that are a program and nothing more.
_CALLS = frozenset("jit pjit closed_call core_call remat checkpoint".split())
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


class Digests:
    """Digests of the results of a program.

    `rules` is true if one of them has a rule of its own for derivatives, and `hosted` if one calls
    a function of Python: both are not part of the program.
    """

    def __init__(self, program: jex.ClosedJaxpr, arguments: Sequence[str]):
        self.rules = False
        self.hosted = False
        self._inner: dict[int, str] = {}
        given = [digest_of_words("argument", x) for x in arguments]
        self.results = self._of(program, given)

    def _of(self, program: jex.ClosedJaxpr, arguments: Sequence[str]) -> list[str]:
        jaxpr = program.jaxpr
        known: dict[Any, str] = dict(zip(jaxpr.invars, arguments, strict=True))
        needed = _needed(jaxpr)
        for x, value in zip(jaxpr.constvars, program.consts, strict=True):
            if x in needed:
                known[x] = digest_of_array(value)

        def digest(x: Any) -> str:
            if isinstance(x, jex.Literal):
                # (Its text has eight digits.)
                return digest_of_array(x.val)
            return known[x]

        for equation in jaxpr.eqns:
            if any(x in needed for x in equation.outvars):
                values = self._apply(equation, [digest(x) for x in equation.invars])
                known.update(zip(equation.outvars, values, strict=True))
        return [digest(x) for x in jaxpr.outvars]

    def _apply(self, equation: Any, arguments: list[str]) -> list[str]:
        """Digests of the results of an operation."""
        name, options = equation.primitive.name, equation.params
        if name in _CALLS and len(arguments) == len(
            _program(options["jaxpr"]).in_avals
        ):
            return self._of(_program(options["jaxpr"]), arguments)
        if name.startswith("custom_jvp_call"):
            self.rules = True
        elif name.startswith("custom_vjp_call") or "callback" in options:
            self.hosted = True
        words = [f"{key}={self._option(options[key])}" for key in sorted(options)]
        whole = digest_of_words(name, *words, *arguments)
        if len(equation.outvars) == 1:
            return [whole]
        return [f"{whole}.{k}" for k in range(len(equation.outvars))]

    def _option(self, x: Any) -> str:
        if isinstance(x, jex.ClosedJaxpr | jex.Jaxpr):
            return self._program(_program(x))
        if isinstance(x, tuple | list):
            return f"({','.join(map(self._option, x))})"
        if hasattr(x, "dtype") and hasattr(x, "shape"):
            if not isinstance(x, jax.ShapeDtypeStruct) and hasattr(x, "__array__"):
                return digest_of_array(x)
        if callable(x) and not isinstance(x, type | np.dtype):
            return "function"  # (see `rules` and `hosted`)
        return _ADDRESS.sub("", repr(x))

    def _program(self, x: jex.ClosedJaxpr) -> str:
        """The digest of a program that is part of an operation, as of a loop."""
        if id(x.jaxpr) not in self._inner:
            places = [f"{k}:{aval}" for k, aval in enumerate(x.in_avals)]
            results = self._of(x, places)
            self._inner[id(x.jaxpr)] = digest_of_words("program", *places, *results)
        return self._inner[id(x.jaxpr)]


def digest_of_words(*words: str) -> str:
    """A digest of words, the same in every process."""
    return hashlib.blake2b("\0".join(words).encode(), digest_size=12).hexdigest()


def _program(x: Any) -> jex.ClosedJaxpr:
    return x if isinstance(x, jex.ClosedJaxpr) else jex.ClosedJaxpr(x, [])


def _needed(jaxpr: Any) -> set[Any]:
    """Variables of a program on which its results depend."""
    needed = {x for x in jaxpr.outvars if isinstance(x, jex.Var)}
    for equation in reversed(jaxpr.eqns):
        if any(x in needed for x in equation.outvars):
            needed.update(x for x in equation.invars if isinstance(x, jex.Var))
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
    values = np.asarray(jax.random.key_data(x) if is_key else x)
    flat = np.ascontiguousarray(values).reshape(-1)
    # (Where processors have instructions for it, SHA-1 takes a third of the time of BLAKE2.)
    numbers: Any = flat.view(np.uint8)  # (mypy knows no array as a buffer)
    digest = hashlib.sha1(numbers, usedforsecurity=False)
    return digest_of_words(str(values.dtype), str(values.shape), digest.hexdigest())
