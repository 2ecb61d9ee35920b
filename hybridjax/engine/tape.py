"""The record of a search: what was done with every lane."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

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
    d, L = lanes.q.shape
    return Tape(
        jnp.zeros((rows, L)),
        jnp.full((rows, L), IDLE, jnp.int32),
        jnp.zeros((rows, L)),
        jnp.zeros((rows, d, L)),
        jnp.zeros((rows, d, L)),
        jnp.zeros((rows, L), jnp.int32),
    )


def write_row(tape: Tape, i: Int[Array, ""], row: Tape) -> Tape:
    """The tape with its row i filled in. (Outside of any branch, where it is done in place.)"""
    return Tape(*(x.at[i].set(y.astype(x.dtype)) for x, y in zip(tape, row, strict=True)))
