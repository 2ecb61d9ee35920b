"""Descriptions of stored results, and digests of arrays, functions and objects in them."""

import dataclasses
import dis
import functools
import hashlib
import importlib.metadata
import inspect
import itertools
import json
import re
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import __version__


def versions() -> dict[str, str]:
    """Return the versions of the packages on which numbers depend to the last bit."""
    names = ("jax", "jaxlib", "numpy", "scipy")
    return {"hybridjax": __version__} | {x: importlib.metadata.version(x) for x in names}


def difference(mine: Any, theirs: Any, name: str = "") -> str | None:
    """Return the first difference between two descriptions in words, None if they are the same."""
    if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        for key in [*theirs, *(x for x in mine if x not in theirs)]:
            inside = f"{name}.{key}" if name else key
            if key not in mine or key not in theirs:
                return f"`{inside}` is {'only there' if key in theirs else 'not there'}"
            change = difference(mine[key], theirs[key], inside)
            if change is not None:
                return change
        return None
    if mine == theirs:
        return None
    if _is_digest(mine) or _is_digest(theirs):
        return f"its `{name}` is not the same"
    return f"its `{name}` is {_short(theirs)}, not {_short(mine)}"


def array_digest(x: Any) -> str:
    """Return a digest of the numbers, the type and the shape of an array."""
    array = np.ascontiguousarray(x)
    digest = hashlib.sha256(f"{array.dtype}{array.shape}".encode())
    digest.update(array.tobytes())
    return _DIGEST + digest.hexdigest()[:32]


def digest_of(*words: str) -> str:
    """Return a digest of texts."""
    return _DIGEST + hashlib.sha256(json.dumps(words).encode()).hexdigest()[:32]


class IndescribableError(Exception):
    """A function calls back into Python, so that its program does not tell what it computes."""


def program_digest(function: Callable, *arguments: Any) -> str:
    """Return a digest of the program (StableHLO, with its constants) of a function of pytrees of
    arrays or shapes, and of the program of its first derivative along those that are real.

    Functions that compute the same by the same operations have the same digest, whoever wrote
    them, in each process with the same versions of JAX.

    **Raises:** `IndescribableError`.
    """
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    real = [k for k, x in enumerate(leaves) if jnp.issubdtype(x.dtype, jnp.inexact)]

    def value(*leaves):
        return function(*jax.tree_util.tree_unflatten(structure, leaves))

    def value_and_derivative(*leaves):
        def of_real(*numbers):
            inputs = list(leaves)
            for k, x in zip(real, numbers, strict=True):
                inputs[k] = x
            return value(*inputs)

        numbers = [leaves[k] for k in real]
        return jax.jvp(of_real, numbers, numbers)

    texts = []
    for program in (value, value_and_derivative):
        texts.append(text := jax.jit(program).lower(*leaves).as_text())
        if re.search(r"custom_call @\w*callback", text):
            raise IndescribableError("it calls back into Python")
    return hashlib.sha256("".join(texts).encode()).hexdigest()


def function_digest(function: Any) -> str:
    """Return a digest of a function: its code, its defaults, the values that it holds (in variables
    around it, as a `functools.partial`, or as a callable object), and the constants and functions
    of its module that it uses. Also of a definition (a section family, an output) with the values
    and functions in its fields.

    Numbers, strings, arrays, containers, dataclasses, functions and callable objects are described
    in full; classes, and objects that other modules define, by their names. Lists and dictionaries
    of a module are left out, as programs change them.
    """
    return digest_of(*_Describer().words(function))


_DIGEST = "sha256:"
# Functions and objects within others are described to this depth. Less: changes in deep helpers are
# not detected. More: recursive functions take longer.
_DEPTH = 8


class _Describer:
    """Describes objects in words that are the same in every process."""

    def __init__(self):
        self._digests: dict[tuple[int, int], tuple[Any, str]] = {}

    def words(self, x: Any, depth: int = 0) -> list[str]:
        if x is None or isinstance(x, bool | int | float | complex | str | bytes):
            return [repr(x)]
        if isinstance(x, types.CodeType):
            return [x.co_code.hex(), *x.co_names, *self._all(x.co_consts, depth)]
        if isinstance(x, tuple | list | set | frozenset):
            items = x if isinstance(x, tuple | list) else sorted(x, key=repr)
            return [type(x).__name__, str(len(x)), *self._all(items, depth)]
        if hasattr(x, "__array__"):
            if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
                x = jax.random.key_data(x)
            array = np.asarray(x)
            # (The bytes of an array of objects are their places in memory.)
            return self.words(array.tolist()) if array.dtype.hasobject else [array_digest(array)]
        name = [type(x).__name__, _name(x if hasattr(x, "__qualname__") else type(x))]
        if depth == _DEPTH:
            return name
        # (Functions that call each other are met again and again. An object that is held keeps its
        # number.)
        key = id(x), depth
        if key not in self._digests:
            self._digests[key] = x, digest_of(*self._all(_parts(x), depth + 1))
        return [*name, self._digests[key][1]]

    def _all(self, items: Iterable[Any], depth: int) -> list[str]:
        return [word for x in items for word in self.words(x, depth)]


def _parts(x: Any) -> Iterable[Any]:
    """Return the parts of an object on which its behavior depends."""
    if isinstance(x, types.FunctionType):
        variables = map(_contents, x.__closure__ or ())
        return x.__code__, *variables, x.__defaults__, x.__kwdefaults__, *_used_globals(x)
    if isinstance(x, types.MethodType):
        return x.__func__, *_held(x.__self__)
    if isinstance(x, functools.partial):
        return x.func, x.args, x.keywords
    if isinstance(x, Mapping):
        return tuple(x.items())
    if isinstance(x, type):
        return ()
    if callable(x):
        return type(x).__call__, *_held(x)
    return _held(x) if dataclasses.is_dataclass(x) else ()


def _used_globals(function: types.FunctionType) -> Iterable[tuple[str, Any]]:
    """Yield the constants and functions of its module that a function uses, with their names."""
    module = function.__module__
    if function.__globals__.get("__name__", module) != module:  # a wrapper of another module
        return
    for name in sorted(_global_names(function.__code__)):
        x = function.__globals__.get(name)
        if _is_constant(x):
            yield name, x
        elif callable(x) and getattr(x, "__module__", None) == module:
            plain = x if isinstance(x, types.FunctionType) else inspect.unwrap(x)
            if isinstance(plain, types.FunctionType):
                yield name, plain


def _global_names(code: types.CodeType) -> set[str]:
    """Return the global names in a function and in functions inside of it."""
    names = {x.argval for x in dis.get_instructions(code) if x.opname == "LOAD_GLOBAL"}
    inside = (_global_names(x) for x in code.co_consts if isinstance(x, types.CodeType))
    return names.union(*inside)


def _is_constant(x: Any) -> bool:
    if isinstance(x, tuple):
        return all(map(_is_constant, x))
    if dataclasses.is_dataclass(x) and not isinstance(x, type | eqx.Module):
        return getattr(x, "__dataclass_params__").frozen  # noqa: B009
    plain = bool, int, float, complex, str, bytes, np.ndarray, np.generic, jax.Array, eqx.Module
    return isinstance(x, plain)


def _contents(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # a name that has not been given yet
        return None


def _held(x: Any) -> Iterable[tuple[str, Any]]:
    """Return the attributes of an object with their names."""
    if dataclasses.is_dataclass(x):
        names = [f.name for f in dataclasses.fields(x)]
    else:
        slots = (getattr(kind, "__slots__", ()) for kind in type(x).__mro__)
        each = [(x,) if isinstance(x, str) else x for x in slots]
        names = [*getattr(x, "__dict__", {}), *itertools.chain(*each)]
    return tuple((name, getattr(x, name, None)) for name in names)


def _name(x: Any) -> str:
    return f"{getattr(x, '__module__', '')}.{x.__qualname__}"


def _is_digest(x: Any) -> bool:
    return isinstance(x, str) and x.startswith(_DIGEST)


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 60 else text[:57] + "..."
