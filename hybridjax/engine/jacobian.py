"""Jacobians of the flow between targets, for many lanes in one call."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, namespace, on_host
from .._core.lanes import vmap_to_lanes
from ..systems.structure import Structure
from .chain import chain
from .lanes import Lanes, constant
from .move import record, retrace
from .search.search import Moved
from .settings import Settings
from .tape import Tape
from .target import Target


def flow_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    settings: Settings,
    h: Float[Array, " L"] | None = None,
    result: Int[Array, " L"] | None = None,
    of_states: bool = False,
    new_input: bool = True,
    wanted: Bool[Array, ""] | bool = True,
) -> tuple[Float[Array, "L n m"], Moved, Tape]:
    """Derivative of (t, q) at the targets with respect to (t, q, u) at the start, at u = 0, or with
    respect to q only (`of_states`). If it is not `wanted`, zeros: only the flow is computed then.

    Exact, through every event on the way, and differentiable once more. Each column is one
    forward-mode tangent; all columns and lanes are pushed forward in one pass. (Linearizing first
    and mapping afterwards would store every stage, and takes 20 times as long.)

    **Returns:** the Jacobians, the lanes at their targets, and the record of the flow.
    """
    u = namespace(lanes.t).zeros((s.nu, lanes.t.shape[0]))
    still, begin, end = s, lanes, target
    if not on_host(lanes.t):
        source, begin, end = constant((s.source, lanes, target))
        still = Structure(source)
    moved, tape = record(still, begin, u, end, settings, h, result, new_input, tangents=wanted)
    jacobian, end = tape_jacobian(s, lanes, target, tape, of_states, wanted)
    if wanted is not True:
        end = jnp.where(wanted, end, jnp.concatenate([moved.lanes.t[None], moved.lanes.q]))
    ends = moved.lanes._replace(t=end[0], q=end[1:])
    moved = moved._replace(lanes=ends)
    return jacobian, moved, tape


def tape_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    tape: Tape,
    of_states: bool = False,
    wanted: Bool[Array, ""] | bool = True,
    across: Float[Array, "A d"] | None = None,
) -> tuple[Float[Array, "L n m"], Float[Array, "n L"]]:
    """What `flow_jacobian` returns, for a flow whose record is there already: the Jacobians, and
    (t, q) at the targets; both are zeros if they are not `wanted`. `across`: see `chain`; traced,
    it makes no difference."""
    if on_host(lanes.t):
        return chain(s, lanes, target, tape, of_states, across)
    columns, end = _push(s.source, lanes, target, tape, of_states, wanted)
    return columns.transpose(2, 1, 0), end


def _columns(system, lanes, target, tape, of_states):
    """Derivatives (m, n, L) and (t, q) at the end (n, L)."""
    s = Structure(system)
    L, d = lanes.t.shape[0], s.d
    n = 1 + d + s.nu

    def flow(x):
        start = eqx.tree_at(lambda y: (y.t, y.q), lanes, (x[0], x[1 : 1 + d]))
        t, q = retrace(s, start, x[1 + d :], target, tape)
        return jnp.concatenate([t[None], q])

    x = jnp.concatenate([lanes.t[None], lanes.q, jnp.zeros((s.nu, L))])
    directions = jnp.eye(n)[1 : 1 + d] if of_states else jnp.eye(n)
    tangents = jnp.broadcast_to(directions[:, :, None], (*directions.shape, L))
    push = jax.vmap(lambda tangent: jax.jvp(flow, (x,), (tangent,)), out_axes=(None, 0))
    end, columns = push(tangents)
    return columns, end


@eqx.filter_custom_jvp
def _push(system, lanes, target, tape, of_states, wanted):
    """`_columns` where they are wanted, with the axes that `jax.vmap` maps as more lanes."""
    bare = dataclasses.replace(target, levels=None)

    def run(common, lane):
        system, levels, wanted = common
        lanes, target, tape = lane
        target = dataclasses.replace(target, levels=levels)

        def columns():
            return _columns(system, lanes, target, tape, of_states)

        def nothing():
            shapes = jax.eval_shape(columns)
            return jax.tree_util.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        return columns() if wanted is True else jax.lax.cond(wanted, columns, nothing)

    return vmap_to_lanes(run)((system, target.levels, wanted), (lanes, bare, tape))


@_push.def_jvp
def _push_jvp(primals, tangents):
    return eqx.filter_jvp(_columns, primals[:-1], tangents[:-1])
