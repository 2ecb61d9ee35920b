"""Adaptive flow of many lanes to their targets, through any number of events.

The search decides on step sizes, on the order of events, and on failures. It is not differentiated;
its decisions are recorded in a `Tape`, which `replay` follows.
"""

from typing import NamedTuple

from jaxtyping import Bool

from ..._core.executor import cond, namespace, while_loop
from ..._core.lanes import shared
from ..._core.results import Result, update_result
from ...systems.structure import Structure
from ..arrays import Array, Index, Inputs, Mask, Times
from ..events import arm
from ..lanes import Lanes
from ..settings import Settings
from ..tape import Tape, blank_tape, write_row
from ..target import Target
from ..watch import watch
from .accept import uneventful
from .aim import take_aim
from .attempt import attempt, deviation
from .outcome import level_counts, with_events, without_events
from .state import Aim, Approach, Attempt, State, Stride, Task


class Moved(NamedTuple):
    """Lanes at the end of a piece of flow."""

    lanes: Lanes
    h: Times
    """Step size to go on with."""
    error: Times
    """Sum of the steps' error estimates, relative to the tolerance."""
    result: Index
    """`Result` codes. A lane that failed stays where it failed."""


class Recorded(NamedTuple):
    """Lanes at the end of a piece of flow, and the record of the way."""

    moved: Moved
    tape: Tape | None
    """`None` if it was not requested."""


class Options(NamedTuple):
    """Further results and properties of a search."""

    tape: bool = False
    """Record a tape."""
    glide: bool = False
    """Try one step of all lanes first: if it ends at the target in all of them, the loop is
    skipped."""
    new_input: bool = True
    """Arm the guards for the input u, which may have jumped."""
    tangents: Bool[Array, ""] | bool = False
    """Make steps also short enough for the derivatives of a replay."""


def search(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    stride: Stride,
    result: Index,
    settings: Settings,
    options: Options,
) -> Recorded:
    """Flow every lane to its target, or to a result code for the reason of its failure.

    Lanes whose `result` is not OK at the start stay there.
    """
    task = Task(u, target, target.limit - lanes.t, stride, settings, options.tangents)
    begin = _begin(s, lanes, result, task, options.new_input)
    tape = blank_tape(settings.max_steps, lanes) if options.tape else None

    def all_the_way() -> Recorded:
        def going(carry):
            state, _ = carry
            return (state.i < settings.max_steps) & state.active.any()

        def iterate(carry):
            state, tape = carry
            aim = take_aim(s, state, task)
            new = attempt(s, state, aim, task)
            end, row = cond(
                uneventful(s, state, aim, new, task).all(),
                lambda: without_events(s, state, aim, new, task),
                lambda: with_events(s, state, aim, new, task),
            )
            return end, None if tape is None else write_row(tape, state.i, row)

        end, written = while_loop(going, iterate, (begin, tape))
        result = update_result(end.result, end.active, Result.STEP_LIMIT)
        return Recorded(Moved(end.lanes, end.h, end.error, result), written)

    if not options.glide:
        return all_the_way()
    aim, new, arrives = _one_step(s, begin, task)

    def in_one_step() -> Recorded:
        end, row = without_events(s, begin, aim, new, task)
        written = None if tape is None else write_row(tape, begin.i, row)
        return Recorded(Moved(end.lanes, end.h, end.error, end.result), written)

    return cond(arrives.all(), in_one_step, all_the_way)


def _begin(s: Structure, lanes: Lanes, result: Index, task: Task, new_input: bool) -> State:
    """The state of the iteration at its start."""
    xp, L, u = namespace(lanes.t), lanes.t.shape[0], task.u
    finite = xp.isfinite(lanes.t) & xp.isfinite(lanes.q).all(axis=0) & xp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    watched = watch(s, lanes.t, lanes.chart, lanes.q, u, task.target, result == Result.OK)
    implicit = any(s.method(a).implicit for a in range(len(s.charts)))
    follows = implicit and task.tangents is not False
    none, zero, no = xp.zeros(L, xp.int32), xp.zeros(L), xp.zeros(L, bool)
    return State(
        arm(s, lanes, watched, task.span) if new_input else lanes,
        watched,
        level_counts(watched, task.span),
        Approach(no, none, zero, zero, zero, none),
        task.stride.h,
        deviation(s, lanes, task.settings) if follows else None,
        zero,
        result,
        no,
        xp.zeros((), xp.int32),
    )


def _one_step(s: Structure, begin: State, task: Task) -> tuple[Aim, Attempt, Mask]:
    """One step of all lanes, and in which of them it ends at the target."""
    levels = shared(task.target.levels)
    clock = levels is None or not any(levels.present(s, a) for a in range(len(s.charts)))
    aim = take_aim(s, begin, task)
    new = attempt(s, begin, aim, task, unroll=True, in_step=clock)
    arrives = uneventful(s, begin, aim, new, task) & (new.lands | aim.last)
    if clock:
        for x in (begin.lanes.t, aim.step):  # the same in all active lanes, as `attempt` assumed
            arrives = arrives & (x == x[namespace(x).argmax(begin.active)])
    return aim, new, arrives | ~begin.active
