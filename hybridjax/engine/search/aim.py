"""Where each lane of a search goes next."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
    # Known times: the step is cut so that it ends on them exactly, in equal pieces.
    known, schedule = target.time, jnp.full_like(lanes.chart, -1)
    if _has_schedules(s):
        scheduled, which = next_schedule(s, lanes.t, lanes.chart, target.time)
        known = jnp.minimum(target.time, scheduled)
        schedule = jnp.where(scheduled <= target.time, which, -1)
    rest = jnp.maximum(known - lanes.t, 0.0)
    steps = jnp.where(jnp.isfinite(rest), rest / state.h, 2.0)
    pieces = jnp.ceil(steps - at_precision(*_WHOLE_STEPS))
    last = (pieces <= 1) & ~approach.on
    step = jnp.where(jnp.isfinite(rest), rest / jnp.maximum(pieces, 1.0), state.h)
    which = jnp.where(approach.on, approach.which, -1)
    # A zero that Newton's guess places within the first step is aimed at, where the way is known.
    value, rate = state.seen
    lead = task.stride.lead
    guess = value / jnp.where(rate < 0, -rate, jnp.inf)
    guess = guess.at[-1].multiply(jnp.where(state.i == 0, lead, 1.0))
    level = np.arange(len(value))[:, None] == len(s.transitions)
    new = (state.i == 0) | (lanes.pace[0] == 0)  # at the start, or right after an event
    within = guess <= jnp.where(level, 1.0, _AIM_WITHIN) * step
    sure = state.ready & (guess > 0) & within & (level | new)
    guess = jnp.where(sure & ~approach.on & (lead > 0), guess, jnp.inf)
    nearest = jnp.min(guess, axis=0)
    homing = jnp.isfinite(nearest)
    step = jnp.where(homing, nearest, step)
    which = jnp.where(homing, jnp.argmin(guess, axis=0).astype(jnp.int32), which)
    last = last & ~homing & state.active
    step = jnp.where(state.active, jnp.where(approach.on, approach.tau, step), 0.0)
    reach = jnp.where(approach.on, approach.reach, step)
    return Aim(which, step, reach), Way(known, jnp.where(last, schedule, -1), last)


def _has_schedules(s: Structure) -> bool:
    return any(isinstance(tr.guard, Scheduled) for tr in s.transitions)
