"""A public call: a function of this package that a user's line calls, with all that it calls.

Whether the user's code has changed is looked at once in a public call, and functions of the user
that are no part of a program (`charts`, `transitions`) are called once.

`boundary/checked.py` opens a `public_call`; others keep values by `once_in_call`. A call is known
by the frame of the user's line: this must stay so, since a user's function that runs in between may
change values, and has its own frame. Models of this package count as code of the user.

If a change in the user's code is not noticed, look whether `public_call` takes two calls for one;
if charts are made again and again, at the conditions in `once_in_call` and at its `key`; if a
warning names another line than the user's, at `_frame_of_user`.
"""

import collections
import contextlib
import contextvars
import sys
import types
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple, TypeVar

from .reading import is_of_package


Value = TypeVar("Value")

# Values that are kept in a call, some 30 for each system. Fewer: in calls with many systems, each
# is looked at several times. More: a branch of thousands of points fills the memory.
_KEPT = 1024


class _Call(NamedTuple):
    """The frame of the user's line, and what was computed in the call by key, each value with the
    object to which it belongs."""

    frame: types.FrameType | None
    values: collections.OrderedDict[Hashable, tuple[Any, Any]]


_running: contextvars.ContextVar[_Call | None]
_running = contextvars.ContextVar("public call", default=None)


def _frame_of_user() -> types.FrameType | None:
    """The innermost frame of code that belongs to no package."""
    frame: types.FrameType | None = sys._getframe(1)
    while frame is not None and is_of_package(frame.f_code.co_filename):
        frame = frame.f_back
    return frame


def frames_to_user() -> int:
    """The number of calls between the function that asks and the user's line (for `stacklevel`)."""
    user = _frame_of_user()
    frame = sys._getframe(1)
    count = 0
    while frame.f_back is not None and frame is not user:
        frame = frame.f_back
        count += 1
    return count


@contextlib.contextmanager
def public_call() -> Iterator[bool]:
    """A context of a call; its value says whether this is a public call of its own. If not, it is
    part of the call that is running: no code of the user stands between the two."""
    frame = _frame_of_user()
    call = _running.get()
    if call is not None and call.frame is frame:
        yield False
        return
    token = _running.set(_Call(frame, collections.OrderedDict()))
    try:
        yield True
    finally:
        _running.reset(token)


def once_in_call(key: Hashable, owner: Any, make: Callable[[], Value]) -> Value:
    """Return what `make` returned for the same key in this public call; otherwise call `make`:
    outside of public calls, and in a user's function that a public call runs (which may change a
    value).

    **Arguments:** `owner`: the object whose `id` is part of the key, which lives as long.
    """
    frame = _frame_of_user()
    call = _running.get()
    # (A thread has no frame of the user: several would share the values.)
    if frame is None or call is None or call.frame is not frame:
        return make()
    if key not in call.values:
        call.values[key] = make(), owner
    call.values.move_to_end(key)
    value, _ = call.values[key]
    while len(call.values) > _KEPT:
        call.values.popitem(last=False)
    return value
