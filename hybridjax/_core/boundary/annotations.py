"""From annotations to kinds."""

import collections.abc
import types
import typing
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np

from .arrays import Complexes, Integers, Reals
from .containers import (
    Either,
    Function,
    Having,
    Instance,
    Items,
    Subclass,
    Table,
    Tuple,
)
from .kind import Kind
from .scalars import ComplexNumber, Nothing, Number, OneOf, Switch, Text, Whole


_PLAIN = {
    bool: Switch(),
    int: Whole(),
    float: Number(),
    complex: ComplexNumber(),
    str: Text(),
    type(None): Nothing(),
    typing.SupportsIndex: Whole(),
}
_SEQUENCES = {
    list: {"form": list},
    collections.abc.Sequence: {},
    collections.abc.Iterable: {"iterable": True},
    collections.abc.Collection: {"iterable": True},
}
_MAPPINGS = {dict, collections.abc.Mapping}
_ARRAYS = {"complex128": Complexes, "float64": Reals, "int64": Integers}


def kind_of(hint: Any) -> Kind | None:
    """What a parameter with this annotation may be; None for anything.

    **Raises:** `TypeError` for an annotation that has no kind.
    """
    if hint is Any or hint is object:
        return None
    if hint in _PLAIN:
        return _PLAIN[hint]
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        own = [x for x in hint.__metadata__ if isinstance(x, Kind)]
        return own[-1] if own else kind_of(arguments[0])
    if origin is Literal:
        return OneOf(*arguments)
    if origin in (Union, types.UnionType):
        return _either(arguments)
    if hint is collections.abc.Callable or origin is collections.abc.Callable:
        return Function()
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return Items(kind_of(arguments[0]), form=tuple)
        return Tuple(*map(kind_of, arguments))
    container = hint if origin is None else origin
    if container in _SEQUENCES:
        return Items(kind_of(arguments[0]) if arguments else None, **_SEQUENCES[container])
    if container in _MAPPINGS:
        return Table(*map(kind_of, arguments)) if arguments else Table(None, None)
    if origin is type:
        return Subclass(arguments[0])
    if isinstance(hint, TypeVar):
        return None if hint.__bound__ is None else kind_of(hint.__bound__)
    if isinstance(container, type):
        return _of_class(container)
    raise TypeError(f"there is no kind for the annotation {hint}.")


def _either(arguments: tuple[Any, ...]) -> Kind | None:
    kinds = [kind_of(x) for x in arguments]
    arrays = [kind for kind in kinds if isinstance(kind, Reals)]
    if (
        len(arrays) > 1 and arrays[0].form is not None
    ):  # of NumPy or of JAX: they stay what they are
        arrays[0].form = None
        kinds = [kind for kind in kinds if kind not in arrays[1:]]
    if len(kinds) == 1:
        return kinds[0]
    if None in kinds:
        return None
    return Either(*sorted(kinds, key=lambda kind: isinstance(kind, Nothing)))


def _of_class(cls: type) -> Kind:
    if issubclass(cls, jaxtyping.AbstractArray):
        return _array(cls)
    if cls.__module__.startswith("numpy._typing"):
        raise TypeError("an array is annotated as `Annotated[Numbers, Reals(shape)]`.")
    if getattr(cls, "_is_protocol", False):
        return Having(cls)
    return Instance(cls)


def _array(hint: Any) -> Kind:
    """Of jaxtyping's annotation: NaN and infinity are left to those who declare more."""
    kind = next((kind for dtype, kind in _ARRAYS.items() if dtype in hint.dtypes), None)
    if kind is None:
        return Instance(hint)
    form = {np.ndarray: np.asarray, jax.Array: jnp.asarray}.get(hint.array_type)
    return kind(hint.dim_str, missing=True, infinite=True, form=form)
