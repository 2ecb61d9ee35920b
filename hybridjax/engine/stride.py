"""How lanes set out on a piece of flow."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..systems.structure import Structure
from .lanes import Lanes, for_each_chart, only
from .settings import Settings
from .watch import chart_field


class Stride(NamedTuple):
    """How lanes set out: what is known beforehand about their way."""

    h: Float[Array, " L"]
    """The first step."""
    lead: Float[Array, " L"]
    """Expected time to the target's level as a multiple of Newton's guess at the start; 0 if it is
    not known."""
    slack: Float[Array, " L"]
    """A step's error estimate may be this many times the tolerance."""


def stride(h: Float[Array, " L"]) -> Stride:
    """Set out with steps h, and no further knowledge."""
    return Stride(h, jnp.zeros_like(h), jnp.ones_like(h))


def initial_step(s: Structure, lanes: Lanes, u, span: Float[Array, " L"], settings: Settings):
    """A cautious first step: a fraction of the time in which the state changes by its size."""

    def work(a, here, out):
        q = only(here, lanes.q[: s.dims[a]])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        rate = jnp.max(jnp.abs(f) / settings.tolerance(a, q), axis=0, initial=0.0) * settings.rtol
        ratio = jnp.where(jnp.isfinite(rate) & (rate > 0), 1 / rate, jnp.inf)
        h = jnp.minimum(0.1 * ratio * (100 * settings.rtol) ** (1 / 7), 0.01 * span)
        return jnp.where(here, h, out)

    everywhere = jnp.ones(lanes.t.shape[0], bool)
    return for_each_chart(s, lanes.chart, everywhere, work, 0.01 * span)
