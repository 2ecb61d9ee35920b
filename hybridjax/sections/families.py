"""Poincaré sections: definitions, bound to no cycle (paper Secs. III and VI-B).

A family holds functions and numbers. `orbits.place` evaluates it on a limit cycle.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..engine.target import AbstractLevels
from ..errors import DefinitionError
from ..systems.output import Output
from ..systems.structure import Structure


def _number(x) -> Array:
    return jnp.asarray(x, float)


class Crossing(eqx.Module):
    """A section: the level set `function = value`, crossed in a stated direction.

    **Fields:**

    - `function`: the name of a state or output, an `Output`, or a function (t, q) -> number.
    - `direction`: "falling" or "rising".
    - `value`: the level.
    - `charts`: names of the charts in which it is crossed; by default all in which it is defined.
    """

    function: str | Output | Callable[..., Any]
    direction: str = eqx.field(static=True)
    value: Float[Array, ""] = eqx.field(converter=_number, default=0.0)
    charts: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.direction not in ("falling", "rising"):
            raise DefinitionError(
                f"a Crossing has direction {self.direction!r}; say 'falling' or 'rising'."
            )

    def __str__(self):
        name = self.function
        if not isinstance(name, str):
            name = getattr(name, "name", getattr(name, "__name__", "function"))
        return f"{name} {self.direction}"

    def check(self, s: Structure) -> None:
        for name in self.charts or ():
            s.chart_index(name)
        if isinstance(self.function, str | Output):
            s.resolve_outputs(self.function)

    def in_chart(self, s: Structure, a: int) -> bool:
        if self.charts is not None and s.names[a] not in self.charts:
            return False
        if isinstance(self.function, str | Output):
            return s.resolve_outputs(self.function).defined(a)
        return True

    def level(self, s: Structure, a: int, t, q):
        """Falls through zero at the section."""
        if isinstance(self.function, str | Output):
            value = s.resolve_outputs(self.function)(a, t, q, jnp.zeros(s.nu))[0]
        else:
            value = jnp.asarray(self.function(t, q), float)
        sign = 1.0 if self.direction == "falling" else -1.0
        return sign * (value - self.value)


class AtEvent(eqx.Module):
    """A hybrid boundary as a section: the state right after the event `name` and its reset."""

    name: str = eqx.field(static=True)

    def __str__(self):
        return f"after {self.name}"

    def check(self, s: Structure) -> None:
        s.transition_index(self.name)


class AbstractSections(eqx.Module):
    """A family of N Poincaré sections in the order in which a cycle meets them."""

    label: eqx.AbstractClassVar[str]
    n_sections: eqx.AbstractVar[int]
    start: eqx.AbstractVar[Crossing | Float[Array, ""] | None]

    @abc.abstractmethod
    def check(self, s: Structure) -> None:
        """Raise `DefinitionError` if the family does not fit the system."""

    @abc.abstractmethod
    def bind(self, s: Structure, period, chart: int, t, q, f) -> "Bound":
        """The family with its numbers filled in. (t, q) in `chart`, with field f, is a point of
        the cycle: the anchor if `start` is a `Crossing`, any point otherwise."""

    @abc.abstractmethod
    def describe(self, i: int) -> str:
        """Section i in a few words, for errors."""


class Bound(eqx.Module):
    """Sections as the flow wants them. Section i ends a piece of flow at a time, at the zero of a
    level function, or at an event."""

    time: Float[Array, " N"]
    """Times of clock sections in the first turn; infinity for the others."""
    event: Int[Array, " N"]
    """Transitions of event sections; -1 for the others."""
    levels: AbstractLevels | None
    period: Float[Array, ""]


def _no_events(count: int):
    return jnp.full(count, -1, jnp.int32)


class ClockPhase(AbstractSections):
    """N equally spaced phases of time: the isochrons of a clocked system (paper Sec. VI-B).

    On an autonomous cycle these are equal steps of time from section 0; time has no natural
    origin there, so one multiplier is 1.

    **Fields:** `n_sections` N; `start`, where section 0 lies: a `Crossing` on the cycle, or a
    phase of the clock in periods.
    """

    label: ClassVar[str] = "isochron"
    n_sections: int = eqx.field(static=True)
    start: Crossing | Float[Array, ""] = eqx.field(
        converter=lambda x: x if isinstance(x, Crossing) else _number(x), default=0.0
    )

    def __check_init__(self):
        _check_count(self.n_sections)

    def check(self, s: Structure) -> None:
        _check_start(self.start, s)

    def bind(self, s, period, chart, t, q, f):
        first = t if isinstance(self.start, Crossing) else self.start * period
        times = first + jnp.arange(self.n_sections) * (period / self.n_sections)
        return Bound(times, _no_events(self.n_sections), None, jnp.asarray(period))

    def describe(self, i):
        return f"section {i} (clock phase {i}/{self.n_sections} after section 0)"


class _PhaseLevels(AbstractLevels):
    phase: "KinematicPhase"
    across: Float[Array, "2 N"]
    """What multiplies (r_p, r_v) in the level: it falls in the sense in which the cycle turns."""

    def present(self, s, a):
        return s.resolve_outputs((self.phase.position, self.phase.velocity)).defined(a)

    def level(self, s, a, i, t, q):
        position, velocity = self.phase.plane(s, a, t, q)
        across = self.across[:, i]
        return jnp.where(i < 0, 1.0, across[0] * position + across[1] * velocity)


class KinematicPhase(AbstractSections):
    """N equally spaced angles of (position - o_p) / s_p + i (velocity - o_v) / s_v (Sec. VI-B).

    The sections follow the sense in which the cycle turns: where the angle decreases in time,
    section i is at the angle of section 0 minus 2 pi i / N.

    **Fields:** `n_sections` N; names of the states or outputs `position` and `velocity`; `center`
    (o_p, o_v) and `scale` (s_p, s_v); `start`, where section 0 lies: a `Crossing` on the cycle, or
    an angle in radians.
    """

    label: ClassVar[str] = "kinematic"
    n_sections: int = eqx.field(static=True)
    position: str = eqx.field(static=True)
    velocity: str = eqx.field(static=True)
    center: Float[Array, "2"] = eqx.field(converter=_number, default=(0.0, 0.0))
    scale: Float[Array, "2"] = eqx.field(converter=_number, default=(1.0, 1.0))
    start: Crossing | Float[Array, ""] = eqx.field(
        converter=lambda x: x if isinstance(x, Crossing) else _number(x), default=0.0
    )

    def __check_init__(self):
        _check_count(self.n_sections)

    def check(self, s: Structure) -> None:
        s.resolve_outputs((self.position, self.velocity))
        _check_start(self.start, s)

    def plane(self, s: Structure, a: int, t, q):
        """The scaled plane's coordinates (r_p, r_v)."""
        z = s.resolve_outputs((self.position, self.velocity))(a, t, q, jnp.zeros(s.nu))
        return (z - self.center) / self.scale

    def bind(self, s, period, chart, t, q, f):
        def angles(a):
            def angle(t, q):
                position, velocity = self.plane(s, a, t, q[: s.dims[a]])
                return jnp.arctan2(velocity, position)

            f_a = jnp.where(jnp.arange(s.d) < s.dims[a], f, 0.0)
            return jax.jvp(angle, (t, q), (jnp.ones_like(t), f_a))

        angle, rate = jax.lax.switch(chart, [lambda a=a: angles(a) for a in range(len(s.charts))])
        sense = jax.lax.stop_gradient(jnp.sign(rate))
        first = angle if isinstance(self.start, Crossing) else self.start
        steps = 2 * jnp.pi * jnp.arange(self.n_sections) / self.n_sections
        angle = first + sense * steps
        across = sense * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        levels = _PhaseLevels(self, across)
        never = jnp.full(self.n_sections, jnp.inf)
        return Bound(never, _no_events(self.n_sections), levels, jnp.asarray(period))

    def describe(self, i):
        return f"section {i} (kinematic phase {i}/{self.n_sections} after section 0)"


class ListLevels(AbstractLevels):
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


class SectionList(AbstractSections):
    """Sections one by one, in the order in which the cycle meets them.

    **Fields:** `items`: a list of `Crossing` and `AtEvent`.
    """

    label: ClassVar[str] = "sections"
    items: tuple[Crossing | AtEvent, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        _check_count(len(self.items))
        for item in self.items:
            if not isinstance(item, Crossing | AtEvent):
                raise DefinitionError(
                    f"SectionList takes Crossing and AtEvent objects, not {type(item).__name__}."
                )

    @property
    def n_sections(self) -> int:
        return len(self.items)

    @property
    def start(self) -> None:
        return None

    def check(self, s: Structure) -> None:
        for item in self.items:
            item.check(s)

    def bind(self, s, period, chart, t, q, f):
        event = [s.transition_index(x.name) if isinstance(x, AtEvent) else -1 for x in self.items]
        levels = None
        if any(isinstance(x, Crossing) for x in self.items):
            levels = ListLevels(self.items)
        never = jnp.full(self.n_sections, jnp.inf)
        return Bound(never, jnp.array(event, jnp.int32), levels, jnp.asarray(period))

    def describe(self, i):
        return f"section {i} ({self.items[i]})"


def as_sections(sections: Any) -> AbstractSections:
    """A family from a family, a single section, or a list of sections."""
    if isinstance(sections, Crossing | AtEvent):
        return SectionList([sections])
    if isinstance(sections, list | tuple):
        return SectionList(sections)
    if not isinstance(sections, AbstractSections):
        raise DefinitionError(
            "sections are a family such as ClockPhase(32) or KinematicPhase(32, ...), or a list of "
            f"Crossing and AtEvent objects; got {type(sections).__name__}."
        )
    return sections


def _check_count(count) -> None:
    if not isinstance(count, int | np.integer) or count < 1:
        raise DefinitionError(
            f"a family needs a whole number of sections, at least 1; got {count}."
        )


def _check_start(start, s: Structure) -> None:
    if isinstance(start, Crossing):
        start.check(s)
