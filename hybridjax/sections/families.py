"""Families of Poincaré sections: the interface (`AbstractSections`), and sections at equal times,
arc lengths or angles, or given one by one.

A family is a definition and belongs to no cycle. `place_sections` (`place.py`) calls its method
`bind` with points of a limit cycle (`Orbit`), and gets `BoundSections`: where each section ends a
piece of flow. A new kind of family is added here, as a subclass.

If sections lie at wrong phases, look at `bind` of the family, and at `_first` (the anchor); if an
angle is wrong, at `_AngleLevels.level` and `KinematicPhase._scaled`. If the times or levels that
`bind` returns are right, and the cycle meets the sections elsewhere, look at `locate.py`.
"""

import abc
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from .._core.arguments import require_among, require_axes
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, Scalar, SectionCount, SignalNames
from .._core.boundary.values import Reals
from .._core.executor import Array, Definition
from .._core.precision import real
from .._core.text import fields
from ..engine.target import AbstractLevels as AbstractLevels
from ..errors import DefinitionError
from ..orbits.crossing import (
    AtEvent,
    Crossing,
    ListLevels,
    SectionLike,
    as_section,
)
from ..systems.structure import Outputs, Structure


class Orbit(NamedTuple):
    """A limit cycle at M equal times in one period from its anchor, row 0."""

    period: Float[Array, ""]
    t: Float[Array, " M"]
    chart: Int[Array, " M"]
    q: Float[Array, "M d"]
    """States, padded with zeros to the largest chart's dimension."""


@checked
class BoundSections(eqx.Module):
    """A family of N sections, evaluated on a cycle: section i ends a piece of flow at a time, at
    the zero of a level function, or at an event."""

    time: Float[Array, " N"]
    """Times of clock sections in one period; infinity for other sections."""
    event: Int[Array, " N"]
    """Indices of the transitions of event sections; -1 for other sections."""
    levels: AbstractLevels | None = None
    """The level functions of all other sections, if there are any."""

    @classmethod
    def at_times(cls, time: Float[Array, " N"]) -> "BoundSections":
        """Sections at times of the clock."""
        return cls(time, jnp.full(time.shape, -1, jnp.int32))

    @classmethod
    def at_levels(
        cls, levels: AbstractLevels, n_sections: SectionCount
    ) -> "BoundSections":
        """Sections at which level functions fall through zero."""
        return cls(
            jnp.full(n_sections, jnp.inf), jnp.full(n_sections, -1, jnp.int32), levels
        )


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
      is the first point of the `orbit`. Values of other types are interpreted by `bind`.
    - `points`: the number M of points of the orbit that `bind` needs, a class variable. Default: 1.
    - `at_anchor`: whether section 0 lies at an anchor that is a `Crossing`, a class variable.
      Default: True.

    **Methods of a subclass:**

    - `check(structure)` raises `DefinitionError` if the family does not fit the system.
    - `bind(structure, orbit)` returns `BoundSections`. The orbit has the fields `period`, `t` (M,),
      `chart` (M,) and `q` (M, d). Its M points are at equal times in one period, and begin at the
      anchor. If `anchor` is no `Crossing`, they begin at any point of the cycle. JAX traces this
      method.
    - `describe(i)` returns a name of section i for errors.
    """

    label: eqx.AbstractClassVar[str]
    points: ClassVar[int] = 1
    at_anchor: ClassVar[bool] = True
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

    __repr__ = fields


class _Anchored(AbstractSections):
    """N sections, the first of which lies at an anchor."""

    n_sections: eqx.AbstractVar[int]
    anchor: eqx.AbstractVar[Crossing | Float[Array, ""]]

    def check(self, s: Structure) -> None:
        if isinstance(self.anchor, Crossing):
            self.anchor.check(s)

    def _first(self, at_crossing: Array, unit: Array | float = 1.0) -> Array:
        """The phase of section 0. If the anchor is a crossing, it is `at_crossing`, the phase of
        the orbit's first point; otherwise it is the anchor, times `unit`."""
        return at_crossing if isinstance(self.anchor, Crossing) else self.anchor * unit

    def describe(self, i: int) -> str:
        return self._describe(i, self.label)

    def _describe(self, i: int, kind: str) -> str:
        """The name of section i, with its distance from section 0 in a kind of phase."""
        if i == 0:
            return "section 0"
        return f"section {i} ({kind} phase {i}/{self.n_sections} after section 0)"


def _as_anchor(x: Crossing | Scalar) -> Crossing | Array:
    return x if isinstance(x, Crossing) else real(x)


@checked
class ClockPhase(_Anchored):
    """N equally spaced phases of time: the isochrons of a clocked system (paper Sec. VI-B).

    On an autonomous cycle these are equal steps of time from section 0. An autonomous system does
    not restore its phase, so that one multiplier is 1.

    **Fields:** `n_sections`, the number N; `anchor`, the position of section 0: a `Crossing` on the
    cycle, or a time of the clock in periods of the cycle. Default: 0.

    **Example:**

    ```python
    sections = hj.ClockPhase(8, anchor=apex)
    print(hj.sections.place_sections(cycle, sections).duration)
    ```

    **Before:** `hj.Crossing`. **After:** `hj.linearize`, `hj.run_experiments`.
    """

    label: ClassVar[str] = "isochron"
    n_sections: int = eqx.field(static=True)
    anchor: Crossing | Float[Array, ""]

    def __init__(self, n_sections: SectionCount, anchor: Crossing | Scalar = 0.0):
        self.n_sections = n_sections
        self.anchor = _as_anchor(anchor)

    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        first = self._first(orbit.t[0], orbit.period)
        steps = jnp.arange(self.n_sections) * (orbit.period / self.n_sections)
        return BoundSections.at_times(first + steps)

    def describe(self, i: int) -> str:
        return self._describe(i, "clock")


@checked
class ArcLength(_Anchored):
    """N sections at times that cut the orbit into N pieces of equal arc length.

    The arc length is that of the curve of some signals on the limit cycle, without the jumps of
    events, by the trapezoidal rule at 128 times. Where the signals move fast, sections are dense in
    time. As for a `ClockPhase`, an autonomous cycle has a multiplier of 1.

    **Fields:**

    - `n_sections`: the number N.
    - `signals`: names of states or outputs that every chart defines.
    - `scale`: one positive number for each signal, in its unit; lengths are of the signals divided
      by them. Default: 1.
    - `anchor`: a `Crossing` on the cycle at which section 0 lies.

    **Example:**

    ```python
    pieces = hj.sections.ArcLength(8, ("yM", "vM"), apex, scale=(0.3, 1.9))
    print(hj.sections.place_sections(cycle, pieces).duration)
    ```

    **Before:** `hj.Crossing`. **After:** `hj.linearize`, `hj.run_experiments`.
    """

    label: ClassVar[str] = "arc length"
    points: ClassVar[int] = 128
    n_sections: int = eqx.field(static=True)
    signals: tuple[str, ...] = eqx.field(static=True)
    anchor: Crossing
    scale: Float[Array, " n"]

    def __init__(
        self,
        n_sections: SectionCount,
        signals: SignalNames,
        anchor: Crossing,
        scale: Annotated[Numbers, Reals("n", sign="positive")] | None = None,
    ):
        self.n_sections = n_sections
        self.signals = tuple(signals)
        self.anchor = anchor
        ones = [1.0] * len(self.signals)
        self.scale = real(ones if scale is None else scale)
        require_axes("`scale`", self.scale, {"signals": len(self.signals)})

    def check(self, s: Structure) -> None:
        super().check(s)
        s.resolve_outputs(self.signals).require(*range(len(s.charts)))

    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        signals = s.resolve_outputs(self.signals)
        along = jax.vmap(lambda *point: _along(s, signals, *point)[1])
        rates = along(*orbit[1:])
        speed = jnp.linalg.norm(rates / self.scale, axis=1)
        mean_speed = (speed + jnp.roll(speed, -1)) / 2
        length = jnp.cumsum(jnp.append(0.0, mean_speed))
        share = jnp.linspace(0.0, 1.0, self.points + 1)
        times = orbit.t[0] + orbit.period * share
        equal = length[-1] * jnp.arange(self.n_sections) / self.n_sections
        return BoundSections.at_times(jnp.interp(equal, length, times))


@checked
class KinematicPhase(_Anchored):
    """N equally spaced angles of (position - o_p) / s_p + i (velocity - o_v) / s_v (Sec. VI-B).

    The sections follow the sense in which the cycle turns: if the angle decreases in time, section
    i is at the angle of section 0 minus 2 pi i / N.

    The same definition gives the phase of a recording (`hj.recordings.estimate_phase`). On a
    section, which is one angle, the velocity follows from the position. As outputs, the two
    therefore contain less information than at sections of a phase that is defined by a `Crossing`.

    **Fields:**

    - `n_sections`: the number N.
    - `position`, `velocity`: names of states, outputs or recorded signals.
    - `center` (o_p, o_v) and `scale` (s_p, s_v), in the units of the two. Default: the origin and 1
      on a model; the middle of each signal's range and half its width in a recording.
    - `anchor`: the position of section 0: a `Crossing` on the cycle, or an angle in radians. At
      angle 0 the velocity is that of the center, and the position is larger than that of the
      center. Default: 0.

    **Example:**

    ```python
    angles = hj.KinematicPhase(8, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=apex)
    print(hj.sections.place_sections(cycle, angles).duration)
    ```

    **Before:** `hj.Crossing`. **After:** `hj.linearize`, `hj.run_experiments`,
    `hj.recordings.estimate_phase`.
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
        self.anchor = _as_anchor(anchor)

    def check(self, s: Structure) -> None:
        where = "KinematicPhase(position, velocity): "
        names = (self.position, self.velocity)
        require_among("output", names, s.output_names(), where)
        super().check(s)

    def _scaled(self, z: Float[Array, "2"]) -> Float[Array, "2"]:
        """The coordinates (r_p, r_v) in the scaled plane."""
        z = z if self.center is None else z - self.center
        return z if self.scale is None else z / self.scale

    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        signals = s.resolve_outputs((self.position, self.velocity))

        def angle(a, t, q, u):
            position, velocity = self._scaled(signals(a, t, q, u))
            return jnp.arctan2(velocity, position)

        begin = (x[0] for x in orbit[1:])
        phase, rate = _along(s, angle, *begin)
        sense = jax.lax.stop_gradient(jnp.sign(rate))
        steps = 2 * jnp.pi * jnp.arange(self.n_sections) / self.n_sections
        angles = self._first(phase) + sense * steps
        direction = jnp.stack([jnp.sin(angles), -jnp.cos(angles)])
        across = sense * direction
        return BoundSections.at_levels(_AngleLevels(self, across), self.n_sections)


def _along(s: Structure, function: Callable, t, chart, q) -> tuple[Array, Array]:
    """A function (a, t, q, u) at a point of an orbit, and its rate along the orbit."""

    def in_chart(a):
        state = q[: s.dims[a]]
        u = jnp.zeros(s.nu)

        def value(t, q):
            return function(a, t, q, u)

        rates = (jnp.ones_like(t), s.field(a, t, state, u))
        return jax.jvp(value, (t, state), rates)

    return jax.lax.switch(
        chart, [lambda a=a: in_chart(a) for a in range(len(s.charts))]
    )


class _AngleLevels(AbstractLevels):
    phase: KinematicPhase
    across: Float[Array, "2 N"]
    """Factors of (r_p, r_v) in the level, with signs such that the level falls in the direction in
    which the cycle goes round."""

    def _signals(self, s: Structure) -> Outputs:
        return s.resolve_outputs((self.phase.position, self.phase.velocity))

    def present(self, s, a):
        return self._signals(s).defined(a)

    def level(self, s, a, i, t, q):
        position, velocity = self.phase._scaled(
            self._signals(s)(a, t, q, jnp.zeros(s.nu))
        )
        across = self.across[:, i]
        signal = across[0] * position + across[1] * velocity
        return jnp.where(i < 0, 1.0, signal)


@checked
class SectionList(AbstractSections):
    """Sections one by one. Where they are placed on a cycle, the first one stays section 0, and the
    others are sorted by the order in which the cycle meets them.

    **Fields:** `items`: a list of `Crossing` and `AtEvent`. The name of an event can replace its
    `AtEvent`.

    **Example:**

    ```python
    listed = hj.sections.SectionList([apex, hj.AtEvent("touchdown")])
    print(hj.sections.place_sections(cycle, listed).duration)
    ```

    **Before:** `hj.Crossing`, `hj.AtEvent`. **After:** `hj.linearize`, `hj.run_experiments`.
    """

    label: ClassVar[str] = "sections"
    items: tuple[Crossing | AtEvent, ...]

    def __init__(self, items: Iterable[SectionLike]):
        """**Raises:** `DefinitionError` for an empty list."""
        self.items = tuple(map(as_section, items))
        if not self.items:
            raise DefinitionError(
                "a list of sections needs one Crossing or AtEvent, or more."
            )

    n_sections = property(lambda self: len(self.items))  # type: ignore[assignment]
    anchor = property(lambda self: None)  # type: ignore[assignment]

    def check(self, s: Structure) -> None:
        for item in self.items:
            item.check(s)

    def bind(self, s: Structure, orbit: Orbit) -> BoundSections:
        event = [
            s.transition_index(x.name) if isinstance(x, AtEvent) else -1
            for x in self.items
        ]
        crossed = any(isinstance(x, Crossing) for x in self.items)
        never = jnp.full(self.n_sections, jnp.inf)
        levels = ListLevels(self.items) if crossed else None
        return BoundSections(never, jnp.array(event, jnp.int32), levels)

    def describe(self, i: int) -> str:
        return f"section {i} ({self.items[i]})"


FamilyLike: TypeAlias = (
    AbstractSections | SectionLike | SectionCount | Sequence[SectionLike]
)
"""A family, a single section, the number of sections of a clock, or a list of sections. An event is
given by its name, too."""


def as_family(sections: FamilyLike) -> AbstractSections:
    """Return a family for any of the forms of `FamilyLike`: a family, a single section, a number of
    clock sections, or a list of sections."""
    if isinstance(sections, int):
        return ClockPhase(sections)
    if isinstance(sections, Crossing | AtEvent | str):
        return SectionList([sections])
    return sections if isinstance(sections, AbstractSections) else SectionList(sections)
