"""Legs: a recorded trajectory, cut at its events.

A search leaves a tape of its moves (steps and jumps). A *leg* is the part between two events, in
one chart. It ends with an event, on the level of a section, or at a time. `legs_of` reads legs from
a tape. `Leg.nodes` chooses where the steps of an itinerary begin, and `Leg.signs` says which sign
each watched function has there. `recorded.py` calls these three, and writes rows from them.

A sign of 0 must go on to mean that nothing is known: `flags.py` does not test such a function. If
trajectories leave their itinerary without need, look at `known_signs`, which may call a rounding
error a sign; if a leg begins or ends in the wrong place, at `ends_leg` in `legs_of`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...systems.structure import Structure
from .. import kernels
from ..lanes import IDLE, Lanes, Tape
from ..replay import recorded_moves
from ..target import AbstractLevels


# A guard whose value is below this part of its largest one in the chart may have either sign.
# Larger: a guard that is passed is not noticed. Smaller: rounding at events is taken for a passage.
_NEAR_ZERO = 1e-7


class Leg(NamedTuple):
    """Recorded moves between two events, in one chart."""

    chart: int
    times: Float[np.ndarray, " 1+m"]
    """Beginnings of the moves, and the end."""
    signs_before: Int[np.ndarray, "m G"]
    """Signs of watched functions at the beginnings of the moves; 0 where they are zero, but for
    errors."""
    signs_after: Int[np.ndarray, "m G"]
    """Signs at the ends of the moves."""
    code: int
    """Its end: the index of a transition, `ARRIVE_LEVEL`, or another negative code for a time."""
    at_once: bool
    """Whether it ends with an event at once, at the time of the event before."""
    lane: int
    """Number of the recorded piece."""
    section: int
    """Index of the level that is watched."""

    @property
    def unknown(self) -> Int[np.ndarray, " G"]:
        """Signs of which nothing is known."""
        return np.zeros(self.signs_before.shape[1], int)

    def nodes(self, density: float) -> Float[np.ndarray, " 1+n"]:
        """Beginnings of steps, and the end, with so many steps for each recorded one."""
        lasts_no_time = self.times[-1] == self.times[0]
        if self.at_once or lasts_no_time:
            return self.times[-1:]
        moves = len(self.times) - 1
        number = np.ceil(moves * density - 1e-9)
        count = max(1, int(number))
        place = np.linspace(0, moves, count + 1)
        return np.interp(place, np.arange(moves + 1), self.times)

    def signs(self, t: float) -> Int[np.ndarray, " G"]:
        """Signs at a time; 0 for a function that changes its sign in the recorded move there."""
        move = int(np.searchsorted(self.times, t, side="right")) - 1
        move = min(move, len(self.signs_before) - 1)
        before = self.signs_before[move]
        after = self.signs_after[move]
        if t == self.times[move]:
            return before
        # (One that rises may do so at any time.)
        return np.where((before == after) | (before < 0), before, 0)


def legs_of(
    s: Structure,
    levels: AbstractLevels | None,
    walk: tuple[Lanes, Tape],
    to: Int[np.ndarray, " L"] | None = None,
) -> list[Leg]:
    """The legs of a trajectory that was recorded piece by piece, side by side.

    **Arguments:** `to`: the section to which each recorded piece leads, at whose level a leg ends;
    None for a turn, whose pieces end within legs.
    """
    moves = recorded_moves(*walk)
    section = np.zeros(len(moves.h), np.int32) if to is None else to[moves.lane]
    h = np.where(moves.at_once, 0.0, moves.h)
    ends_of_moves = moves.t + h
    at_end = _before_events(walk[1])
    before = _signs(s, levels, moves.t, moves.chart, moves.q, section)
    after = _signs(s, levels, ends_of_moves, moves.chart, at_end, section)
    ends_leg = moves.code >= 0
    ends_leg[-1] = True
    if to is not None:
        ends_leg[:-1] |= np.diff(moves.lane) != 0
    legs = []
    first = 0
    for end in np.flatnonzero(ends_leg):
        own = slice(first, end + 1)
        leg = Leg(
            chart=int(moves.chart[first]),
            times=np.append(moves.t[own], ends_of_moves[end]),
            signs_before=before[own],
            signs_after=after[own],
            code=int(moves.code[end]),
            at_once=bool(moves.at_once[end]),
            lane=int(moves.lane[end]),
            section=int(section[end]),
        )
        legs.append(leg)
        first = end + 1
    return legs


def _before_events(tape: Tape) -> Float[np.ndarray, "d M"]:
    """States at the ends of the moves of a tape, before events, lane by lane."""
    lane, row = np.nonzero(tape.code.T != IDLE)
    return np.asarray(tape.before)[row, :, lane].T


def _signs(s: Structure, levels, t, chart, q, section) -> Int[np.ndarray, "M G"]:
    """Signs of the watched functions at M points; 0 where they are zero but for errors.

    **Arguments:** `section` (M,): index of the level that is watched.
    """
    counts = [kernels.count_watched(s, a, levels) for a in range(len(s.dims))]
    signs = np.zeros((len(t), max(counts)), int)
    for a in np.unique(chart).tolist():
        count = counts[a]
        if not count:
            continue
        here = np.flatnonzero(chart == a)
        state = q[: s.dims[a], here]
        no_input = np.zeros((s.nu, 1))
        watched = kernels.watched(s, a, levels, t[here], state, no_input, section[here])
        signs[here, :count] = known_signs(watched[:, 0]).T
    return signs


def known_signs(values: Float[np.ndarray, "G M"]) -> Int[np.ndarray, "G M"]:
    """Signs of functions at M points; 0 where a function is NaN, or zero but for errors."""
    values = np.nan_to_num(values, posinf=np.inf, neginf=-np.inf)
    sizes = np.abs(values)
    finite = np.where(np.isfinite(values), sizes, 0.0)
    largest = finite.max(axis=1, keepdims=True)
    is_known = sizes > _NEAR_ZERO * largest
    return np.where(is_known, np.sign(values), 0).astype(int)
