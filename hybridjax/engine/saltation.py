r"""The linearization of an event: the saltation formula, for points on the host.

A deviation $x$ of the state before an event, at a fixed time, delays it by
$\delta = -h_q x / \dot h$, where the guard $h$ falls at the rate $\dot h = h_t + h_q f^-$ along the
field $f^-$ before the event. After it, at the same fixed time, the deviation is

$$x^+ = R_q x + (R_q f^- + R_t - f^+)\,\delta$$

with the reset $R$ and the field $f^+$ after it (M. A. Aizerman and F. R. Gantmacher, Quarterly J.
Mechanics and Applied Mathematics 11, 1958). Of a scheduled event, $h$ is the time that is left:
its delay depends on inputs only.

`itinerary/bodies.py` has this formula for columns that are carried along, and `replay.py` for
deviations of both time and state.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Inexact

from ..systems.structure import Structure
from ..systems.transition import Scheduled
from . import kernels


class Jump(NamedTuple):
    """One transition at P points."""

    level: Inexact[np.ndarray, " P"]
    """The guard, or the time that is left."""
    rate: Inexact[np.ndarray, " P"]
    """Its rate along the field."""
    gradient: Inexact[np.ndarray, "P n"]
    """Its derivative by the state."""
    after: Inexact[np.ndarray, "P m"]
    """State after the event."""
    by_state: Inexact[np.ndarray, "P m n"]
    """Derivatives of the reset."""
    by_input: Inexact[np.ndarray, "P m nu"]
    slip: Inexact[np.ndarray, "P m"]
    """Change of the state after the event, at a fixed time, by the time of the event."""
    delay_by_level: Inexact[np.ndarray, " P"]
    """Change of the time of the event by the level of the guard; NaN where its rate is zero."""
    delay_by_state: Inexact[np.ndarray, "P n"]
    delay_by_input: Inexact[np.ndarray, "P nu"]

    @property
    def saltation(self) -> Inexact[np.ndarray, "P m n"]:
        """Derivative of the state after the event by that before it, at a fixed time."""
        return self.by_state + self.slip[..., None] * self.delay_by_state[:, None]

    @property
    def input_saltation(self) -> Inexact[np.ndarray, "P m nu"]:
        """The same by the inputs."""
        return self.by_input + self.slip[..., None] * self.delay_by_input[:, None]


def jump(
    s: Structure,
    g: int,
    t: Inexact[np.ndarray, " P"],
    q: Inexact[np.ndarray, "P n"],
    u: Inexact[np.ndarray, "nu #P"],
) -> Jump:
    """Transition g at times and states before it."""
    transition = s.transitions[g]
    a = s.chart_index(transition.source)
    b = s.chart_index(transition.target)
    n = s.dims[a]
    point = t, q.T, u
    before = kernels.field(s, a, *point)[:, 0].T
    if isinstance(transition.guard, Scheduled):
        guard = kernels.due(s, g, *point)[0].T
    else:
        row = s.guards(a).index(g)
        first = np.zeros(1, np.int32)
        guard = kernels.watched(s, a, None, *point, first)[row].T
    gradient = guard[:, 2 : 2 + n]
    rate = guard[:, 1] + np.sum(gradient * before, axis=1)
    never = np.full_like(rate, np.nan)
    delay_by_level = np.divide(-1.0, rate, where=rate != 0, out=never)
    reset = np.moveaxis(kernels.reset(s, s.member(g), *point), -1, 0)
    after = reset[:, :, 0]
    by_time = reset[:, :, 1]
    by_state = reset[:, :, 2 : 2 + n]
    field_after = kernels.field(s, b, t, after.T, u)[:, 0].T
    along = (by_state @ before[..., None])[..., 0]
    return Jump(
        guard[:, 0],
        rate,
        gradient,
        after,
        by_state,
        reset[:, :, 2 + n :],
        along + by_time - field_after,
        delay_by_level,
        gradient * delay_by_level[:, None],
        guard[:, 2 + n :] * delay_by_level[:, None],
    )
