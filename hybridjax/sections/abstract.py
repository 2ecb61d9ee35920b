"""What every family of Poincaré sections gives (paper Secs. III and VI-B)."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Scalar, SectionCount
from .._core.executor import Array, Definition
from .._core.precision import real

# Subclasses of `AbstractSections` meet these two, which other layers define.
from .._core.text import fields
from ..engine.target import AbstractLevels as AbstractLevels
from ..orbits.crossing import Crossing
from ..systems.structure import Structure as Structure


class CyclePoint(NamedTuple):
    """A point of a limit cycle: what a family is told of the cycle on which it is placed."""

    period: Float[Array, ""]
    chart: Int[Array, ""]
    t: Float[Array, ""]
    q: Float[Array, " d"]
    """Its state, padded with zeros to the largest chart's dimension."""
    velocity: Float[Array, " d"]
    """The chart's field there, padded likewise."""


@checked
class BoundSections(eqx.Module):
    """A family of N sections with its numbers filled in: section i ends a piece of flow at a time,
    at the zero of a level function, or at an event."""

    time: Float[Array, " N"]
    """Times of clock sections in one period; infinity for the others."""
    event: Int[Array, " N"]
    """Indices of the transitions of event sections; -1 for the others."""
    levels: AbstractLevels | None = None
    """The level functions of all other sections, if there are any."""

    @classmethod
    def at_times(cls, time: Float[Array, " N"]) -> "BoundSections":
        """Sections at times of the clock."""
        return cls(time, jnp.full(time.shape, -1, jnp.int32))

    @classmethod
    def at_levels(cls, levels: AbstractLevels, n_sections: SectionCount) -> "BoundSections":
        """Sections where level functions fall through zero."""
        never = jnp.full(n_sections, jnp.inf)
        return cls(never, jnp.full(n_sections, -1, jnp.int32), levels)


class AbstractSections(Definition):
    """A family of N Poincaré sections, in the order in which a limit cycle meets them.

    A family is a definition: it holds functions and numbers, and belongs to no cycle.
    `place_sections` finds out where its sections lie on one. To add a family, subclass this and
    give the fields and methods below; `ClockPhase` is the shortest example.

    **Fields of a subclass:**

    - `label`: what data taken at these sections are labeled with, a class variable.
    - `n_sections`: the number N.
    - `anchor`: where section 0 lies. A `Crossing`: at the point where the cycle crosses it, which
      `bind` is then given. Anything else is the family's own business.

    **Methods of a subclass:** `check`, `bind` and `describe`.
    """

    label: eqx.AbstractClassVar[str]
    n_sections: eqx.AbstractVar[int]
    anchor: eqx.AbstractVar[Crossing | Float[Array, ""] | None]

    @abc.abstractmethod
    def check(self, s: Structure) -> None:
        """**Raises:** `DefinitionError` if the family does not fit the system."""

    @abc.abstractmethod
    def bind(self, s: Structure, point: CyclePoint) -> BoundSections:
        """The sections on a cycle of which `point` is known: its anchor if `anchor` is a
        `Crossing`, any point otherwise. It is traced by JAX."""

    @abc.abstractmethod
    def describe(self, i: int) -> str:
        """Section i in a few words, for errors."""

    def __repr__(self):
        return fields(self)


def as_anchor(x: Crossing | Scalar) -> Crossing | Array:
    """A crossing as it is, a number as an array."""
    return x if isinstance(x, Crossing) else real(x)


def check_anchor(anchor: Crossing | Array | None, s: Structure) -> None:
    """**Raises:** `DefinitionError` for a crossing that the system does not have."""
    if isinstance(anchor, Crossing):
        anchor.check(s)
