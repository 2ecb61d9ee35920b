"""The records of a search: the tape of all steps, and the log of events."""

from typing import NamedTuple

from jaxtyping import Float, Int

from .._core.executor import namespace, on_host, put
from .arrays import Array
from .lanes import Lanes


# Codes on a tape. Codes >= 0 are the transition that fires at the end of a move.
IDLE, MOVE, ARRIVE_TIME, ARRIVE_LEVEL = range(-4, 0)


class Tape(NamedTuple):
    """The moves, one row per iteration and one column per lane. Without its first axis: one row."""

    h: Float[Array, "R L"]
    """Length of the move."""
    code: Int[Array, "R L"]
    """Its end: IDLE (no move), MOVE, ARRIVE_TIME, ARRIVE_LEVEL, or a transition's index."""
    t: Float[Array, "R L"]
    """Time at the end of the move."""
    before: Float[Array, "R d L"]
    """State at the end of the move, before a reset."""
    after: Float[Array, "R d L"]
    """State after the reset."""
    chart: Int[Array, "R L"]
    """Chart after the reset."""


def blank_tape(rows: int, lanes: Lanes) -> Tape:
    """A tape without moves."""
    xp, (d, L) = namespace(lanes.q), lanes.q.shape
    times, states = lambda: xp.zeros((rows, L)), lambda: xp.zeros((rows, d, L))
    code, chart = xp.full((rows, L), IDLE, xp.int32), xp.zeros((rows, L), xp.int32)
    return Tape(times(), code, times(), states(), states(), chart)


def write_row(tape: Tape, i: Int[Array, ""], row: Tape) -> Tape:
    """The tape with its row i filled in: in place on the host, and by XLA outside of branches."""
    if on_host(tape.h):
        for x, y in zip(tape, row, strict=True):
            x[i] = y
        return tape
    return Tape(*(put(x, i, y.astype(x.dtype)) for x, y in zip(tape, row, strict=True)))
