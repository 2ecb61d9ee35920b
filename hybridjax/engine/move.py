"""Flow of many trajectories (lanes) to their targets, with derivatives.

`move` is the function that other code calls. Its values are those of a search (`search/`), which
decides on steps and events and records them on a tape. Its derivatives, in forward and reverse
mode, are those of a `replay` of this tape (the same steps again, without decisions). `_move_jvp` is
the rule that joins both. With arrays of NumPy, `move` calls the search on the host, without
derivatives; with those of JAX, it is traced.

- `through` flows a lane to one target after the other, such as the ends of the pieces of a turn.
- `follow` gives the derivatives of `move` to a flow that was recorded before.
- `flow_jacobian` and `tape_jacobian` compute Jacobians, all columns at once.

Nothing is decided here: look for wrong values in the search, and for wrong derivatives in
`replay.py`, which says how single moves are tested. What this file can get wrong is which numbers
are held constant (`fixed`), and which axes of `jax.vmap` become lanes (`_over_lanes`).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.compilation import whole
from .._core.executor import namespace, on_host, scan
from .._core.lanes import lane_jvp, shared, vmap_to_lanes
from .._core.results import Result
from ..systems.structure import Structure
from .arrays import Array, Index, Inputs, Times
from .lanes import Lanes, Tape, fixed, stack_rows
from .replay import chain, replay
from .search.search import initial_step, search
from .search.state import Moved, Options, Recorded, Stride
from .settings import Settings
from .target import Target


Jacobians = Float[Array, "L n m"]
_PLAIN = Options()


def move(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    setout: Stride | Times | None = None,
    result: Index | None = None,
    options: Options = _PLAIN,
) -> Recorded:
    """Flow every lane to its target under a constant input.

    Nothing is raised: a lane that fails has a `Result` code. Times and states have exact first and
    second derivatives, through crossings, too, with respect to all floating-point arrays: states,
    times, inputs, parameters, the target. The tape has no derivatives.

    `setout` is the first step, or a `Stride`.
    """
    xp = namespace(lanes.t)
    if setout is None:
        setout = initial_step(s, lanes, u, target.limit - lanes.t, settings)
    if not isinstance(setout, Stride):
        setout = stride(setout)
    if result is None:
        result = xp.full(lanes.t.shape, Result.OK, xp.int32)
    if on_host(lanes.t):
        return search(s, lanes, u, target, settings, setout, result, options)
    return _move(s, lanes, u, target, fixed(setout), result, settings, options)


def stride(h: Times) -> Stride:
    """A `Stride` with this first step, without other knowledge of the way."""
    return Stride(h, h * 0, h * 0 + 1)


def through(
    s: Structure,
    begin: tuple[Lanes, Stride, Index],
    u: Inputs,
    targets: Target,
    settings: Settings,
    options: Options,
    patience: float = np.inf,
) -> tuple[tuple[Lanes, Stride, Index], tuple[Lanes, Moved, Tape | None]]:
    """Flow a single lane, or lanes with a system each, to the `targets` one after the other. A flow
    to one target lasts no longer than `patience`. On the host this takes many calls of small
    programs, or one call of a large program if `options.at_once`.

    **Arguments:** `begin`: the lanes, their strides and their results.

    **Returns:** the lanes, strides and results at the last target; for each target (rows) the lanes
    before, the lanes at the target, and the tape.
    """
    ends = (targets.time, targets.index, targets.event, targets.limit)
    levels = targets.levels
    failures = targets.missed, targets.event_sequence
    if not options.at_once:
        static = (move, options, *failures)
        return _pieces(static, s, levels, settings, ends, begin, u, patience)
    static = (search, options._replace(at_once=False), *failures)

    def make():
        return whole(_pieces, (static,), (s, levels, settings))

    arguments = ends, begin, u, np.float64(patience)
    return s.once(("through", static), (levels, settings), make)(*arguments)


def _pieces(static: tuple, s, levels, settings, ends, begin, u, patience):
    """The pieces of `through`, as a loop. `ends` has the fields of the targets that differ from one
    piece to the next; `static` has those that do not, and the function that makes a piece."""
    flow, options, missed, sequence = static

    def piece(carry, end):
        lanes, stride, result = carry
        time, index, event, limit = (namespace(x).atleast_1d(x) for x in end)
        limit = namespace(time).minimum(limit, lanes.t + patience)
        target = Target(
            time=time,
            index=index,
            event=event,
            limit=limit,
            event_sequence=sequence,
            levels=levels,
            missed=missed,
        )
        moved, tape = flow(s, lanes, u, target, settings, stride, result, options)
        carry = moved.lanes, stride._replace(h=moved.h), moved.result
        return carry, (lanes, moved, tape)

    return scan(piece, begin, ends, stack_rows)


@eqx.filter_jit
def searched(
    s, lanes, u, target, setout, result, settings, options: Options
) -> Recorded:
    """The search as a program, without derivatives. Axes that `jax.vmap` maps become further
    lanes."""

    def run(s, target, common, by_lane):
        settings, options = common
        lanes, u, setout, result = by_lane
        return search(s, lanes, u, target, shared(settings), setout, result, options)

    return _over_lanes(run, s, target, (settings, options), (lanes, u, setout, result))


def _over_lanes(
    run: Callable, s: Structure, target: Target, common: tuple, by_lane: tuple
) -> Any:
    """Call `run(s, target, common, by_lane)`. Axes that `jax.vmap` maps become further lanes."""

    def whole(common, by_lane):
        source, levels, *common = common
        target, *by_lane = by_lane
        return run(Structure(source), target.with_levels(levels), common, by_lane)

    target, levels = target.split()
    return vmap_to_lanes(whole)((s.source, levels, *common), (target, *by_lane))


@eqx.filter_custom_jvp
def _move(s, lanes, u, target, setout, result, settings, options: Options) -> Recorded:
    return searched(s, lanes, u, target, setout, result, settings, options)


@_move.def_jvp
def _move_jvp(primals, tangents):
    """Search without derivatives, with steps that suit derivatives, and replay its tape."""
    s, lanes, u, target, setout, result, settings, options = primals
    taped = options._replace(tape=True, tangents=True)
    still = fixed((s, lanes, u, target, setout))
    recorded: Recorded = searched(*still, result, settings, taped)  # pyright: ignore[reportCallIssue]
    primals = s, lanes, u, target, recorded
    ends = _follow_jvp(primals, (*tangents[:4], None))
    return ends if options.tape else tuple(x._replace(tape=None) for x in ends)


@eqx.filter_custom_jvp
def follow(s, lanes, u, target, recorded: Recorded) -> Recorded:
    """The values of a recorded flow, with the derivatives of `move` at `lanes`, which must be close
    to the start of the record."""
    return recorded


def _follow_jvp(primals, tangents):
    """Times and states at the end with their derivatives, by a replay. All else has none."""
    s, lanes, u, target, recorded = primals
    target, levels = target.split()

    def repeat(by_lane, common):
        t, q, u, time = by_lane
        s, levels = common
        begin = eqx.tree_at(lambda x: (x.t, x.q), lanes, (t, q))
        end = eqx.tree_at(lambda x: x.time, target, time).with_levels(levels)
        return replay(s, begin, u, end, recorded.tape)

    t_s, t_lanes, t_u, t_target, *_ = tangents
    point = lanes.t, lanes.q, u, target.time
    t_point = t_lanes.t, t_lanes.q, t_u, t_target.time
    common = (s, levels), (t_s, t_target.levels)
    (t, q), (t_t, t_q) = lane_jvp(repeat, (point, t_point), common)

    def ends(x):
        return (x.moved.lanes.t, x.moved.lanes.q)

    out = eqx.tree_at(ends, recorded, (t, q))
    none = jax.tree_util.tree_map(lambda _: None, out)
    return out, eqx.tree_at(ends, none, (t_t, t_q), is_leaf=lambda x: x is None)


follow.def_jvp(_follow_jvp)


def flow_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    settings: Settings,
    h: Times,
    result: Index,
) -> tuple[Jacobians, Moved, Tape]:
    """Derivative of (t, q) at the targets with respect to q at the start, in JAX. The input does
    not jump at the start.

    The derivative is exact, through every event on the way, and can be differentiated once more.
    Each column is one forward-mode tangent; all columns and lanes are pushed forward in one pass.
    (Linearizing first and mapping afterwards would store every stage, and takes 20 times as long.)

    **Returns:** the Jacobians, the lanes at their targets, and the record of the flow.
    """
    still, start, goal = fixed((s, lanes, target))
    u = jnp.zeros((s.nu, 1))
    options = Options(tape=True, new_input=False, tangents=True)
    moved, tape = move(still, start, u, goal, settings, h, result, options)
    assert tape is not None
    jacobian, end = tape_jacobian(s, lanes, target, tape, of_states=True)
    ends = moved.lanes._replace(t=end[0], q=end[1:])
    return jacobian, moved._replace(lanes=ends), tape


def tape_jacobian(
    s: Structure,
    lanes: Lanes,
    target: Target,
    tape: Tape,
    of_states: bool = False,
    across: Float[Array, "A d"] | None = None,
) -> tuple[Jacobians, Float[Array, "n L"]]:
    """Derivative of (t, q) at the targets of a recorded flow with respect to (t, q, u) at the
    start, at u = 0; and (t, q) at the targets.

    **Arguments:** `of_states`: take derivatives by q only. `across`: see `chain`; it has no effect
    inside of programs of JAX.
    """
    if on_host(lanes.t):
        return chain(s, lanes, target, tape, of_states, across)
    columns, end = _push(s, lanes, target, tape, of_states)
    return columns.transpose(2, 1, 0), end


def _columns(s, lanes, target, tape, of_states):
    """Derivatives (m, n, L) and (t, q) at the end (n, L)."""
    L = lanes.t.shape[0]
    states = slice(1, 1 + s.d)
    inputs = slice(1 + s.d, None)

    def flow(point):
        begin = point[0], point[states]
        start = eqx.tree_at(lambda x: (x.t, x.q), lanes, begin)
        t, q = replay(s, start, point[inputs], target, tape)
        return jnp.concatenate([t[None], q])

    def push(tangent):
        return jax.jvp(flow, (point,), (tangent,))

    unpushed = jnp.zeros((s.nu, L))
    point = jnp.concatenate([lanes.t[None], lanes.q, unpushed])
    directions = jnp.eye(len(point))
    if of_states:
        directions = directions[states]
    tangents = jnp.broadcast_to(directions[:, :, None], (*directions.shape, L))
    end, columns = jax.vmap(push, out_axes=(None, 0))(tangents)
    return columns, end


@eqx.filter_custom_jvp
def _push(s, lanes, target, tape, of_states):
    """Call `_columns`. Axes that `jax.vmap` maps become further lanes."""

    def run(s, target, common, by_lane):
        return _columns(s, by_lane[0], target, by_lane[1], of_states)

    return _over_lanes(run, s, target, (), (lanes, tape))


@_push.def_jvp
def _push_jvp(primals, tangents):
    return eqx.filter_jvp(_columns, primals, tangents)
