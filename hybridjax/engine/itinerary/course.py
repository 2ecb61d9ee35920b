"""What follows an itinerary (`Travelers`), where it is now (`Course`), and what it needs on the way
(`Constants`).

Charts may have different numbers of states: a `Course` has d numbers, the largest of them. Those
that a chart does not use are zero; each stage that sets a state keeps them so (`padded_like`).

A new field of `Course` also gets its value at the start, in `_departed` of `turn.py`. All numbers
of a `Course` have derivatives; numbers without derivatives belong in `Flags`. Nothing is computed
here: a wrong number was set by a stage in `bodies.py`, and a wrong end of a leg by `_arrived` or
`_schedule` there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from ...systems.structure import Structure
from ..arrays import Array
from ..settings import Settings
from ..target import AbstractLevels
from .table import Table


class Course(NamedTuple):
    """A trajectory on its way, with C columns; the state is padded to d numbers."""

    t: Float[Array, ""]
    y: Float[Array, "1+C d"]
    """The state, then its columns."""
    begin: Float[Array, ""]
    """Time at which the present leg began."""
    delay: Float[Array, " C"]
    """Columns of the time of the last event, or of the arrival on a section."""
    ends: Float[Array, " E"]
    """Ends of legs: as guessed, and as found once they are past."""
    rate: Float[Array, " d"]
    """The field where the present row begins."""
    value: Float[Array, ""]
    """Value there of the watched function that the row brings to zero, if it brings one."""
    slope: Float[Array, ""]
    """Rate of this function along the flow."""
    h: Float[Array, ""]
    """The time that the row takes."""

    def state(self, s: Structure, a: int) -> Float[Array, " n"]:
        """The state without padding, in chart a."""
        return self.y[0, : s.dims[a]]


class Travelers(NamedTuple):
    """Whose trajectories follow an itinerary: one system, or many in lanes.

    Lanes stand on the first axis of arrays. Only what a row does is vectorized over them: JAX takes
    many times as long to vectorize the loop over the rows.
    """

    of: Callable[[Any], Structure]
    """The structure by its numbers."""
    numbers: Any
    """Of one system, or of all lanes."""
    many: bool
    structure: Structure
    """With any numbers: those that it needs for nothing else."""

    def each(self, function: Callable) -> Callable:
        """A function of the numbers and further arrays of one lane, for all."""
        return jax.vmap(function) if self.many else function


class Constants(NamedTuple):
    """Numbers that all rows use; see `follow`."""

    numbers: Any
    levels: AbstractLevels | None
    settings: Settings
    rows: Table
    count: Int[Array, ""] | None  # type: ignore[assignment]  # (not the method of tuples)
    begin: tuple
    known: Float[Array, " E"] | None


def padded_like(
    x: Float[Array, "*C n"], like: Float[Array, "*C d"]
) -> Float[Array, "*C d"]:
    """`x` with zeros for numbers that a chart does not use."""
    more = like.shape[-1] - x.shape[-1]
    kept = [(0, 0)] * (x.ndim - 1)
    return jnp.pad(x, kept + [(0, more)]) if more else x
