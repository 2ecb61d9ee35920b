"""Things that come one after the other, too many to hold at once."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .containers import Instance, Items
from .kind import Kind


class Stream(Kind):
    """Any iterable of objects of a class. A sequence is checked at once; what comes from elsewhere
    is checked when it comes, and named as `argument`."""

    def __init__(self, cls: type, argument: str):
        self.item, self.argument = Instance(cls), argument
        self.allowed = f"an iterable of items, each {self.item.allowed}"

    def take(self, value):
        if isinstance(value, Sequence):
            return Items(self.item).take(value)
        others = np.ndarray | jax.Array | Mapping
        if isinstance(value, others) or not isinstance(value, Iterable):
            raise self.refused(value)
        once = iter(value) is value
        return self.checked(value) if once else _Again(self, value)

    def checked(self, value: Iterable) -> Iterator[Any]:
        for i, item in enumerate(value):
            if not isinstance(item, self.item.cls):
                raise self.item.refused(item).inside(i).of(self.argument)
            yield item


class _Again:
    """What can be iterated over more than once, checked each time."""

    def __init__(self, stream: Stream, value: Iterable):
        self._stream, self._value = stream, value

    def __iter__(self) -> Iterator[Any]:
        return self._stream.checked(self._value)
