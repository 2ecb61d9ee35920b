"""The rows of an itinerary, as data: what happens, in which order.

A *leg* is the part of a trajectory between two events (see `legs.py`). A ball that bounces without
loss, from apex to apex, has two legs. Its watched functions are the guard, number 0, and the level
of the section, number 1. In four steps, each of which begins a piece, the rows are

| row | body: does, chart | leg | fraction | target | piece |
|---|---|---|---|---|---|
| 0 | STEP, flight | 0 | 0.5 | | 0 begins |
| 1 | STEP, flight | 0 | 0.5 | | 1 begins |
| 2, 3 | STEP, flight: corrections | 0 | | 0, the guard | |
| 4 | JUMP, flight | 0 | | 0 | |
| 5, 6 | STEP, flight | 1 | 0.5, 0.5 | | 2, 3 begin |
| 7, 8 | STEP, flight: corrections | 1 | | 1, the section | |
| 9 | LEVEL, flight | 1 | | 1 | |
| 10 to 127 | NOTHING | | | | |

The end of a leg is not known exactly, so that each step takes a fraction of its leg. *Corrections*
follow: steps of the length that brings a watched function to zero, which is Newton's method for the
time of the event. JUMP and LEVEL begin with a last correction, by Euler's method. SCHEDULE comes
before the steps of a leg that ends by the clock, and TIME ends a leg at a time that is known.

Nothing is computed here: wrong rows come from `recorded.py`. A new column of `Rows` also needs a
type in `_TYPES` and a value in `_Writer._add` there, and a field of `Row` in `table.py`. A row that
does something new needs a number below, a `Body` from `_Writer`, and stages in `bodies.py`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...systems.structure import Kind


# Pieces of one turn, in each of which columns begin anew. Fewer: strong contraction drowns in the
# product of the steps of a piece. More: programs run longer.
PIECES = 16

# What a row does.
NOTHING, SCHEDULE, STEP, JUMP, LEVEL, TIME = range(6)


class Rows(NamedTuple):
    """R rows, column by column."""

    body: Int[np.ndarray, " R"]
    """Index among the `bodies` of the program."""
    leg: Int[np.ndarray, " R"]
    fraction: Float[np.ndarray, " R"]
    """STEP: its length, as a part of the leg; 0 for a correction."""
    target: Int[np.ndarray, " R"]
    """Corrections, JUMP and LEVEL: number of the watched function of the chart that is brought to
    zero (see `watched.py`). Others, and scheduled or immediate jumps: -1."""
    place: Int[np.ndarray, " R"]
    """JUMP: index of the transition among those of its kind."""
    piece: Int[np.ndarray, " R"]
    """STEP: number of the piece that begins with it; the number of all pieces if none does."""
    onward: Bool[np.ndarray, " R"]
    """JUMP: whether the trajectory goes on after it. Otherwise it ends on a section right after the
    event."""
    section: Int[np.ndarray, " R"]
    """Index of the level that is watched."""
    signs: Int[np.ndarray, "R G"]
    """Signs of the watched functions of the chart where a row begins, on the recorded
    trajectory; 0 where they may have either. (`flags.py` compares them.)"""


class Body(NamedTuple):
    """What rows of one kind do, for the compiler."""

    does: int
    chart: int = -1
    """In which it begins."""
    kind: Kind = ()
    """JUMP and SCHEDULE: the transitions that share its code."""
    at_once: bool = False
    """JUMP: whether it happens at the time of the event before."""

    @property
    def transition(self) -> int:
        """The first transition of its kind, which is the only one if it is scheduled."""
        return self.kind[0]

    @property
    def way(self) -> "Body":
        """One of the rows that share their way through the program: all that begin in a chart do,
        and each schedule goes its own."""
        return Body(STEP) if self.does in (STEP, JUMP, LEVEL) else self


class Form(NamedTuple):
    """All of an itinerary that a program is compiled for. (Hashable.)"""

    bodies: tuple[Body, ...]
    watched: int
    """Largest number of watched functions of a chart."""
    sections: int = 0
    """Number of sections: a piece begins at each, with columns of the time, the state and the
    inputs. 0 for a turn in `PIECES` pieces, with columns of the state."""

    @property
    def pieces(self) -> int:
        return self.sections or PIECES

    @property
    def ways(self) -> tuple[Body, ...]:
        """The ways of rows through the program, see `Body.way`."""
        return tuple(dict.fromkeys(body.way for body in self.bodies))

    @property
    def charts(self) -> tuple[int, ...]:
        """The charts in which rows begin."""
        begun = {x.chart for x in self.bodies if x.way.does == STEP}
        return tuple(sorted(begun))

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of jumps."""
        jumps = {x.kind for x in self.bodies if x.does == JUMP}
        return tuple(sorted(jumps))


class Itinerary(NamedTuple):
    """The rows of a recorded trajectory, and what else it has shown."""

    form: Form
    rows: Rows
    count: int | Int[np.ndarray, ""]  # type: ignore[assignment]  # (not the method of tuples)
    """Rows that do something; the others follow."""
    ends: Float[np.ndarray, " E"]
    """Ends of the legs, from the beginning of the trajectory; that of the last one is repeated."""
    last: int
    """Number of the last leg."""
    charts: Int[np.ndarray, " K"]
    """Charts in which the pieces begin."""
    begins: Int[np.ndarray, " K"]
    """Numbers of events before them."""
    armed: Bool[np.ndarray, "G K"]
    """Transitions that are armed there."""
    events: tuple[int, ...]
    """Indices of transitions, in order."""
    certain: bool
    """Whether rows can tell if all events are still due (see `_is_certain` in `recorded.py`)."""
