"""Outputs of hybrid states."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.lanes import Lanes, for_each_chart, needed, only
from ..systems.structure import Outputs, Structure


def observe(
    s: Structure, z: Outputs, lanes: Lanes, u: Float[Array, "nu L"]
) -> Float[Array, "ny L"]:
    """Outputs of every lane, NaN where its chart does not define them."""
    L = lanes.t.shape[0]

    def work(a, here, out):
        point = needed(here, [only(here, x) for x in (lanes.t, lanes.q[: s.dims[a]], u)])
        values = s.by_lane(lambda s, t, q, u: z(a, t, q, u))(*point)
        return jnp.where(here, values, out)

    nothing = jnp.full((len(z.names), L), jnp.nan)
    return for_each_chart(s, lanes.chart, jnp.ones(L, bool), work, nothing)
