"""Adaptive flow of many lanes (trajectories side by side) to their targets, through any number of
events.

`engine/move.py` and `engine/flow.py` call `search`, with arrays of NumPy or of JAX. It decides on
step sizes, on the order of events, and on failures. It is not differentiated: its steps are
recorded on a `Tape`, and `replay.py` differentiates these.

Each iteration has four stages: `take_aim` chooses the length of the step, up to the next known
time; `attempt.py` computes the step; `accept.py` accepts or rejects it; `outcome.py` makes the next
state. If an event is missed, look first in `accept.py` and `../cubic.py`; if a failure has the
wrong reason, in `outcome.py`.
"""

import numpy as np
from jaxtyping import Float

from ..._core.executor import cond, namespace, on_host, put, while_loop
from ..._core.results import Result, update_result
from ...systems.structure import Structure
from ...systems.transition import SAME_TIME
from ..arrays import Array, Index, Inputs, Mask, Times
from ..events import arm, next_schedule, overdue
from ..lanes import Lanes, Tape, blank_tape, for_each_chart, only, write_row
from ..settings import Settings, size
from ..target import Target
from ..watch import chart_field, watch
from .accept import uneventful
from .attempt import attempt, deviation
from .outcome import level_counts, with_events, without_events
from .state import Aim, Approach, Moved, Options, Recorded, State, Stride, Task


# A step aims at the zero of a guard if Newton's guess of the zero lies within this part of the
# step. Nearer to 1: steps are spent on zeros that are not there. Nearer to 0: zeros are met without
# being aimed at.
_AIM_WITHIN = 0.7
# The first step, as a part of the time in which the state changes by its own magnitude, and at most
# this part of the time allowed. (For errors of 1e-2; the default method has order 7.) Higher: first
# steps are rejected. Lower: many short steps at the beginning.
_FIRST_STEP = 0.1
# The shortest first step, as a part of the time allowed, if magnitudes of states are not known: a
# state that begins near zero changes by its own magnitude at once. Higher: stiff systems reject the
# step. Lower: more short steps at the beginning.
_SHORTEST = 1e-6


def search(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    settings: Settings,
    stride: Stride,
    result: Index,
    options: Options,
) -> Recorded:
    """Flow every lane to its target. A lane that fails stays where it failed, and has a result
    code.

    Lanes whose `result` is not OK at the start do not move.
    """
    task = Task(
        s, u, target, target.limit - lanes.t, stride, settings, options.tangents
    )
    begin = _begin(lanes, result, task, options.new_input)
    tape = blank_tape(settings.max_steps, lanes) if options.tape else None

    def going(carry):
        state, _ = carry
        return (state.i < settings.max_steps) & state.active.any()

    def iterate(carry):
        state, tape = carry
        aim = take_aim(state, task)
        step = state, aim, attempt(state, aim, task), task
        calm = uneventful(*step).all()
        end, row = cond(calm, lambda: without_events(*step), lambda: with_events(*step))
        return end, None if tape is None else write_row(tape, state.i, row)

    end, written = while_loop(going, iterate, (begin, tape))
    # (Empty rows are cut off, since copying them takes time. The tape of a single lane keeps the
    # length that it has in XLA.)
    if written is not None and on_host(end.i) and s.by_system:
        written = Tape(*(x[: end.i] for x in written))
    result = update_result(end.result, end.active, Result.STEP_LIMIT)
    return Recorded(Moved(end.lanes, end.h, end.error, result), written)


def _begin(lanes: Lanes, result: Index, task: Task, new_input: bool) -> State:
    """The state of the iteration at its start."""
    s = task.s
    xp = namespace(lanes.t)
    L = lanes.t.shape[0]
    u = task.u
    finite = xp.isfinite(lanes.t) & xp.isfinite(lanes.q).all(axis=0)
    finite = finite & xp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    runs = result == Result.OK
    watched = watch(s, lanes.t, lanes.chart, lanes.q, u, task.target, runs)
    none = xp.zeros(L, xp.int32)
    zero = xp.zeros(L)
    no = xp.zeros(L, bool)
    armed = arm(s, lanes, watched, task.span) if new_input else lanes
    counts = level_counts(watched, task.span)
    along = task.stride.along
    implicit = any(s.method(a).implicit for a in range(len(s.charts)))
    if along is None and implicit and task.tangents:
        along = deviation(s, lanes, task.settings)
    return State(
        lanes=armed,
        watched=watched,
        highest=xp.abs(watched.value),
        aimed=counts,
        approach=Approach(no, none, zero, zero, zero, none),
        h=task.stride.h,
        along=along,
        error=zero,
        result=result,
        arrived=no,
        i=xp.zeros((), xp.int32),
    )


def take_aim(state: State, task: Task) -> Aim:
    """The steps that lanes attempt next. Lanes that are not active have steps of length 0."""
    approach = state.approach
    xp = namespace(state.lanes.t)
    due, schedule, at_once = _known_time(state, task)
    # The step is cut so that it ends on known times exactly, in equal pieces.
    left = xp.maximum(due - state.lanes.t, 0.0)
    # (In a flow of no duration, the first step is zero.)
    h = xp.where(left > 0, state.h, 1.0)
    pieces = xp.ceil(xp.where(xp.isfinite(left), left / h, 2.0) - SAME_TIME)
    last = (pieces <= 1) & ~approach.on
    step = xp.where(xp.isfinite(left), left / xp.maximum(pieces, 1.0), state.h)
    which = xp.where(approach.on, approach.which, -1)
    # The first step aims at a zero if Newton's guess of it lies within the step.
    guess = _expected_zeros(state, task, step, at_once)
    nearest = xp.min(guess, axis=0)
    lands = xp.isfinite(nearest)
    step = xp.where(lands, nearest, step)
    which = xp.where(lands, xp.argmin(guess, axis=0).astype(xp.int32), which)
    last = last & ~lands & state.active
    step = xp.where(state.active, xp.where(approach.on, approach.tau, step), 0.0)
    reach = xp.where(approach.on, approach.reach, step)
    return Aim(
        which=which,
        step=step,
        reach=reach,
        due=due,
        schedule=xp.where(last, schedule, -1),
        last=last,
        at_once=at_once,
    )


def _known_time(state: State, task: Task) -> tuple[Times, Index, Mask]:
    """The next known time, the transition that is due at this time (-1: none), and whether it is
    due at once because a reset has put its guard below zero."""
    s = task.s
    lanes = state.lanes
    target = task.target
    xp = namespace(lanes.t)
    scheduled, which = next_schedule(s, lanes.t, lanes.chart, target.time, lanes.armed)
    due = xp.minimum(target.time, scheduled)
    schedule = xp.where(scheduled <= target.time, which, -1)
    beyond = lanes.armed & overdue(state.watched, lanes.t, task.span)
    at_once = state.active & ~state.approach.on & beyond.any(axis=0)
    due = xp.where(at_once, lanes.t, due)
    if s.transitions:
        overdue_first = xp.argmax(beyond, axis=0).astype(xp.int32)
        schedule = xp.where(at_once, overdue_first, schedule)
    return due, schedule, at_once


def _expected_zeros(
    state: State, task: Task, step: Times, at_once: Mask
) -> Float[Array, "W L"]:
    """Newton's guesses of the times to zeros of watched functions, if they lie within `step`; else
    infinity. They are used if the caller has set `Stride.lead` (a factor that corrects the guess at
    the start); those of guards, only in the first step after the start or after an event."""
    approach = state.approach
    xp = namespace(step)
    value, rate = state.watched
    lead = task.stride.lead
    guess = value / xp.where(rate < 0, -rate, xp.inf)
    guess = put(guess, -1, guess[-1] * xp.where(state.i == 0, lead, 1.0))
    level = np.arange(len(value))[:, None] == len(task.s.transitions)
    # At the start, or right after an event.
    new = (state.i == 0) | (state.lanes.pace[0] == 0)
    within = (guess > 0) & (guess <= xp.where(level, 1.0, _AIM_WITHIN) * step)
    known = ~approach.on & (lead > 0) & ~at_once
    expected = state.ready & within & (level | new) & known
    return xp.where(expected, guess, xp.inf)


def initial_step(
    s: Structure, lanes: Lanes, u: Inputs, span: Times, settings: Settings
) -> Times:
    """A cautious first step: a part of the time in which the state changes by its size."""

    def work(a, here, out):
        q = only(here, lanes.q[: s.dims[a]])
        f = chart_field(s, a, only(here, u))(only(here, lanes.t), q)
        scaled = settings.scale is not None
        rates = xp.abs(f) / (size(settings, a, q) if scaled else xp.abs(q))
        rate = xp.max(xp.where(xp.isfinite(rates), rates, 0.0), axis=0, initial=0.0)
        time = xp.where(rate > 0, 1 / rate, xp.inf)
        part = _FIRST_STEP * (rtol / 1e-2) ** (1 / 7)
        first = xp.minimum(part * time, _FIRST_STEP * span)
        first = first if scaled else xp.maximum(first, _SHORTEST * span)
        return xp.where(here, first, out)

    assert settings.rtol is not None
    xp = namespace(lanes.t)
    rtol = settings.rtol
    return for_each_chart(
        s, lanes.chart, xp.ones(lanes.t.shape[0], bool), work, _FIRST_STEP * span
    )
