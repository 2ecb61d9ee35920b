"""Flow of many lanes to their targets, differentiable in forward and reverse mode."""

import dataclasses

import equinox as eqx
import jax
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, namespace, on_host
from .._core.lanes import lane_jvp, shared, vmap_to_lanes
from .._core.results import Result
from ..systems.structure import Structure
from .lanes import Lanes, constant
from .replay import replay
from .search.search import Moved, Options, Recorded, search
from .search.stride import Stride, initial_step, stride
from .settings import Settings
from .tape import Tape
from .target import Target


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
    event_log: int = 0,
) -> Moved:
    """Flow every lane to its target under a constant input.

    Lanes fail one by one, with a code each; nothing is raised. Times and states have exact
    derivatives (first and second, through crossings too) with respect to everything that is a
    floating-point array: states, times, inputs, parameters, the target.

    `setout` is the first step, or a `Stride`. With `new_input`, the guards are armed anew;
    otherwise the lanes go on as they are. With `glide`, one step is thought to be enough for most.
    `event_log` is the number of events of each lane that are kept in `Moved.log`.
    """
    options = Options(glide=glide, new_input=new_input, event_log=event_log)
    return _begin(s, lanes, u, target, settings, setout, result, options).moved


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
) -> Recorded:
    """As `move`, with a record of every step, which has no derivatives.

    With `tangents`, steps are short enough for the derivatives, too, that a replay will have.
    """
    options = Options(tape=True, new_input=new_input, tangents=tangents)
    return _begin(s, lanes, u, target, settings, setout, result, options)


def retrace(
    s: Structure, lanes: Lanes, u: Float[Array, "nu L"], target: Target, tape: Tape
) -> tuple[Float[Array, " L"], Float[Array, "d L"]]:
    """Times and states at the end of a recorded piece of flow, differentiable."""
    return replay(s, lanes, u, target, tape.h, tape.code)


def _begin(s: Structure, lanes, u, target, settings, setout, result, options) -> Recorded:
    if setout is None:
        setout = initial_step(s, lanes, u, target.limit - lanes.t, settings)
    if not isinstance(setout, Stride):
        setout = stride(setout)
    if result is None:
        xp = namespace(lanes.t)
        result = xp.full(lanes.t.shape, Result.OK, xp.int32)
    if on_host(lanes.t):
        return search(s, lanes, u, target, setout, result, settings, options)
    return _move(s.source, lanes, u, target, constant(setout), result, settings, options)


@eqx.filter_jit
def _search(system, lanes, u, target, setout, result, settings, options: Options) -> Recorded:
    """`search`, with the axes that `jax.vmap` maps as more lanes."""
    bare = dataclasses.replace(target, levels=None)

    def run(common, lane):
        system, levels, settings, options = common
        lanes, u, bare, setout, result = lane
        target = dataclasses.replace(bare, levels=levels)
        s = Structure(system)
        return search(s, lanes, u, target, setout, result, shared(settings), options)

    common = system, target.levels, settings, options
    return vmap_to_lanes(run)(common, (lanes, u, bare, setout, result))


@eqx.filter_custom_jvp
def _move(system, lanes, u, target, setout, result, settings, options: Options) -> Recorded:
    return _search(system, lanes, u, target, setout, result, settings, options)


@_move.def_jvp
def _move_jvp(primals, tangents):
    system, lanes, u, target, setout, result, settings, options = primals
    closely = options.tangents is not False or not options.glide
    taped = options._replace(tape=True, glide=False, tangents=closely)
    system_, lanes_, u_, target_ = constant((system, lanes, u, target))
    found = _search(system_, lanes_, u_, target_, constant(setout), result, settings, taped)
    tape = found.tape

    def repeat(lane, common):
        (t, q, u, time), (system, levels) = lane, common
        begin = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        to = dataclasses.replace(target, time=time, levels=levels)
        return replay(Structure(system), begin, u, to, tape.h, tape.code, options.glide)

    t_system, t_lanes, t_u, t_target, *_ = tangents
    lane = (lanes.t, lanes.q, u, target.time), (t_lanes.t, t_lanes.q, t_u, t_target.time)
    common = (system, target.levels), (t_system, t_target.levels)
    (t, q), (t_t, t_q) = lane_jvp(repeat, lane, common)
    ends = lambda x: (x.moved.lanes.t, x.moved.lanes.q)  # noqa: E731
    out = eqx.tree_at(ends, Recorded(found.moved, tape if options.tape else None), (t, q))
    nothing = jax.tree_util.tree_map(lambda _: None, out)
    return out, eqx.tree_at(ends, nothing, (t_t, t_q), is_leaf=lambda x: x is None)
