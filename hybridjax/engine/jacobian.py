"""Jacobians of the flow between targets, for many lanes in one call."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from .._core.executor import namespace, on_host
from .._core.lanes import vmap_to_lanes
from ..systems.structure import Structure
from .arrays import Array, Index, Times
from .chain import chain
from .lanes import Lanes, constant
from .move import record
from .replay import replay
from .search.search import Moved
from .settings import Settings
from .tape import Tape
from .target import Target


Jacobians = Float[Array, "L n m"]
Wanted = Bool[Array, ""] | bool


def flow_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    settings: Settings,
    h: Times | None = None,
    result: Index | None = None,
    new_input: bool = True,
    wanted: Wanted = True,
) -> tuple[Jacobians, Moved, Tape]:
    """Derivative of (t, q) at the targets with respect to q at the start, without input. If it is
    not `wanted`, zeros: only the flow is computed then.

    Exact, through every event on the way, and differentiable once more. Each column is one
    forward-mode tangent; all columns and lanes are pushed forward in one pass. (Linearizing first
    and mapping afterwards would store every stage, and takes 20 times as long.)

    **Returns:** the Jacobians, the lanes at their targets, and the record of the flow.
    """
    u = namespace(lanes.t).zeros((s.nu, lanes.t.shape[0]))
    fixed = (s, lanes, target) if on_host(lanes.t) else constant((s, lanes, target))
    still, start, goal = fixed
    moved, tape = record(still, start, u, goal, settings, h, result, new_input, tangents=wanted)
    assert tape is not None
    jacobian, end = tape_jacobian(s, lanes, target, tape, of_states=True, wanted=wanted)
    if wanted is not True:
        end = jnp.where(wanted, end, jnp.concatenate([moved.lanes.t[None], moved.lanes.q]))
    return jacobian, moved._replace(lanes=moved.lanes._replace(t=end[0], q=end[1:])), tape


def tape_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    tape: Tape,
    of_states: bool = False,
    wanted: Wanted = True,
    across: Float[Array, "A d"] | None = None,
) -> tuple[Jacobians, Float[Array, "n L"]]:
    """Derivative of (t, q) at the targets of a recorded flow with respect to (t, q, u) at the
    start, at u = 0, or to q only (`of_states`), and (t, q) at the targets; both are zeros if they
    are not `wanted`. `across`: see `chain`; traced, it makes no difference."""
    if on_host(lanes.t):
        return chain(s, lanes, target, tape, of_states, across)
    columns, end = _push(s, lanes, target, tape, of_states, wanted)
    return columns.transpose(2, 1, 0), end


def _columns(s, lanes, target, tape, of_states):
    """Derivatives (m, n, L) and (t, q) at the end (n, L)."""
    L, d = lanes.t.shape[0], s.d
    n = 1 + d + s.nu

    def flow(x):
        start = eqx.tree_at(lambda y: (y.t, y.q), lanes, (x[0], x[1 : 1 + d]))
        t, q = replay(s, start, x[1 + d :], target, tape)
        return jnp.concatenate([t[None], q])

    x = jnp.concatenate([lanes.t[None], lanes.q, jnp.zeros((s.nu, L))])
    directions = jnp.eye(n)[1 : 1 + d] if of_states else jnp.eye(n)
    tangents = jnp.broadcast_to(directions[:, :, None], (*directions.shape, L))
    push = jax.vmap(lambda tangent: jax.jvp(flow, (x,), (tangent,)), out_axes=(None, 0))
    end, columns = push(tangents)
    return columns, end


@eqx.filter_custom_jvp
def _push(s, lanes, target, tape, of_states, wanted):
    """`_columns` where they are wanted, with the axes that `jax.vmap` maps as more lanes."""

    def run(common, by_lane):
        source, levels, wanted = common
        lanes, target, tape = by_lane

        def columns():
            return _columns(Structure(source), lanes, target.with_levels(levels), tape, of_states)

        def zeros():
            shapes = jax.eval_shape(columns)
            return jax.tree_util.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        return columns() if wanted is True else jax.lax.cond(wanted, columns, zeros)

    target, levels = target.split()
    return vmap_to_lanes(run)((s.source, levels, wanted), (lanes, target, tape))


@_push.def_jvp
def _push_jvp(primals, tangents):
    return eqx.filter_jvp(_columns, primals[:-1], tangents[:-1])
