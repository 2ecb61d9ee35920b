"""The functions whose zeros end a move: guards, and the level function of the target section."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..systems.structure import Structure
from .lanes import by_lane, for_each_chart, only
from .step import LaneField, midpoint_step
from .target import Target


class Watch(NamedTuple):
    """Watched functions at a point, signed so that they fall at their event: one row for each
    transition, and a last one for the target's level. Rows that mean nothing in a lane's chart
    have value 1 and rate 0."""

    value: Float[Array, "W L"]
    rate: Float[Array, "W L"]


def chart_field(s: Structure, a: int, u: Float[Array, "nu L"]) -> LaneField:
    """Field of chart a over lanes."""
    return lambda t, q: by_lane(lambda t, q, u: s.field(a, t, q, u))(t, q, u)


def slopes(s: Structure, t, chart, q, u) -> Float[Array, "d L"]:
    """The field at every lane."""

    def work(a, here, out):
        n = s.dims[a]
        f = chart_field(s, a, only(here, u))(only(here, t), only(here, q[:n]))
        return out.at[:n].set(jnp.where(here, f, out[:n]))

    return for_each_chart(s, chart, jnp.ones(t.shape, bool), work, jnp.zeros_like(q))


def watched(s: Structure, a: int, target: Target):
    """The watched functions of chart a: pairs (row, function(t, q, u, index))."""
    functions = [(g, lambda t, q, u, i, g=g: s.guard(g, t, q, u)) for g in s.guards(a)]
    if target.levels is not None and target.levels.present(s, a):
        levels = target.levels
        functions.append((len(s.transitions), lambda t, q, u, i: levels.level(s, a, i, t, q)))
    return functions


def values(s: Structure, a: int, target: Target, t, q, u, index, f):
    """Rows, values and rates of chart a's watched functions over lanes; f is the field there."""
    functions = watched(s, a, target)

    def one(t, q, u, i, f):
        def all_of_them(t, q):
            return jnp.stack([function(t, q, u, i) for _, function in functions])

        return jax.jvp(all_of_them, (t, q), (jnp.ones_like(t), f))

    value, rate = by_lane(one)(t, q, u, index, f)
    return jnp.array([row for row, _ in functions]), value, rate


def watch(
    s: Structure,
    t: Float[Array, " L"],
    chart: Int[Array, " L"],
    q: Float[Array, "d L"],
    u: Float[Array, "nu L"],
    target: Target,
    mask: Bool[Array, " L"],
    f: Float[Array, "d L"] | None = None,
) -> Watch:
    """All watched functions at the lanes of `mask`. Without the field f, it is computed."""
    shape = (len(s.transitions) + 1, t.shape[0])
    nothing = Watch(jnp.ones(shape), jnp.zeros(shape))

    def work(a, here, out):
        if not watched(s, a, target):
            return out
        n = s.dims[a]
        point = only(here, t), only(here, q[:n])
        uu, index = only(here, u), only(here, target.index)
        slope = chart_field(s, a, uu)(*point) if f is None else only(here, f[:n])
        rows, value, rate = values(s, a, target, *point, uu, index, slope)
        return Watch(
            out.value.at[rows].set(jnp.where(here, value, out.value[rows])),
            out.rate.at[rows].set(jnp.where(here, rate, out.rate[rows])),
        )

    return for_each_chart(s, chart, mask, work, nothing)


class Settled(NamedTuple):
    """Lanes moved onto the zero of the function that they cross."""

    past: Float[Array, " L"]
    """Time from the end of the step to the zero."""
    q: Float[Array, "n L"]
    first: Float[Array, " L"]
    """The first of the two corrections that `past` is made of."""


def settle(s: Structure, a: int, target: Target, t, q, u, index, which) -> Settled:
    """Two Newton steps onto the zero of watched function `which` (-1: stay), in chart a.

    From the crossing itself (up to rounding) they change nothing, but carry the derivatives of
    the crossing's time and state exactly, to second order: this is the saltation formula.
    """
    field = chart_field(s, a, u)

    def correction(t, q):
        f = field(t, q)
        rows, value, rate = values(s, a, target, t, q, u, index, f)
        chosen = rows[:, None] == which
        value = jnp.sum(jnp.where(chosen, value, 0.0), axis=0)
        rate = jnp.sum(jnp.where(chosen, rate, 0.0), axis=0)
        return -value / jnp.where(rate == 0, 1.0, rate), f

    first, _ = correction(t, q)
    q = midpoint_step(field, t, q, first)
    second, f = correction(t + first, q)
    return Settled(first + second, q + second * f, first)
