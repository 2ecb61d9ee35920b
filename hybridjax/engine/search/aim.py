"""Where each lane of a search goes next."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.executor import Array, namespace, put
from ..._core.precision import at_precision
from ...systems.structure import Structure
from ...systems.transition import Scheduled
from ..events import next_schedule
from .state import State, Task


# A guard's zero is aimed at if Newton's guess places it within this part of the step. Nearer to 1
# (twice as much is all the same), more steps are spent on zeros that are not there.
_AIM_WITHIN = 0.7
# The way to a known time is a whole number of steps if it is longer by at most this part of a step
# (in double and in single precision). Twice as much allows steps that are too long by as much.
_WHOLE_STEPS = 1e-9, 1e-5


class Aim(NamedTuple):
    """What lanes go for."""

    which: Int[Array, " L"]
    """The watched function on whose zero they mean to land; -1 for none."""
    step: Float[Array, " L"]
    """How far they go."""
    reach: Float[Array, " L"]
    """Length of the step in which that zero is thought to be."""


class Way(NamedTuple):
    """The known times ahead of each lane, and what it does about them."""

    known: Float[Array, " L"]
    """The next known time."""
    schedule: Int[Array, " L"]
    """The transition that is due at the end of this step; -1 for none."""
    last: Bool[Array, " L"]
    """Whether this step ends there."""


def take_aim(s: Structure, state: State, task: Task) -> tuple[Aim, Way]:
    """Where each lane goes next; nowhere, if it is not active."""
    lanes, approach, target = state.lanes, state.approach, task.target
    xp = namespace(lanes.t)
    # Known times: the step is cut so that it ends on them exactly, in equal pieces.
    known, schedule = target.time, xp.full_like(lanes.chart, -1)
    if _has_schedules(s):
        scheduled, which = next_schedule(s, lanes.t, lanes.chart, target.time)
        known = xp.minimum(target.time, scheduled)
        schedule = xp.where(scheduled <= target.time, which, -1)
    rest = xp.maximum(known - lanes.t, 0.0)
    steps = xp.where(xp.isfinite(rest), rest / state.h, 2.0)
    pieces = xp.ceil(steps - at_precision(*_WHOLE_STEPS))
    last = (pieces <= 1) & ~approach.on
    step = xp.where(xp.isfinite(rest), rest / xp.maximum(pieces, 1.0), state.h)
    which = xp.where(approach.on, approach.which, -1)
    # A zero that Newton's guess places within the first step is aimed at, where the way is known.
    value, rate = state.seen
    lead = task.stride.lead
    guess = value / xp.where(rate < 0, -rate, xp.inf)
    guess = put(guess, -1, guess[-1] * xp.where(state.i == 0, lead, 1.0))
    level = np.arange(len(value))[:, None] == len(s.transitions)
    new = (state.i == 0) | (lanes.pace[0] == 0)  # at the start, or right after an event
    within = guess <= xp.where(level, 1.0, _AIM_WITHIN) * step
    sure = state.ready & (guess > 0) & within & (level | new)
    guess = xp.where(sure & ~approach.on & (lead > 0), guess, xp.inf)
    nearest = xp.min(guess, axis=0)
    homing = xp.isfinite(nearest)
    step = xp.where(homing, nearest, step)
    which = xp.where(homing, xp.argmin(guess, axis=0).astype(xp.int32), which)
    last = last & ~homing & state.active
    step = xp.where(state.active, xp.where(approach.on, approach.tau, step), 0.0)
    reach = xp.where(approach.on, approach.reach, step)
    return Aim(which, step, reach), Way(known, xp.where(last, schedule, -1), last)


def _has_schedules(s: Structure) -> bool:
    return any(isinstance(tr.guard, Scheduled) for tr in s.transitions)
