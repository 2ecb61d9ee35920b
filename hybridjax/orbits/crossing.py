"""Single sections: the level set of a function (`Crossing`), and the state right after an event
(`AtEvent`).

Users make them and give them to `find_limit_cycle`, `flow` and families of sections. `to_section`
turns one into the `Target` at which the engine ends a flow. The *level* of a crossing is a function
that falls through zero at the section, which must stay: the engine looks for falls alone. A further
kind of section needs a case in `SectionLike`, in `to_section`, and wherever code asks for
`AtEvent`.

If a section is crossed in the wrong direction, look at `Crossing.level`; if it is not met in a
chart, at `Crossing.in_chart`; if it is refused without need, at `check`.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Scalar, SignalNames
from .._core.boundary.values import Plain
from .._core.executor import Definition, namespace
from .._core.precision import real
from .._core.text import fields
from ..engine.target import AbstractLevels, Target
from ..systems.check import check_output
from ..systems.structure import Structure
from ..systems.system import Output


Direction = Literal["falling", "rising"]


@checked
class Crossing(Definition):
    """A section: the level set `function = value`, crossed in a stated direction.

    In a recording (`hj.recordings.estimate_phase`) it is the beginning of each cycle.

    **Fields:**

    - `signal`: the name of a state, an output or a recorded signal; an `Output`; or a function
      (t, q) -> number.
    - `direction`: "falling" or "rising".
    - `value`: the level, in the function's unit. Default: 0.
    - `charts`: names of the charts in which it is crossed. Default: all in which the function is
      defined.

    **Example:**

    ```python
    apex = hj.Crossing("vM", "falling")
    high = hj.Crossing(lambda t, q: q[0], "rising", 1.9, charts="flight")
    ```

    **After:** `hj.ClockPhase`, `hj.find_limit_cycle`, `hj.recordings.estimate_phase`.
    """

    signal: str | Output | Callable[..., Any]
    direction: Direction = eqx.field(static=True)
    value: Float[Array, ""]
    charts: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        signal: str | Output | Callable[..., Any],
        direction: Direction,
        value: Scalar = 0.0,
        charts: SignalNames | None = None,
    ):
        self.signal = signal
        self.direction = direction
        self.value = real(value)
        self.charts = None if charts is None else tuple(charts)

    def __str__(self):
        name = self.signal
        if not isinstance(name, str):
            name = getattr(name, "name", getattr(name, "__name__", ""))
        return f"{name if name.isidentifier() else 'function'} {self.direction}"

    __repr__ = fields

    def check(self, s: Structure) -> None:
        """**Raises:** `DefinitionError` for charts or outputs that do not exist, and for
        functions that are not well formed."""
        for name in self.charts or ():
            s.chart_index(name)
        if isinstance(self.signal, str):
            s.resolve_outputs(self.signal)
            return
        output: Any = self.signal
        if not isinstance(output, Output):

            def of_state(t, q, u, f=output):
                return f(t, q)

            output = Output(str(self), dict.fromkeys(self.charts or s.names, of_state))
        list(check_output(s, output, "section"))

    def in_chart(self, s: Structure, a: int) -> bool:
        """True if the section can be crossed in chart a."""
        if self.charts is not None and s.names[a] not in self.charts:
            return False
        if isinstance(self.signal, str | Output):
            return s.resolve_outputs(self.signal).defined(a)
        return True

    def level(
        self, s: Structure, a: int, t: Float[Array, ""], q: Float[Array, " n"]
    ) -> Float[Array, ""]:
        """The level at one state of chart a, which falls through zero at the section."""
        if isinstance(self.signal, str | Output):
            no_input = jnp.zeros(s.nu)
            value = s.resolve_outputs(self.signal)(a, t, q, no_input)[0]
        else:
            value = jnp.asarray(self.signal(t, q), float)
        return (1.0 if self.direction == "falling" else -1.0) * (value - self.value)


@checked
class AtEvent(eqx.Module):
    """A section at an event: the state right after the event `name` and its reset.

    In a recording (`hj.recordings.estimate_phase`) the event is the beginning of each cycle.

    **Example:**

    ```python
    sections = [hj.AtEvent("touchdown"), apex]
    print(hj.sections.place_sections(cycle, sections).duration)
    ```

    **After:** `hj.find_limit_cycle`, `hj.linearize`, `hj.recordings.estimate_phase`.
    """

    name: str = eqx.field(static=True)

    def __str__(self):
        return f"after {self.name}"

    __repr__ = fields

    def check(self, s: Structure) -> None:
        """**Raises:** `DefinitionError` for an event that the system does not have."""
        s.transition_index(self.name)


EventName = Annotated[
    str, Plain("the name of an event", lambda value: isinstance(value, str))
]
SectionLike: TypeAlias = Crossing | AtEvent | EventName
"""A single section; an event also by its name."""


def as_section(section: SectionLike) -> Crossing | AtEvent:
    """Return a section: of a name, that right after the event."""
    return AtEvent(section) if isinstance(section, str) else section


class ListLevels(AbstractLevels):
    """The level functions of the crossings in a list of sections. Events in the list, and the index
    -1, which stands for no section, have the level 1, which never falls."""

    items: tuple[Crossing | AtEvent, ...]

    def present(self, s, a):
        return any(isinstance(x, Crossing) and x.in_chart(s, a) for x in self.items)

    def level(self, s, a, i, t, q):
        def branch(item):
            if isinstance(item, Crossing) and item.in_chart(s, a):
                return lambda: item.level(s, a, t, q)
            return lambda: jnp.ones(())

        return jax.lax.switch(
            i + 1, [lambda: jnp.ones(()), *(branch(x) for x in self.items)]
        )


def to_section(
    target: Target, section: Crossing | AtEvent | None, event: int = -1
) -> Target:
    """A target that ends on a section: at its level, or after the event of this index."""
    if isinstance(section, Crossing):
        return dataclasses.replace(target, levels=ListLevels((section,)))
    xp = namespace(target.time)
    return dataclasses.replace(
        target, event=xp.full(target.event.shape, event, xp.int32)
    )
