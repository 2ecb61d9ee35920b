"""Single values: whole and real numbers, switches, words."""

import math
import numbers
import operator
from typing import Any

import jax
import numpy as np

from .kind import Kind
from .misfit import Misfit, listed


class Whole(Kind):
    """A whole number between bounds, as a Python `int`: ints and NumPy's, arrays of one integer
    without axes; no bools and no floats."""

    def __init__(self, low: int | None = None, high: int | None = None):
        self.low = -math.inf if low is None else low
        self.high = math.inf if high is None else high
        self.allowed = "an integer"
        if low is not None and high is not None:
            self.allowed += f" from {low} to {high}"
        elif low is not None:
            self.allowed += f" of at least {low}"

    def take(self, value):
        if type(value) is not int:
            if isinstance(value, bool | np.bool_):
                raise self.refused(value)
            refuse_traced(value, self.allowed)
            try:
                value = operator.index(value)
            except TypeError:
                raise self.refused(value) from None
        if not self.low <= value <= self.high:
            raise self.refused(value)
        return value


class Number(Kind):
    """A finite real number between bounds, as a Python `float`: numbers of Python and NumPy, arrays
    of one number without axes; no bools, strings and complex numbers. With `infinite`, infinity may
    stand for no bound; with `missing`, NaN for a value that is not known."""

    def __init__(
        self,
        allowed: str = "a finite number",
        *,
        above: int | float = -math.inf,
        low: int | float = -math.inf,
        high: int | float = math.inf,
        below: int | float = math.inf,
        infinite: bool = False,
        missing: bool = False,
    ):
        self.allowed = allowed
        self.above, self.low, self.high, self.below = above, low, high, below
        self.infinite, self.missing = infinite, missing

    def take(self, value):
        number = value if type(value) is float else self._as_float(value)
        if not self.fits(number):
            raise self.refused(value)
        return number

    def fits(self, number: float) -> bool:
        if not math.isfinite(number):
            return (self.infinite and number > 0) or (self.missing and math.isnan(number))
        return self.low <= number <= self.high and self.above < number < self.below

    def _as_float(self, value: Any) -> float:
        refuse_traced(value, self.allowed)
        if (
            isinstance(value, np.ndarray | jax.Array)
            and value.ndim == 0
            and value.dtype.kind in "fiu"
        ):
            value = value.item()
        if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real):
            raise self.refused(value)
        try:
            return float(value)
        except OverflowError:
            raise self.refused(value) from None


class Switch(Kind):
    """True or False."""

    allowed = "True or False"

    def take(self, value):
        if value is True or value is False:
            return value
        refuse_traced(value, self.allowed)
        if isinstance(value, np.bool_):
            return bool(value)
        if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0 and value.dtype == bool:
            return bool(value)
        raise self.refused(value)


class ComplexNumber(Kind):
    """A finite number, real or complex."""

    allowed = "a finite number"

    def take(self, value):
        refuse_traced(value, self.allowed)
        if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0:
            value = value.item()
        if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Complex):
            raise self.refused(value)
        if not (math.isfinite(value.real) and math.isfinite(value.imag)):
            raise self.refused(value)
        return complex(value)


class OneOf(Kind):
    """One of some words."""

    def __init__(self, *words: Any):
        self.words = words
        self.allowed = listed([repr(word) for word in words])

    def take(self, value):
        for word in self.words:
            if value is word or (type(value) is type(word) and value == word):
                return value
        raise self.refused(value)


class Text(Kind):
    """A string."""

    allowed = "a string"

    def take(self, value):
        if isinstance(value, str):
            return value
        raise self.refused(value)


class Nothing(Kind):
    """None."""

    allowed = "None"

    def take(self, value):
        if value is None:
            return value
        raise self.refused(value)


def refuse_traced(value: Any, allowed: str) -> None:
    if isinstance(value, jax.core.Tracer):
        raise Misfit(
            f"must be {allowed} whose value is known, but JAX traces it: call this outside of jit, "
            "vmap and grad",
            near=True,
        )
