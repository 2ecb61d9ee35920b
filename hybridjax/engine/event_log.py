"""Which events happened when, lane by lane."""

from typing import NamedTuple

from jaxtyping import Float, Int

from .._core.executor import Array, cond, namespace
from .lanes import Lanes
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


def blank_log(size: int, lanes: Lanes) -> EventLog:
    """A log of `size` events of each lane, in which nothing is written yet."""
    xp, L = namespace(lanes.t), lanes.t.shape[0]
    return EventLog(
        xp.full((size, L), xp.nan),
        xp.full((size, L), -1, xp.int32),
        xp.zeros(L, xp.int32),
    )


def log_events(log: EventLog, row: Tape) -> EventLog:
    """The log, with the events of one row of a tape."""
    xp, fired = namespace(row.code), row.code >= 0

    def write():
        here = fired & (xp.arange(len(log.time))[:, None] == log.count)
        time = xp.where(here, row.t, log.time)
        return EventLog(time, xp.where(here, row.code, log.event), log.count + fired)

    return cond(fired.any(), write, lambda: log)
