"""The itinerary of a trajectory: its steps and events, as the rows of a table.

A *leg* lies between two events. A leg ends at a time that is not known exactly, so that each of
its steps is a fraction of the leg; corrections, which are Newton steps on the guard, follow the
last one.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.lanes import shared
from ...systems.structure import Kind, Structure
from ...systems.transition import Scheduled
from .. import kernels
from ..events import await_schedules, with_schedules
from ..lanes import ARRIVE_LEVEL, IDLE, Lanes, Tape
from ..replay import recorded_moves
from ..target import AbstractLevels


# Newton steps on the guard after the last step of a leg, by the method of the chart. A last one, of
# Euler, follows. Fewer: lanes far from the recorded one miss their event. More: turns last longer.
CORRECTIONS = 2
# Pieces of one turn, in each of which columns begin anew. Fewer: strong contraction drowns in the
# product of the steps of a piece. More: programs run longer.
PIECES = 16
# Rows of a table are a multiple of this. More: empty rows take time. Fewer: itineraries of other
# lengths compile again.
_ROUND = 128
# The same of legs.
_LEGS = 4
# A guard whose value is below this part of its largest one in the chart may have either sign.
# Larger: a guard that is passed is not noticed. Smaller: rounding at events is taken for a passage.
_NEAR_ZERO = 1e-7

# What a row does.
NOTHING, SCHEDULE, STEP, JUMP, LEVEL, TIME = range(6)


class Rows(NamedTuple):
    """R rows; those of other kinds do not use a column."""

    body: Int[np.ndarray, " R"]
    """Index among the `bodies` of the program."""
    leg: Int[np.ndarray, " R"]
    fraction: Float[np.ndarray, " R"]
    """Length of a step, as a part of the leg."""
    target: Int[np.ndarray, " R"]
    """Of a correction: the row of the watched function of the chart that it brings to zero. Of an
    arrival on a section: that of the level. -1 for a step."""
    place: Int[np.ndarray, " R"]
    """Of a jump: index of the transition among those of its kind."""
    piece: Int[np.ndarray, " R"]
    """Of a step: number of the piece that begins with it; that of all pieces for none."""
    onward: Bool[np.ndarray, " R"]
    """Of a jump: whether the trajectory goes on after it. Otherwise it ends on a section right
    after the event."""
    section: Int[np.ndarray, " R"]
    """Index of the level that is watched."""
    signs: Int[np.ndarray, "R G"]
    """Signs of the watched functions of the chart where a row begins, on the recorded
    trajectory; 0 where they may have either. (See `Bodies` for their use.)"""


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


class Body(NamedTuple):
    """What rows of one kind do, for the compiler."""

    does: int
    chart: int = -1
    """In which it begins."""
    kind: Kind = ()
    """Of jumps."""
    at_once: bool = False
    """Whether the jump happens at the time of the event before."""

    @property
    def transition(self) -> int:
        """Of a jump: the first transition of its kind, which is the only one if it is scheduled."""
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
    """The steps and events of a recorded trajectory, one row for each."""

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
    """Whether rows can tell if all events are still due (see `_is_certain`)."""


def levels_in(s: Structure, a: int, levels: AbstractLevels | None) -> bool:
    """Test whether a level of the section is watched in chart a."""
    return levels is not None and shared(levels).present(s, a)


class _Table:
    """Rows that are written one after the other."""

    def __init__(self, sections: int = 0):
        self.sections = sections
        self.rows: list[tuple] = []
        self.bodies: list[Body] = [Body(NOTHING)]

    def include(self, bodies: Iterable[Body]) -> None:
        """Have bodies compiled, whether rows use them or not."""
        self.bodies += [x for x in dict.fromkeys(bodies) if x not in self.bodies]

    def add(
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
        section: int = 0,
    ) -> None:
        self.include([body])
        number = self.bodies.index(body)
        if piece is None:
            piece = self.sections or PIECES
        places = target, place, piece
        self.rows.append((number, leg, fraction, *places, onward, section, signs))


class _Leg(NamedTuple):
    """Recorded moves between two events, in one chart."""

    chart: int
    times: Float[np.ndarray, " 1+m"]
    """Beginnings of the moves, and the end."""
    begins: Int[np.ndarray, "m G"]
    """Signs of watched functions at the beginnings of the moves (see `_signs`)."""
    ends: Int[np.ndarray, "m G"]
    code: int
    """With which it ends: of an event, of a level, or negative."""
    at_once: bool
    lane: int = 0
    """Number of the recorded piece."""
    section: int = 0
    """Index of the level that is watched."""

    @property
    def unknown(self) -> Int[np.ndarray, " G"]:
        """Signs of which nothing is known."""
        return np.zeros(self.begins.shape[1], int)

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
        """Signs at a time; 0 for what changes its sign in the recorded move there."""
        move = int(np.searchsorted(self.times, t, side="right")) - 1
        move = min(move, len(self.begins) - 1)
        begin, end = self.begins[move], self.ends[move]
        if t == self.times[move]:
            return begin
        # (One that rises may do so at any time.)
        return np.where((begin == end) | (begin < 0), begin, 0)


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
    legs = _legs(s, levels, turn)
    nodes = [leg.nodes(density) for leg in legs]
    while sum(len(x) - 1 for x in nodes) < PIECES:
        density *= 1.25
        nodes = [leg.nodes(density) for leg in legs]
    return _written(s, legs, nodes, _Table(), _pieces(nodes))


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
    legs = _legs(s, levels, walk, to)
    nodes = [leg.nodes(density) for leg in legs]
    lanes = [leg.lane for leg in legs]
    arrivals = np.flatnonzero(np.diff(lanes)) + 1
    begins = set(arrivals.tolist())
    if begins_on_section:
        begins.add(0)
    begins.discard(len(legs))
    table = _Table(len(begins))
    pieces = {(k, -1) for k in begins}
    itinerary = _written(s, legs, nodes, table, pieces)
    return itinerary, np.append(arrivals, len(legs)) - 1


def _written(
    s: Structure, legs: list[_Leg], nodes: list, table: _Table, pieces: set
) -> Itinerary:
    """The itinerary of legs with these nodes.

    **Arguments:** `pieces`: leg and number of the node at which each piece begins; node -1 for one
    that begins with the leg, on a section.
    """
    begun = _Pieces(s, legs)
    for k, (leg, times) in enumerate(zip(legs, nodes, strict=True)):
        begins = {j for j in range(-1, len(times)) if (k, j) in pieces}
        _rows_of_leg(s, table, k, leg, times, begun, begins)
        # (A trajectory that ends with an event ends at a time that is free.)
        is_last = k == len(legs) - 1
        goes_on = not is_last and (k + 1, -1) not in pieces
        before = leg.signs(times[-2]) if len(times) > 1 else leg.unknown
        _end(s, table, k, leg, before, goes_on, is_last)
    last_times = np.array([leg.times[-1] for leg in legs])
    ends = last_times - legs[0].times[0]
    missing = -len(ends) % _LEGS
    no_more = np.repeat(ends[-1:], missing)
    form, rows, used = _finished(table)
    armed = np.array(begun.armed).reshape(len(begun.charts), len(s.transitions))
    return Itinerary(
        form,
        rows,
        count=used,
        ends=np.append(ends, no_more),
        last=len(ends) - 1,
        charts=np.array(begun.charts, np.int32),
        begins=np.array(begun.events, np.int32),
        armed=armed.T,
        events=tuple(leg.code for leg in legs if leg.code >= 0),
        certain=all(_is_certain(s, leg) for leg in legs),
    )


class _Pieces:
    """The pieces of an itinerary that have begun: their charts, the numbers of events before them,
    and the transitions that are armed."""

    def __init__(self, s: Structure, legs: list[_Leg]):
        self._s, self._legs = s, legs
        self.charts: list[int] = []
        self.events: list[int] = []
        self.armed: list[np.ndarray] = []

    def piece(self, k: int, t: float) -> int:
        """Begin a piece at a time in leg k, and return its number."""
        leg = self._legs[k]
        self.charts.append(leg.chart)
        earlier = self._legs[:k]
        self.events.append(sum(before.code >= 0 for before in earlier))
        signs = leg.signs(t)
        self.armed.append(_armed(self._s, leg.chart, t, signs))
        return len(self.charts) - 1


def _rows_of_leg(
    s: Structure,
    table: _Table,
    k: int,
    leg: _Leg,
    times: Float[np.ndarray, " 1+n"],
    begun: _Pieces,
    begins: set[int],
) -> None:
    """Add the rows of leg k until its end.

    **Arguments:** `begins`: numbers of the steps at which pieces begin; -1 for the beginning of the
    leg, on a section.
    """
    if leg.code >= 0 and not leg.at_once and _is_scheduled(s, leg.code):
        schedule = Body(SCHEDULE, leg.chart, (leg.code,))
        table.add(schedule, k, leg.unknown)
    step = Body(STEP, leg.chart)
    fractions = _fractions(times)
    if -1 in begins and not len(fractions):
        # (A piece begins with a step, if need be with one of no time.)
        fractions = np.zeros(1)
    for j, fraction in enumerate(fractions):
        t = times[j]
        piece = None
        if j in begins or (j == 0 and -1 in begins):
            piece = begun.piece(k, t)
        where: Any = dict(piece=piece, section=leg.section)
        table.add(step, k, leg.signs(t), fraction=fraction, **where)


def _is_certain(s: Structure, leg: _Leg) -> bool:
    """Test whether rows can tell if the event of a leg is still due: not if it comes after no time,
    unless it happens at once, with its guard beyond zero; and not if another guard falls to zero
    there, so that its sign is unknown."""
    if leg.code < 0:
        return True
    guards = s.guards(leg.chart)
    before = leg.begins[-1]
    after = leg.ends[-1]
    for place, g in enumerate(guards):
        falls_to_zero = before[place] > 0 and after[place] == 0
        if g != leg.code and falls_to_zero:
            return False
    if not leg.at_once:
        return bool(leg.times[-1] > leg.times[0])
    if _is_scheduled(s, leg.code):
        return False
    return bool(after[guards.index(leg.code)] < 0)


def _armed(s: Structure, a: int, t: float, signs) -> Bool[np.ndarray, " G"]:
    """Transitions that are armed in chart a, where watched functions have these signs."""
    armed = np.zeros((len(s.transitions), 1), bool)
    for place, g in enumerate(s.guards(a)):
        armed[g] = signs[place] > 0
    time = np.array([t])
    awaited = await_schedules(s, armed, time, time)
    return with_schedules(s, armed, awaited)[:, 0]


def _fractions(times: Float[np.ndarray, " 1+n"]) -> Float[np.ndarray, " n"]:
    """Durations of the steps of a leg, as parts of its own."""
    if len(times) < 2:
        return np.zeros(0)
    whole = times[-1] - times[0]
    return np.diff(times) / whole


def _pieces(nodes: list[Float[np.ndarray, " 1+n"]]) -> set[tuple[int, int]]:
    """The nodes at which pieces begin, by leg and number: nearly equal parts of the turn."""
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


def _end(
    s: Structure,
    table: _Table,
    k: int,
    leg: _Leg,
    before: np.ndarray,
    goes_on: bool,
    is_last: bool,
) -> None:
    """Add the rows with which leg k ends. `before`: signs where its last step begins."""
    a, signs = leg.chart, leg.ends[-1]
    if leg.code == ARRIVE_LEVEL:
        target = len(s.guards(a))
        signs = _corrected(table, k, leg, before, target)
        body = Body(LEVEL, a)
        table.add(body, k, signs, target=target, section=leg.section)
    elif leg.code < 0:
        if is_last:
            # (The next row tests what has happened in a step. Here none would follow.)
            table.add(Body(STEP, a), k, signs, section=leg.section)
        level = len(s.guards(a))
        table.add(Body(TIME), k, leg.unknown, target=level)
    else:
        jump, place = _jump(s, leg.code, leg.at_once)
        target = -1
        if not (leg.at_once or _is_scheduled(s, leg.code)):
            target = s.guards(a).index(leg.code)
            signs = _corrected(table, k, leg, before, target)
        where: Any = dict(target=target, section=leg.section)
        table.add(jump, k, signs, place=place, onward=goes_on, **where)


def _corrected(
    table: _Table, k: int, leg: _Leg, before: np.ndarray, target: int
) -> Int[np.ndarray, " G"]:
    """Add the corrections of leg k, and return the signs at its end.

    The first correction has the sign of its function before it; the others none, as it is zero.
    """
    signs = leg.ends[-1].copy()
    signs[target] = before[target]
    for _ in range(CORRECTIONS):
        where: Any = dict(target=target, section=leg.section)
        table.add(Body(STEP, leg.chart), k, signs, **where)
        signs = signs.copy()
        signs[target] = 0
    return signs


def _legs(
    s: Structure, levels, turn: tuple[Lanes, Tape], to: np.ndarray | None = None
) -> list[_Leg]:
    """The legs of a recorded turn, or of a walk to sections."""
    moves = recorded_moves(*turn)
    if to is None:
        index = np.zeros(len(moves.h), np.int32)
    else:
        index = to[moves.lane]
    h = np.where(moves.at_once, 0.0, moves.h)
    before = _before_events(turn[1])
    begins = _signs(s, levels, moves.t, moves.chart, moves.q, index)
    ends_of_moves = moves.t + h
    ends = _signs(s, levels, ends_of_moves, moves.chart, before, index)
    is_last = moves.code >= 0
    is_last[-1] = True
    if to is not None:
        is_last[:-1] |= np.diff(moves.lane) != 0
    legs = []
    first = 0
    for end in np.flatnonzero(is_last):
        own = slice(first, end + 1)
        leg = _Leg(
            int(moves.chart[first]),
            np.append(moves.t[own], moves.t[end] + h[end]),
            begins[own],
            ends[own],
            int(moves.code[end]),
            bool(moves.at_once[end]),
            int(moves.lane[end]),
            int(index[end]),
        )
        legs.append(leg)
        first = end + 1
    return legs


def _before_events(tape: Tape) -> Float[np.ndarray, "d M"]:
    """States at the ends of the moves of a tape, before events, lane by lane."""
    lane, row = np.nonzero(tape.code.T != IDLE)
    return np.asarray(tape.before)[row, :, lane].T


def _signs(s: Structure, levels, t, chart, q, index) -> Int[np.ndarray, "M G"]:
    """Signs of the watched functions of charts at points; 0 where they are zero but for errors.

    **Arguments:** `index` (M,): of the level that is watched.
    """
    counts = [len(s.guards(a)) + levels_in(s, a, levels) for a in range(len(s.dims))]
    signs = np.zeros((len(t), max(counts)), int)
    for a in np.unique(chart).tolist():
        count = counts[a]
        if not count:
            continue
        here = np.flatnonzero(chart == a)
        state = q[: s.dims[a], here]
        no_input = np.zeros((s.nu, 1))
        rows = kernels.watched(s, a, levels, t[here], state, no_input, index[here])
        value = np.nan_to_num(rows[:, 0], posinf=np.inf, neginf=-np.inf)
        magnitude = np.abs(value)
        finite = np.where(np.isfinite(value), magnitude, 0.0)
        largest = finite.max(axis=1, keepdims=True)
        known = np.abs(value) > _NEAR_ZERO * largest
        sign = np.where(known, np.sign(value), 0)
        signs[here, :count] = sign.T
    return signs


def _is_scheduled(s: Structure, g: int) -> bool:
    return isinstance(s.transitions[g].guard, Scheduled)


def _jump(s: Structure, g: int, at_once: bool) -> tuple[Body, int]:
    """The body of a transition, and its index among those of its kind."""
    kind = next(kind for kind in s.kinds if g in kind)
    a = s.chart_index(s.transitions[g].source)
    return Body(JUMP, a, kind, at_once), kind.index(g)


def _finished(table: _Table) -> tuple[Form, Rows, int]:
    """The form and the rows of a table, filled up with empty ones, and the number of the others."""
    used = len(table.rows)
    width = len(table.rows[0][-1])
    for _ in range(-used % _ROUND):
        table.add(Body(NOTHING), 0, np.zeros(width, int))
    columns = {}
    for name, values in zip(Rows._fields, zip(*table.rows, strict=True), strict=True):
        columns[name] = np.array(values).astype(_TYPES[name])
    rows = Rows(**columns)
    # (Bodies in one order, so that itineraries with the same ones share a program.)
    bodies = tuple(sorted(table.bodies))
    place = np.array([bodies.index(body) for body in table.bodies], np.int32)
    rows = rows._replace(body=place[rows.body])
    form = Form(bodies, width, table.sections)
    return form, rows, used
