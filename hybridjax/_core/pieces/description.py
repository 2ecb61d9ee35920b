"""Whether a store holds what is asked for; and how what users wrote is described there."""

import hashlib
import importlib.metadata
import json
import types
from collections.abc import Callable, Mapping
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
    that it holds show it."""
    return digest_of(*_words(function, 0))


_DIGEST = "sha256:"
# Functions within functions that are looked at.
_DEPTH = 5


def _words(x: Any, depth: int) -> list[str]:
    if isinstance(x, types.FunctionType) and depth < _DEPTH:
        held = [cell.cell_contents for cell in x.__closure__ or ()]
        inside = [word for y in (*held, *(x.__defaults__ or ())) for word in _words(y, depth + 1)]
        return ["function", x.__qualname__, *_words(x.__code__, depth), *inside]
    if isinstance(x, types.CodeType):
        constants = [word for y in x.co_consts for word in _words(y, depth)]
        return [x.co_code.hex(), *x.co_names, *constants]
    if isinstance(x, tuple | list | frozenset):
        items = sorted(x, key=repr) if isinstance(x, frozenset) else x
        return [type(x).__name__, *(word for y in items for word in _words(y, depth))]
    if x is None or isinstance(x, bool | int | float | complex | str | bytes):
        return [repr(x)]
    if hasattr(x, "__array__"):
        return [array_digest(x)]
    kind = x if isinstance(x, type) else type(x)
    return [f"{kind.__module__}.{kind.__qualname__}"]


def _is_digest(x: Any) -> bool:
    return isinstance(x, str) and x.startswith(_DIGEST)


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 60 else text[:57] + "..."
