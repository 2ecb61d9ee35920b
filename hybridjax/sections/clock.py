"""Sections at equally spaced times of the clock."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Scalar, SectionCount
from ..systems.structure import Structure
from .abstract import (
    AbstractSections,
    BoundSections,
    CyclePoint,
    as_anchor,
    check_anchor,
)
from .crossing import Crossing


@checked
class ClockPhase(AbstractSections):
    """N equally spaced phases of time: the isochrons of a clocked system (paper Sec. VI-B).

    On an autonomous cycle these are equal steps of time from section 0; time has no natural
    origin there, so one multiplier is 1.

    **Fields:** `n_sections`, the number N; `anchor`, where section 0 lies: a `Crossing` on the
    cycle, or a phase of the clock in periods.
    """

    label: ClassVar[str] = "isochron"
    n_sections: int = eqx.field(static=True)
    anchor: Crossing | Float[Array, ""]

    def __init__(self, n_sections: SectionCount, anchor: Crossing | Scalar = 0.0):
        self.n_sections, self.anchor = n_sections, as_anchor(anchor)

    def check(self, s: Structure) -> None:
        check_anchor(self.anchor, s)

    def bind(self, s: Structure, point: CyclePoint) -> BoundSections:
        first = point.t if isinstance(self.anchor, Crossing) else self.anchor * point.period
        return BoundSections.at_times(
            first + jnp.arange(self.n_sections) * (point.period / self.n_sections)
        )

    def describe(self, i: int) -> str:
        return f"section {i} (clock phase {i}/{self.n_sections} after section 0)"
