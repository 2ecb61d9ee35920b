"""Outputs of hybrid states."""

from jaxtyping import Float

from .._core.executor import Array, namespace, on_host
from ..engine import kernels
from ..engine.lanes import Lanes, for_each_chart, needed, only
from ..systems.structure import Outputs, Structure


def observe(
    s: Structure, z: Outputs, lanes: Lanes, u: Float[Array, "nu L"]
) -> Float[Array, "ny L"]:
    """Outputs of every lane, NaN where its chart does not define them."""
    L = lanes.t.shape[0]

    def work(a, here, out):
        point = needed(here, [only(here, x) for x in (lanes.t, lanes.q[: s.dims[a]], u)])
        if on_host(here):
            values = kernels.outputs(s, a, tuple(z.items), *point)[:, 0]
        else:
            values = s.by_lane(lambda s, t, q, u: z(a, t, q, u))(*point)
        return xp.where(here, values, out)

    xp = namespace(lanes.t)
    nothing = xp.full((len(z.names), L), xp.nan)
    return for_each_chart(s, lanes.chart, xp.ones(L, bool), work, nothing)
