"""Which events happened when, lane by lane."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .tape import Tape


class EventLog(NamedTuple):
    """The first K events of each lane in a piece of flow, in order. (Times have no derivatives.)

    Where more than K happened, `count` says so, and the log lacks the later ones. An event that
    made its lane fail is in the log, too.
    """

    time: Float[Array, "K L"]
    """NaN where there is none."""
    event: Int[Array, "K L"]
    """The transition's index; -1 where there is none."""
    count: Int[Array, " L"]
    """Number of events."""


def blank_log(size: int, lanes: int) -> EventLog:
    """A log of `size` events of each lane, in which nothing is written yet."""
    return EventLog(
        jnp.full((size, lanes), jnp.nan),
        jnp.full((size, lanes), -1, jnp.int32),
        jnp.zeros(lanes, jnp.int32),
    )


def log_events(log: EventLog, row: Tape) -> EventLog:
    """The log, with the events of one row of a tape."""
    fired = row.code >= 0

    def write():
        here = fired & (jnp.arange(len(log.time))[:, None] == log.count)
        time = jnp.where(here, row.t, log.time)
        return EventLog(time, jnp.where(here, row.code, log.event), log.count + fired)

    return jax.lax.cond(fired.any(), write, lambda: log)
