"""Sections one by one, and what else may stand for a family."""

from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, Scalar, SectionCount
from .._core.boundary.values import Reals
from .._core.precision import real
from ..engine.target import AbstractLevels
from ..errors import DefinitionError
from ..orbits.crossing import AtEvent, Crossing, ListLevels
from ..systems.structure import Structure
from .abstract import (
    AbstractSections,
    BoundSections,
    CyclePoint,
    as_anchor,
    check_anchor,
)


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


FamilyLike = AbstractSections | Crossing | AtEvent | Sequence[Crossing | AtEvent]
"""A family, a single section, or a list of sections."""


def as_family(sections: FamilyLike) -> AbstractSections:
    """A family from a family, a single section, or a list of sections."""
    if isinstance(sections, Crossing | AtEvent):
        return SectionList([sections])
    return sections if isinstance(sections, AbstractSections) else SectionList(sections)


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


@checked
class KinematicPhase(AbstractSections):
    """N equally spaced angles of (position - o_p) / s_p + i (velocity - o_v) / s_v (Sec. VI-B).

    The sections follow the sense in which the cycle turns: where the angle decreases in time,
    section i is at the angle of section 0 minus 2 pi i / N.

    The same definition gives the phase of a recording (`hj.recordings.estimate_phase`). At its
    sections the two signals are two sides of one number: as outputs they tell less than at those
    of a phase that goes from one `Crossing` to the next.

    **Fields:**

    - `n_sections`: the number N.
    - `position`, `velocity`: names of states, outputs or recorded signals.
    - `center` (o_p, o_v) and `scale` (s_p, s_v), in the units of the two. By default the origin
      and 1 on a model; the middle of each signal's range and half its width in a recording.
    - `anchor`: where section 0 lies: a `Crossing` on the cycle, or an angle in radians. At 0 the
      velocity is that of the center, and the position is beyond it.
    """

    label: ClassVar[str] = "kinematic"
    n_sections: int = eqx.field(static=True)
    position: str = eqx.field(static=True)
    velocity: str = eqx.field(static=True)
    center: Float[Array, "2"] | None
    scale: Float[Array, "2"] | None
    anchor: Crossing | Float[Array, ""]

    def __init__(
        self,
        n_sections: SectionCount,
        position: str,
        velocity: str,
        center: Annotated[Numbers, Reals("2")] | None = None,
        scale: Annotated[Numbers, Reals("2", sign="positive")] | None = None,
        anchor: Crossing | Scalar = 0.0,
    ):
        self.n_sections, self.position, self.velocity = n_sections, position, velocity
        self.center = None if center is None else real(center)
        self.scale = None if scale is None else real(scale)
        self.anchor = as_anchor(anchor)

    def check(self, s: Structure) -> None:
        s.resolve_outputs((self.position, self.velocity))
        check_anchor(self.anchor, s)

    def plane(
        self, s: Structure, a: int, t: Float[Array, ""], q: Float[Array, " n"]
    ) -> Float[Array, "2"]:
        """The coordinates (r_p, r_v) of one state of chart a in the scaled plane."""
        z = s.resolve_outputs((self.position, self.velocity))(a, t, q, jnp.zeros(s.nu))
        z = z if self.center is None else z - self.center
        return z if self.scale is None else z / self.scale

    def bind(self, s: Structure, point: CyclePoint) -> BoundSections:
        def angle_and_rate(a):
            def angle(t, q):
                position, velocity = self.plane(s, a, t, q[: s.dims[a]])
                return jnp.arctan2(velocity, position)

            velocity = jnp.where(jnp.arange(s.d) < s.dims[a], point.velocity, 0.0)
            return jax.jvp(angle, (point.t, point.q), (jnp.ones_like(point.t), velocity))

        charts = [lambda a=a: angle_and_rate(a) for a in range(len(s.charts))]
        angle, rate = jax.lax.switch(point.chart, charts)
        sense = jax.lax.stop_gradient(jnp.sign(rate))
        first = angle if isinstance(self.anchor, Crossing) else self.anchor
        steps = 2 * jnp.pi * jnp.arange(self.n_sections) / self.n_sections
        angles = first + sense * steps
        across = sense * jnp.stack([jnp.sin(angles), -jnp.cos(angles)])
        return BoundSections.at_levels(_AngleLevels(self, across), self.n_sections)

    def describe(self, i: int) -> str:
        return f"section {i} (kinematic phase {i}/{self.n_sections} after section 0)"


class _AngleLevels(AbstractLevels):
    phase: KinematicPhase
    across: Float[Array, "2 N"]
    """What multiplies (r_p, r_v) in the level: it falls in the sense in which the cycle turns."""

    def present(self, s, a):
        return s.resolve_outputs((self.phase.position, self.phase.velocity)).defined(a)

    def level(self, s, a, i, t, q):
        position, velocity = self.phase.plane(s, a, t, q)
        across = self.across[:, i]
        return jnp.where(i < 0, 1.0, across[0] * position + across[1] * velocity)
