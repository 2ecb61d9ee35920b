"""Flow of many lanes to their targets, differentiable in forward and reverse mode."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.lane_jvp import lane_jvp
from .._core.per_lane import shared
from .._core.results import Result
from .._core.vmap_as_lanes import vmap_to_lanes
from ..systems.structure import Structure
from .lanes import Lanes
from .replay import replay
from .search import Moved, search
from .settings import Settings
from .stride import Stride, initial_step, stride
from .tape import Tape
from .target import Target


class _How(NamedTuple):
    """Ways of `search`."""

    tape: bool
    glide: bool
    new_input: bool
    tangents: Bool[Array, ""] | bool


def move(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    settings: Settings,
    setout: Stride | Float[Array, " L"] | None = None,
    result: Int[Array, " L"] | None = None,
    new_input: bool = True,
    glide: bool = False,
) -> Moved:
    """Flow every lane to its target under a constant input.

    Lanes fail one by one, with a code each; nothing is raised. Times and states have exact
    derivatives (first and second, through crossings too) with respect to everything that is a
    floating-point array: states, times, inputs, parameters, the target.

    `setout` is the first step, or a `Stride`. With `new_input`, the guards are armed anew;
    otherwise the lanes go on as they are. With `glide`, one step is thought to be enough for most.
    """
    how = _How(False, glide, new_input, False)
    setout, result = _defaults(s, lanes, u, target, settings, setout, result)
    return _move(s.source, lanes, u, target, setout, result, settings, how)[0]


def record(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    settings: Settings,
    setout: Stride | Float[Array, " L"] | None = None,
    result: Int[Array, " L"] | None = None,
    new_input: bool = True,
    tangents: Bool[Array, ""] | bool = False,
) -> tuple[Moved, Tape]:
    """As `move`, with a record of every step, which has no derivatives.

    With `tangents`, steps are short enough for the derivatives, too, that a replay will have.
    """
    how = _How(True, False, new_input, tangents)
    setout, result = _defaults(s, lanes, u, target, settings, setout, result)
    return _move(s.source, lanes, u, target, setout, result, settings, how)


def retrace(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    tape: Tape,
) -> tuple[Float[Array, " L"], Float[Array, "d L"]]:
    """Times and states at the end of a recorded piece of flow, differentiable."""
    return replay(s, lanes, u, target, tape.h, tape.code)


def _defaults(s, lanes, u, target, settings, setout, result):
    if setout is None:
        setout = initial_step(s, lanes, u, target.limit - lanes.t, settings)
    if not isinstance(setout, Stride):
        setout = stride(setout)
    if result is None:
        result = jnp.full(lanes.t.shape, Result.OK, jnp.int32)
    return constant(setout), result


def constant(tree):
    """The same numbers without derivatives."""
    return jax.tree_util.tree_map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, tree
    )


@eqx.filter_jit
def _search(system, lanes, u, target, setout, result, settings, how: _How):
    bare = dataclasses.replace(target, levels=None)
    run = vmap_to_lanes(lambda common, lane: _run(*common, *lane))
    return run((system, target.levels, settings, how), (lanes, u, bare, setout, result))


def _run(system, levels, settings, how: _How, lanes, u, target, setout, result):
    return search(
        Structure(system),
        lanes,
        u,
        dataclasses.replace(target, levels=levels),
        stride=setout,
        result=result,
        settings=shared(settings),
        **how._asdict(),
    )


@eqx.filter_custom_jvp
def _move(system, lanes, u, target, setout, result, settings, how: _How):
    return _search(system, lanes, u, target, setout, result, settings, how)


@_move.def_jvp
def _move_jvp(primals, tangents):
    system, lanes, u, target, setout, result, settings, how = primals
    closely = how.tangents is not False or not how.glide
    taped = how._replace(tape=True, glide=False, tangents=closely)
    go = (constant(x) for x in (system, lanes, u, target, setout, result))
    moved, tape = _search(*go, settings, taped)

    def repeat(lane, common):
        (t, q, u, time), (system, levels) = lane, common
        start = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        to = dataclasses.replace(target, time=time, levels=levels)
        return replay(Structure(system), start, u, to, tape.h, tape.code, how.glide)

    t_system, t_lanes, t_u, t_target, *_ = tangents
    lane = (lanes.t, lanes.q, u, target.time), (t_lanes.t, t_lanes.q, t_u, t_target.time)
    common = (system, target.levels), (t_system, t_target.levels)
    (t, q), (t_t, t_q) = lane_jvp(repeat, lane, common)
    ends = lambda x: (x[0].lanes.t, x[0].lanes.q)  # noqa: E731
    out = eqx.tree_at(ends, (moved, tape if how.tape else None), (t, q))
    nothing = jax.tree_util.tree_map(lambda _: None, out)
    return out, eqx.tree_at(ends, nothing, (t_t, t_q), is_leaf=lambda x: x is None)
