"""The words with which public signatures say what they take, beside plain types and `Literal`.

Static type checkers see the plain type in each. A kind that only one function needs is written in
its signature: `Annotated[float, Number("a number above 1", above=1)]`, `Annotated[Numbers, Reals("N
d")]`. A kind for several functions is one more name here. The bounds are those of `limits.py`.

`kind_of` turns an annotation into its kind. If an argument is not checked as its annotation says,
look there; if a value is refused wrongly, at the kind itself (`values.py`, `containers.py`).
"""

import collections.abc
import os
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np

from .. import limits
from ..arguments import Numbers
from ..jax_compat import is_numpy_annotation
from . import values
from .containers import Either, Having, Instance, Items, Names, Table, Tuple
from .values import Complexes, Integers, Kind, Number, OneOf, Reals, Switch, Whole


# Whole numbers.
Count = Annotated[int, Whole(1, limits.COUNT)]
Index = Annotated[int, Whole(0, limits.COUNT)]
"""Also numbers that may be zero: samples to discard, lags of a lead."""
SectionCount = Annotated[int, Whole(1, limits.SECTIONS)]
PeriodCount = Annotated[int, Whole(1, limits.PERIODS)]
ExperimentCount = Annotated[int, Whole(1, limits.PERIODS)]
Order = Annotated[int, Whole(1, limits.ORDER)]
StepCount = Annotated[int, Whole(1, limits.COUNT)]
WorkerCount = Annotated[int, Whole(1, limits.ORDER)]
Seed = Annotated[int, Whole(0)]

# Real numbers that have to be known. (`float` alone: any finite one.)
Positive = Annotated[float, Number("a positive number", above=0)]
NonNegative = Annotated[float, Number("a number that is not negative", low=0)]
Probability = Annotated[float, Number("a number between 0 and 1", above=0, below=1)]
Share = Annotated[float, Number("a number above 0, at most 1", above=0, high=1)]
Fraction = Annotated[float, Number("a number from 0 to 1", low=0, high=1)]

# The same, where one has an array of JAX at hand as often as a `float`.
Duration = Annotated[Numbers, Number("a positive number", above=0)]
Wait = Annotated[Numbers, Number("a number that is not negative", low=0)]

# Numbers that JAX may trace.
Scalar = Annotated[Numbers, Reals("")]
PositiveScalar = Annotated[Numbers, Reals("", sign="positive")]
Vector = Annotated[Numbers, Reals("n")]

# Words.
SignalNames = Annotated[str | Sequence[str], Names()]
"""One name, or several distinct ones; handed on as a tuple."""
OptionalNames = Annotated[str | Sequence[str], Names(empty=True)]
"""The same, or none: `()`."""
NewOptionalNames = Annotated[
    str | Sequence[str] | Mapping[str, str], Names(units=True, empty=True)
]
NewNames = Annotated[str | Sequence[str] | Mapping[str, str], Names(units=True)]
"""Names that are given to something; or units by name, as in `{"yM": "m", "force": "N"}`."""
FilePath = Annotated[str | os.PathLike[str], values.PATH]


_PLAIN = {
    bool: Switch(),
    int: Whole(),
    float: Number(),
    complex: Number(),  # (in jaxtyping's `ArrayLike`; no number of this package is complex)
    str: values.TEXT,
    type(None): values.NOTHING,
    typing.SupportsIndex: Whole(),
}
_SEQUENCES: dict[Any, dict[str, Any]] = {
    list: {"form": list},
    tuple: {"form": tuple},
    collections.abc.Sequence: {},
    collections.abc.Iterable: {"iterable": True},
    collections.abc.Collection: {"iterable": True},
}
_MAPPINGS = {dict, collections.abc.Mapping}
_ARRAYS = {"complex128": Complexes, "float64": Reals, "int64": Integers}


def kind_of(hint: Any) -> Kind | None:
    """Return the kind of a parameter with this annotation; None if it may be anything.

    **Raises:** `TypeError` for an annotation that has no kind.
    """
    if hint is Any or hint is object:
        return None
    if hint in _PLAIN:
        return _PLAIN[hint]
    arguments = get_args(hint)
    origin = get_origin(hint) or hint
    if origin is Annotated:
        declared = [x for x in hint.__metadata__ if isinstance(x, Kind)]
        return declared[-1] if declared else kind_of(arguments[0])
    if origin is Literal:
        return OneOf(*arguments)
    if origin in (Union, types.UnionType):
        return _either(arguments)
    if origin is collections.abc.Callable:
        return values.FUNCTION
    if origin in _SEQUENCES:
        return _sequence(origin, arguments)
    if origin in _MAPPINGS:
        return Table(*map(kind_of, arguments or (Any, Any)))
    if isinstance(origin, type):
        return _of_class(origin)
    raise TypeError(f"there is no kind for the annotation {hint}.")


def _sequence(origin: Any, arguments: tuple[Any, ...]) -> Kind:
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        return Tuple(*map(kind_of, arguments))
    item = kind_of(arguments[0]) if arguments else None
    return Items(item, **_SEQUENCES[origin])


def _either(arguments: tuple[Any, ...]) -> Kind | None:
    kinds = [kind_of(x) for x in arguments]
    arrays = [kind for kind in kinds if isinstance(kind, Reals)]
    if len(arrays) > 1 and arrays[0].form is not None:
        # (Arrays of NumPy or of JAX stay what they are.)
        arrays[0].form = None
        kinds = [kind for kind in kinds if kind not in arrays[1:]]
    if len(kinds) == 1:
        return kinds[0]
    narrow = [kind for kind in kinds if kind is not None]
    if len(narrow) < len(kinds):
        return None
    return Either(*sorted(narrow, key=lambda kind: kind is values.NOTHING))


def _of_class(cls: type) -> Kind:
    if issubclass(cls, jaxtyping.AbstractArray):
        return _array(cls)
    if is_numpy_annotation(cls):
        raise TypeError("an array is annotated as `Annotated[Numbers, Reals(shape)]`.")
    return Having(cls) if getattr(cls, "_is_protocol", False) else Instance(cls)


def _array(hint: Any) -> Kind:
    """Return the kind of a jaxtyping annotation, which allows NaN and infinity."""
    kind = next((kind for dtype, kind in _ARRAYS.items() if dtype in hint.dtypes), None)
    if kind is None:
        return Instance(hint)
    forms: dict[Any, collections.abc.Callable] = {
        np.ndarray: np.asarray,
        jax.Array: jnp.asarray,
    }
    return kind(
        hint.dim_str, missing=True, infinite=True, form=forms.get(hint.array_type)
    )
