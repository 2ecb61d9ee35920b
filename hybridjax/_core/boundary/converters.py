"""Converters for numbers in fields of definitions: arrays, which JAX may trace and differentiate.

The annotation of a converter is what the constructor of its class takes (equinox shows it in the
signature), and is checked there.
"""

from typing import Annotated

from jaxtyping import Array, Float

from ..arguments import Numbers
from ..precision import real
from .arrays import Reals
from .kinds import PositiveScalar, Scalar, Vector


def number(x: Scalar) -> Float[Array, ""]:
    return real(x)


def positive(x: PositiveScalar) -> Float[Array, ""]:
    return real(x)


def vector(x: Vector) -> Float[Array, " n"]:
    return real(x)


def pair(x: Annotated[Numbers, Reals("2")] | None) -> Float[Array, "2"] | None:
    return None if x is None else real(x)


def positive_pair(
    x: Annotated[Numbers, Reals("2", sign="positive")] | None,
) -> Float[Array, "2"] | None:
    return None if x is None else real(x)


def sizes(x: Annotated[Numbers, Reals("A d", sign="nonnegative")] | None) -> Array | None:
    return None if x is None else real(x)
