"""Flow of many lanes to their targets, differentiable in forward and reverse mode."""

import equinox as eqx
import jax
from jaxtyping import Bool

from .._core.executor import namespace, on_host
from .._core.lanes import lane_jvp, shared, vmap_to_lanes
from .._core.results import Result
from ..systems.structure import Structure
from .arrays import Array, Index, Inputs, Times
from .lanes import Lanes, constant
from .replay import replay
from .search.first_step import initial_step, stride
from .search.search import Moved, Options, Recorded, search
from .search.state import Stride
from .settings import Settings
from .target import Target


def move(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    setout: Stride | Times | None = None,
    result: Index | None = None,
    new_input: bool = True,
) -> Moved:
    """Flow every lane to its target under a constant input.

    Lanes fail one by one, with a code each; nothing is raised. Times and states have exact
    derivatives (first and second, through crossings too) with respect to everything that is a
    floating-point array: states, times, inputs, parameters, the target.

    `setout` is the first step, or a `Stride`. With `new_input`, the guards are armed anew;
    otherwise they stay armed as they are.
    """
    options = Options(new_input=new_input)
    return _flow(s, lanes, u, target, settings, setout, result, options).moved


def glide(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    setout: Stride,
    result: Index,
) -> Moved:
    """The same as `move`, for lanes most of which are expected to arrive in one step."""
    options = Options(glide=True)
    return _flow(s, lanes, u, target, settings, setout, result, options).moved


def record(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    setout: Stride | Times | None = None,
    result: Index | None = None,
    new_input: bool = True,
    tangents: Bool[Array, ""] | bool = False,
) -> Recorded:
    """The same as `move`, with a record of every step, which has no derivatives.

    With `tangents`, steps are also short enough for the derivatives of a replay.
    """
    options = Options(tape=True, new_input=new_input, tangents=tangents)
    return _flow(s, lanes, u, target, settings, setout, result, options)


def _flow(s: Structure, lanes, u, target, settings, setout, result, options) -> Recorded:
    if setout is None:
        setout = initial_step(s, lanes, u, target.limit - lanes.t, settings)
    if not isinstance(setout, Stride):
        setout = stride(setout)
    if result is None:
        xp = namespace(lanes.t)
        result = xp.full(lanes.t.shape, Result.OK, xp.int32)
    if on_host(lanes.t):
        return search(s, lanes, u, target, setout, result, settings, options)
    return _move(s, lanes, u, target, constant(setout), result, settings, options)


@eqx.filter_jit
def _search(s, lanes, u, target, setout, result, settings, options: Options) -> Recorded:
    """`search`, with the axes that `jax.vmap` maps as more lanes."""

    def run(common, by_lane):
        s, levels, settings, options = common
        lanes, u, target, setout, result = by_lane
        target = target.with_levels(levels)
        return search(Structure(s), lanes, u, target, setout, result, shared(settings), options)

    target, levels = target.split()
    common = s.source, levels, settings, options
    return vmap_to_lanes(run)(common, (lanes, u, target, setout, result))


@eqx.filter_custom_jvp
def _move(s, lanes, u, target, setout, result, settings, options: Options) -> Recorded:
    return _search(s, lanes, u, target, setout, result, settings, options)


@_move.def_jvp
def _move_jvp(primals, tangents):
    s, lanes, u, target, setout, result, settings, options = primals
    closely = options.tangents is not False or not options.glide
    taped = options._replace(tape=True, glide=False, tangents=closely)
    still = constant((s, lanes, u, target, setout))
    recorded: Recorded = _search(*still, result, settings, taped)  # pyright: ignore[reportCallIssue]
    tape = recorded.tape
    assert tape is not None
    target, levels = target.split()

    def repeat(by_lane, common):
        (t, q, u, time), (s, levels) = by_lane, common
        begin = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        end = eqx.tree_at(lambda x: x.time, target, time).with_levels(levels)
        return replay(s, begin, u, end, tape, options.glide)

    t_s, t_lanes, t_u, t_target, *_ = tangents
    by_lane = (lanes.t, lanes.q, u, target.time), (t_lanes.t, t_lanes.q, t_u, t_target.time)
    (t, q), (t_t, t_q) = lane_jvp(repeat, by_lane, ((s, levels), (t_s, t_target.levels)))
    ends = lambda x: (x.moved.lanes.t, x.moved.lanes.q)  # noqa: E731
    out = eqx.tree_at(ends, Recorded(recorded.moved, tape if options.tape else None), (t, q))
    none = jax.tree_util.tree_map(lambda _: None, out)
    return out, eqx.tree_at(ends, none, (t_t, t_q), is_leaf=lambda x: x is None)
