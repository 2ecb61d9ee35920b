"""Sections at equally spaced angles in a plane of two signals."""

from typing import Annotated, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.arrays import Reals
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, Scalar, SectionCount
from ..engine.target import AbstractLevels
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
        self.center = None if center is None else jnp.asarray(center, float)
        self.scale = None if scale is None else jnp.asarray(scale, float)
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
