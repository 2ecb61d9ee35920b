"""Properties of equinox modules that are computed once."""

import functools
import weakref
from collections.abc import Callable
from typing import Any


class remembered:  # noqa: N801 (a decorator, as `property` is)
    """A property that is computed once for each object.

    `functools.cached_property` would write into the object's `__dict__`. Equinox sees that in the
    object's pytree structure, and what was compiled for it would be compiled again.
    """

    def __init__(self, function: Callable[[Any], Any]):
        self._function, self._values = function, {}
        functools.update_wrapper(self, function)

    def __get__(self, instance, owner=None):
        if instance is None:
            return self
        key = id(instance)
        if key not in self._values:
            self._values[key] = self._function(instance)
            weakref.finalize(instance, self._values.pop, key)
        return self._values[key]
