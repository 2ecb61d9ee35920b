"""Kinds of single values and of arrays, and what is wrong with a value that does not fit."""

import math
import numbers
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


# Characters of a value that are shown.
_SHOWN = 60


class Misfit(Exception):
    """A value that does not fit. `problem` goes on where the name of the argument ends, and `path`
    leads from the argument to the value: "[2]", or "['k']".

    A misfit is `near` if the value is of the right sort and something in it is wrong, so that
    other sorts, which would do as well, need not be named.
    """

    def __init__(self, problem: str | Callable[[], str], *, near: bool = False, path: str = ""):
        self._problem, self.near, self.path = problem, near, path

    @property
    def problem(self) -> str:
        """In words, which are made when they are asked for: of several sorts most do not fit."""
        return self._problem if isinstance(self._problem, str) else self._problem()

    def __str__(self) -> str:
        return self.problem

    def inside(self, key: Any) -> "Misfit":
        """The same, of a value that stands under this key of the argument."""
        return Misfit(self._problem, near=True, path=f"[{key!r}]{self.path}")

    def of(self, name: str) -> "Misfit":
        """The same, of the argument with this name."""
        return Misfit(self._problem, path=name + self.path)


def show(value: Any) -> str:
    """A value in a few words: numbers and strings as they are written, arrays by their shape,
    other objects by their class."""
    if isinstance(value, jax.core.Tracer):
        return f"a traced value of shape {value.shape}"
    if isinstance(value, np.ndarray | jax.Array):
        if value.ndim == 0:
            return f"the array {value.item()!r:.{_SHOWN}}"
        return f"an array of {value.dtype} with shape {value.shape}"
    if isinstance(value, np.generic):
        return show(value.item())
    if (
        value is None
        or value is Ellipsis
        or isinstance(value, bool | int | float | complex | str | bytes)
    ):
        return _shortened(value)
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    if isinstance(value, list | tuple | set | frozenset | dict) and len(value) < 100:
        text = repr(value)
        return text if len(text) <= _SHOWN else f"a {type(value).__name__} of {len(value)}"
    if callable(value) and hasattr(value, "__name__"):
        return f"the function {value.__name__}"
    return with_article(type(value).__name__)


def _shortened(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python writes
        return "a number with thousands of digits"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def with_article(name: str) -> str:
    """ "a Record", "an Output", "an LDTP"."""
    vowels = "AEFHILMNORSX" if name[:2].isupper() else "AEIOUaeiou"
    return f"{'an' if name[0] in vowels else 'a'} {name}"


def listed(words: list[str]) -> str:
    """ "a", "a or b", "a, b or c"."""
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


class Kind:
    """What an argument may be. Instances stand in `Annotated[...]`, or are made from a plain type
    by `kind_of`."""

    allowed: str
    """What is allowed, as it stands after "must be"."""

    def take(self, value: Any) -> Any:
        """The value in the form that functions work with: an `int` for any whole number, an array
        for nested lists of numbers, most others as they are.

        **Raises:** `Misfit` where it is not allowed.
        """
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.allowed  # (as `help` shows it)

    def refused(self, value: Any) -> Misfit:
        return Misfit(lambda: f"must be {self.allowed}, not {show(value)}")


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


class Reals(Kind):
    """An array of real numbers with a shape, given as such, or as numbers in nested sequences.

    Arrays stay what they are, NumPy's or JAX's; everything else becomes one of NumPy. Numbers are
    floating-point numbers afterwards. Of a traced array the shape and the type are checked, since
    its values are not known.

    **Arguments:**

    - `shape`: jaxtyping's words: `""` one number, `"N d"` two axes, `"2"` two numbers, `"... d"`
      any axes and one more. Axes of the same name have the same length; one called "#L" has any.
    - `sign`: "positive", "nonnegative" or "any".
    - `missing`: whether NaN may stand for what is missing. `infinite`: whether infinity may stand.
    - `form`: makes arrays of one library of all: `np.asarray`, `jnp.asarray`.
    """

    single, sort = "a finite number", "real numbers"
    types = "fiu"
    dtype: type = float

    def __init__(
        self,
        shape: str = "...",
        *,
        sign: str = "any",
        missing: bool = False,
        infinite: bool = False,
        form: Callable[[Any], Any] | None = None,
    ):
        self.shape, self.sign = tuple(shape.split()), sign
        self.missing, self.infinite, self.form = missing, infinite, form
        self._only_axes = all(word.isidentifier() for word in self.shape) and (
            len(set(self.shape)) == len(self.shape)
        )
        self.items = self.sort if sign == "any" else f"{sign} numbers"
        if self.shape == ():
            self.allowed = self.single if sign == "any" else f"a {sign} number"
        elif self.shape == ("...",):
            self.allowed = f"an array of {self.items}"
        else:
            self.allowed = f"an array of {self.items} with shape {self._written()}"

    def take(self, value):
        array = value if isinstance(value, np.ndarray | jax.Array) else self._array(value)
        if array.dtype.kind not in self.types:
            raise self._wrong_type(value, array)
        if not self._fits(array.shape):
            one = "one number" if self.shape == () else f"of shape {self._written()}"
            raise Misfit(f"must be {one}, not of shape {array.shape}", near=True)
        if not isinstance(array, jax.core.Tracer):
            self._check_values(array)
        if array.dtype.kind != self.types[0]:
            array = array.astype(self.dtype)
        return array if self.form is None else self.form(array)

    def _array(self, value: Any) -> np.ndarray | jax.Array:
        try:
            return np.asarray(value)
        except jax.errors.TracerArrayConversionError:
            return self._traced(value)
        except (ValueError, TypeError):
            if isinstance(value, list | tuple):
                raise Misfit(
                    "must be a rectangular array, but its rows differ in length", near=True
                ) from None
            raise self.refused(value) from None

    def _traced(self, value: Any) -> jax.Array:
        """Numbers in sequences of which some are traced."""
        try:
            return jnp.asarray(value)
        except (ValueError, TypeError):
            raise self.refused(value) from None

    def _wrong_type(self, value: Any, array: Any) -> Misfit:
        if array.dtype.kind == "c":
            return Misfit(f"must be real, not {show(value)}", near=True)
        if array.ndim == 0 or isinstance(value, str | dict | set):
            return self.refused(value)
        wrong = {"U": "strings", "S": "bytes", "O": "other objects"}
        return Misfit(
            f"must hold {self.items}, not {wrong.get(array.dtype.kind, array.dtype)}", near=True
        )

    def _fits(self, shape: tuple[int, ...]) -> bool:
        words = self.shape
        if self._only_axes:
            return len(shape) == len(words)
        if "..." in words:
            first = words.index("...")
            after = len(words) - first - 1
            if len(shape) < first + after:
                return False
            words = words[:first] + words[first + 1 :]
            shape = shape[:first] + shape[len(shape) - after :]
        if len(words) != len(shape):
            return False
        sizes: dict[str, int] = {}
        for word, n in zip(words, shape, strict=True):
            known = int(word) if word.isdecimal() else sizes.setdefault(word, n)
            if n != known and word.isalnum():
                return False
        return True

    def _check_values(self, array: np.ndarray | jax.Array) -> None:
        values = np.asarray(array)
        # (A sum is a number where all of them are, and takes no memory.)
        free = self.missing and self.infinite
        if values.dtype.kind not in "iu" and not free and not np.isfinite(_sum(values)):
            bad = np.isinf(values) if self.missing else ~np.isfinite(values)
            if self.infinite:
                bad &= ~np.isinf(values)
            self._refuse_any(bad, values, "finite")
        if self.sign == "positive":
            self._refuse_any(values <= 0, values, "positive")
        elif self.sign == "nonnegative":
            self._refuse_any(values < 0, values, "zero or positive")

    def _refuse_any(self, bad: np.ndarray | np.bool_, values: np.ndarray, allowed: str) -> None:
        if not bad.any():
            return
        if values.ndim == 0:
            one = self.single if self.sign == "any" else f"a {self.sign} number"
            raise Misfit(f"must be {one}, not {show(values.item())}", near=True)
        index = tuple(map(int, np.argwhere(bad)[0]))
        raise Misfit(
            f"must be {allowed}, but is {values[index]:.6g} at index "
            f"{index[0] if len(index) == 1 else index}",
            near=True,
        )

    def _written(self) -> str:
        return f"({', '.join(self.shape)}{',' * (len(self.shape) == 1)})"


class Complexes(Reals):
    """An array of numbers, real or complex, as `Reals` otherwise."""

    single, sort = "a finite number", "numbers"
    types = "cfiu"
    dtype = complex


class Integers(Reals):
    """An array of whole numbers, as `Reals` otherwise."""

    single, sort = "an integer", "integers"
    types = "iu"
    dtype = int


def _sum(values: np.ndarray) -> Any:
    with np.errstate(all="ignore"):
        return np.sum(values)
