"""The interface of a family of Poincaré sections (paper Secs. III and VI-B)."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import SectionCount
from .._core.executor import Array, Definition
from .._core.text import fields
from ..engine.target import AbstractLevels as AbstractLevels
from ..orbits.crossing import Crossing
from ..systems.structure import Structure


class Orbit(NamedTuple):
    """A limit cycle at M equal times in one period from its anchor, row 0."""

    period: Float[Array, ""]
    t: Float[Array, " M"]
    chart: Int[Array, " M"]
    q: Float[Array, "M d"]
    """States, padded with zeros to the largest chart's dimension."""
    velocity: Float[Array, "M d"]
    """The chart's field there, padded likewise."""


@checked
class BoundSections(eqx.Module):
    """A family of N sections, evaluated on a cycle: section i ends a piece of flow at a time, at
    the zero of a level function, or at an event."""

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
        """Sections at which level functions fall through zero."""
        never = jnp.full(n_sections, jnp.inf)
        return cls(never, jnp.full(n_sections, -1, jnp.int32), levels)


class AbstractSections(Definition):
    """A family of N Poincaré sections, in the order in which a limit cycle crosses them.

    A family is a definition: it holds functions and numbers, and belongs to no cycle.
    `place_sections` locates its sections on a cycle. To add a family, subclass this and define the
    fields and methods below; `ClockPhase` is the shortest example, and `ArcLength` one that
    depends on the whole orbit.

    **Fields of a subclass:**

    - `label`: the label of data taken at these sections, a class variable.
    - `n_sections`: the number N.
    - `anchor`: the position of section 0. A `Crossing`: the point where the cycle crosses it, which
      is then the first point of the `orbit`. Other values are used by `bind` only.
    - `points`: the number M of points of the orbit that `bind` needs, a class variable. Default: 1.

    **Methods of a subclass:**

    - `check(structure)` raises `DefinitionError` if the family does not fit the system.
    - `bind(structure, orbit)` returns `BoundSections`. The orbit has the fields `period`, `t` (M,),
      `chart` (M,), `q` (M, d) and `velocity` (M, d), at M equal times in one period from the
      anchor, or from any point of the cycle if `anchor` is no `Crossing`. JAX traces this method.
    - `describe(i)` returns a name of section i for errors.
    """

    label: eqx.AbstractClassVar[str]
    points: ClassVar[int] = 1
    n_sections: eqx.AbstractVar[int]
    anchor: eqx.AbstractVar[Crossing | Float[Array, ""] | None]

    @abc.abstractmethod
    def check(self, s: Structure) -> None:
        """**Raises:** `DefinitionError` if the family does not fit the system."""

    @abc.abstractmethod
    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        """The sections on a cycle."""

    @abc.abstractmethod
    def describe(self, i: int) -> str:
        """A name of section i for errors."""

    def __repr__(self):
        return fields(self)
