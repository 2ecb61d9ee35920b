"""Arguments made into arrays and names, with one clear sentence where that cannot be done."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from ..errors import DefinitionError
from .precision import require_x64
from .signal import Names, Signal
from .tracing import is_traced


Numbers = npt.ArrayLike | Sequence | int | float
"""What becomes an array: arrays, numbers, sequences of them. (numpy's `ArrayLike` leaves `int` and
`float` to the promotion of static type checkers, which checks at run time do not know.)"""


def real_array(name: str, value: Any, ndim: int) -> jax.Array:
    """`value` as a real floating-point array with `ndim` axes.

    **Raises:** `DefinitionError` if it is ragged, complex, not a number, or has other axes;
    `PrecisionError` in single precision.
    """
    require_x64()
    if not isinstance(value, jax.Array):
        try:
            value = np.asarray(value)
        except ValueError as error:
            raise DefinitionError(f"`{name}` is not a rectangular array: {error}.") from error
    if value.dtype == bool or not np.issubdtype(value.dtype, np.number):
        raise DefinitionError(f"`{name}` must hold real numbers, not {value.dtype}.")
    if np.issubdtype(value.dtype, np.complexfloating):
        raise DefinitionError(f"`{name}` must be real, but is {value.dtype}.")
    if value.ndim != ndim:
        raise DefinitionError(f"`{name}` must have {ndim} axes, but its shape is {value.shape}.")
    dtype = value.dtype if np.issubdtype(value.dtype, np.floating) else float
    return jnp.asarray(value, dtype)


def require_finite(name: str, value: jax.Array) -> None:
    """Refuse NaN and infinity; does nothing while traced."""
    if is_traced(value):
        return
    bad = np.argwhere(~np.isfinite(np.asarray(value)))
    if len(bad):
        raise DefinitionError(f"`{name}` is not finite at index {tuple(map(int, bad[0]))}.")


def names(kind: str, given: Names | None, count: int) -> tuple[str, ...]:
    """`count` distinct names, with units where these are given; by default `u` or `y` for one,
    `u0, u1, ...` for several.

    **Raises:** `DefinitionError` if `given` has another length or repeats a name.
    """
    if given is None:
        letter = {"inputs": "u", "outputs": "y"}[kind]
        return (letter,) if count == 1 else tuple(f"{letter}{i}" for i in range(count))
    if isinstance(given, Mapping):
        given = tuple(Signal(name, unit) for name, unit in given.items())
    given = (given,) if isinstance(given, str) else tuple(given)
    if len(given) != count:
        raise DefinitionError(f"{count} {kind} need {count} names, but `{kind}` is {given}.")
    if len(set(given)) != count:
        raise DefinitionError(f"`{kind}` repeats a name: {given}.")
    return given
