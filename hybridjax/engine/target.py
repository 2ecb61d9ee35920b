"""Where a piece of flow ends: at a time, at the zero of a level function, or at an event.

Callers of `move` make a `Target` (mostly by `toward` or `until`), with one entry for each lane (a
trajectory of many side by side). The search reads it. `AbstractLevels` is the interface of sections
whose position depends on the state; `sections/` and `orbits/crossing.py` implement it.

Levels must fall through zero at their section, as guards do at their event. The fields that are
`static` are a part of the compiled program: another value compiles it again. A section that is
never reached has its cause in the sign of its `level`, or in `present`; a lane that gives up too
early has it in `limit`. A new kind of end is a field of `Target`; it is tested in
`search/outcome.py`, and if times depend on it, replayed in `replay.py`.
"""

import abc
import dataclasses

import equinox as eqx
from jaxtyping import Float, Int

from .._core.executor import Definition, namespace, stop_gradient
from .._core.lanes import PerLane
from .._core.results import Result
from ..systems.structure import Structure
from .arrays import Array


class AbstractLevels(Definition):
    """The level functions of state-based sections: section i lies where its level falls through
    zero."""

    @abc.abstractmethod
    def present(self, s: Structure, a: int) -> bool:
        """Test whether any of the sections can be crossed in chart a."""

    @abc.abstractmethod
    def level(
        self,
        s: Structure,
        a: int,
        i: Int[Array, ""],
        t: Float[Array, ""],
        q: Float[Array, " n"],
    ) -> Float[Array, ""]:
        """Level of section i at a single state of chart a; it falls through zero at the section.

        1 for a section that cannot be crossed in chart a.
        """


class Target(eqx.Module):
    """The ends of a piece of flow, one per lane. Section and event may be arrays with a single
    entry, which then holds for all lanes."""

    time: Float[Array, " L"]
    """End at this time; infinity if the end is not at a known time."""
    index: Int[Array, " #L"]
    """End at the section of this index, if `levels` is given."""
    event: Int[Array, " #L"]
    """End right after the transition of this index; -1 for none."""
    limit: Float[Array, " L"]
    """Give up at this time."""
    event_sequence: tuple[int, ...] | None = eqx.field(static=True)
    """Transitions on one period of the limit cycle, from the first event after the start on; `None`
    if any order will do."""
    levels: AbstractLevels | PerLane | None
    missed: Result = eqx.field(static=True)
    """The code of a lane that does not arrive."""
    count: Int[Array, " #L"] | None = None
    """End right after so many events; None for no such end."""

    def split(self) -> tuple["Target", AbstractLevels | PerLane | None]:
        """Split into the fields with one entry for each lane, and the level functions, which all
        lanes share."""
        return dataclasses.replace(self, levels=None), self.levels

    def with_levels(self, levels: AbstractLevels | PerLane | None) -> "Target":
        return dataclasses.replace(self, levels=levels)


def toward(time: Float[Array, " L"], event: int, limit: Float[Array, "..."]) -> Target:
    """The target of lanes that end at times, or where `time` is infinite, at an event (or at a
    level that is filled in later), giving up at `limit`. (Where the time is known, the limit lies
    just after it: a lane that is there, and has passed a scheduled event first, has not failed.)"""
    xp = namespace(time)
    shape = time.shape
    later = xp.nextafter(stop_gradient(time), xp.inf)
    return Target(
        time=time,
        index=xp.zeros(shape, xp.int32),
        event=xp.full(shape, event, xp.int32),
        limit=xp.where(xp.isfinite(time), later, limit),
        event_sequence=None,
        levels=None,
        missed=Result.SECTION_MISSED,
    )


def until(time: Float[Array, " L"]) -> Target:
    """The target of lanes that flow to given times."""
    return toward(time, -1, time)
