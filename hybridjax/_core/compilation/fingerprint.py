"""What a compiled program is known by: a digest of all that it is made of.

Whatever cannot be described in full has no digest (`IndescribableError`), and programs made of it
are compiled as any other. So what is not thought of here costs time, but gives no wrong result.
"""

import dataclasses
import enum
import functools as ft
import hashlib
import inspect
import os
import pathlib
import platform
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np

from ..vector_math import rewrite


_PACKAGE = __name__.partition(".")[0]
# Objects of JAX in the parameters of equations that their names and `repr` describe.
_BY_REPR = (
    "UnspecifiedValue", "Mesh", "AbstractMesh", "NamedSharding", "PartitionSpec", "AvalLayout",
    "FTTuple", "FTPyTree",  # how loops group their variables (JAX 0.12)
)  # fmt: skip
# Functions in the parameters of equations. Derivative rules are described by the derivative of the
# program that has them (see `Program`).
_RULES = {
    "custom_jvp_call": ("jvp_jaxpr_fun",),
    "custom_vjp_call": ("fwd_jaxpr_thunk", "bwd", "out_trees"),
}
# Settings of JAX that change no program, and that may differ between processes that share them.
_ASIDE = ("cache", "log", "dump", "traceback", "transfer_guard", "platform", "jax_default_device")


class IndescribableError(Exception):
    """Something has no digest."""


class Program:
    """A function of which only its program (a jaxpr) is left. Programs that compute the same are
    equal, whoever traced them, and in any process.

    **Raises:** `IndescribableError`, when it is made, if the program holds something that has no
    digest, such as a callback.
    """

    def __init__(self, function: Callable, numbers: list, *arguments: Any):
        """`function(numbers, *arguments)` gives one array. It may be differentiated once, along
        those of its `arguments` that are real."""
        self._jaxpr = jax.make_jaxpr(function)(numbers, *arguments)
        parts = [self._jaxpr]
        if _has_rules(self._jaxpr.jaxpr):
            real = [jnp.issubdtype(x.dtype, jnp.inexact) for x in arguments]

            def along(numbers, arguments):
                def of_real(*some):
                    some = iter(some)
                    pairs = zip(arguments, real, strict=True)
                    return function(numbers, *(next(some) if own else x for x, own in pairs))

                some = [x for x, own in zip(arguments, real, strict=True) if own]
                return jax.jvp(of_real, some, some)

            parts.append(jax.make_jaxpr(along)(numbers, arguments))
        self.digest = digest(*parts)

    def __call__(self, numbers: list, *arguments: Any) -> jax.Array:
        (value,) = jex.jaxpr_as_fun(self._jaxpr)(*numbers, *arguments)
        return jnp.asarray(value)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Program) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def digest(*things: Any) -> str:
    """A digest of pytrees of arrays, numbers, words, programs and objects of this package. Of
    arrays outside of programs it is about shapes and types only.

    **Raises:** `IndescribableError`.
    """
    found = hashlib.sha256()
    for word in _described(things):
        found.update(f"{len(word)}:".encode() + word)
    return found.hexdigest()


def surroundings() -> str:
    """A digest of what programs depend on beside what they are made of: the source of this package,
    versions, the processor, and settings."""
    names = _settings(len(jax.config.values))
    values = repr([getattr(jax.config, name, None) for name in names])
    flags = os.environ.get("XLA_FLAGS", "")
    return _surroundings(_installed(), names, values, flags, rewrite.is_enabled())


@ft.lru_cache(64)
def _surroundings(*words: Any) -> str:
    return digest(*words)


@ft.lru_cache(64)
def _settings(count: int) -> tuple[str, ...]:
    """The names of JAX's settings, of which there are so many."""
    return tuple(sorted(x for x in jax.config.values if not any(word in x for word in _ASIDE)))


@ft.cache
def _installed() -> str:
    root = pathlib.Path(__file__).parents[2]
    source = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        source.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    versions = [sys.version, *(x.__version__ for x in (jax, jax.lib, np, eqx))]
    return digest(source.hexdigest(), versions, _processor())


def _processor() -> list[str]:
    """The kind of processor: what a program was compiled for must not run on another."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        found = {x for x in lines if x.startswith(("model name", "flags", "Features", "CPU part"))}
        return [platform.machine(), *sorted(found)]
    except OSError:
        return [platform.machine(), platform.processor(), platform.node()]


def _has_rules(jaxpr: jex.Jaxpr) -> bool:
    return any(
        eqn.primitive.name in _RULES or any(map(_has_rules, jaxprs(eqn.params)))
        for eqn in jaxpr.eqns
    )


def jaxprs(params: dict[str, Any]) -> list[jex.Jaxpr]:
    """Those among the parameters of an equation, or in tuples of these. (`jax.extend.core` has a
    function for it since JAX 0.10.)"""
    values = [x for v in params.values() for x in (v if isinstance(v, tuple) else (v,))]
    return [
        x.jaxpr if isinstance(x, jex.ClosedJaxpr) else x
        for x in values
        if isinstance(x, jex.Jaxpr | jex.ClosedJaxpr)
    ]


def _described(x: Any) -> Iterator[bytes]:
    """Words from which the whole of x could be told."""
    if x is None or type(x) in (bool, int, float, complex, str, bytes):
        yield type(x).__name__.encode()
        yield repr(x).encode()
    elif isinstance(x, jex.ClosedJaxpr):
        yield b"program"
        yield from _sequence(map(_value, x.consts))
        yield from _jaxpr(x.jaxpr)
    elif isinstance(x, jex.Jaxpr):
        yield b"jaxpr"
        yield from _jaxpr(x)
    elif isinstance(x, Program):
        yield b"Program"
        yield x.digest.encode()
    elif _is_array(x):
        yield b"array"
        yield from _described((x.shape, _dtype(x.dtype)))
    elif isinstance(x, np.dtype):
        yield b"dtype"
        yield _dtype(x).encode()
    elif isinstance(x, tuple | list) and not hasattr(x, "_fields"):
        yield type(x).__name__.encode()
        yield from _sequence(map(_described, x))
    elif type(x) is dict:
        yield b"dict"
        yield from _described(list(x))
        yield from _described(list(x.values()))
    elif isinstance(x, enum.Enum):
        yield _name(type(x))
        yield x.name.encode()
    elif hasattr(x, "_fields") and isinstance(x, tuple):
        yield _name(type(x))
        yield from _sequence(map(_described, x))
    elif isinstance(x, eqx.Module):
        yield _name(type(x))
        yield from _sequence(_described(getattr(x, f.name)) for f in dataclasses.fields(x))
    elif inspect.isfunction(x):
        yield _name(x)
    elif type(x).__name__ in _BY_REPR:
        yield _name(type(x))
        yield repr(x).encode()
    else:
        raise IndescribableError(f"{type(x)}")


def _sequence(items: Iterable[Iterator[bytes]]) -> Iterator[bytes]:
    """Descriptions one after the other, and where they end."""
    for item in items:
        yield b"item"
        yield from item
    yield b"end"


def _name(kind: type | Callable) -> bytes:
    """The name of a class or function of this package or of JAX: users' own may be called the
    same."""
    module = kind.__module__
    home = sys.modules.get(module)
    if module.partition(".")[0] not in (_PACKAGE, "jax", "jaxlib") or (
        getattr(home, kind.__qualname__, None) is not kind
    ):
        raise IndescribableError(f"{kind}")
    return f"{module}.{kind.__qualname__}".encode()


def _dtype(dtype: Any) -> str:
    if not isinstance(dtype, np.dtype):
        raise IndescribableError(f"{dtype}")
    return dtype.str if dtype.kind != "V" else dtype.name


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)


def _value(x: Any) -> Iterator[bytes]:
    """An array with its numbers."""
    if not isinstance(x, jax.Array | np.ndarray | np.generic | bool | int | float | complex):
        raise IndescribableError(f"{type(x)}")
    array = np.asarray(x)
    yield from _described((type(x).__name__, bool(getattr(x, "weak_type", False))))
    yield from _described((array.shape, _dtype(array.dtype)))
    yield np.ascontiguousarray(array).tobytes()


def _jaxpr(jaxpr: jex.Jaxpr) -> Iterator[bytes]:
    """A program, its variables by number."""
    if jaxpr.effects:
        raise IndescribableError(f"{jaxpr.effects}")
    numbers: dict[jex.Var, int] = {}

    def bound(variables):
        for v in variables:
            numbers[v] = len(numbers)
            yield from _aval(v.aval)
        yield b"end"

    def used(atoms):
        for x in atoms:
            if isinstance(x, jex.Literal):
                yield b"literal"
                yield from _aval(x.aval)
                yield from _value(x.val)
            else:
                yield f"{numbers[x]}".encode()
        yield b"end"

    yield from bound(jaxpr.constvars)
    yield from bound(jaxpr.invars)
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        yield name.encode()
        yield from used(eqn.invars)
        for key, value in sorted(eqn.params.items()):
            if key not in _RULES.get(name, ()):
                yield key.encode()
                yield from _described(value)
                arrays = filter(_is_array, jax.tree_util.tree_leaves(value))
                yield from _sequence(map(_value, arrays))  # part of the program, with their numbers
            if key == "symbolic_zeros" and value:  # the rule may look at more than a derivative
                raise IndescribableError(f"{name} with symbolic zeros")
        yield from bound(eqn.outvars)
    yield from used(jaxpr.outvars)


def _aval(aval: Any) -> Iterator[bytes]:
    if type(aval) is not jax.core.ShapedArray:
        raise IndescribableError(f"{aval}")
    yield from _described((aval.shape, _dtype(aval.dtype), aval.weak_type))
