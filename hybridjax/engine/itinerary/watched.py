"""Watched functions: what a row sees of the guards of its chart, and of the level of a section.

The functions of a chart are numbered 0 to G - 1: its guards in the order of `Structure.guards`,
then the level of the row's section, if the chart has one. `Rows.signs` and `Rows.target` count in
the same way. Charts with fewer functions are filled up by functions that are infinite, so that one
program serves all charts.

A value of infinity also stands for a function of which nothing is known, because a leg begins.

`bodies.py` evaluates these functions where a row begins, and `flags.py` compares them with the
recorded signs. The numbering must stay, since recorded rows refer to it. If another function is
compared than the recorded one, look at `watched_values`; if an event counts though its predicate
does not hold, at `with_predicates`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float

from ...systems.structure import Structure
from ..arrays import Array
from ..cubic import interpolate, root_near_end
from ..kernels import watched_at
from ..target import AbstractLevels
from .table import Row


class Watched(NamedTuple):
    """The watched functions of a chart, and their rates along the flow, at a time."""

    t: Float[Array, ""]
    value: Float[Array, " G"]
    rate: Float[Array, " G"]
    enabled: Bool[Array, " G"]
    """Whether the predicates of their events hold."""
    enabled_at_zero: Bool[Array, " G"]
    """Whether they held where a function fell through zero, since the row before."""
    q: Float[Array, " d"]
    """The state."""

    @classmethod
    def unknown(
        cls, t: Float[Array, ""], width: int, q: Float[Array, " d"]
    ) -> "Watched":
        """Watched functions of which nothing is known."""
        far = jnp.full(width, jnp.inf)
        enabled = jnp.ones(width, bool)
        return cls(t, far, jnp.ones(width), enabled, ~enabled, q)

    @property
    def is_unknown(self) -> Bool[Array, " G"]:
        return jnp.isinf(self.value)


def watched_values(
    s: Structure, a: int, levels: AbstractLevels | None, row: Row, t, q, u
) -> Float[Array, " g"]:
    """The watched functions of chart a at a state."""
    kinds = s.guard_kinds(a)
    return watched_at(a, kinds, s, levels, t, q, u, row.section)


def with_predicates(
    a: int, s: Structure, before: Watched, now: Watched, fields: tuple
) -> Watched:
    """Watched functions of chart a with the predicates of their events, now and where they have
    fallen through zero.

    **Arguments:** `fields`: at the times of `before` and `now`.
    """
    predicates = [
        (place, g)
        for place, g in enumerate(s.guards(a))
        if s.transitions[g].enabled is not None
    ]
    if not predicates:
        return now
    n = s.dims[a]
    u = jnp.zeros(s.nu)
    h = now.t - before.t
    enabled = now.enabled
    enabled_at_zero = now.enabled_at_zero
    for place, g in predicates:
        values = before.value[place], now.value[place]
        slopes = h * before.rate[place], h * now.rate[place]
        zero = root_near_end(*values, *slopes)
        # (NaN where nothing is known of the time before.)
        x = jnp.clip(jnp.nan_to_num(zero, nan=1.0), 0.0, 1.0)
        state = interpolate(x, h, before.q, now.q, *fields)
        time = before.t + x * h
        holds = s.enabled(g, time, state[:n], u)
        holds_now = s.enabled(g, now.t, now.q[:n], u)
        enabled = enabled.at[place].set(holds_now)
        enabled_at_zero = enabled_at_zero.at[place].set(holds)
    return now._replace(enabled=enabled, enabled_at_zero=enabled_at_zero)
