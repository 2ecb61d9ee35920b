"""Flow of many lanes to their targets, differentiable in forward and reverse mode."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.results import Result
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from .lanes import Lanes
from .replay import replay
from .search import initial_step, search, Tape
from .target import Target


class Settings(eqx.Module):
    """Accuracy and effort of the flow."""

    rtol: float = eqx.field(static=True, default=1e-10)
    """Bound on a step's error estimate relative to each state's size."""
    atol: float = eqx.field(static=True, default=1e-10)
    """Bound on a step's error estimate, absolute."""
    max_steps: int = eqx.field(static=True, default=256)
    """Bound on the number of iterations (steps, tried or taken) of one piece of flow."""


class Moved(eqx.Module):
    """Lanes at the end of a piece of flow."""

    lanes: Lanes
    h: Float[Array, " L"]
    """Step size to go on with."""
    result: Int[Array, " L"]
    """`Result` codes. A lane that failed stands where it failed."""


def move(
    system: HybridSystem,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    settings: Settings,
    h: Float[Array, " L"] | None = None,
    result: Int[Array, " L"] | None = None,
) -> Moved:
    """Flow every lane to its target under a constant input.

    Lanes fail one by one, with a code each; nothing is raised. Exact first derivatives (and
    second, through crossings too) of times and states with respect to everything that is a
    floating-point array: states, times, inputs, parameters, the target.
    """
    if h is None:
        h = initial_step(Structure(system), lanes, u, target.limit - lanes.t, settings.rtol)
    if result is None:
        result = jnp.full(lanes.t.shape, Result.OK, jnp.int32)
    h = jax.lax.stop_gradient(h)
    return _move(system, lanes, u, target, h, result, settings)


def trace(
    system: HybridSystem, lanes: Lanes, u: Float[Array, "nu L"], target: Target, settings: Settings
) -> tuple[Moved, Tape]:
    """As `move`, with a record of every step. Not differentiable."""
    s = Structure(system)
    h = initial_step(s, lanes, u, target.limit - lanes.t, settings.rtol)
    result = jnp.full(lanes.t.shape, Result.OK, jnp.int32)
    found = _search(s, lanes, u, target, h, result, settings, tape=True)
    return Moved(found.lanes, found.h, found.result), found.tape


def _search(s, lanes, u, target, h, result, settings, tape):
    return search(
        s,
        lanes,
        u,
        target,
        h=h,
        result=result,
        rtol=settings.rtol,
        atol=settings.atol,
        max_steps=settings.max_steps,
        tape=tape,
    )


@eqx.filter_custom_jvp
def _move(system, lanes, u, target, h, result, settings):
    found = _search(Structure(system), lanes, u, target, h, result, settings, tape=False)
    return Moved(found.lanes, found.h, found.result)


@_move.def_jvp
def _move_jvp(primals, tangents):
    system, lanes, u, target, h, result, settings = primals
    found = _search(Structure(system), lanes, u, target, h, result, settings, tape=True)
    h_tape, code = found.tape.h, found.tape.code

    def follow(system, t, q, u, target):
        start = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        return replay(Structure(system), start, u, target, h_tape, code)

    t_system, t_lanes, t_u, t_target, *_ = tangents
    (t, q), (t_t, t_q) = eqx.filter_jvp(
        follow,
        (system, lanes.t, lanes.q, u, target),
        (t_system, t_lanes.t, t_lanes.q, t_u, t_target),
    )
    end = eqx.tree_at(lambda x: (x.t, x.q), found.lanes, (t, q))
    out = Moved(end, found.h, found.result)
    nothing = jax.tree_util.tree_map(lambda _: None, out)
    d_out = eqx.tree_at(
        lambda x: (x.lanes.t, x.lanes.q), nothing, (t_t, t_q), is_leaf=lambda x: x is None
    )
    return out, d_out
