"""Single sections: where a function crosses a level, and the state after an event."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.executor import Definition, as_numbers
from ..errors import DefinitionError
from ..systems.output import Output
from ..systems.structure import Structure


Direction = Literal["falling", "rising"]


def number(x: ArrayLike) -> Array:
    """`x` as a floating-point array, so that families can be differentiated in their numbers."""
    return as_numbers(x)


class Crossing(Definition):
    """A section: the level set `function = value`, crossed in a stated direction.

    In a recording (`hj.recordings.estimate_phase`) it is the beginning of each cycle.

    **Fields:**

    - `function`: the name of a state, an output or a recorded signal; an `Output`; or a function
      (t, q) -> number.
    - `direction`: "falling" or "rising".
    - `value`: the level, in the function's unit.
    - `charts`: names of the charts in which it is crossed; by default all in which it is defined.
    """

    function: str | Output | Callable[..., Any]
    direction: Direction = eqx.field(static=True)
    value: Float[Array, ""] = eqx.field(converter=number, default=0.0)
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
        """**Raises:** `DefinitionError` for charts or outputs that the system does not have."""
        for name in self.charts or ():
            s.chart_index(name)
        if isinstance(self.function, str | Output):
            s.resolve_outputs(self.function)

    def in_chart(self, s: Structure, a: int) -> bool:
        """Whether it can be crossed in chart a."""
        if self.charts is not None and s.names[a] not in self.charts:
            return False
        if isinstance(self.function, str | Output):
            return s.resolve_outputs(self.function).defined(a)
        return True

    def level(
        self, s: Structure, a: int, t: Float[Array, ""], q: Float[Array, " n"]
    ) -> Float[Array, ""]:
        """A function of one state of chart a that falls through zero at the section."""
        if isinstance(self.function, str | Output):
            value = s.resolve_outputs(self.function)(a, t, q, jnp.zeros(s.nu))[0]
        else:
            value = jnp.asarray(self.function(t, q), float)
        sign = 1.0 if self.direction == "falling" else -1.0
        return sign * (value - self.value)


class AtEvent(eqx.Module):
    """A hybrid boundary as a section: the state right after the event `name` and its reset.

    In a recording (`hj.recordings.estimate_phase`) the event is the beginning of each cycle.
    """

    name: str = eqx.field(static=True)

    def __str__(self):
        return f"after {self.name}"

    def check(self, s: Structure) -> None:
        """**Raises:** `DefinitionError` for an event that the system does not have."""
        s.transition_index(self.name)
