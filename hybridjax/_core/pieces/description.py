"""Whether a store holds what is asked for; and how what users wrote is described there."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ... import __version__


def versions() -> dict[str, str]:
    """Of the packages on which numbers depend to the last bit."""
    others = ("jax", "jaxlib", "numpy", "scipy")
    return {"hybridjax": __version__} | {x: importlib.metadata.version(x) for x in others}


def difference(mine: Any, theirs: Any, name: str = "") -> str | None:
    """The first difference between two descriptions in words; None if they are the same."""
    if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        for key in [*theirs, *(x for x in mine if x not in theirs)]:
            inside = f"{name}.{key}" if name else key
            if key not in mine or key not in theirs:
                return f"`{inside}` is {'only there' if key in theirs else 'not there'}"
            found = difference(mine[key], theirs[key], inside)
            if found is not None:
                return found
        return None
    if mine == theirs:
        return None
    if _is_digest(mine) or _is_digest(theirs):
        return f"its `{name}` is not the same"
    return f"its `{name}` is {_short(theirs)}, not {_short(mine)}"


def array_digest(x: Any) -> str:
    """A digest of an array with its numbers."""
    array = np.ascontiguousarray(x)
    found = hashlib.sha256(f"{array.dtype}{array.shape}".encode())
    found.update(array.tobytes())
    return _DIGEST + found.hexdigest()[:32]


def digest_of(*words: str) -> str:
    """A digest of texts."""
    return _DIGEST + hashlib.sha256(json.dumps(words).encode()).hexdigest()[:32]


def function_digest(function: Callable) -> str:
    """A digest of what a function does, as far as its code, its defaults and the numbers and words
    that it holds show it: in variables around it, as a `functools.partial`, or as an object that
    can be called. Of other objects that it holds, the class stands for all."""
    return digest_of(*_words(function, 0))


def definition_digest(x: Any) -> str:
    """A digest of a definition, as families of sections and outputs are: of all that its fields
    hold."""
    return digest_of(*_definition(x))


_DIGEST = "sha256:"
# Functions and objects within others that are looked at.
_DEPTH = 5


def _definition(x: Any) -> list[str]:
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        held = [(f.name, getattr(x, f.name)) for f in dataclasses.fields(x)]
        return [_name(type(x)), *(word for name, y in held for word in (name, *_definition(y)))]
    if isinstance(x, tuple | list):
        return [type(x).__name__, str(len(x)), *(word for y in x for word in _definition(y))]
    return _words(x, 0)


def _words(x: Any, depth: int) -> list[str]:
    inside = functools.partial(_words, depth=depth + 1)
    if x is None or isinstance(x, bool | int | float | complex | str | bytes):
        return [repr(x)]
    if isinstance(x, types.CodeType):
        constants = [word for y in x.co_consts for word in _words(y, depth)]
        return [x.co_code.hex(), *x.co_names, *constants]
    if isinstance(x, tuple | list | set | frozenset):
        items = x if isinstance(x, tuple | list) else sorted(x, key=repr)
        return [type(x).__name__, str(len(x)), *(word for y in items for word in _words(y, depth))]
    if hasattr(x, "__array__"):
        return [array_digest(x)]
    parts = _parts(x) if depth < _DEPTH else ()
    name = _name(x if hasattr(x, "__qualname__") else type(x))
    return [type(x).__name__, name, *(word for y in parts for word in inside(y))]


def _parts(x: Any) -> Iterable[Any]:
    """What an object is made of that says what it does."""
    if isinstance(x, types.FunctionType):
        variables = map(_contents, x.__closure__ or ())
        return x.__code__, *variables, x.__defaults__, x.__kwdefaults__
    if isinstance(x, types.MethodType):
        return x.__func__, *_held(x.__self__)
    if isinstance(x, functools.partial):
        return x.func, x.args, x.keywords
    if isinstance(x, Mapping):
        return tuple(x.items())
    if callable(x) and not isinstance(x, type):
        return type(x).__call__, *_held(x)
    return ()


def _contents(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # a name that has not been given yet
        return None


def _held(x: Any) -> Iterable[Any]:
    """The attributes of an object, with their names."""
    return tuple(getattr(x, "__dict__", {}).items())


def _name(x: Any) -> str:
    return f"{getattr(x, '__module__', '')}.{x.__qualname__}"


def _is_digest(x: Any) -> bool:
    return isinstance(x, str) and x.startswith(_DIGEST)


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 60 else text[:57] + "..."
