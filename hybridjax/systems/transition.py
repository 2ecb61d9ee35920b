"""`Transition`: an event that leads from one chart to another, by a guard or a schedule
(`Scheduled`), with a reset.

Users make transitions; the engine reads them through `structure.py`. The two constants of the file
say when two times are the same. Names of fields are public and must not change. A `guard` is as the
user wrote it: the engine gets the one that falls at its event from `Structure.guard`.

If an event happens twice, or not at all after a reset, look at `rearm` in `engine/events.py`; if a
scheduled event comes at a wrong time, at `next_schedule` there and at `Scheduled.nearest`.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers
from .._core.boundary.values import Reals
from .._core.executor import Array, namespace, stop_gradient
from .._core.precision import real
from .._core.text import fields
from ..errors import DefinitionError


Direction = Literal["falling", "rising"]
# Times on a cycle coincide if they differ by less than this part of the period. A guard is due, in
# another order of events, if it would be zero within ten times as much. Smaller: rounding separates
# events that coincide. Larger: events that are merely close are reported.
TOGETHER = 1e-9


def at_one_time(t: Array, other: Array, period: Array) -> Array:
    """Test whether two times on a cycle are the same."""
    return abs(t - other) <= TOGETHER * period


# Times of a schedule are equal if they differ by less than this part of its period. In the same
# way, numbers of steps are equal if they differ by less than this; and the level of a target counts
# only once it exceeds its change in this part of the time allowed. Higher: a flow that ends shortly
# before an event includes the event, and a level that falls right after the start is missed. Lower:
# an event happens twice, a step has the length of a rounding error, or a level that was zero up to
# rounding is met again.
SAME_TIME = 1e-11


@checked
class Scheduled(eqx.Module):
    """Events at known times `offset + k * period`, k an integer: a tick of a clock, a PWM edge.

    **Example:**

    ```python
    tick = hj.Transition("tick", "on", "off", hj.systems.Scheduled(0.5, offset=0.1))
    ```

    **After:** `hj.Transition`.
    """

    period: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self,
        period: Annotated[Numbers, Reals("...", sign="positive")],
        offset: Annotated[Numbers, Reals("...")] = 0.0,
    ):
        for name, given in (("period", period), ("offset", offset)):
            # (Of JAX's arrays, several lanes may each have their own number.)
            if isinstance(given, np.ndarray) and given.shape:
                raise DefinitionError(
                    f"Scheduled: `{name}` must be one number, not of shape {given.shape}."
                )
        self.period = real(period)
        self.offset = real(offset)

    __repr__ = fields

    def numbers(self, t: Array) -> tuple[Array, Array]:
        """`offset` and `period`, as arrays of the kind of t."""
        xp = namespace(t)
        return xp.asarray(self.offset), xp.asarray(self.period)

    def nearest(self, t: Array) -> Array:
        """The event's time that is nearest to t, as a function of `offset` and `period`."""
        offset, period = self.numbers(t)
        return (
            offset + stop_gradient(namespace(t).round((t - offset) / period)) * period
        )


def _identity(t, q, u):
    return q


@checked
class Transition(eqx.Module):
    """An event that ends a stay in chart `source` and begins one in chart `target`.

    **Fields:**

    - `name`: how the event is called in plots and errors, e.g. "touchdown".
    - `source`, `target`: names of charts.
    - `guard`: threshold function (t, q, u) -> number whose zero crossing in the stated direction
        is the event, or a `Scheduled` (then `direction` has no meaning).
    - `direction`: "falling" (from positive to negative) or "rising".
    - `reset`: (t, q, u) -> state in `target`, as an array or a tuple. Identity by default.
    - `enabled`: optional predicate (t, q, u) -> bool, evaluated at the crossing or the scheduled
        time; where it is false there is no event.

    A guard is armed once it has left zero on the side from which it crosses, so that a guard that
    was just crossed does not trigger again. In two cases an event happens at once after a reset: if
    the reset enters another chart in which a guard is at zero or beyond it and moves away from zero
    (unless the old chart has this guard, too), and if a reset within a chart moves the state across
    an armed guard.

    Scheduled transitions with the same formulas for period and offset belong to one clock: each
    tick leads to one event.

    **Example:**

    ```python
    height = lambda t, q, u: q[0] - 1.0
    bounce = lambda t, q, u: (q[0], -0.7 * q[1])
    lands = hj.Transition("touchdown", "flight", "flight", height, reset=bounce)
    ```

    **Before:** `hj.Chart`. **After:** `hj.HybridSystem`.
    """

    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    guard: Callable[..., Any] | Scheduled
    direction: Direction = eqx.field(static=True, default="falling")
    reset: Callable[..., Any] = _identity
    enabled: Callable[..., Any] | None = None

    @property
    def sign(self) -> float:
        """+1 or -1, so that sign * guard falls through zero at the event."""
        return 1.0 if self.direction == "falling" else -1.0

    def __repr__(self):
        about = f"{self.name!r}: {self.source} -> {self.target}"
        if isinstance(self.guard, Scheduled):
            return f"Transition({about}, scheduled)"
        return f"Transition({about}, {self.direction})"
