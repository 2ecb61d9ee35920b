"""Write the itinerary of a recorded trajectory.

`recorded` is for one turn of a cycle, `recorded_walk` for a trajectory from section to section.
Both cut the tape into legs, choose the steps of each leg, and have `_Writer` write for each leg

    SCHEDULE, if it ends by the clock
    STEP, for each of its steps
    STEP, for each correction of the time of its end
    JUMP, LEVEL or TIME, for its end

This order must stay: a row needs what the rows before it have computed. If rows are missing or in a
wrong order, look in `_Writer`; if a leg itself is wrong, in `legs.py`; if an itinerary is not used
although it could be, in `_is_certain`. `rows.py` says what columns mean.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...systems.structure import Structure
from ...systems.transition import Scheduled
from ..events import await_schedules, with_schedules
from ..lanes import ARRIVE_LEVEL, Lanes, Tape
from ..target import AbstractLevels
from .legs import Leg, legs_of
from .rows import (
    JUMP,
    LEVEL,
    NOTHING,
    PIECES,
    SCHEDULE,
    STEP,
    TIME,
    Body,
    Form,
    Itinerary,
    Rows,
)


# Newton steps on the guard after the last step of a leg, by the method of the chart. A last one, of
# Euler, follows. Fewer: lanes far from the recorded one miss their event. More: turns last longer.
CORRECTIONS = 2
# Rows of a table are a multiple of this. More: empty rows take time. Fewer: itineraries of other
# lengths compile again.
_ROUND = 128
# The number of ends of legs in an itinerary is a multiple of this, for the same reason.
_LEGS = 4

_TYPES = {
    "body": np.int32,
    "leg": np.int32,
    "fraction": float,
    "target": np.int32,
    "place": np.int32,
    "piece": np.int32,
    "onward": bool,
    "section": np.int32,
    "signs": np.int32,
}

Nodes = Float[np.ndarray, " 1+n"]
"""Times at which the n steps of a leg begin, and its end."""


def recorded(
    s: Structure,
    turn: tuple[Lanes, Tape],
    levels: AbstractLevels | None,
    density: float = 1.0,
) -> Itinerary:
    """The itinerary of a turn that was recorded piece by piece, side by side.

    **Arguments:** `levels`: of the section on which the turn ends, if it does. `density`: number of
    steps for each recorded one, up to rounding in each leg.
    """
    legs = legs_of(s, levels, turn)
    nodes = [leg.nodes(density) for leg in legs]
    # (Each piece needs a step.)
    while sum(len(x) - 1 for x in nodes) < PIECES:
        density *= 1.25
        nodes = [leg.nodes(density) for leg in legs]
    return _written(s, legs, nodes, _equal_pieces(nodes))


def recorded_walk(
    s: Structure,
    walk: tuple[Lanes, Tape],
    levels: AbstractLevels | None,
    to: Int[np.ndarray, " L"],
    begins_on_section: bool,
    density: float = 1.0,
) -> tuple[Itinerary, Int[np.ndarray, " L"]]:
    """The itinerary of a trajectory from section to section, recorded side by side, and the numbers
    of the legs that end on sections.

    **Arguments:** `to`: the section to which each recorded piece leads. `begins_on_section`:
    whether the first piece begins on one.
    """
    legs = legs_of(s, levels, walk, to)
    nodes = [leg.nodes(density) for leg in legs]
    lanes = [leg.lane for leg in legs]
    first_legs = np.flatnonzero(np.diff(lanes)) + 1
    pieces = {(k, -1) for k in first_legs.tolist()}
    if begins_on_section:
        pieces.add((0, -1))
    itinerary = _written(s, legs, nodes, pieces, sections=len(pieces))
    return itinerary, np.append(first_legs, len(legs)) - 1


def _equal_pieces(nodes: list[Nodes]) -> set[tuple[int, int]]:
    """The nodes at which the pieces of a turn begin, by leg and number: nearly equal parts of the
    turn."""
    places = []
    for k, of_leg in enumerate(nodes):
        places += [(k, j) for j in range(len(of_leg) - 1)]
    times = np.array([nodes[k][j] for k, j in places])
    start = nodes[0][0]
    whole = nodes[-1][-1] - start
    chosen = [0]
    for piece in range(1, PIECES):
        # (Each piece after this one keeps a node of its own.)
        first = chosen[-1] + 1
        end = len(places) - (PIECES - piece) + 1
        goal = start + piece * whole / PIECES
        distance = np.abs(times[first:end] - goal)
        chosen.append(first + int(np.argmin(distance)))
    return {places[k] for k in chosen}


def _written(
    s: Structure,
    legs: list[Leg],
    nodes: list[Nodes],
    pieces: set[tuple[int, int]],
    sections: int = 0,
) -> Itinerary:
    """The itinerary of legs with these nodes.

    **Arguments:** `pieces`: leg and number of the node at which each piece begins; node -1 for one
    that begins with the leg, on a section.
    """
    writer = _Writer(s, legs, sections)
    for k, times in enumerate(nodes):
        begins = {j for leg, j in pieces if leg == k}
        is_last = k == len(legs) - 1
        goes_on = not is_last and (k + 1, -1) not in pieces
        writer.add_steps(k, times, begins)
        writer.add_end(k, times, goes_on)
    form, rows, used = writer.finished()
    last_times = np.array([leg.times[-1] for leg in legs])
    ends = last_times - legs[0].times[0]
    missing = -len(ends) % _LEGS
    no_more = np.repeat(ends[-1:], missing)
    armed = [piece.armed for piece in writer.pieces]
    return Itinerary(
        form,
        rows,
        count=used,
        ends=np.append(ends, no_more),
        last=len(ends) - 1,
        charts=np.array([piece.chart for piece in writer.pieces], np.int32),
        begins=np.array([piece.events for piece in writer.pieces], np.int32),
        armed=np.array(armed).reshape(len(armed), len(s.transitions)).T,
        events=tuple(leg.code for leg in legs if leg.code >= 0),
        certain=all(_is_certain(s, leg) for leg in legs),
    )


class _Piece(NamedTuple):
    """A piece, where it begins."""

    chart: int
    events: int
    """Number of events before."""
    armed: Bool[np.ndarray, " G"]
    """Transitions that are armed."""


class _Writer:
    """The rows so far, and the pieces that have begun."""

    def __init__(self, s: Structure, legs: list[Leg], sections: int):
        self._s = s
        self._legs = legs
        self._sections = sections
        self._rows: list[tuple] = []
        self._bodies: list[Body] = [Body(NOTHING)]
        self.pieces: list[_Piece] = []

    def add_steps(self, k: int, times: Nodes, begins: set[int]) -> None:
        """Add the steps of leg k.

        **Arguments:** `begins`: numbers of the steps at which pieces begin; -1 for the beginning of
        the leg, on a section.
        """
        leg = self._legs[k]
        if leg.code >= 0 and not leg.at_once and _is_scheduled(self._s, leg.code):
            schedule = Body(SCHEDULE, leg.chart, (leg.code,))
            self._add(schedule, k, leg.unknown)
        step = Body(STEP, leg.chart)
        fractions = _fractions(times)
        if -1 in begins and not len(fractions):
            # (A piece begins with a step, if need be with one of no time.)
            fractions = np.zeros(1)
        for j, fraction in enumerate(fractions):
            t = times[j]
            piece = None
            if j in begins or (j == 0 and -1 in begins):
                piece = self._begin_piece(k, t)
            self._add(step, k, leg.signs(t), fraction=fraction, piece=piece)

    def add_end(self, k: int, times: Nodes, goes_on: bool) -> None:
        """Add the corrections and the end of leg k.

        **Arguments:** `goes_on`: whether the piece goes on after it.
        """
        leg = self._legs[k]
        before = leg.signs(times[-2]) if len(times) > 1 else leg.unknown
        if leg.code >= 0:
            self._add_jump(k, before, goes_on)
        elif leg.code == ARRIVE_LEVEL:
            self._add_level(k, before)
        else:
            self._add_time(k)

    def _add_jump(self, k: int, before: np.ndarray, goes_on: bool) -> None:
        leg = self._legs[k]
        s = self._s
        kind = next(kind for kind in s.kinds if leg.code in kind)
        jump = Body(JUMP, leg.chart, kind, leg.at_once)
        signs = leg.signs_after[-1]
        target = -1
        if not (leg.at_once or _is_scheduled(s, leg.code)):
            target = s.guards(leg.chart).index(leg.code)
            signs = self._add_corrections(k, before, target)
        place = kind.index(leg.code)
        self._add(jump, k, signs, target=target, place=place, onward=goes_on)

    def _add_level(self, k: int, before: np.ndarray) -> None:
        chart = self._legs[k].chart
        level = len(self._s.guards(chart))
        signs = self._add_corrections(k, before, level)
        self._add(Body(LEVEL, chart), k, signs, target=level)

    def _add_time(self, k: int) -> None:
        leg = self._legs[k]
        level = len(self._s.guards(leg.chart))
        if k == len(self._legs) - 1:
            # (The next row tests what has happened in a step. Here none would follow.)
            self._add(Body(STEP, leg.chart), k, leg.signs_after[-1])
        self._add(Body(TIME), k, leg.unknown, target=level)

    def _add_corrections(
        self, k: int, before: np.ndarray, target: int
    ) -> Int[np.ndarray, " G"]:
        """Add the corrections of leg k, and return the signs at its end.

        The first correction has the sign of its function `before` the last step; the others none,
        as it is zero.
        """
        leg = self._legs[k]
        signs = leg.signs_after[-1].copy()
        signs[target] = before[target]
        for _ in range(CORRECTIONS):
            self._add(Body(STEP, leg.chart), k, signs, target=target)
            signs = signs.copy()
            signs[target] = 0
        return signs

    def _begin_piece(self, k: int, t: float) -> int:
        """Begin a piece at a time in leg k, and return its number."""
        leg = self._legs[k]
        events = sum(before.code >= 0 for before in self._legs[:k])
        armed = _armed(self._s, leg.chart, t, leg.signs(t))
        self.pieces.append(_Piece(leg.chart, events, armed))
        return len(self.pieces) - 1

    def _add(
        self,
        body: Body,
        leg: int,
        signs: np.ndarray,
        *,
        fraction: float = 0.0,
        target: int = -1,
        place: int = 0,
        piece: int | None = None,
        onward: bool = True,
    ) -> None:
        if body not in self._bodies:
            self._bodies.append(body)
        row: dict[str, Any] = dict(
            body=self._bodies.index(body),
            leg=leg,
            fraction=fraction,
            target=target,
            place=place,
            piece=(self._sections or PIECES) if piece is None else piece,
            onward=onward,
            section=self._legs[leg].section,
            signs=signs,
        )
        self._rows.append(tuple(row[name] for name in Rows._fields))

    def finished(self) -> tuple[Form, Rows, int]:
        """The form and the rows, filled up with empty ones, and the number of the others."""
        used = len(self._rows)
        no_signs = self._legs[0].unknown
        for _ in range(-used % _ROUND):
            self._add(Body(NOTHING), 0, no_signs)
        columns = {}
        by_name = zip(Rows._fields, zip(*self._rows, strict=True), strict=True)
        for name, values in by_name:
            columns[name] = np.array(values).astype(_TYPES[name])
        rows = Rows(**columns)
        # (Bodies in one order, so that itineraries with the same ones share a program.)
        bodies = tuple(sorted(self._bodies))
        place = np.array([bodies.index(body) for body in self._bodies], np.int32)
        rows = rows._replace(body=place[rows.body])
        return Form(bodies, len(no_signs), self._sections), rows, used


def _is_scheduled(s: Structure, g: int) -> bool:
    return isinstance(s.transitions[g].guard, Scheduled)


def _fractions(times: Nodes) -> Float[np.ndarray, " n"]:
    """Durations of the steps of a leg, as parts of its own."""
    if len(times) < 2:
        return np.zeros(0)
    whole = times[-1] - times[0]
    return np.diff(times) / whole


def _armed(s: Structure, a: int, t: float, signs) -> Bool[np.ndarray, " G"]:
    """Transitions that are armed in chart a, where watched functions have these signs."""
    armed = np.zeros((len(s.transitions), 1), bool)
    for place, g in enumerate(s.guards(a)):
        armed[g] = signs[place] > 0
    time = np.array([t])
    awaited = await_schedules(s, armed, time, time)
    return with_schedules(s, armed, awaited)[:, 0]


def _is_certain(s: Structure, leg: Leg) -> bool:
    """Test whether rows can tell if the event of a leg is still due: not if it comes after no time,
    unless it happens at once, with its guard beyond zero; and not if another guard falls to zero
    there, so that its sign is unknown."""
    if leg.code < 0:
        return True
    guards = s.guards(leg.chart)
    before = leg.signs_before[-1]
    after = leg.signs_after[-1]
    for place, g in enumerate(guards):
        falls_to_zero = before[place] > 0 and after[place] == 0
        if g != leg.code and falls_to_zero:
            return False
    if not leg.at_once:
        return bool(leg.times[-1] > leg.times[0])
    if _is_scheduled(s, leg.code):
        return False
    return bool(after[guards.index(leg.code)] < 0)
