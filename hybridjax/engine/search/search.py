"""Adaptive flow of many lanes to their targets, through any number of events.

This is the part that decides: step sizes, which event comes first, when to give up. It is not
differentiated; what it decides is written down as a `Tape`, which `replay` follows.

In each iteration every lane that is still on its way takes aim, attempts a step of its own, and
meets its outcome.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from ..._core.executor import Array, cond, namespace, while_loop
from ..._core.lanes import shared
from ..._core.results import Result, update_result
from ...systems.structure import Structure
from ..event_log import EventLog, blank_log, log_events
from ..events import arm
from ..lanes import Lanes
from ..settings import Settings
from ..solver.tableau import method_of
from ..tape import Tape, blank_tape, write_row
from ..target import Target
from ..watch import watch
from .aim import take_aim
from .attempt import attempt, deviation
from .outcome import aims, calmly, eventfully
from .state import Approach, State, Task
from .stride import Stride


class Moved(NamedTuple):
    """Lanes at the end of a piece of flow."""

    lanes: Lanes
    h: Float[Array, " L"]
    """Step size to go on with."""
    error: Float[Array, " L"]
    """Sum of the steps' error estimates, relative to the tolerance."""
    result: Int[Array, " L"]
    """`Result` codes. A lane that failed stands where it failed."""
    log: EventLog | None
    """The events on the way, if they were asked for."""


class Recorded(NamedTuple):
    """Lanes at the end of a piece of flow, and how they came there."""

    moved: Moved
    tape: Tape | None
    """`None` if it was not asked for."""


class Options(NamedTuple):
    """What else a search does."""

    tape: bool = False
    """Write a tape."""
    glide: bool = False
    """Try one step of all lanes first: if it brings all of them home, nothing else is done."""
    new_input: bool = True
    """Arm the guards for the input u, which may have jumped."""
    tangents: Bool[Array, ""] | bool = False
    """Make steps also short enough for the derivatives of a replay."""
    event_log: int = 0
    """Keep a log of so many events of each lane."""


def search(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu L"],
    target: Target,
    stride: Stride,
    result: Int[Array, " L"],
    settings: Settings,
    options: Options,
) -> Recorded:
    """Flow every lane to its target, or to a result code that says why not.

    Lanes whose `result` is not OK at the start stay where they are.
    """
    xp, L = namespace(lanes.t), lanes.t.shape[0]
    finite = xp.isfinite(lanes.t) & xp.isfinite(lanes.q).all(axis=0) & xp.isfinite(u).all(axis=0)
    result = update_result(result, ~finite, Result.BAD_INPUT)
    task = Task(u, target, target.limit - lanes.t, stride, settings)
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, target, result == Result.OK)
    implicit = any(method_of(s, a).implicit for a in range(len(s.charts)))
    carries = implicit and options.tangents is not False
    none, zero = xp.zeros(L, xp.int32), xp.zeros(L)
    begin = State(
        arm(s, lanes, seen, task.span) if options.new_input else lanes,
        seen,
        aims(seen, task.span),
        Approach(xp.zeros(L, bool), none, zero, zero, zero, none),
        stride.h,
        deviation(s, lanes, settings) if carries else None,
        xp.zeros(L),
        result,
        xp.zeros(L, bool),
        xp.zeros((), xp.int32),
    )
    blank = blank_tape(settings.max_steps, lanes) if options.tape else None
    no_events = blank_log(options.event_log, lanes) if options.event_log else None

    def attempted(state, unroll=False, in_step=False):
        """Aims, ways, and an attempt in all active lanes, and which of them it leaves calm."""
        aim, way = take_aim(s, state, task)
        new = attempt(
            s, state, aim, task, unroll=unroll, in_step=in_step, tangents=options.tangents
        )
        calm = new.calm & (new.error <= stride.slack) & ~state.approach.on & (way.schedule < 0)
        calm = calm & ~(new.lands & (aim.which < len(s.transitions)))
        return calm, aim, way, new

    def going(carry):
        state, *_ = carry
        return (state.i < settings.max_steps) & state.active.any()

    def body(carry):
        state, tape, log = carry
        i, (calm, aim, way, new) = state.i, attempted(state)
        state, row = cond(
            (calm | ~state.active).all(),
            lambda: calmly(s, state, aim, way, new, task),
            lambda: eventfully(s, state, aim, way, new, task),
        )
        tape = None if tape is None else write_row(tape, i, row)
        log = None if log is None else log_events(log, row)
        return state, tape, log

    def all_the_way():
        end, tape, log = while_loop(going, body, (begin, blank, no_events))
        result = update_result(end.result, end.active, Result.STEP_LIMIT)
        return Recorded(Moved(end.lanes, end.h, end.error, result, log), tape)

    if not options.glide:
        return all_the_way()

    levels = shared(target.levels)
    clock = levels is None or not any(levels.present(s, a) for a in range(len(s.charts)))
    calm, aim, way, new = attempted(begin, unroll=True, in_step=clock)
    home = calm & (new.lands | way.last)
    if clock:
        home = home & _alike(lanes.t, begin.active) & _alike(aim.step, begin.active)

    def in_one_step():
        end, row = calmly(s, begin, aim, way, new, task)
        tape = None if blank is None else write_row(blank, begin.i, row)
        return Recorded(Moved(end.lanes, end.h, end.error, end.result, no_events), tape)

    return cond((home | ~begin.active).all(), in_one_step, all_the_way)


def _alike(x: Float[Array, " L"], mask: Bool[Array, " L"]) -> Bool[Array, " L"]:
    """Which lanes have the same number as the first lane of `mask`."""
    return x == x[namespace(x).argmax(mask)]
