"""The rule by which a step is accepted or rejected, and the length of the next one.

The search attempts a step for each lane (a trajectory of many side by side; `attempt.py`). `accept`
reads this attempt, and returns a `Verdict`, from which `outcome.py` makes the next state. A
*watched function* is a guard or the level of the target section. An *approach* leads to a crossing
that was met within a step: the lane aims at it, until a step *lands* on the zero. An event that is
missed has its cause in `_crossing`, an approach without end in the first part of `accept`.

Each active lane must have exactly one of the verdicts `plain`, `lands`, `too_long`, `refine`,
`crosses`, `closer` and `lost`: `outcome.py` relies on this. (`touch` comes in addition.)
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..._core.executor import cond, namespace
from ..._core.lanes import pick
from ..arrays import Array, Index, Mask, Times
from ..cubic import CubicCrossing, first_crossing
from ..events import INSTANT, width
from ..lanes import Lanes
from .attempt import LANDING, LANDING_TRIES
from .state import Aim, Attempt, State, Task


# The next step has the part `_CAUTION` of the length that the error estimate asks for, and lies
# between these multiples of the last step (the lower one if the estimate is NaN). Nearer to 1: more
# steps are rejected. Farther: more steps are taken.
_CAUTION = 0.9
_SHRINK = 0.2
_GROW = 3.0
# Only an extremum that lies at most this part of a step from zero, in time, is a touch. Higher: a
# function that decays to small values, as a population does, is called grazing. Lower: a grazing is
# missed where other states require short steps.
TURN = 0.1


class Verdict(NamedTuple):
    """The verdict on an attempted step. It is accepted without (`plain`) or with a landing
    (`lands`), or it is rejected for one of the other reasons."""

    plain: Mask
    """The step is accepted, and ends on no zero."""
    lands: Mask
    """The step is accepted, and ends on the zero aimed at."""
    too_long: Mask
    """The error of the step is too large."""
    refine: Mask
    """A watched function is not resolved: the step is halved."""
    crosses: Mask
    """A watched function crosses zero on the way: the lane approaches it."""
    closer: Mask
    """The landing failed, and is tried again by a shorter step."""
    lost: Mask
    """The landing failed for good."""
    touch: Mask
    """A watched function touches zero without a clear crossing."""
    which: Index
    """The function that crosses first."""
    position: Times
    """Position of that crossing, as a fraction of the step."""
    chosen: Bool[Array, "W L"]
    """The function on whose zero the lane has landed."""

    @property
    def accepted(self) -> Mask:
        return self.plain | self.lands


def accurate(new: Attempt, task: Task) -> Mask:
    """Test whether the error estimate is at most the tolerance (times the lane's slack)."""
    return new.error <= task.stride.slack


def uneventful(state: State, aim: Aim, new: Attempt, task: Task) -> Mask:
    """Lanes whose step is certainly accepted: it is accurate, there is no event, and no watched
    function comes near zero, except for the target's level if the lane lands on it."""
    at_guard = new.lands & (aim.which < len(task.s.transitions))
    calm = (
        new.calm
        & accurate(new, task)
        & ~state.approach.on
        & (aim.schedule < 0)
        & ~at_guard
    )
    return calm | ~state.active


def accept(state: State, aim: Aim, new: Attempt, t: Times, task: Task) -> Verdict:
    """Accept or reject the attempted steps, which end at t.

    A step is accepted if it is accurate, if every watched function is resolved over it, and if no
    watched function crosses zero before its end (or before the zero at which it ends).
    """
    approach = state.approach
    active = state.active
    end = new.watched
    xp = namespace(t)
    within_error = accurate(new, task)
    # Which approaches succeed.
    tau = approach.tau + new.past
    beyond = LANDING * approach.reach + INSTANT * task.span
    inside = (tau >= -beyond) & (tau <= approach.reach + beyond)
    falling = of_row(end.rate, aim.which) < 0
    lands = active & new.lands & falling & xp.where(approach.on, inside, within_error)
    failed = active & approach.on & ~lands
    closer = failed & (approach.tries < LANDING_TRIES)
    # Watched functions that cross zero on the way.
    fresh = active & ~approach.on & within_error
    looked_at = fresh | lands
    moved = step_length(aim, new)
    # (If an event happens at once, the step has no length, and nothing is crossed.)
    ready = state.ready & ~aim.at_once
    crossing = _crossing(looked_at & ~aim.at_once, state, new, moved, ready, task)
    zero = width(t, task.span, end.rate)
    chosen = lands & (np.arange(len(zero))[:, None] == aim.which)
    at_end = lands & (xp.abs(end.value) <= zero)
    positions = xp.where(chosen | at_end, xp.inf, crossing.position)
    position = xp.min(positions, axis=0)
    bent = fresh & new.bent
    crosses = looked_at & xp.isfinite(position) & ~bent
    refine = bent | (looked_at & ~crosses & crossing.near.any(axis=0))
    lands = lands & ~crosses & ~refine
    return Verdict(
        plain=fresh & ~crosses & ~refine & ~lands,
        lands=lands,
        too_long=active & ~approach.on & ~within_error,
        refine=refine,
        crosses=crosses,
        closer=closer,
        lost=failed & ~closer,
        touch=looked_at & ~crosses & (crossing.touch & ~chosen).any(axis=0),
        which=xp.argmin(positions, axis=0).astype(xp.int32),
        position=position,
        chosen=chosen & lands,
    )


def step_length(aim: Aim, new: Attempt) -> Times:
    """Time from the start of the step to its end, or to the zero on which it lands."""
    return aim.step + namespace(aim.step).where(new.lands, new.past, 0.0)


def next_step(h: Times, aim: Aim, error: Times, lanes: Lanes, task: Task) -> Times:
    """The length of the next step, after a step that was allowed to have the length h and had the
    error `error`."""
    s = task.s
    xp = namespace(error)
    error = error / task.stride.slack
    orders = [s.method(a).order for a in range(len(s.charts))]
    if set(orders) == {8.0}:  # cheaper than a power
        length = xp.sqrt(xp.sqrt(xp.sqrt(error)))
    else:
        length = error ** xp.asarray(1 / np.array(orders))[lanes.chart]
    factor = xp.clip(_CAUTION / length, _SHRINK, _GROW)
    step = aim.step * xp.where(xp.isfinite(length), factor, _SHRINK)
    return xp.where((aim.step < h) & (length <= 1), xp.maximum(h, step), step)


def of_row(x: Array, which: Index) -> Times:
    """Each lane's entry in the row `which`; 0 for -1."""
    return pick(x, range(len(x)), which)


def _crossing(
    some: Mask,
    state: State,
    new: Attempt,
    moved: Times,
    ready: Bool[Array, "W L"],
    task: Task,
) -> CubicCrossing:
    """The crossings on the way. (In a branch: otherwise XLA would compute them once for every
    use.)"""
    start = state.watched
    end = new.watched
    xp = namespace(ready)
    cubic = start.value, end.value, moved * start.rate, moved * end.rate
    no = xp.zeros_like(ready)
    nowhere = xp.full_like(end.value, xp.inf)
    none = CubicCrossing(nowhere, no, no)

    def find():
        turn = TURN * state.h / xp.where(moved > 0, moved, xp.inf)
        touching = state.touching(task.settings)
        return first_crossing(*cubic, ready, new.margin, touching, turn)

    return cond(some.any(), find, lambda: none)
