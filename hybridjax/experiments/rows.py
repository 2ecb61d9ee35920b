"""The course of an experiment as a table: its steps and events from section to section.

Near a limit cycle, an experiment has the same charts and events as the cycle. One period is a table
of *rows*, and each row moves all experiments at once (`passage.py`): it is a step in a chart, a
correction of the time of an event, or an event. A *leg* is the way from one event or section to the
next. `run.py` calls `tables(placed, plan)`, which returns a short and a long table; `_Writer`
writes the rows.

In some experiments, an event near a section may happen on the other side of the section. Such an
event has rows in both intervals. Each row moves only the experiments at its *place*, that is, after
a certain section and a certain number of events. If an event turns out to lie beyond the next
section, it is undone. A further column is a field of `Rows`, an argument of `_Writer._add`, and is
read in `passage.py`. The order of rows must stay (events of an interval in turn, then the section),
since a period is one pass over the rows.

An experiment that leaves its table without need has its cause in the signs that are expected
(`Rows.signs`) or in the rows that are written (`_Writer._interval`). If an event near a section has
no row where it happens, look at `_intervals`; if steps have wrong lengths, at `_leg`.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import to_host
from ..engine import kernels
from ..engine.itinerary.legs import known_signs
from ..engine.itinerary.recorded import CORRECTIONS
from ..engine.lanes import IDLE
from ..sections.placed import PlacedSections
from ..systems.structure import Kind, Member, Structure
from ..systems.transition import Scheduled
from .plan import Plan


# Numbers of rows are rounded up to multiples of this. More: arrays are longer than needed. Fewer:
# tables of other lengths are compiled again.
_ROUND = 16
# The time to an event is Newton's guess times a factor, which is known from the cycle, if the
# factor lies between this and its inverse. Larger: bad guesses set the length of steps. Smaller:
# good guesses are not used.
_WORST_GUESS = 3.0
# An event near a section may happen after it in some experiments. So it also has rows beyond the
# section, if its distance from the section is below this part of the interval. Smaller: more
# experiments leave the table. Larger: more rows that hardly any experiment needs.
_NEAR_SECTION = 0.05


# The place at which a turn begins.
BEGIN = 0


class Rows(NamedTuple):
    """R rows of one period. (A row does not use the columns that belong to rows of another
    kind.)"""

    body: Int[np.ndarray, " R"]
    """Index among the bodies of the program."""
    section: Int[np.ndarray, " R"]
    """The section at which the interval begins."""
    at: Int[np.ndarray, " R"]
    """Number of the place (section and events passed) whose experiments the row moves."""
    then: Int[np.ndarray, " R"]
    """Number of the place of these experiments afterwards."""
    begins: Bool[np.ndarray, " R"]
    """Whether a leg begins with this row; otherwise its step is as long as the last one."""
    corrects: Bool[np.ndarray, " R"]
    """Whether a step is a correction of the time of an event."""
    arrives: Bool[np.ndarray, " R"]
    """Whether the row ends on the next section."""
    target: Int[np.ndarray, " R"]
    """The row of the watched function whose zero is the end of the leg; -1 for a known time."""
    part: Float[np.ndarray, " R"]
    """Length of a step, as a part of the time to the end of the leg. (If the leg ends at a zero,
    this time is Newton's guess.)"""
    fixed: Float[np.ndarray, " R"]
    """Length of a step if Newton's guess is bad; 0 otherwise."""
    place: Int[np.ndarray, " R"]
    """For an event: index of the transition among those of its kind. (Not a place as in `at`.)"""
    may_wait: Bool[np.ndarray, " R"]
    """For an event: whether it may happen beyond the next section instead."""
    signs: Int[np.ndarray, "R G"]
    """Expected signs of the watched functions (guards, and the level of the section) at the
    beginning of a row; 0 if either sign is allowed."""


class Body(NamedTuple):
    """The kind of a row, for which one function is compiled: legs in a chart, or events of a
    kind."""

    chart: int
    kind: Kind = ()


class Form(NamedTuple):
    """The static properties of a table, for which a program is compiled. (Hashable.)"""

    bodies: tuple[Body, ...]
    watched: int
    """Largest number of watched functions of a chart."""


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """Rows of one turn, of which the first `count` are used."""

    form: Form
    rows: Rows
    count: int


class _Event(NamedTuple):
    """An event on the cycle."""

    section: int
    """The section before the event."""
    t: float
    transition: int
    before: Float[np.ndarray, " d"]
    after: Float[np.ndarray, " d"]
    at_section: bool
    """Whether the next section is this event."""


class _Points(NamedTuple):
    """Watched functions at P points of the cycle."""

    newton: Float[np.ndarray, "P G"]
    """Newton's guesses of the times until watched functions are zero."""
    signs: Int[np.ndarray, "P G"]

    def part(self, points: slice) -> "_Points":
        """The functions at some of the points."""
        return _Points(self.newton[points], self.signs[points])


def applies(s: Structure, placed: PlacedSections) -> bool:
    """Test whether experiments can follow a table: with explicit methods, and events at the zeros
    of guards that are always enabled."""
    assert placed.tape is not None
    codes = np.asarray(placed.tape.code)
    is_event = codes >= 0
    if np.asarray(placed.tape.at_once)[is_event].any():
        return False
    charts = set(np.asarray(placed.lanes.chart).tolist())
    for g in np.unique(codes[is_event]).tolist():
        charts.add(s.chart_index(s.transitions[g].target))
    if any(s.method(a).implicit for a in charts):
        return False
    possible = [x for x in s.transitions if s.chart_index(x.source) in charts]
    scheduled = any(isinstance(x.guard, Scheduled) for x in possible)
    return not scheduled and all(x.enabled is None for x in possible)


class Tables(NamedTuple):
    """The tables of experiments around a cycle, of the same length."""

    near: Table
    """For experiments near the cycle."""
    far: Table
    """For experiments that leave the table `near`: with twice as many steps, and with rows for each
    event also in the intervals before and after its own."""


def tables(placed: PlacedSections, plan: Plan) -> Tables | None:
    """The tables of one period, by a step schedule; None if experiments cannot follow a table."""
    placed, plan = to_host((placed, plan))
    if not applies(placed.structure(), placed):
        return None
    near = _Writer(placed, plan, spare=False, density=1).written()
    far = _Writer(placed, plan, spare=True, density=2).written()
    return Tables(_of_length(near, far), _of_length(far, near))


def _of_length(table: Table, other: Table) -> Table:
    """A table, lengthened to the number of rows of another one by repetitions of its last row."""
    more = max(len(other.rows.body) - len(table.rows.body), 0)

    def repeat(x):
        return np.concatenate([x, np.repeat(x[-1:], more, axis=0)])

    return dataclasses.replace(table, rows=Rows(*map(repeat, table.rows)))


class _Writer:
    """Writes the rows of a table one by one."""

    def __init__(self, placed: PlacedSections, plan: Plan, spare: bool, density: int):
        self.placed = placed
        self.plan = plan
        self.spare = spare
        self.density = density
        self.s = placed.structure()
        self.N = placed.n_sections
        self.t = placed.lanes.t
        self.chart = placed.lanes.chart
        self.ends = self.t + placed.duration
        self.events = _events(placed)
        self.levels = placed.bound.levels
        self._watch_points()
        self.width = self.at_sections.signs.shape[1]
        self.rows: list[dict[str, Any]] = []
        self.places: dict[tuple[int, int], int] = {(0, 0): BEGIN}
        self.bodies: list[Body] = []

    def _watch_points(self) -> None:
        """Evaluate the watched functions at sections, and before and after events.

        (All together, so that each guard has one scale: at its own event alone, a guard is a
        rounding error.)
        """
        N = self.N
        events = self.events
        E = len(events)
        on_section = [np.arange(N), self.t, self.chart, self.placed.lanes.q]
        if not events:
            self.at_sections = self._points(*on_section)
            return
        section = [event.section for event in events]
        t = [event.t for event in events]
        chart_before = [self._chart(e) for e in range(E)]
        chart_after = [self._chart(e + 1) for e in range(E)]
        before = np.array([event.before for event in events]).T
        after = np.array([event.after for event in events]).T
        points = self._points(
            np.concatenate([np.arange(N), section, section]),
            np.concatenate([self.t, t, t]),
            np.concatenate([self.chart, chart_before, chart_after]),
            np.concatenate([self.placed.lanes.q, before, after], axis=1),
        )
        self.at_sections = points.part(slice(N))
        self.before = points.part(slice(N, N + E))
        self.after = points.part(slice(N + E, None))

    def written(self) -> Table:
        for k in range(self.N):
            self._interval(k)
        used = len(self.rows)
        self.rows += self.rows[-1:] * (-used % _ROUND)
        columns: dict[str, np.ndarray] = {}
        for name in Rows._fields:
            column = np.array([row[name] for row in self.rows])
            if np.issubdtype(column.dtype, np.integer):
                column = column.astype(np.int32)
            columns[name] = column
        bodies = tuple(sorted(self.bodies))
        place = np.array([bodies.index(body) for body in self.bodies], np.int32)
        rows = Rows(**columns)
        rows = rows._replace(body=place[rows.body])
        return Table(Form(bodies, self.width), rows, used)

    def _interval(self, k: int) -> None:
        """Write the rows from section k to the next."""
        events = self._happening(k)
        passed = self._passed(k)
        for e in events:
            self._to_event(k, e, is_first=e == passed)
        for count in sorted(self._arriving(k)):
            self._to_section(k, count)

    def _happening(self, k: int) -> list[int]:
        """Numbers of the events that may happen after section k, counted from section 0."""
        turn = len(self.events)
        around = range(-turn, 2 * turn) if turn else range(0)
        return [e for e in around if k in self._intervals(e)]

    def _intervals(self, e: int) -> list[int]:
        """Sections after which event e may happen, counted from section 0."""
        turn, number = divmod(e, len(self.events))
        event = self.events[number]
        own = event.section
        within = self.ends[own] - self.t[own]
        late = self.ends[own] - event.t < _NEAR_SECTION * within
        early = event.t - self.t[own] < _NEAR_SECTION * within
        found = [own]
        if (late or self.spare) and not event.at_section:
            found.append(own + 1)
        if early or self.spare:
            found.append(own - 1)
        return [k + turn * self.N for k in found]

    def _passed(self, k: int) -> int:
        """Number of events on the cycle before section k."""
        turn, section = divmod(k, self.N)
        before = sum(event.section < section for event in self.events)
        return before + turn * len(self.events)

    def _arriving(self, k: int) -> set[int]:
        """Numbers of events after which the next section may be reached by a leg."""
        after = self._passed(k + 1)
        counts = {after}
        for e in self._happening(k):
            if k + 1 in self._intervals(e):
                counts |= {e, e + 1}
        if self.events and self._ends_with_event(k):
            counts.discard(after)
        return counts

    def _ends_with_event(self, k: int) -> bool:
        return any(event.at_section and event.section == k for event in self.events)

    def _chart(self, passed: int) -> int:
        """The chart after a number of events."""
        if not self.events:
            return int(self.chart[0])
        event = self.events[(passed - 1) % len(self.events)]
        return self.s.chart_index(self.s.transitions[event.transition].target)

    def _to_event(self, k: int, e: int, is_first: bool) -> None:
        """Write the leg from section k, or from the event before, to event e."""
        event = self.events[e % len(self.events)]
        a, kind, place = self._event_kind(event.transition)
        target = self.s.guards(a).index(event.transition)
        is_own = e // len(self.events) * self.N + event.section == k
        before = e - 1 if e - 1 in self._happening(k) else None
        begin, points, at = self._begin(k, before)
        turn = e // len(self.events) * float(self.placed.cycle.period)
        duration = event.t + turn - begin
        if is_first or (before is not None and is_own):
            newton = points.newton[at, target]
            signs = points.signs[at].copy()
            signs[target] = max(signs[target], 0)
        else:
            newton = None
            duration = 0.0
            signs = np.zeros(self.width, int)
            signs[target] = 1
        arrives = event.at_section and is_own
        self._leg(k, a, duration, newton, passed=e, target=target, signs=signs)
        nothing = np.zeros(self.width, int)
        for _ in range(CORRECTIONS):
            self._add(
                Body(a),
                k,
                passed=e,
                target=target,
                signs=nothing,
                corrects=True,
                part=1.0,
            )
        at_event = self.before.signs[e % len(self.events)].copy()
        at_event[target] = 0
        if kernels.has_level(self.s, a, self.levels):
            at_event[-1] = 0
        waits = len(self._intervals(e)) > 1
        self._add(
            Body(a, kind),
            k,
            passed=e,
            target=target,
            signs=at_event,
            place=place,
            may_wait=waits,
            arrives=arrives,
        )

    def _begin(self, k: int, before: int | None) -> tuple[float, _Points, int]:
        """Time, points and index at which a leg in the interval after section k begins."""
        if before is None:
            return float(self.t[k]), self.at_sections, k
        turn, number = divmod(before, len(self.events))
        period = float(self.placed.cycle.period)
        t = self.events[number].t + turn * period
        return t, self.after, number

    def _to_section(self, k: int, count: int) -> None:
        """Write the leg to the section after k, for experiments that have passed `count` events."""
        a = self._chart(count)
        is_own = count == self._passed(k + 1)
        has_event = count > self._passed(k)
        last = self._passed(k + 1) - 1 if is_own and has_event else None
        begin, points, at = self._begin(k, last)
        duration = self.ends[k] - begin
        by_time = np.isfinite(self.placed.bound.time[(k + 1) % self.N])
        target = -1 if by_time else len(self.s.guards(a))
        signs = np.zeros(self.width, int)
        newton = None
        if is_own:
            signs = points.signs[at]
            newton = None if by_time else points.newton[at, target]
        self._leg(
            k,
            a,
            duration,
            newton,
            passed=count,
            target=target,
            signs=signs,
            arrives=True,
        )

    def _leg(
        self,
        k: int,
        a: int,
        duration: float,
        newton: float | None,
        *,
        passed: int,
        target: int,
        signs: np.ndarray,
        arrives: bool = False,
    ) -> None:
        """Write the steps of a leg of this duration on the cycle.

        `newton`: Newton's guess of the duration on the cycle; None if it is not needed or exact.
        """
        steps = max(1, int(np.ceil(duration / self.plan.h[k] - 1e-6)))
        steps *= self.density
        part = 1 / steps
        fixed = 0.0
        if newton is not None:
            if duration / _WORST_GUESS < newton < duration * _WORST_GUESS:
                part = duration / newton / steps
            else:
                fixed = duration / steps
        inner = np.maximum(signs, 0)
        for j in range(steps):
            self._add(
                Body(a),
                k,
                passed=passed,
                target=target,
                signs=inner if j else signs,
                begins=j == 0,
                part=part,
                fixed=fixed,
                arrives=arrives and j == steps - 1,
            )

    def _add(
        self,
        body: Body,
        section: int,
        *,
        passed: int,
        target: int,
        signs: np.ndarray,
        begins: bool = False,
        corrects: bool = False,
        arrives: bool = False,
        part: float = 0.0,
        fixed: float = 0.0,
        place: int = 0,
        may_wait: bool = False,
    ) -> None:
        if body not in self.bodies:
            self.bodies.append(body)
        number = self.bodies.index(body)
        at = self._place(section, passed)
        is_event = bool(body.kind)
        then = self._place(section + int(arrives), passed + int(is_event))
        row = dict(
            body=number,
            section=section,
            at=at,
            then=then,
            begins=begins,
            corrects=corrects,
            arrives=arrives,
            target=target,
            part=part,
            fixed=fixed,
            place=place,
            may_wait=may_wait,
            signs=signs,
        )
        self.rows.append(row)

    def _place(self, section: int, passed: int) -> int:
        """The number of a place by section and events passed since section 0."""
        if section == self.N:
            section = 0
            passed = passed - len(self.events)
        return self.places.setdefault((section, passed), len(self.places))

    def _event_kind(self, g: int) -> tuple[int, Kind, int]:
        """The chart that a transition leaves, the kind of the transition, and its index within the
        kind."""
        member: Member = self.s.member(g)
        a = self.s.chart_index(self.s.transitions[g].source)
        return a, member.kind, int(member.place[0])

    def _points(self, section, t, chart, q) -> _Points:
        """Watched functions at points after these sections."""
        s = self.s
        charts = range(len(s.dims))
        counts = [kernels.count_watched(s, a, self.levels) for a in charts]
        newton = np.zeros((len(t), max(counts)))
        signs = np.zeros((len(t), max(counts)), int)
        for a in np.unique(chart).tolist():
            count = counts[a]
            if not count:
                continue
            n = s.dims[a]
            here = np.flatnonzero(chart == a)
            index = (section[here] + 1) % self.N
            u = np.zeros((s.nu, 1))
            point = t[here], q[:n, here], u
            columns = kernels.watched(s, a, self.levels, *point, index)
            field = kernels.field(s, a, *point)[:, 0]
            value = columns[:, 0]
            gradient = columns[:, 2 : 2 + n]
            rate = columns[:, 1] + np.sum(gradient * field, axis=1)
            with np.errstate(all="ignore"):
                newton[here, :count] = np.nan_to_num(-value / rate).T
            signs[here, :count] = known_signs(value).T
        return _Points(newton, signs)


def _events(placed: PlacedSections) -> list[_Event]:
    """The events of one turn, in order."""
    tape = placed.tape
    assert tape is not None
    found = []
    for k in range(placed.n_sections):
        rows = np.flatnonzero(tape.code[:, k] >= 0)
        moves = np.flatnonzero(tape.code[:, k] != IDLE)
        for row in rows:
            found.append(
                _Event(
                    section=k,
                    t=float(tape.t[row, k]),
                    transition=int(tape.code[row, k]),
                    before=tape.before[row, :, k],
                    after=tape.after[row, :, k],
                    at_section=bool(row == moves[-1]),
                )
            )
    return found
