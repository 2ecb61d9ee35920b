"""What is wrong with an argument, in words."""

from collections.abc import Callable
from typing import Any

import jax
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
