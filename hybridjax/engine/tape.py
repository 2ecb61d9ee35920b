"""The record of a search: what was done with every lane."""

from typing import NamedTuple

from jaxtyping import Float, Int

from .._core.executor import Array, namespace, on_host, put
from .lanes import Lanes


# Codes on a tape. Codes >= 0 name the transition that fires at the end of a move.
IDLE, MOVE, ARRIVE_TIME, ARRIVE_LEVEL = -4, -3, -2, -1


class Tape(NamedTuple):
    """What was done, one row per iteration and one column per lane. Without its first axis: one
    row."""

    h: Float[Array, "R L"]
    """Length of the move."""
    code: Int[Array, "R L"]
    """How it ended: IDLE (no move), MOVE, ARRIVE_TIME, ARRIVE_LEVEL, or a transition's index."""
    t: Float[Array, "R L"]
    """Time at the end of the move."""
    before: Float[Array, "R d L"]
    """State at the end of the move, before a reset."""
    after: Float[Array, "R d L"]
    """State after the reset."""
    chart: Int[Array, "R L"]
    """Chart after the reset."""


def blank_tape(rows: int, lanes: Lanes) -> Tape:
    """A tape on which nothing is written yet."""
    xp, (d, L) = namespace(lanes.q), lanes.q.shape
    return Tape(
        xp.zeros((rows, L)),
        xp.full((rows, L), IDLE, xp.int32),
        xp.zeros((rows, L)),
        xp.zeros((rows, d, L)),
        xp.zeros((rows, d, L)),
        xp.zeros((rows, L), xp.int32),
    )


def write_row(tape: Tape, i: Int[Array, ""], row: Tape) -> Tape:
    """The tape with its row i filled in: in place on the host, and by XLA outside of branches."""
    if on_host(tape.h):
        for x, y in zip(tape, row, strict=True):
            x[i] = y
        return tape
    return Tape(*(put(x, i, y.astype(x.dtype)) for x, y in zip(tape, row, strict=True)))
