"""Sections at equally spaced angles in a plane of two signals."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.executor import as_numbers
from ..engine.target import AbstractLevels
from ..systems.structure import Structure
from .abstract import (
    AbstractSections,
    BoundSections,
    CyclePoint,
    as_anchor,
    check_anchor,
    check_n_sections,
)
from .crossing import Crossing


def _pair(x: ArrayLike | Sequence[ArrayLike] | None) -> Array | None:
    return None if x is None else as_numbers(x)


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
    center: Float[Array, "2"] | None = eqx.field(converter=_pair, default=None)
    scale: Float[Array, "2"] | None = eqx.field(converter=_pair, default=None)
    anchor: Crossing | Float[Array, ""] = eqx.field(converter=as_anchor, default=0.0)

    def __check_init__(self):
        check_n_sections(self.n_sections)

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
