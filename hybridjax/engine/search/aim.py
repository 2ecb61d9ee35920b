"""The step that each lane attempts next."""

import numpy as np

from ..._core.executor import namespace, put
from ...systems.structure import Structure
from ..events import SAME_TIME, next_schedule
from .state import Aim, State, Task


# A guard's zero is aimed at if Newton's guess places it within this part of the step. Nearer to 1:
# steps are spent on zeros that are not there. Nearer to 0: zeros are met without being aimed at.
_AIM_WITHIN = 0.7


def take_aim(s: Structure, state: State, task: Task) -> Aim:
    """The steps of active lanes; steps of length 0 of all others."""
    lanes, approach, target = state.lanes, state.approach, task.target
    xp = namespace(lanes.t)
    # Known times: the step is cut so that it ends on them exactly, in equal pieces.
    due, schedule = target.time, xp.full_like(lanes.chart, -1)
    if s.has_schedules:
        scheduled, which = next_schedule(s, lanes.t, lanes.chart, target.time)
        due = xp.minimum(target.time, scheduled)
        schedule = xp.where(scheduled <= target.time, which, -1)
    left = xp.maximum(due - lanes.t, 0.0)
    steps = xp.where(xp.isfinite(left), left / state.h, 2.0)
    pieces = xp.ceil(steps - SAME_TIME)
    last = (pieces <= 1) & ~approach.on
    step = xp.where(xp.isfinite(left), left / xp.maximum(pieces, 1.0), state.h)
    which = xp.where(approach.on, approach.which, -1)
    # A zero that Newton's guess places within the first step is aimed at, where the way is known.
    value, rate = state.watched
    lead = task.stride.lead
    guess = value / xp.where(rate < 0, -rate, xp.inf)
    guess = put(guess, -1, guess[-1] * xp.where(state.i == 0, lead, 1.0))
    level = np.arange(len(value))[:, None] == len(s.transitions)
    new = (state.i == 0) | (lanes.pace[0] == 0)  # at the start, or right after an event
    within = guess <= xp.where(level, 1.0, _AIM_WITHIN) * step
    expected = state.ready & (guess > 0) & within & (level | new) & ~approach.on & (lead > 0)
    guess = xp.where(expected, guess, xp.inf)
    nearest = xp.min(guess, axis=0)
    lands = xp.isfinite(nearest)
    step = xp.where(lands, nearest, step)
    which = xp.where(lands, xp.argmin(guess, axis=0).astype(xp.int32), which)
    last = last & ~lands & state.active
    step = xp.where(state.active, xp.where(approach.on, approach.tau, step), 0.0)
    reach = xp.where(approach.on, approach.reach, step)
    return Aim(which, step, reach, due, xp.where(last, schedule, -1), last)
