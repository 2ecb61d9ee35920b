"""Jacobians of the flow between targets, for many lanes in one call."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..flow.lanes import Lanes
from ..flow.move import Moved, Settings, follow, record
from ..flow.tape import Tape
from ..flow.target import Target
from ..systems.structure import Structure
from ..systems.system import HybridSystem


def flow_jacobian(
    system: HybridSystem,
    lanes: Lanes,
    target: Target,
    settings: Settings,
    h: Float[Array, " L"] | None = None,
    result: Int[Array, " L"] | None = None,
) -> tuple[Float[Array, "L n m"], Moved, Tape]:
    """Derivative of (t, q) at the targets with respect to (t, q, u) at the start, at u = 0.

    Exact, through every event on the way, and differentiable once more. Each column is one
    forward-mode tangent; all columns and lanes are pushed forward in one pass. (Linearising first
    and mapping afterwards would store every stage, and takes 20 times as long.)

    **Returns:** the Jacobians, the lanes at their targets, and the record of the flow.
    """
    s = Structure(system)
    L, d = lanes.t.shape[0], s.d
    n = 1 + d + s.nu
    zero = jnp.zeros((s.nu, L))
    moved, tape = record(system, lanes, zero, target, settings, h, result)

    def flow(x):
        start = eqx.tree_at(lambda y: (y.t, y.q), lanes, (x[0], x[1 : 1 + d]))
        t, q = follow(system, start, x[1 + d :], target, tape)
        return jnp.concatenate([t[None], q])

    x = jnp.concatenate([lanes.t[None], lanes.q, zero])
    tangents = jnp.broadcast_to(jnp.eye(n)[:, :, None], (n, n, L))
    push = jax.vmap(lambda tangent: jax.jvp(flow, (x,), (tangent,)), out_axes=(None, 0))
    end, columns = push(tangents)
    moved = eqx.tree_at(lambda x: (x.lanes.t, x.lanes.q), moved, (end[0], end[1:]))
    return columns.transpose(2, 1, 0), moved, tape
