"""Values that are computed once for an object, and forgotten with it."""

import functools
import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar, cast, overload


Owner = TypeVar("Owner")
Value = TypeVar("Value")


class Memory:
    """Values by object and key. Threads may share it.

    They are kept beside the objects. What is written into an equinox module's `__dict__` (as
    `functools.cached_property` does) becomes part of its pytree structure, and what was compiled
    for it would be compiled again. Objects are told apart by identity: equality of modules is that
    of their arrays.
    """

    def __init__(self):
        self._lock = threading.Lock()
        self._values: dict[int, tuple[weakref.ref, dict[Hashable, Any]]] = {}

    def __len__(self) -> int:
        return len(self._values)

    def recall(self, owner: Any, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value that `make` gave when it was first asked for.

        Nothing is locked while it is made, so that `make` may ask for other values, and use
        threads. Threads that ask for the same value at the same time may each make it; all of them
        get the one that was there first.
        """
        values = self._of(owner)
        if key in values:
            return values[key]
        return values.setdefault(key, make())

    def _of(self, owner: Any) -> dict[Hashable, Any]:
        name = id(owner)
        with self._lock:
            entry = self._values.get(name)
            # (An object that died may have left its id to this one.)
            if entry is None or entry[0]() is not owner:
                entry = weakref.ref(owner, functools.partial(self._forget, name)), {}
                self._values[name] = entry
            return entry[1]

    def _forget(self, name: int, dead: weakref.ref) -> None:
        # No lock: this may be called anywhere, also inside of `_of`. Single operations of a
        # dictionary are whole; what has been replaced by an heir of the id stays.
        entry = self._values.get(name)
        if entry is not None and entry[0] is dead:
            self._values.pop(name, None)


class remembered(Generic[Owner, Value]):  # noqa: N801 (a decorator, as `property` is)
    """A property that is computed once for each object."""

    def __init__(self, function: Callable[[Owner], Value]):
        self._function, self.memory = function, Memory()
        functools.update_wrapper(cast(Callable, self), function)

    @overload
    def __get__(self, instance: None, owner: Any = None) -> "remembered[Owner, Value]": ...

    @overload
    def __get__(self, instance: Owner, owner: Any = None) -> Value: ...

    def __get__(self, instance: Owner | None, owner: Any = None) -> Any:
        if instance is None:
            return self
        return self.memory.recall(instance, None, lambda: self._function(instance))
