"""Sections one by one, and what else may stand for a family."""

from collections.abc import Iterable, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp

from .._core.boundary.checked import checked
from ..engine.target import AbstractLevels
from ..errors import DefinitionError
from ..systems.structure import Structure
from .abstract import AbstractSections, BoundSections, CyclePoint
from .crossing import AtEvent, Crossing


@checked
class SectionList(AbstractSections):
    """Sections one by one, in the order in which the cycle meets them.

    **Fields:** `items`: a list of `Crossing` and `AtEvent`.
    """

    label: ClassVar[str] = "sections"
    items: tuple[Crossing | AtEvent, ...]

    def __init__(self, items: Iterable[Crossing | AtEvent]):
        """**Raises:** `DefinitionError` for an empty list."""
        self.items = tuple(items)
        if not self.items:
            raise DefinitionError(
                "a list of sections needs at least one Crossing or AtEvent, but `items` is empty."
            )

    @property
    def n_sections(self) -> int:
        return len(self.items)

    @property
    def anchor(self) -> None:
        return None

    def check(self, s: Structure) -> None:
        for item in self.items:
            item.check(s)

    def bind(self, s: Structure, point: CyclePoint) -> BoundSections:
        event = [s.transition_index(x.name) if isinstance(x, AtEvent) else -1 for x in self.items]
        some = any(isinstance(x, Crossing) for x in self.items)
        never = jnp.full(self.n_sections, jnp.inf)
        levels = ListLevels(self.items) if some else None
        return BoundSections(never, jnp.array(event, jnp.int32), levels)

    def describe(self, i: int) -> str:
        return f"section {i} ({self.items[i]})"


class ListLevels(AbstractLevels):
    """The level functions of the crossings among some sections."""

    items: tuple[Crossing | AtEvent, ...]

    def present(self, s, a):
        return any(isinstance(x, Crossing) and x.in_chart(s, a) for x in self.items)

    def level(self, s, a, i, t, q):
        def branch(item):
            if isinstance(item, Crossing) and item.in_chart(s, a):
                return lambda: item.level(s, a, t, q)
            return lambda: jnp.ones(())

        branches = [lambda: jnp.ones(()), *(branch(x) for x in self.items)]
        return jax.lax.switch(i + 1, branches)


FamilyLike = AbstractSections | Crossing | AtEvent | Sequence[Crossing | AtEvent]
"""A family, a single section, or a list of sections."""


def as_family(sections: FamilyLike) -> AbstractSections:
    """A family from a family, a single section, or a list of sections."""
    if isinstance(sections, Crossing | AtEvent):
        return SectionList([sections])
    return sections if isinstance(sections, AbstractSections) else SectionList(sections)
