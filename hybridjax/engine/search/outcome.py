"""Outcome of attempted steps: accepted states, events, and reasons to stop.

`search.py` calls one of two functions in each iteration, with the attempted steps of all lanes, and
gets the next `State` and the row of the tape: `without_events` if no lane comes near an event, and
`with_events` otherwise. Both must give the same result where both apply. In `with_events`, the
failures are a list: the first one that holds is the `Result` of the lane. If a reason of a failure
is wrong, look there; if a state after an event is wrong, look at `_reset`.
"""

import numpy as np
from jaxtyping import Bool, Float

from ..._core.executor import cond, namespace, put
from ..._core.results import Result, update_result
from ...systems.structure import Structure
from ...systems.transition import SAME_TIME
from ..arrays import Array, Index, Mask, Times
from ..cubic import bend_at_end
from ..events import (
    INSTANT,
    Entry,
    apply_resets,
    await_schedules,
    belongs,
    enabled,
    guard_noise,
    keep_pace,
    rearm,
    rival_of,
    width,
    with_schedules,
)
from ..lanes import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, MOVE, Lanes, Tape
from ..settings import ROUNDING
from ..watch import Watch, watch
from .accept import TURN, Verdict, accept, next_step, of_row, step_length
from .attempt import SLOW, deviation
from .state import Aim, Approach, Attempt, State, Task


# A crossing is a grazing if the guard would turn less than this many half rounding errors below
# zero. Higher: crossings whose derivatives are right to four digits are called grazing. Lower:
# derivatives of crossings are made of rounding errors.
_SHALLOW = 1e5
# Only crossings slower than this part of the guard's rate at the start of the step are tested for
# `_SHALLOW`. Higher: rounding errors are computed for more events. Lower: a grazing is missed after
# a short step.
_MAY_BE_SHALLOW = 0.1
# The second derivative of a watched function at its zero is at least this part of its average over
# the step. Higher: crossings at the end of long steps are called grazing. Lower: a grazing is
# missed where rounding spoils the second derivative.
_LEAST_BEND = 0.05
# The shortest step near t = 0, as a part of the time allowed. Larger: events just before a state
# would leave all bounds (spikes of a neuron) are missed. Smaller: more steps until a blow-up is
# reported.
_SHORTEST = 1e-18


def without_events(
    state: State, aim: Aim, new: Attempt, task: Task
) -> tuple[State, Tape]:
    """The state after steps that are accepted in all active lanes, without events, and the row of
    the tape. Lanes may arrive."""
    lanes = state.lanes
    active = state.active
    xp = namespace(lanes.t)
    level = active & new.lands
    on_time = aim.last
    moved = aim.step + xp.where(level, new.past, 0.0)
    t = xp.where(on_time, aim.due, lanes.t + moved)
    arrived = level | on_time
    pace = put(lanes.pace, 0, lanes.pace[0] + moved)
    armed = await_schedules(task.s, lanes.armed, lanes.t, t)
    lanes = Lanes(t, lanes.chart, new.q, armed, lanes.events, pace)
    h = next_step(state.h, aim, new.error, lanes, task)
    late = active & ~arrived & (t >= task.target.limit)
    code = xp.where(on_time, ARRIVE_TIME, xp.where(level, ARRIVE_LEVEL, MOVE))
    code = xp.where(active, code, IDLE).astype(xp.int32)
    end = state._replace(
        lanes=lanes,
        watched=_merge(active, new.watched, state.watched),
        highest=_highest(state, active, new.watched),
        h=xp.where(active, h, state.h),
        along=new.along,
        error=state.error + xp.where(active, new.error, 0.0),
        result=update_result(state.result, late, task.target.missed),
        arrived=state.arrived | arrived,
        i=state.i + 1,
    )
    at_once = xp.zeros_like(active)
    rival = xp.full(active.shape, -1, xp.int32)
    states = new.q, new.q
    return end, Tape(moved, code, t, *states, lanes.chart, at_once, rival, lanes.events)


def with_events(state: State, aim: Aim, new: Attempt, task: Task) -> tuple[State, Tape]:
    """The state after steps that may be rejected or end in events, and the row of the tape."""
    s = task.s
    lanes = state.lanes
    active = state.active
    target = task.target
    xp = namespace(lanes.t)
    G = len(s.transitions)
    moved = step_length(aim, new)
    t = xp.where(aim.last, aim.due, xp.where(active, lanes.t + moved, lanes.t))
    verdict = accept(state, aim, new, t, task)
    accepted = verdict.accepted
    lands = verdict.lands
    # Events, and arrivals.
    fires = lands & (aim.which < G) & enabled(s, t, new.q, task.u, aim.which)
    by_clock = verdict.plain & (aim.schedule >= 0)
    happens = by_clock & enabled(s, t, new.q, task.u, aim.schedule)
    fired = xp.where(fires, aim.which, xp.where(happens, aim.schedule, -1))
    level = lands & (aim.which == G)
    on_time = verdict.plain & aim.last & ~by_clock
    arrived = on_time | level | ((fired >= 0) & (fired == target.event))
    if target.count is not None:
        arrived = arrived | ((fired >= 0) & (lanes.events + 1 >= target.count))
    after, watched, aimed, fired, zeno, slow = _after(
        state, aim, new, verdict, fired, t, task
    )
    h, stuck = _next_step(state, aim, new, verdict, fired, task)
    # Failures; the first one counts.
    grazes = verdict.touch | (slow & ~zeno) | (stuck & (verdict.refine | verdict.lost))
    # (Any threshold between rounding errors and a tenth distinguishes a field that jumps from a
    # blow-up.)
    change = xp.max(xp.abs(new.q - lanes.q), axis=0)
    size = xp.max(xp.abs(lanes.q), axis=0)
    still = (change <= 1e-3 * size) | ((size == 0) & xp.isfinite(change))
    unexpected = (fired >= 0) & ~_expected(target.event_sequence, lanes.events, fired)
    result = state.result
    unknown = xp.isnan(sum(new.watched)).any(axis=0)
    for failed, code in (
        (stuck & unknown, Result.FIELD_NOT_FINITE),
        (grazes, Result.GRAZING),
        (stuck & still, Result.STEP_COLLAPSE),
        (stuck & ~xp.isfinite(new.q).all(axis=0), Result.FIELD_NOT_FINITE),
        (stuck, Result.BLOW_UP),
        (zeno, Result.ZENO),
        (unexpected, Result.EVENT_ORDER),
        (active & ~arrived & (after.t >= target.limit), target.missed),
    ):
        result = update_result(result, failed, code)
    along = new.along
    if along is not None:
        fresh = cond(
            (fired >= 0).any(),
            lambda: deviation(task.s, after, task.settings),
            lambda: new.along,
        )
        along = xp.where(fired >= 0, fresh, xp.where(accepted, along, state.along))
    end = State(
        lanes=after,
        watched=watched,
        highest=_highest(state, accepted, new.watched, watched, fired),
        aimed=aimed,
        approach=_approach(state, new, verdict, moved),
        h=h,
        along=along,
        error=state.error + xp.where(accepted, new.error, 0.0),
        result=result,
        arrived=state.arrived | arrived,
        i=state.i + 1,
    )
    code = xp.where(accepted, MOVE, IDLE)
    code = xp.where(on_time, ARRIVE_TIME, code)
    code = xp.where(fired >= 0, fired, code)
    code = xp.where(level, ARRIVE_LEVEL, code).astype(xp.int32)
    at_once = aim.at_once & (fired >= 0)
    before = lanes._replace(t=t, q=new.q)
    rival = rival_of(s, before, new.watched, task.u, fired, task.span)
    states = new.q, after.q
    return end, Tape(moved, code, t, *states, after.chart, at_once, rival, after.events)


def _after(
    state: State,
    aim: Aim,
    new: Attempt,
    verdict: Verdict,
    fired: Index,
    t: Times,
    task: Task,
) -> tuple[Lanes, Watch, Mask, Index, Mask, Mask]:
    """The state after steps and events. Returns the lanes, their watched functions, whether the
    next fall of the target's level counts (`level_counts`), the events that happened, and two
    masks: events accumulate, a zero is crossed at a vanishing speed. Such a zero is no event, as
    its time means nothing, unless events accumulate."""
    lanes = state.lanes
    end = new.watched
    accepted = verdict.accepted
    xp = namespace(t)
    zero = width(t, task.span, end.rate)
    stays = verdict.lands | aim.at_once
    ready = (state.ready & ((end.value > 0) | stays)) | (end.value > zero)
    row = np.arange(len(zero))[:, None]
    due = verdict.plain & (row == aim.schedule)
    ready = xp.where(accepted, ready & ~verdict.chosen & ~due, state.ready)
    speed = xp.abs(of_row(end.rate, aim.which))
    on = state.approach.on
    slow = verdict.lands & (new.slow | (on & (speed < SLOW * state.approach.rate)))
    slow = slow | _is_shallow(state, aim, new, verdict, t, task)
    passed = xp.where(accepted, step_length(aim, new), 0.0)
    count = len(task.s.transitions)
    pace, zeno = keep_pace(lanes.pace, passed, fired >= 0, slow, task.span, count)
    fired = xp.where(slow & ~zeno, -1, fired)
    t = xp.where(accepted, t, lanes.t)
    waiting = await_schedules(task.s, lanes.armed, lanes.t, t) & ~due[:-1]
    after = Lanes(
        t,
        lanes.chart,
        xp.where(accepted, new.q, lanes.q),
        with_schedules(task.s, ready[:-1], waiting),
        lanes.events + (fired >= 0),
        pace,
    )
    watched = _merge(accepted, end, state.watched)
    end = _reset(after, watched, ready[-1], fired, task)
    return *end, fired, zeno, slow


def _is_shallow(
    state: State, aim: Aim, new: Attempt, verdict: Verdict, t: Times, task: Task
) -> Mask:
    """Test which lanes land on a zero that errors decide about: the watched function would turn a
    few errors of steps, or rounding errors of a guard, below zero."""
    s = task.s
    lanes = state.lanes
    xp = namespace(t)
    rate = of_row(new.watched.rate, aim.which)
    before = of_row(state.watched.rate, aim.which)
    speed = xp.abs(rate)
    length = step_length(aim, new)
    lands = verdict.lands & (length > 0)
    bend = xp.maximum(rate - before, 0.0) / xp.where(lands, length, 1.0)
    # The second derivative at the zero, which rounding spoils after a short step. Over a long one,
    # it may be far from its average.
    begin = of_row(state.watched.value, aim.which)
    end = of_row(new.watched.value, aim.which)
    at_zero = bend_at_end(begin, end, length * before, length * rate)
    at_zero = at_zero / xp.where(lands, length, 1.0) ** 2
    at_zero = xp.clip(at_zero, _LEAST_BEND * bend, bend)
    touching = of_row(state.touching(task.settings), aim.which)
    turns_soon = speed < TURN * state.h * at_zero
    touches = lands & turns_soon & (speed**2 < 2 * touching * at_zero)
    if not s.transitions:
        return touches
    slower = lands & (speed < _MAY_BE_SHALLOW * xp.abs(before))
    at_guard = lanes._replace(t=t, q=new.q)

    def rounding():
        return of_row(guard_noise(s, at_guard, task.u, slower), aim.which)

    error = cond(slower.any(), rounding, lambda: xp.zeros_like(t))
    return touches | (slower & (speed**2 < _SHALLOW * error * bend))


def _reset(
    lanes: Lanes,
    watched: Watch,
    aimed: Mask,
    fired: Index,
    task: Task,
) -> tuple[Lanes, Watch, Mask]:
    """Lanes after the resets of their events, their watched functions, and whether the next fall of
    the target's level counts."""
    s = task.s
    xp = namespace(fired)
    fires = fired >= 0

    def work():
        q, chart = apply_resets(s, lanes.t, lanes.chart, lanes.q, task.u, fired)
        new = lanes._replace(q=q, chart=chart)
        after = watch(s, new.t, chart, q, task.u, task.target, fires)
        residue = xp.abs(of_row(watched.value, fired))
        entry = _entry(lanes, watched, new, task)
        new = rearm(s, new, after, fired, task.span, task.u, residue, entry)
        counts = xp.where(fires, level_counts(after, task.span), aimed)
        return new, _merge(fires, after, watched), counts

    return cond(fires.any(), work, lambda: (lanes, watched, aimed))


def _entry(lanes: Lanes, watched: Watch, new: Lanes, task: Task) -> Entry:
    """Compare the guards of the charts after resets (`new`) with those of the charts before.

    (Charts with different numbers of states have no guards in common.)
    """
    s = task.s
    xp = namespace(lanes.t)
    dims = xp.asarray(np.array(s.dims))
    same = lanes.chart == new.chart
    alike = ~same & (dims[lanes.chart] == dims[new.chart])

    def compare():
        """For each guard of the new chart (rows) and of the old chart (columns), whether both have
        the same value at the state before."""
        before = watch(s, lanes.t, new.chart, lanes.q, task.u, task.target, alike)
        noise = guard_noise(s, lanes._replace(chart=new.chart), task.u, alike)
        value = before.value[:-1]
        rate = before.rate[:-1]
        zero = SAME_TIME * task.span * xp.abs(rate) + noise
        apart = xp.abs(value[:, None] - watched.value[None, :-1])
        has_guard = belongs(s, lanes.chart)[None, :-1]
        equal = (apart <= zero[:, None]) & has_guard
        known = equal.any(axis=1) & alike
        armed = (equal & lanes.armed).any(axis=1) & alike
        return known, armed

    no = xp.zeros_like(lanes.armed)
    known = no
    armed = no
    if _share_guards(s):
        known, armed = cond(alike.any(), compare, lambda: (no, no))
    return Entry(known | same, xp.where(same, lanes.armed, armed))


def _share_guards(s: Structure) -> bool:
    """Test whether any transition leads to another chart that may have guards of the first one."""
    for transition in s.transitions:
        a = s.chart_index(transition.source)
        b = s.chart_index(transition.target)
        if a != b and s.dims[a] == s.dims[b] and s.guards(a) and s.guards(b):
            return True
    return False


def _approach(state: State, new: Attempt, verdict: Verdict, moved: Times) -> Approach:
    """The crossing that each lane approaches next: a crossing that was met in this step, or the one
    that it approached before."""
    approach = state.approach
    crosses = verdict.crosses
    which = verdict.which
    xp = namespace(moved)
    rate_before = xp.abs(of_row(state.watched.rate, which))
    rate_after = xp.abs(of_row(new.watched.rate, which))
    fastest = xp.maximum(rate_before, rate_after)
    tau = xp.clip(approach.tau + new.past, 0.0, approach.reach)
    return Approach(
        on=crosses | verdict.closer,
        which=xp.where(crosses, which, approach.which),
        tau=xp.where(crosses, verdict.position * moved, tau),
        reach=xp.where(crosses, moved, approach.reach),
        rate=xp.where(crosses, fastest, approach.rate),
        tries=xp.where(crosses, 0, approach.tries + 1),
    )


def _next_step(
    state: State, aim: Aim, new: Attempt, verdict: Verdict, fired: Index, task: Task
) -> tuple[Times, Mask]:
    """The length of the next step, and which lanes are stuck, since this step is too short to be
    taken."""
    xp = namespace(fired)
    plain = verdict.plain
    too_long = verdict.too_long
    adapted = next_step(state.h, aim, new.error, state.lanes, task)
    h = xp.where(plain | too_long, adapted, state.h)
    # After an event the step may be as long as the first step of the flow. (If magnitudes of states
    # are not known, the first step was a guess, which would be rejected after every event.)
    restart = adapted if task.settings.scale is None else task.stride.h
    h = xp.where(fired >= 0, xp.maximum(h, restart), h)
    h = xp.where(verdict.lost, 0.5 * aim.reach, h)
    h = xp.where(verdict.refine, 0.5 * aim.step, h)
    instant = INSTANT * task.span
    t = state.lanes.t
    # (A fast state needs steps shorter than an instant, down to the rounding error of t.)
    shortest = xp.minimum(instant, ROUNDING * xp.abs(t) + _SHORTEST * task.span)
    misses = verdict.refine | verdict.lost
    stuck = (too_long & (h < shortest)) | (misses & (h < instant))
    return h, stuck


def level_counts(watched: Watch, span: Times) -> Mask:
    """Test whether the target's level is clearly positive, so that its next fall through zero ends
    the flow."""
    return watched.value[-1] > SAME_TIME * span * abs(watched.rate[-1])


def _highest(
    state: State,
    accepted: Mask,
    end: Watch,
    after: Watch | None = None,
    fired: Index | None = None,
) -> Float[Array, "W L"]:
    """The `State.highest` after steps that end at `end`, and after the events `fired` there."""
    xp = namespace(accepted)
    height = xp.abs(end.value)
    highest = xp.where(accepted, xp.maximum(state.highest, height), state.highest)
    if after is None or fired is None:
        return highest
    changes = (after.value != end.value) | (after.rate != end.rate)
    return xp.where((fired >= 0) & changes, xp.abs(after.value), highest)


def _merge(mask: Mask, new: Watch, old: Watch) -> Watch:
    xp = namespace(new.value)
    return Watch(
        xp.where(mask, new.value, old.value), xp.where(mask, new.rate, old.rate)
    )


def _expected(
    sequence: tuple[int, ...] | None, events: Index, fired: Index
) -> Bool[Array, " L"]:
    """Test whether the next event of each lane is the one that follows on the limit cycle."""
    xp = namespace(fired)
    if not sequence:
        return xp.full(fired.shape, sequence is None)
    return xp.array(sequence)[events % len(sequence)] == fired
