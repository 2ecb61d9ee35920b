"""Kinds of single values and of arrays, and what is wrong with a value that does not fit
(`Misfit`).

A *kind* describes the values that an argument may have: `Kind.take` returns a value in the form in
which functions use it, or raises `Misfit`, of which `checked.py` makes an error that names the
argument. Kinds that are made of other kinds are in `containers.py`, and the names of kinds for
signatures in `kinds.py`.

A new kind is a subclass with `allowed` (the words after "must be") and `fits`, or `take` if it
changes the value. If a good value is refused, look at `take` of its kind; if a message describes a
value badly, at `show`.

Single numbers and switches must refuse what JAX traces (`refuse_traced`), and arrays must not look
at its values. If a message names one kind where an argument may have several, look where `near` is
set.
"""

import contextlib
import dataclasses
import math
import numbers
import operator
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..executor import is_tracer


# Characters of a value that a message shows. More: messages of several lines. Fewer: names are cut.
_SHOWN = 60


class Misfit(Exception):
    """A value that does not fit. `problem` goes on where the name of the argument ends, and `path`
    leads from the argument to the value: "[2]", or "['k']".

    A misfit is `near` if the value has the right type and something in it is wrong. The message
    then does not name the other types that the argument may have.
    """

    def __init__(
        self,
        problem: str | Callable[[], str],
        *,
        near: bool = False,
        path: str = "",
        lead: Callable[[], str] | None = None,
    ):
        self._problem = problem
        self.near = near
        self.path = path
        self._lead = lead

    @property
    def problem(self) -> str:
        """The words, composed at the first use: of several kinds most do not fit, unseen."""
        return self._problem if isinstance(self._problem, str) else self._problem()

    @property
    def lead(self) -> str:
        """The rest of the sentence: the call that makes what is allowed, or nothing."""
        return "" if self._lead is None else self._lead()

    def leading(self, lead: Callable[[], str]) -> "Misfit":
        """The same, with the rest of the sentence."""
        return Misfit(self._problem, near=self.near, path=self.path, lead=lead)

    def inside(self, key: Any) -> "Misfit":
        """The same, of a value that stands under this key of the argument."""
        path = f"[{key!r}]{self.path}"
        return Misfit(self._problem, near=True, path=path, lead=self._lead)

    def of(self, name: str) -> "Misfit":
        """The same, of the argument with this name."""
        return Misfit(self._problem, path=name + self.path, lead=self._lead)


def show(value: Any) -> str:
    """A value in a few words: numbers and strings as they are written, arrays by their shape,
    other objects by their class."""
    if is_tracer(value):
        return f"a traced value of shape {value.shape}"
    if isinstance(value, np.ndarray | jax.Array):
        if value.ndim == 0:
            return f"the array {value.item()!r:.{_SHOWN}}"
        return f"an array of {value.dtype} with shape {value.shape}"
    if isinstance(value, np.generic):
        return show(value.item())
    if isinstance(value, _WRITTEN):
        return _written(value)
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    if isinstance(value, list | tuple | set | frozenset | dict) and len(value) < 100:
        text = repr(value)
        if len(text) <= _SHOWN:
            return text
        return f"a {type(value).__name__} of {len(value)}"
    if callable(value) and hasattr(value, "__name__"):
        return f"the function {value.__name__}"
    return with_article(type(value).__name__)


_WRITTEN = int, float, complex, str, bytes, type(None), type(...)


def _written(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python writes
        return "a number with thousands of digits"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def with_article(name: str) -> str:
    """ "a SectionSeries", "an Output", "an LDTP"."""
    vowels = "AEFHILMNORSX" if name[:2].isupper() else "AEIOUaeiou"
    return f"{'an' if name[0] in vowels else 'a'} {name}"


def listed(words: list[str]) -> str:
    """ "a", "a or b", "a, b or c"."""
    *first, last = words
    return f"{', '.join(first)} or {last}" if first else last


class Kind:
    """What an argument may be. Instances stand in `Annotated[...]`, or are made from a plain type
    by `kind_of`."""

    allowed: str
    """The values that are allowed, as it stands after "must be"."""

    def take(self, value: Any) -> Any:
        """Return the value in the form that functions work with: an `int` for any whole number, an
        array for nested lists of numbers, most others as they are.

        **Raises:** `Misfit` where it is not allowed.
        """
        if self.fits(value):
            return value
        raise self.refused(value)

    fits: Callable[[Any], bool]
    """Whether a value is allowed. (For kinds whose `take` returns the value unchanged.)"""

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
        if low is not None:
            self.allowed += (
                f" of at least {low}" if high is None else f" from {low} to {high}"
            )

    def take(self, value):
        number = value
        if type(value) is not int:
            if isinstance(value, bool | np.bool_):
                raise self.refused(value)
            refuse_traced(value, self.allowed)
            try:
                number = operator.index(value)
            except TypeError:
                raise self.refused(value) from None
        if not self.low <= number <= self.high:
            raise self.refused(number)
        return number


@dataclasses.dataclass(eq=False, repr=False)
class Number(Kind):
    """A finite real number between bounds, as a Python `float`: numbers of Python and NumPy, arrays
    of one number without axes; no bools, strings and complex numbers. With `infinite`, infinity may
    stand for no bound."""

    allowed: str = "a finite number"
    _: dataclasses.KW_ONLY
    above: int | float = -math.inf
    low: int | float = -math.inf
    high: int | float = math.inf
    below: int | float = math.inf
    infinite: bool = False

    def take(self, value):
        number = value
        if type(value) is not float:
            number = _plain(value, self.allowed)
            if isinstance(number, bool | np.bool_) or not isinstance(
                number, numbers.Real
            ):
                raise self.refused(value)
            try:
                number = float(number)
            except OverflowError:
                raise self.refused(value) from None
        if not self.fits(number):
            raise self.refused(value)
        return number

    def fits(self, value):
        if not math.isfinite(value):
            return self.infinite and value > 0
        return self.low <= value <= self.high and self.above < value < self.below


class Switch(Kind):
    """True or False."""

    allowed = "True or False"

    def take(self, value):
        switch = value if isinstance(value, bool) else _plain(value, self.allowed)
        if not isinstance(switch, bool | np.bool_):
            raise self.refused(value)
        return bool(switch)


class OneOf(Kind):
    """One of some words."""

    def __init__(self, *words: Any):
        self.words = words
        self.allowed = listed([repr(word) for word in words])

    def fits(self, value):
        return any(
            value is x or (type(value) is type(x) and value == x) for x in self.words
        )


class Plain(Kind):
    """What passes a test."""

    def __init__(self, allowed: str, fits: Callable[[Any], bool]):
        self.allowed = allowed
        self.fits = fits


TEXT = Plain("a string", lambda value: isinstance(value, str))
PATH = Plain("the name of a file or folder", lambda value: _is_path(value))
NOTHING = Plain("None", lambda value: value is None)
FUNCTION = Plain("a function", callable)


def _is_path(value: Any) -> bool:
    name = os.fspath(value) if isinstance(value, os.PathLike) else value
    return isinstance(name, str) and name != "" and "\0" not in name


def _plain(value: Any, allowed: str) -> Any:
    """A number of Python for an array without axes."""
    refuse_traced(value, allowed)
    if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0:
        return value.item()
    return value


def unmasked(values: Any) -> np.ndarray:
    """An array of NumPy, NaN where it was masked (as readers of netCDF mask what is missing)."""
    if (
        isinstance(values, np.ma.MaskedArray)
        and values.dtype.kind in "fiub"
        and values.mask.any()
    ):
        values = np.ma.filled(values.astype(float), np.nan)
    return np.asarray(values)


def refuse_traced(value: Any, allowed: str) -> None:
    if is_tracer(value):
        text = f"must be {allowed}, but JAX traces it: call this outside of jit, vmap and grad"
        raise Misfit(text, near=True)


class Reals(Kind):
    """An array of real numbers with a shape, given as such, or as numbers in nested sequences.

    Arrays stay NumPy's or JAX's; everything else becomes one of NumPy. Numbers are floating-point
    numbers of double precision afterwards, NaN where they were masked. Of a traced array the shape
    and the type are checked, since its values are not known.

    **Arguments:**

    - `shape`: words of jaxtyping: `""` one number, `"N d"` two axes, `"2"` two numbers, `"..."` any
      axes. Axes of the same name have the same length.
    - `sign`: "positive", "nonnegative" or "any".
    - `missing`: whether NaN may stand for what is missing. `infinite`: whether infinity may stand.
    - `form`: makes arrays of one library of all: `np.asarray`, `jnp.asarray`.
    """

    single = "a finite number"
    items = "real numbers"
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
        self.shape = tuple(shape.split())
        self.sign = sign
        self.missing = missing
        self.infinite = infinite
        self.form = form
        if sign != "any":
            self.single = f"a {sign} number"
            self.items = f"{sign} numbers"
        self.allowed = self.single if self.shape == () else f"an array of {self.items}"
        if self.shape not in ((), ("...",)):
            self.allowed += f" with shape {self._written()}"

    def take(self, value):
        array = value if isinstance(value, jax.Array) else self._array(value)
        if array.dtype.kind not in self.types:
            raise self._wrong_type(value, array)
        if not self._fits(array.shape):
            wanted = f"of shape {self._written()}" if self.shape else "one number"
            problem = f"must be {wanted}, not of shape {array.shape}"
            raise Misfit(problem, near=True)
        if not is_tracer(array):
            self._check_values(array)
        # (Arrays of JAX in single precision have lost digits, and are refused by `require_x64`.)
        if isinstance(array, np.ndarray) or array.dtype.kind != self.types[0]:
            array = array.astype(self.dtype, copy=False)
        return array if self.form is None else self.form(array)

    def _array(self, value: Any) -> np.ndarray | jax.Array:
        if hasattr(value, "columns"):
            text = "must be an array, not a table: give `table[names].to_numpy()`, in their order"
            raise Misfit(text, near=True)
        try:
            return unmasked(value)
        except jax.errors.TracerArrayConversionError:  # some of the numbers are traced
            with contextlib.suppress(ValueError, TypeError):
                return jnp.asarray(value)
        except (ValueError, TypeError):
            if isinstance(value, list | tuple):
                raise Misfit(
                    "must be rectangular: its rows differ in length", near=True
                ) from None
        raise self.refused(value) from None

    def _wrong_type(self, value: Any, x: Any) -> Misfit:
        if x.dtype.kind == "c":
            return Misfit(f"must be real, not {show(value)}", near=True)
        if x.ndim == 0 or isinstance(value, str | dict | set):
            return self.refused(value)
        wrong = {"U": "strings", "S": "bytes", "O": "other objects"}
        return Misfit(
            f"must hold {self.items}, not {wrong.get(x.dtype.kind, x.dtype)}", near=True
        )

    def _fits(self, shape: tuple[int, ...]) -> bool:
        if self.shape == ("...",):
            return True
        if len(shape) != len(self.shape):
            return False
        sizes = {word: int(word) for word in self.shape if word.isdecimal()}
        return all(
            n == sizes.setdefault(x, n) for x, n in zip(self.shape, shape, strict=True)
        )

    def _check_values(self, array: np.ndarray | jax.Array) -> None:
        values = np.asarray(array)
        # (A sum is a number where all of them are, and takes no memory. What is free is not read.)
        with np.errstate(all="ignore"):
            finite = (self.missing and self.infinite) or np.isfinite(np.sum(values))
        if not finite:
            bad = np.isnan(values) & (not self.missing) | np.isinf(values) & (
                not self.infinite
            )
            self._refuse_any(bad, values, "finite")
        if self.sign == "positive":
            self._refuse_any(values <= 0, values, "positive")
        elif self.sign == "nonnegative":
            self._refuse_any(values < 0, values, "zero or positive")

    def _refuse_any(
        self,
        bad: np.ndarray | np.bool_,
        values: np.ndarray,
        allowed: str,
    ) -> None:
        if not bad.any():
            return
        if values.ndim == 0:
            raise Misfit(f"must be {self.single}, not {show(values.item())}", near=True)
        index = tuple(map(int, np.argwhere(bad)[0]))
        place = index[0] if len(index) == 1 else index
        raise Misfit(
            f"must be {allowed}, but is {values[index]:.6g} at index {place}", near=True
        )

    def _written(self) -> str:
        comma = "," if len(self.shape) == 1 else ""
        return f"({', '.join(self.shape)}{comma})"


class Complexes(Reals):
    """An array of numbers, real or complex, as `Reals` otherwise."""

    single = "a finite number"
    items = "numbers"
    types = "cfiu"
    dtype = complex


class Integers(Reals):
    """An array of whole numbers, as `Reals` otherwise."""

    single = "an integer"
    items = "integers"
    types = "iu"
    dtype = int
