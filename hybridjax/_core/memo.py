"""Values that are computed once for an object, and forgotten with it."""

import functools
import weakref
from collections.abc import Callable, Hashable
from typing import Any


class Memory:
    """Values by object and key.

    They are kept beside the objects. What is written into an equinox module's `__dict__` (as
    `functools.cached_property` does) becomes part of its pytree structure, and what was compiled
    for it would be compiled again.
    """

    def __init__(self):
        self._values: dict[int, dict[Hashable, Any]] = {}

    def __len__(self) -> int:
        return len(self._values)

    def recall(self, owner: Any, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value that `make` gave when it was first asked for."""
        if id(owner) not in self._values:
            self._values[id(owner)] = {}
            weakref.finalize(owner, self._values.pop, id(owner))
        values = self._values[id(owner)]
        if key not in values:
            values[key] = make()
        return values[key]


class remembered:  # noqa: N801 (a decorator, as `property` is)
    """A property that is computed once for each object."""

    def __init__(self, function: Callable[[Any], Any]):
        self._function, self.memory = function, Memory()
        functools.update_wrapper(self, function)

    def __get__(self, instance, owner=None):
        if instance is None:
            return self
        return self.memory.recall(instance, None, lambda: self._function(instance))
