r"""The linearization of an event: the saltation formula, for points on the host.

A deviation $x$ of the state before an event, at a fixed time, delays it by
$\delta = -h_q x / \dot h$, where the guard $h$ falls at the rate $\dot h = h_t + h_q f^-$ along the
field $f^-$ before the event. After it, at the same fixed time, the deviation is

$$x^+ = R_q x + (R_q f^- + R_t - f^+)\,\delta$$

with the reset $R$ and the field $f^+$ after it (M. A. Aizerman and F. R. Gantmacher, Quarterly J.
Mechanics and Applied Mathematics 11, 1958). For a scheduled event, $h$ is the time that is left
until the event, which does not depend on the state.

`jump` evaluates the formula at many points at once, for `orbits/` (linear flow, verdict,
coincidence). `replay.py` calls `delay_of_zero` and `chained`, for deviations of both time and
state. In compiled programs that follow an itinerary, `itinerary/bodies.py` gets the same formula by
forward mode.

If derivatives across an event are wrong, compare `Jump.slip` with the bracket of the formula, and
`Jump.delay_by_state` with its delay. NaN means that the rate of the guard is zero. The order of
columns that `by_point` takes apart (value, time, states, inputs) is that of `kernels.py`, and must
stay.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Inexact

from ..systems.structure import Structure
from ..systems.transition import Scheduled
from . import kernels


class ByPoint(NamedTuple):
    """Derivatives of a function of (t, q, u) at P points."""

    by_t: Inexact[np.ndarray, "P k 1"]
    by_q: Inexact[np.ndarray, "P k n"]
    by_u: Inexact[np.ndarray, "P k nu"]


def by_point(expanded: Inexact[np.ndarray, "P k columns"], n: int) -> ByPoint:
    """The derivatives of `engine.kernels`, whose first column is the value, with points first."""
    by_t = expanded[:, :, 1:2]
    by_q = expanded[:, :, 2 : 2 + n]
    by_u = expanded[:, :, 2 + n :]
    return ByPoint(by_t, by_q, by_u)


def chained(
    by: ByPoint,
    dt: Inexact[np.ndarray, "P 1 m"],
    dq: Inexact[np.ndarray, "P n m"],
) -> Inexact[np.ndarray, "P k m"]:
    """Derivatives of a function of (t, q, u) by m numbers, from the derivatives `dt` and `dq` of t
    and q by these numbers (chain rule). The last of the m numbers are the inputs u."""
    out = by.by_t @ dt + by.by_q @ dq
    inputs = by.by_u.shape[2]
    out[:, :, out.shape[2] - inputs :] += by.by_u
    return out


def delay_of_zero(
    by: ByPoint,
    field: Inexact[np.ndarray, "P n 1"],
    dt: Inexact[np.ndarray, "P 1 m"],
    dq: Inexact[np.ndarray, "P n m"],
) -> Inexact[np.ndarray, "P 1 m"]:
    """Derivatives of the time at which a function of (t, q, u) is zero along the field, from the
    derivatives `dt` and `dq` of the points; NaN where the rate of the function is zero."""
    rate = by.by_t + by.by_q @ field
    change = chained(by, dt, dq)
    never = np.full_like(change, np.nan)
    return np.divide(-change, rate, where=rate != 0, out=never)


class Jump(NamedTuple):
    """One transition at P points."""

    level: Inexact[np.ndarray, " P"]
    """The guard, or the time that is left."""
    rate: Inexact[np.ndarray, " P"]
    """Rate of the level along the field."""
    gradient: Inexact[np.ndarray, "P n"]
    """Derivative of the level by the state."""
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
        by_delay = self.slip[..., None] * self.delay_by_state[:, None]
        return self.by_state + by_delay

    @property
    def input_saltation(self) -> Inexact[np.ndarray, "P m nu"]:
        """Derivative of the state after the event by the inputs, at a fixed time."""
        by_delay = self.slip[..., None] * self.delay_by_input[:, None]
        return self.by_input + by_delay


def jump(
    s: Structure,
    g: int,
    t: Inexact[np.ndarray, " P"],
    q: Inexact[np.ndarray, "P n"],
    u: Inexact[np.ndarray, "nu #P"],
) -> Jump:
    """Transition g at P times and states before it; the inputs may be one column for all points."""
    transition = s.transitions[g]
    a = s.chart_index(transition.source)
    b = s.chart_index(transition.target)
    n = s.dims[a]
    point = t, q.T, u
    if isinstance(transition.guard, Scheduled):
        guard = kernels.due(s, g, *point)[0].T
    else:
        row = s.guards(a).index(g)
        first = np.zeros(1, np.int32)
        guard = kernels.watched(s, a, None, *point, first)[row].T
    before = kernels.field(s, a, *point)[:, 0].T
    rows = kernels.reset(s, s.member(g), *point)
    reset = np.moveaxis(rows, -1, 0)
    after = reset[:, :, 0]
    field_after = kernels.field(s, b, t, after.T, u)[:, 0].T

    field = before[:, :, None]
    level = by_point(guard[:, None], n)
    by = by_point(reset, n)
    rate = (level.by_t + level.by_q @ field)[:, 0, 0]
    never = np.full_like(rate, np.nan)
    delay_by_level = np.divide(-1.0, rate, where=rate != 0, out=never)
    return Jump(
        level=guard[:, 0],
        rate=rate,
        gradient=level.by_q[:, 0],
        after=after,
        by_state=by.by_q,
        by_input=by.by_u,
        slip=(by.by_q @ field + by.by_t)[:, :, 0] - field_after,
        delay_by_level=delay_by_level,
        delay_by_state=level.by_q[:, 0] * delay_by_level[:, None],
        delay_by_input=level.by_u[:, 0] * delay_by_level[:, None],
    )
