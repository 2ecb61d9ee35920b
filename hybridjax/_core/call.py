"""A public call: a function of this package that a user calls, with all that it calls.

Whether the user's code has changed is looked at once in a public call, and functions of the user
that are no part of a program (`charts`, `transitions`) are called once.
"""

import contextlib
import contextvars
import os
import pathlib
import types
from collections.abc import Callable, Hashable, Iterator
from typing import Any, TypeVar


Value = TypeVar("Value")

_PACKAGE = os.path.join(pathlib.Path(__file__).parents[1], "")
_MODELS = os.path.join(_PACKAGE, "models")

# What was computed in the public call that is running, with the objects to which it belongs.
_of_call: contextvars.ContextVar[dict[Hashable, tuple[Any, Any]] | None]
_of_call = contextvars.ContextVar("of_call", default=None)


@contextlib.contextmanager
def public_call(caller: types.FrameType | None) -> Iterator[None]:
    """A context of a call: a public call of its own, or a part of that which is running if this
    package is the caller. (A user's function that this package calls may change a value, and then
    call this package.)"""
    if _of_call.get() is not None and _is_own(caller):
        yield
        return
    token = _of_call.set({})
    try:
        yield
    finally:
        _of_call.reset(token)


def _is_own(caller: types.FrameType | None) -> bool:
    """Test for code of this package. (Equinox stands between a class and its caller.)"""
    while caller is not None and _root(caller) == "equinox":
        caller = caller.f_back
    if caller is None or _root(caller) != "hybridjax":
        return False
    path = caller.f_code.co_filename
    return path.startswith(_PACKAGE) and not path.startswith(_MODELS)


def _root(frame: types.FrameType) -> str:
    return str(frame.f_globals.get("__name__")).partition(".")[0]


def once_in_call(key: Hashable, owner: Any, make: Callable[[], Value]) -> Value:
    """Return what `make` returned in this public call for the same key; outside of all calls, what
    it returns.

    **Arguments:** `owner`: the object whose `id` is part of the key, which lives as long.
    """
    values = _of_call.get()
    if values is None:
        return make()
    if key not in values:
        values[key] = make(), owner
    return values[key][0]
