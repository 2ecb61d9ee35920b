"""Values that are computed once for an object, and forgotten with it.

Systems, cycles, models and fits keep here what takes long to compute: by `remembered`, a property;
by a `Memory`, also with a key; by `Recent`, the last few values. The object is the owner of its
values. A value in a `Memory` must not refer to its owner: neither would ever be forgotten.

If memory grows, look for a value that refers to its owner; if a value of earlier arguments comes
back, for an argument that is missing in the key (`Memory`) or in `others` (`Recent`); if a value is
computed again and again, look whether the owner is made anew each time, as owners are known by
identity.
"""

import collections
import functools
import weakref
from collections.abc import Callable, Hashable
from typing import Any, TypeVar, cast

import equinox as eqx
import jax


Value = TypeVar("Value")


class Memory:
    """Values by object and key. Threads may share it.

    They are kept beside the objects. What is written into an equinox module's `__dict__` (as
    `functools.cached_property` does) becomes part of its pytree structure, and what was compiled
    for it would be compiled again. Objects are told apart by identity: equality of modules is that
    of their arrays.
    """

    def __init__(self):
        self._values: dict[int, dict[Hashable, Any]] = {}

    def get(self, owner: Any, key: Hashable) -> Any:
        """Return the value that is kept for this owner and key, or None."""
        return self._values.get(id(owner), {}).get(key)

    def recall(self, owner: Any, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value that `make` returned at the first call for this owner and key.

        Nothing is locked while it is made, so that `make` may recall other values, and use threads.
        Threads that recall the same value at the same time may each make it; all of them get the
        value that was stored first.
        """
        name = id(owner)
        if name not in self._values:
            # (Several threads may come this far: single operations of a dictionary are atomic.)
            self._values.setdefault(name, {})
            weakref.finalize(owner, self._values.pop, name, None).atexit = False
        values = self._values[name]
        return values[key] if key in values else values.setdefault(key, make())


class Recent:
    """The last values that were computed for an object with others that are equal trees. Values may
    refer to the object, which is kept with them: a `Memory` would keep all of them for ever.
    Threads may share it."""

    def __init__(self, size: int):
        self._kept: collections.deque[tuple] = collections.deque(maxlen=size)

    def get(self, owner: Any, *others: Any) -> Any:
        """Return the value that is kept for this object and equal others, or None."""
        for known, kept, value in tuple(self._kept):
            if known is owner and eqx.tree_equal(*jax.device_get((kept, others))):
                return value
        return None

    def keep(self, value: Value, owner: Any, *others: Any) -> Value:
        """Keep a value for this object and others, and return it."""
        self._kept.appendleft((owner, others, value))
        return value


class remembered:  # noqa: N801 (a decorator, as `property` is)
    """A property that is computed once for each object."""

    def __init__(self, function: Callable[[Any], Any]):
        self._function = function
        self.memory = Memory()
        functools.update_wrapper(cast(Callable, self), function)

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        if instance is None:
            return self
        return self.memory.recall(instance, None, lambda: self._function(instance))
