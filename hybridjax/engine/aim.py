"""Where lanes of a search stand, and where each of them goes next."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.precision import at_precision
from ..systems.structure import Structure
from ..systems.transition import Scheduled
from .events import next_schedule
from .lanes import Lanes
from .stride import Stride
from .watch import Watch


# A guard's zero is aimed at if Newton's guess places it within this fraction of the step.
_SURE = 0.7


class Aim(NamedTuple):
    """What lanes go for."""

    which: Int[Array, " L"]
    """The watched function on whose zero they mean to land; -1 for none."""
    step: Float[Array, " L"]
    """How far they go."""
    reach: Float[Array, " L"]
    """Length of the step in which that zero is thought to be."""


class Approach(NamedTuple):
    """Lanes that have seen a crossing in a step and are about to land on it."""

    on: Bool[Array, " L"]
    which: Int[Array, " L"]
    """The watched function that crosses."""
    tau: Float[Array, " L"]
    """Where the crossing is thought to be, as a time from where the lane is."""
    reach: Float[Array, " L"]
    """Length of the step in which it was seen."""
    rate: Float[Array, " L"]
    """The largest rate of that function at the ends of that step."""
    tries: Int[Array, " L"]


class State(NamedTuple):
    lanes: Lanes
    seen: Watch
    """The watched functions where the lanes are."""
    aimed: Array
    """Whether the target's level would end the flow at its next falling zero."""
    approach: Approach
    h: Array
    error: Array
    result: Array
    arrived: Array
    i: Array


class Way(NamedTuple):
    """The known times ahead of each lane, and what it does about them."""

    known: Array
    """The next known time."""
    schedule: Array
    """The transition that is due at the end of this step; -1 for none."""
    last: Array
    """Whether this step ends there."""


def take_aim(s, state: State, active, target, stride: Stride) -> tuple[Aim, Way]:
    """Where to each lane goes next."""
    lanes, approach = state.lanes, state.approach
    # Known times: the step is cut so that it ends on them exactly, in equal pieces.
    known, schedule = target.time, jnp.full_like(lanes.chart, -1)
    if _has_schedules(s):
        scheduled, which = next_schedule(s, lanes.t, lanes.chart, target.time)
        known = jnp.minimum(target.time, scheduled)
        schedule = jnp.where(scheduled <= target.time, which, -1)
    rest = jnp.maximum(known - lanes.t, 0.0)
    pieces = jnp.ceil(jnp.where(jnp.isfinite(rest), rest / state.h, 2.0) - at_precision(1e-9, 1e-5))
    last = (pieces <= 1) & ~approach.on
    step = jnp.where(jnp.isfinite(rest), rest / jnp.maximum(pieces, 1.0), state.h)
    which = jnp.where(approach.on, approach.which, -1)
    # A zero that Newton's guess places within the first step is aimed at, where the way is known.
    value, rate = state.seen
    ready = jnp.concatenate([lanes.armed, state.aimed[None]])
    guess = value / jnp.where(rate < 0, -rate, jnp.inf)
    guess = guess.at[-1].multiply(jnp.where(state.i == 0, stride.lead, 1.0))
    level = jnp.arange(len(value))[:, None] == len(s.transitions)
    new = (state.i == 0) | (lanes.pace[0] == 0)  # at the start, or right after an event
    sure = ready & (guess > 0) & (guess <= jnp.where(level, 1.0, _SURE) * step) & (level | new)
    guess = jnp.where(sure & ~approach.on & (stride.lead > 0), guess, jnp.inf)
    nearest = jnp.min(guess, axis=0)
    homing = jnp.isfinite(nearest)
    step = jnp.where(homing, nearest, step)
    which = jnp.where(homing, jnp.argmin(guess, axis=0).astype(jnp.int32), which)
    last = last & ~homing
    last = last & active
    step = jnp.where(active, jnp.where(approach.on, approach.tau, step), 0.0)
    reach = jnp.where(approach.on, approach.reach, step)
    return Aim(which, step, reach), Way(known, jnp.where(last, schedule, -1), last)


def _has_schedules(s: Structure) -> bool:
    return any(isinstance(tr.guard, Scheduled) for tr in s.transitions)
