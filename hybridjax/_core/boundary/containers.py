"""Kinds that are made of other kinds: choices, sequences, tables, objects of a class.

A kind describes the values that an argument may have; `take` returns the value in the form in which
functions use it, or raises `Misfit`. `checked.py` calls it, by way of the names in `kinds.py`.

A new container is a subclass with `allowed` (the words after "must be") and `take`, which must hand
items to their kinds by `_taken`, so that errors say where an item stands. It stands in
`Annotated[...]`, or `kind_of` (`kinds.py`) makes it of a plain type.

A result of several steps stands for its parts (`_parts`, `_stands_for`): if a function gets a fit
instead of the whole result, or the reverse, look at the order in `Instance` and `Having`. If a
message names the wrong one of several types, look at `Either`.
"""

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from ..executor import is_tracer
from ..meaning import current
from ..signal import Signal
from .values import Kind, Misfit, listed, refuse_traced, show, with_article


class Either(Kind):
    """A value that one of several kinds takes, tried in their order."""

    def __init__(self, *kinds: Kind):
        self.kinds = kinds
        self.allowed = listed(list(dict.fromkeys(kind.allowed for kind in kinds)))

    def take(self, value):
        nearest = None
        for kind in self.kinds:
            try:
                return kind.take(value)
            except Misfit as misfit:
                if misfit.near and nearest is None:
                    nearest = misfit
        raise nearest or self.refused(value)


class Instance(Kind):
    """An object of a class."""

    def __init__(self, cls: type):
        self.cls = cls
        self.allowed = with_article(cls.__name__)

    def take(self, value):
        for thing in (value, *_parts(value)):
            if isinstance(thing, self.cls):
                return current(thing)
        raise self.refused(value)


class Having(Kind):
    """An object with what a protocol asks for. (Properties are not evaluated, as `isinstance`
    would do.)"""

    def __init__(self, protocol: type):
        self.cls = protocol
        names = {**vars(protocol), **protocol.__annotations__}
        self.names = sorted(x for x in names if x[0] != "_")
        self.allowed = f"an object with `{'` and `'.join(self.names)}`"

    def take(self, value):
        # (The parts first: a part such as a fit has more than its whole, for example errors of the
        # multipliers.)
        for thing in (*_parts(value), value):
            if self.fits(thing):
                return thing
        raise self.refused(value)

    def fits(self, value):
        missing = object()
        found = [inspect.getattr_static(value, x, missing) for x in self.names]
        return all(x is not missing for x in found)


def _parts(value: Any) -> Iterator[Any]:
    """Iterate over the parts that functions take in place of a result of several steps."""
    for name in getattr(type(value), "_stands_for", ()):
        yield getattr(value, name)


class Items(Kind):
    """A sequence all of whose items are of one kind: a list, a tuple, an array's first axis. With
    `form`, it is brought to that form; with `iterable`, whatever can be iterated over is taken."""

    def __init__(
        self,
        item: Kind | None,
        *,
        form: type | None = None,
        iterable: bool = False,
    ):
        self.item = item
        self.form = form
        self.iterable = iterable
        if item is None:
            self.allowed = "a sequence"
        else:
            self.allowed = f"a sequence (each item {item.allowed})"

    def take(self, value):
        if isinstance(value, str | bytes | Mapping):
            raise self.refused(value)
        if isinstance(value, np.ndarray | jax.Array):
            if value.ndim == 0:
                refuse_traced(value, self.allowed)
                raise self.refused(value)
            value = list(value if is_tracer(value) else np.asarray(value))
        elif not isinstance(value, Sequence):
            if not (self.iterable and isinstance(value, Iterable)):
                raise self.refused(value)
            value = tuple(value)
        if self.item is not None:
            form = list if isinstance(value, list) else tuple
            value = form(_taken(self.item, i, x) for i, x in enumerate(value))
        if self.form is None or isinstance(value, self.form):
            return value
        return self.form(value)


class Tuple(Kind):
    """A list or a tuple with one value for each of `kinds`."""

    def __init__(self, *kinds: Kind | None):
        self.kinds = kinds
        parts = ", ".join(
            "anything" if kind is None else kind.allowed for kind in kinds
        )
        self.allowed = f"a tuple of {len(kinds)} ({parts})"

    def take(self, value):
        if isinstance(value, np.ndarray | jax.Array) and value.ndim == 1:
            value = tuple(value)
        if not isinstance(value, list | tuple) or len(value) != len(self.kinds):
            raise self.refused(value)
        pairs = enumerate(zip(self.kinds, value, strict=True))
        return tuple(
            x if kind is None else _taken(kind, i, x) for i, (kind, x) in pairs
        )


class Table(Kind):
    """A mapping all of whose keys and values are of one kind each."""

    def __init__(self, key: Kind | None, value: Kind | None):
        self.key = key
        self.value = value
        self.allowed = "a mapping such as {name: value}"

    def take(self, value):
        if not isinstance(value, Mapping):
            raise self.refused(value)
        out = {}
        for name, item in value.items():
            name = name if self.key is None else _taken(self.key, name, name)
            out[name] = item if self.value is None else _taken(self.value, name, item)
        # (A state of a cycle knows more than its numbers.)
        with_items = getattr(type(value), "with_items", None)
        return out if with_items is None else with_items(value, out)


class Names(Kind):
    """One name, or several distinct ones, returned as a tuple. Objects of the class `other` may
    stand among the names. Unless `empty`, at least one name is needed. With `units`, a table from
    names to units is taken too."""

    def __init__(
        self,
        other: type | None = None,
        *,
        empty: bool = False,
        units: bool = False,
    ):
        self.empty = empty
        self.units = units
        self.types = (str,) if other is None else (str, other)
        self.allowed = "a name, or a sequence of distinct names"
        if other is not None:
            self.allowed += f" (or {with_article(other.__name__)} in place of one)"
        if units:
            self.allowed += ", or their units by name"

    def take(self, value):
        items = self._items(value)
        if not items and not self.empty:
            raise self.refused(value)
        if not all(isinstance(x, self.types) for x in items):
            raise self.refused(value)
        given = tuple(str(x) if isinstance(x, np.str_) else current(x) for x in items)
        names = [x for x in given if isinstance(x, str)]
        if len(set(names)) < len(names):
            raise Misfit(f"must name each only once, not {show(given)}", near=True)
        return given

    def _items(self, value: Any) -> list[Any]:
        """The names in a sequence or a table of units, or the single one that it is."""
        if self.units and isinstance(value, Mapping):
            if not all(isinstance(x, str) for x in (*value, *value.values())):
                raise self.refused(value)
            return list(map(Signal, value, value.values()))
        if isinstance(value, np.ndarray) and value.ndim != 1:
            raise self.refused(value)
        if isinstance(value, list | tuple | np.ndarray):
            return list(value)
        return [value]


def _taken(kind: Kind, key: Any, value: Any) -> Any:
    try:
        return kind.take(value)
    except Misfit as misfit:
        raise misfit.inside(key) from None


class Stream(Kind):
    """Any iterable of objects of a class. A sequence is checked at once; an item of any other
    iterable is checked when it arrives, and errors name it `argument`."""

    def __init__(self, cls: type, argument: str):
        self.item = Instance(cls)
        if getattr(cls, "_is_protocol", False):
            self.item.allowed = Having(cls).allowed
        self.argument = argument
        self.allowed = f"an iterable of items, each {self.item.allowed}"

    def take(self, value):
        if isinstance(value, Sequence):
            return Items(self.item).take(value)
        if isinstance(value, np.ndarray | jax.Array | Mapping) or not isinstance(
            value, Iterable
        ):
            raise self.refused(value)
        return _Checked(self, value)


class _Checked:
    """An iterable whose items are checked each time that it is iterated over."""

    def __init__(self, stream: Stream, value: Iterable):
        self._stream = stream
        self._value = value

    def __iter__(self) -> Iterator[Any]:
        item = self._stream.item
        for i, x in enumerate(self._value):
            if not isinstance(x, item.cls):
                raise item.refused(x).inside(i).of(self._stream.argument)
            yield x
