"""Arrays of numbers with a shape."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .kind import Kind
from .misfit import Misfit, show


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
