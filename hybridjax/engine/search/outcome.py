"""What becomes of lanes after each of them has attempted a step.

As long as no watched function comes near to a zero in any lane, little has to be done (`calmly`);
otherwise `eventfully` finds out what happened.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.executor import Array, cond, namespace, put
from ..._core.lanes import pick
from ..._core.precision import at_precision
from ..._core.results import Result, update_result
from ...systems.structure import Structure
from ..events import apply_resets, enabled, keep_pace, rearm, width
from ..hermite import CubicCrossing, first_crossing
from ..lanes import Lanes
from ..solver.tableau import method_of
from ..tape import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, MOVE, Tape
from ..watch import Watch, watch
from .aim import Aim, Way
from .attempt import SLOW, Attempt, deviation
from .state import Approach, State, Task


# Steps below this part of the time allowed (in double and in single precision) are not taken: the
# lane is stuck. Twice as much gives up one halving earlier.
_SHORTEST_STEP = 1e-13, 1e-6
# A lane that is stuck blows up if its largest state changes by more than this part in that step:
# otherwise its field jumps. Any number between rounding and a tenth tells the two apart.
_STILL = 1e-3
# Attempts to land on a crossing before the step in which it was seen is halved. More of them only
# cost time where the cubic interpolant is no guide to the crossing.
_LANDING_TRIES = 8
# A landing may lie beyond the step in which the crossing was seen by this part of that step, and by
# this part of the time allowed (in double and in single precision). Twice as much accepts zeros
# that may belong to the step after it.
_BEYOND_STEP, _BEYOND_STEP_OF_SPAN = 1e-6, (1e-13, 1e-6)
# A target's level counts once it is above what its rate makes in this part of the time allowed (in
# double and in single precision). Twice as much may miss a level that falls right after the start;
# half may meet one that was at zero up to rounding.
_LEVEL_CLEAR = 1e-10, 1e-6
# The next step has this part of the length that the error estimate asks for, and lies between these
# multiples of the last one (the lowest where the estimate is no number). Nearer to 1, more steps
# are rejected.
_CAUTION, _SHRINK, _GROW, _SHRINK_BLINDLY = 0.9, 0.2, 3.0, 0.1


def calmly(
    s: Structure, state: State, aim: Aim, way: Way, new: Attempt, task: Task
) -> tuple[State, Tape]:
    """Nothing happened to any lane, except perhaps that it arrived. Also returns the row for the
    tape."""
    lanes, active, slack = state.lanes, state.active, task.stride.slack
    xp = namespace(lanes.t)
    level, on_time = active & new.lands, way.last
    moved = aim.step + xp.where(level, new.past, 0.0)
    t = xp.where(way.last, way.known, lanes.t + moved)
    arrived = level | on_time
    pace = put(lanes.pace, 0, lanes.pace[0] + moved)
    lanes = Lanes(t, lanes.chart, new.q, lanes.armed, lanes.events, pace)
    h = _next_step(state.h, aim.step, _length(s, lanes, new.error / slack))
    h = xp.where(active, h, state.h)
    late = active & ~arrived & (t >= task.target.limit)
    code = xp.where(on_time, ARRIVE_TIME, xp.where(level, ARRIVE_LEVEL, MOVE))
    code = xp.where(active, code, IDLE).astype(xp.int32)
    row = Tape(moved, code, t, new.q, new.q, lanes.chart)
    end = State(
        lanes,
        _merge(active, new.seen, state.seen),
        state.aimed,
        state.approach,
        h,
        new.along,
        state.error + xp.where(active, new.error, 0.0),
        update_result(state.result, late, task.target.missed),
        state.arrived | arrived,
        state.i + 1,
    )
    return end, row


def eventfully(
    s: Structure, state: State, aim: Aim, way: Way, new: Attempt, task: Task
) -> tuple[State, Tape]:
    """Find out what happened to each lane, and let it happen. Also returns the row for the tape."""
    lanes, seen, end, approach = state.lanes, state.seen, new.seen, state.approach
    active, target, slack = state.active, task.target, task.stride.slack
    xp, G = namespace(lanes.t), len(s.transitions)
    near = new.error <= slack

    # 1. Which approaches succeed.
    tau = approach.tau + new.past
    beyond = _BEYOND_STEP * approach.reach + at_precision(*_BEYOND_STEP_OF_SPAN) * task.span
    inside = (tau >= -beyond) & (tau <= approach.reach + beyond)
    falling = _of(end.rate, aim.which) < 0
    lands = active & new.lands & falling & xp.where(approach.on, inside, near)
    closer = active & approach.on & ~lands & (approach.tries < _LANDING_TRIES)
    lost = active & approach.on & ~lands & ~closer
    moved = aim.step + xp.where(new.lands, new.past, 0.0)
    t = xp.where(way.last, way.known, xp.where(active, lanes.t + moved, lanes.t))

    # 2. What was crossed on the way.
    ready = state.ready
    fresh = active & ~approach.on & near
    crossing = _crossing(fresh | lands, seen, end, moved, ready)
    zero = width(t, task.span, end.rate)
    chosen = lands & (np.arange(G + 1)[:, None] == aim.which)
    old = lands & (xp.abs(end.value) <= zero)
    s_first = xp.where(chosen | old, xp.inf, crossing.position)
    which = xp.argmin(s_first, axis=0).astype(xp.int32)
    first = xp.min(s_first, axis=0)
    bent = fresh & new.bent
    crosses = ((fresh | lands) & xp.isfinite(first)) & ~bent
    refine = bent | ((fresh | lands) & ~crosses & (crossing.near & ~chosen).any(axis=0))
    touch = fresh & ~crosses & (crossing.touch & ~chosen).any(axis=0)
    lands = lands & ~crosses & ~refine
    chosen = chosen & lands
    plain = fresh & ~crosses & ~refine & ~lands
    accept = plain | lands

    # 3. What happens there.
    clear = end.value > zero
    ready = xp.where(accept, ((ready & ((end.value > 0) | lands)) | clear) & ~chosen, ready)
    guard = lands & (aim.which < G)
    fires = guard & enabled(s, t, new.q, task.u, aim.which)
    by_clock = plain & (way.schedule >= 0)
    fired = xp.where(fires, aim.which, xp.where(by_clock, way.schedule, -1))
    level = lands & (aim.which == G)
    on_time = plain & way.last & ~by_clock
    arrived = on_time | level | ((fired >= 0) & (fired == target.event))
    speed = xp.abs(_of(end.rate, aim.which))
    slow = lands & (new.slow | (approach.on & (speed < SLOW * approach.rate)))
    pace, zeno = keep_pace(lanes.pace, xp.where(accept, moved, 0.0), fired >= 0, slow)
    expected = _expected(target.event_sequence, lanes.events, fired)
    falls = (xp.abs(end.value) <= zero) & (end.rate < 0)
    together = (ready & falls)[:-1].any(axis=0)
    after = Lanes(
        xp.where(accept, t, lanes.t),
        lanes.chart,
        xp.where(accept, new.q, lanes.q),
        ready[:-1],
        lanes.events + (fired >= 0),
        pace,
    )
    seen = _merge(accept, end, seen)
    after, seen, aimed = _reset(s, after, seen, ready[-1], fired, together, task)

    # 4. The next step, and reasons to stop.
    fastest = xp.maximum(xp.abs(_of(state.seen.rate, which)), xp.abs(_of(end.rate, which)))
    approach = Approach(
        crosses | closer,
        xp.where(crosses, which, approach.which),
        xp.where(crosses, first * moved, xp.clip(tau, 0.0, approach.reach)),
        xp.where(crosses, moved, approach.reach),
        xp.where(crosses, fastest, approach.rate),
        xp.where(crosses, 0, approach.tries + 1),
    )
    adapted = _next_step(state.h, aim.step, _length(s, lanes, new.error / slack))
    too_long = active & ~state.approach.on & ~near
    h = xp.where(plain | too_long, adapted, state.h)
    h = xp.where(fired >= 0, xp.maximum(h, task.stride.h), h)
    h = xp.where(refine, 0.5 * aim.step, xp.where(lost, 0.5 * aim.reach, h))
    stuck = (too_long | refine | lost) & (h < at_precision(*_SHORTEST_STEP) * task.span)
    graze = touch | (slow & ~zeno) | (stuck & (refine | lost))
    result = update_result(state.result, graze, Result.GRAZING)
    still = xp.max(xp.abs(new.q - lanes.q), axis=0) <= _STILL * xp.max(xp.abs(lanes.q), axis=0)
    result = update_result(result, stuck & still, Result.STEP_COLLAPSE)
    undefined = stuck & ~xp.isfinite(new.q).all(axis=0)
    result = update_result(result, undefined, Result.FIELD_NOT_FINITE)
    result = update_result(result, stuck, Result.BLOW_UP)
    result = update_result(result, zeno, Result.ZENO)
    result = update_result(result, (fired >= 0) & ~expected, Result.EVENT_ORDER)
    result = update_result(result, active & ~arrived & (after.t >= target.limit), target.missed)

    code = xp.where(accept, MOVE, IDLE)
    code = xp.where(on_time, ARRIVE_TIME, code)
    code = xp.where(level, ARRIVE_LEVEL, xp.where(fired >= 0, fired, code))
    row = Tape(moved, code.astype(xp.int32), t, new.q, after.q, after.chart)
    error = state.error + xp.where(accept, new.error, 0.0)
    arrived = state.arrived | arrived
    along = new.along
    if along is not None:
        anew = cond((fired >= 0).any(), lambda: deviation(s, after, task.settings), lambda: along)
        along = xp.where(fired >= 0, anew, xp.where(accept, along, state.along))
    end = State(after, seen, aimed, approach, h, along, error, result, arrived, state.i + 1)
    return end, row


def _crossing(
    some: Bool[Array, " L"],
    seen: Watch,
    end: Watch,
    moved: Float[Array, " L"],
    ready: Bool[Array, "W L"],
) -> CubicCrossing:
    """What was crossed on the way. (In a branch, so that it is not computed anew by every user.)"""

    xp = namespace(ready)

    def look():
        return first_crossing(seen.value, end.value, moved * seen.rate, moved * end.rate, ready)

    def nothing():
        no = xp.zeros_like(ready)
        return CubicCrossing(xp.full_like(end.value, xp.inf), no, no)

    return cond(some.any(), look, nothing)


def _length(s: Structure, lanes: Lanes, error: Float[Array, " L"]) -> Float[Array, " L"]:
    """The length of a step with this error, as a multiple of the one with an error of 1."""
    xp, orders = namespace(error), [method_of(s, a).order for a in range(len(s.charts))]
    if set(orders) == {8.0}:  # cheaper than a power
        return xp.sqrt(xp.sqrt(xp.sqrt(error)))
    return error ** xp.asarray(1 / np.array(orders))[lanes.chart]


def _next_step(
    h: Float[Array, " L"], step: Float[Array, " L"], length: Float[Array, " L"]
) -> Float[Array, " L"]:
    """The step after one of length `step`, which is so many times as long as it might be, where h
    was allowed."""
    xp = namespace(length)
    factor = xp.clip(_CAUTION / length, _SHRINK, _GROW)
    factor = xp.where(xp.isfinite(length), factor, _SHRINK_BLINDLY)
    return xp.where((step < h) & (length <= 1), xp.maximum(h, step * factor), step * factor)


def _reset(
    s: Structure,
    lanes: Lanes,
    seen: Watch,
    aimed: Bool[Array, " L"],
    fired: Int[Array, " L"],
    together: Bool[Array, " L"],
    task: Task,
) -> tuple[Lanes, Watch, Bool[Array, " L"]]:
    """The lanes after their events, what they see there, and whether they aim at their target."""
    xp, fires = namespace(fired), fired >= 0

    def work():
        q, chart = apply_resets(s, lanes.t, lanes.chart, lanes.q, task.u, fired)
        new = lanes._replace(q=q, chart=chart)
        after = watch(s, new.t, chart, q, task.u, task.target, fires)
        residue = xp.abs(_of(seen.value, fired))
        new = rearm(s, new, after, fired, together, task.span, task.u, residue)
        return new, _merge(fires, after, seen), xp.where(fires, aims(after, task.span), aimed)

    return cond(fires.any(), work, lambda: (lanes, seen, aimed))


def aims(seen: Watch, span: Float[Array, " L"]) -> Bool[Array, " L"]:
    """Whether the target's level is clearly positive, so that its next fall counts."""
    return seen.value[-1] > at_precision(*_LEVEL_CLEAR) * span * abs(seen.rate[-1])


def _merge(mask: Bool[Array, " L"], new: Watch, old: Watch) -> Watch:
    xp = namespace(mask)
    return Watch(xp.where(mask, new.value, old.value), xp.where(mask, new.rate, old.rate))


def _of(x: Float[Array, "W L"], which: Int[Array, " L"]) -> Float[Array, " L"]:
    """Each lane's entry in the row `which`; 0 for -1."""
    return pick(x, range(len(x)), which)


def _expected(
    sequence: tuple[int, ...] | None, events: Int[Array, " L"], fired: Int[Array, " L"]
) -> Bool[Array, " L"]:
    """Whether the next event of each lane is the one that the limit cycle has."""
    xp = namespace(fired)
    if sequence is None:
        return xp.ones(fired.shape, bool)
    if not sequence:
        return xp.zeros(fired.shape, bool)
    return xp.array(sequence)[events % len(sequence)] == fired
