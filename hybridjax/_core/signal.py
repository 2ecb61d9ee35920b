"""Names of signals with their units: strings that know their unit, from the declaration in a system
to the axes of figures.

A `Signal` must stay a string with the hash of its name, so that it is found in dictionaries of
names. A further unit of time is a line in `SECONDS`.

If a unit is missing in a table or figure, look for the place where its name became a plain string:
`str(name)`, f-strings and methods of strings return names without a unit. If a name is not found
among names that look the same, their units differ (`__eq__`). If a unit is written badly, look at
`ratio`, `square` and `with_unit`.
"""

from collections.abc import Iterable
from typing import Any


SECONDS = {
    "s": 1.0,
    "sec": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "μs": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
}
"""Units of time."""


class Signal(str):
    """The name of a state, input or output, with its unit ("" where nobody said it).

    It is a string like any other, so that whatever hands names on hands units on. Equal names with
    different units are not equal, lest meters be taken for millimeters; a name without a unit
    equals all of that name.
    """

    __slots__ = ("unit",)
    unit: str

    def __new__(cls, name: str, unit: str = "") -> "Signal":
        self = super().__new__(cls, name)
        self.unit = unit
        return self

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, str):
            return NotImplemented
        if not str.__eq__(self, other):
            return False
        units = {self.unit, unit_of(other)} - {""}
        return len(units) < 2

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = str.__hash__

    def __repr__(self) -> str:
        if self.unit:
            return f"{super().__repr__()} ({self.unit})"
        return super().__repr__()

    def __getnewargs__(self) -> Any:
        return str(self), self.unit


def signals(names: Iterable[str], units: Iterable[str]) -> tuple[Signal, ...]:
    """Names with the units that stand beside them, in the same order: none, or one for each."""
    names = tuple(names)
    units = tuple(units)
    return tuple(map(Signal, names, units or ("",) * len(names)))


def unit_of(name: str) -> str:
    """The unit of a signal, "" where it is not known."""
    return getattr(name, "unit", "")


def ratio(output: str, input: str) -> str:
    """The unit of an output per input, as in m/N; "" unless both are known."""
    units = unit_of(output), unit_of(input)
    return "/".join(map(_factor, units)) if all(units) else ""


def square(name: str) -> str:
    """The unit of a signal's power, as in N²; "" where it is not known."""
    return _factor(unit_of(name)) and f"{_factor(unit_of(name))}²"


def _factor(unit: str) -> str:
    return f"({unit})" if set(unit) & set(" */") else unit


def with_unit(text: str, unit: str) -> str:
    """A text for the axis of a figure, with a unit in brackets."""
    return f"{text} ({unit})" if unit else text
