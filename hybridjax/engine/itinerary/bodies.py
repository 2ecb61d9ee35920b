r"""What the rows of an itinerary do: steps in charts, jumps at events, arrivals on sections.

Beside the state $q$ run columns $v$, its derivatives in some directions at a fixed time. Between
events they obey $\dot v = f_q v + f_u w$, where w is the constant input of the direction. An event
of the guard h takes place later by $\delta = -(h_q v + h_u w) / \dot h$. At its time the columns
are $v + f^- \delta$; after the reset R, and at a fixed time again, they are
$R_q (v + f^- \delta) + R_t \delta + R_u w - f^+ \delta$: the saltation formula (M. A. Aizerman and
F. R. Gantmacher, Quarterly J. Mechanics and Applied Mathematics 11, 1958). On a section they are
$v + f \delta$ where the section is a level, and v where it is a time.

All rows that do the same share one piece of the program. Only the functions of a system (fields,
guards, resets) are chosen among, by the number of the chart or of the kind of transition.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ...systems.structure import Kind, Member, Structure
from ...systems.transition import SAME_TIME, TOGETHER, Scheduled
from ..arrays import Array
from ..settings import ROUNDING, Settings
from ..target import AbstractLevels
from . import steps
from .motion import Alone, Motion, choose, chosen
from .rows import JUMP, LEVEL, NOTHING, SCHEDULE, STEP, TIME, Body, Form, Rows


# Times of a schedule are equal if they differ by less than this part of its period. Larger: an
# event that is due shortly before another one is left out. Smaller: rounding separates the
# beginning of a leg from the tick with which it begins.
_SAME_TICK = 10 * SAME_TIME


class Course(NamedTuple):
    """A trajectory on its way, with C columns; the state is padded to d numbers."""

    t: Float[Array, ""]
    y: Float[Array, "1+C d"]
    """The state, then its columns."""
    begin: Float[Array, ""]
    """Time at which the present leg began."""
    delay: Float[Array, " C"]
    """Columns of the time of the last event, or of the arrival on a section."""
    ends: Float[Array, " E"]
    """Ends of legs: as guessed, and as found once they are past."""
    rate: Float[Array, " d"]
    """The field where the present row begins."""
    value: Float[Array, ""]
    """The watched function that the row brings to zero there, if it does,"""
    slope: Float[Array, ""]
    """and its rate along the flow."""
    h: Float[Array, ""]
    """The time that the row takes."""


class Flags(NamedTuple):
    """How well a trajectory follows its itinerary. Flags have no derivatives."""

    before: "Watched"
    """Watched functions where the last row began, and since then."""
    entry: "Entry"
    """Guards of the chart that the last jump has entered, in the chart before."""
    error: Float[Array, ""]
    """Largest estimated error of a step so far, relative to what is allowed."""
    last: Float[Array, ""]
    """Largest last correction of the time of an event."""
    left: Bool[Array, ""]
    """Whether the itinerary was left: a watched function has passed zero where it should not."""


class Watched(NamedTuple):
    """The watched functions of a chart, and their rates along the flow, at a time."""

    t: Float[Array, ""]
    value: Float[Array, " G"]
    rate: Float[Array, " G"]
    enabled: Bool[Array, " G"] | bool = True
    """Whether their events are enabled."""

    @classmethod
    def unknown(cls, t: Float[Array, ""], width: int) -> "Watched":
        """Watched functions of which nothing is known."""
        far = jnp.full(width, jnp.inf)
        return cls(t, far, jnp.ones(width), jnp.ones(width, bool))


class Entry(NamedTuple):
    """Guards of a chart that a jump enters, as far as the chart before has them, too."""

    known: Bool[Array, " G"]
    """Whether it has this guard: it is the same chart, or has one of the same value."""
    armed: Bool[Array, " G"]
    """Whether that guard was still to fall."""

    @classmethod
    def departure(cls, width: int) -> "Entry":
        """That of the beginning of a trajectory: no guard is due there."""
        nothing = jnp.zeros(width, bool)
        return cls(known=~nothing, armed=nothing)

    @classmethod
    def unknown(cls, width: int) -> "Entry":
        """That of a chart whose guards the chart before has not."""
        nothing = jnp.zeros(width, bool)
        return cls(known=nothing, armed=nothing)


class EventNotes(NamedTuple):
    """What is noted of an event while it happens."""

    due: Bool[Array, " G"]
    """Guards whose events happen at once where the last jump has led."""
    entry: Entry
    disabled: Bool[Array, ""]
    """Whether the event's predicate does not hold."""


class Row(NamedTuple):
    """One row for the program: its columns (see `Rows`), and numbers by its body."""

    leg: Int[Array, ""]
    target: Int[Array, ""]
    place: Int[Array, ""]
    piece: Int[Array, ""]
    onward: Bool[Array, ""]
    section: Int[Array, ""]
    way: Int[Array, ""]
    """Number among `Form.ways`."""
    chart: Int[Array, ""]
    """Number among `Form.charts`."""
    kind: Int[Array, ""]
    """Number among `Form.kinds`; for a level the one after them."""
    ends_leg: Bool[Array, ""]
    is_jump: Bool[Array, ""]
    at_once: Bool[Array, ""]
    scheduled: Bool[Array, ""]
    """Whether it is a jump at a time of a schedule."""
    fraction: Float[Array, ""]
    signs: Int[Array, " G"]


class Table(NamedTuple):
    """R rows in few arrays: the program reads each at once."""

    numbers: Int[Array, "R K"]
    """The first fields of `Row`, in order, then the signs."""
    fraction: Float[Array, " R"]

    def row(self, k: Int[Array, ""]) -> Row:
        return read(Table(self.numbers[k], self.fraction[k]))


def read(one: Table) -> Row:
    """The row in one line of a table."""
    *fields, _, _ = Row._fields
    values = {x: one.numbers[i] for i, x in enumerate(fields)}
    for name in ("onward", "ends_leg", "is_jump", "at_once", "scheduled"):
        values[name] = values[name] > 0
    return Row(**values, fraction=one.fraction, signs=one.numbers[len(fields) :])


def tabulated(s: Structure, form: Form, rows: Rows) -> Table:
    """The rows of an itinerary for its program."""
    ways, kinds = form.ways, form.kinds
    chart = {a: k for k, a in enumerate(form.charts)}

    def of_body(body: Body) -> tuple[int, ...]:
        is_jump = body.does == JUMP
        scheduled = is_jump and isinstance(
            s.transitions[body.transition].guard, Scheduled
        )
        return (
            ways.index(body.way),
            chart.get(body.chart, 0),
            kinds.index(body.kind) if is_jump else len(kinds),
            body.does != STEP,
            is_jump,
            body.at_once,
            scheduled,
        )

    by_body = jnp.asarray(np.array([of_body(x) for x in form.bodies], np.int32))
    own = rows.leg, rows.target, rows.place, rows.piece, rows.onward, rows.section
    columns = jnp.stack([jnp.asarray(x, jnp.int32) for x in own], axis=1)
    signs = jnp.asarray(rows.signs, jnp.int32)
    numbers = [columns, by_body[jnp.asarray(rows.body)], signs]
    return Table(jnp.concatenate(numbers, axis=1), jnp.asarray(rows.fraction))


class Travelers(NamedTuple):
    """Whose trajectories follow an itinerary: one system, or many in lanes.

    Lanes stand on the first axis of arrays. Only what a row does is vectorized over them: JAX takes
    many times as long to vectorize the loop over the rows.
    """

    of: Callable[[Any], Structure]
    """The structure by its numbers."""
    numbers: Any
    """Of one system, or of all lanes."""
    many: bool
    structure: Structure
    """With any numbers: those that it needs for nothing else."""

    def each(self, function: Callable) -> Callable:
        """A function of the numbers and further arrays of one lane, for all."""
        return jax.vmap(function) if self.many else function


class Constants(NamedTuple):
    """Numbers that all rows use; see `follow`."""

    numbers: Any
    levels: AbstractLevels | None
    settings: Settings
    rows: Table
    count: Int[Array, ""] | None  # type: ignore[assignment]  # (not the method of tuples)
    begin: tuple
    known: Float[Array, " E"] | None


@dataclasses.dataclass(frozen=True)
class Bodies:
    """What rows do, in stages (see `motion.py`) of all lanes.

    **Fields:** `solver`: of each chart; `inputs`: those of each column, None for columns without
    inputs.
    """

    travelers: Travelers
    form: Form
    solver: Callable[[int], steps.Solver]
    inputs: Float[Array, "C nu"] | None = None

    def take(self, motion: Motion, row: Row, course: Any, flags: Flags):
        """The course, which moves, and the flags after a row."""
        ways = self.form.ways
        branches = [ft.partial(self._way, way, motion, row) for way in ways]
        return chosen(row.way, branches, course, flags)

    def _way(self, way: Body, motion: Motion, row: Row, course, flags: Flags):
        if way.does == NOTHING:
            return course, flags
        if way.does == SCHEDULE:
            stage = self._lane(self._schedule, way.transition, row)
            return motion.apply(stage, course, flags)
        if way.does == TIME:
            return motion.apply(self._lane(self._time, row), course, flags)
        return self._act(motion, row, course, flags)

    def _act(self, motion: Motion, row: Row, course, flags: Flags):
        """A row that begins in a chart: a step, or the end of a leg."""
        course, now = self._in_chart(motion, row, self._observe, course)
        noted = self._lane(self._noted, row)
        seen = _still(motion.values(course)), now
        flags, due = Alone(motion.constants).apply(noted, flags, seen)
        does = {body.does for body in self.form.bodies}
        branches = []
        if STEP in does:
            branches.append(ft.partial(self._step, motion, row))
        if does & {JUMP, LEVEL}:
            branches.append(ft.partial(self._end, motion, row))
        return chosen(row.ends_leg.astype(int), branches, course, flags, (now, due))

    # Stages, and numbers of rows.

    def _lane(self, function: Callable, *fixed: Any) -> Callable:
        """The stage of all lanes, for that of one, `function(*fixed, structure, constants, moving,
        notes)`."""

        def stage(constants: Constants, moving, notes):
            def of_lane(numbers, moving, notes):
                s = self.travelers.of(numbers)
                return function(*fixed, s, constants, moving, notes)

            return self.travelers.each(of_lane)(constants.numbers, moving, notes)

        return stage

    def _in_chart(
        self, motion: Motion, row: Row, function: Callable, moving, notes=None
    ):
        """What moves, and the notes, after the stage of the chart in which a row begins."""
        stages = [self._lane(function, a, row) for a in self.form.charts]
        return choose(motion, row.chart, stages, moving, notes)

    # Rows that begin in no chart.

    def _schedule(
        self, g: int, row: Row, s: Structure, _, course: Course, flags: Flags
    ):
        """A leg begins whose end is known: the tick nearest to the guess."""
        guard = s.transitions[g].guard
        assert isinstance(guard, Scheduled)
        tick = guard.nearest(course.ends[row.leg])
        return course._replace(ends=course.ends.at[row.leg].set(tick)), flags

    def _time(self, row: Row, s: Structure, _, course: Course, flags: Flags):
        """The arrival at a time that is known."""
        # (The steps of a leg that lasts no time on the recorded trajectory do not arrive later.)
        misses = course.ends[row.leg] - course.t
        course = course._replace(delay=jnp.zeros_like(course.delay))
        return _arrived(row, course, _leveled(row, flags), misses)

    # What a row sees where it begins.

    def _observe(self, a: int, row: Row, s: Structure, constants, course: Course, _):
        """The field of chart a, and its watched functions."""
        q = _state(s, a, course)
        t, u = course.t, jnp.zeros(s.nu)
        field = steps.field(s, a, t, q)
        course = course._replace(rate=_padded(field, course.rate))
        if not _count_watched(s, a, constants.levels):
            return course, Watched.unknown(_still(t), self.form.watched)

        def values(t, q):
            return _values(s, a, constants.levels, row, t, q, u)

        value, rate = jax.jvp(values, (t, q), (jnp.ones_like(t), field))
        course = course._replace(value=value[row.target], slope=rate[row.target])
        more = self.form.watched - len(value)
        # (Rates of what is not watched are 1: nothing divides by zero.)
        value = jnp.pad(value, (0, more), constant_values=jnp.inf)
        rate = jnp.pad(rate, (0, more), constant_values=1.0)
        enabled = jnp.ones(self.form.watched, bool)
        for place, g in enumerate(s.guards(a)):
            if s.transitions[g].enabled is not None:
                enabled = enabled.at[place].set(s.enabled(g, t, q, u))
        return course, _still(Watched(t, value, rate, enabled))

    def _noted(self, row: Row, s: Structure, _, flags: Flags, seen):
        """The flags at a row, where watched functions have these values, and the guards that are
        due there."""
        course, now = seen
        due = self._due(row, s, course, flags, now)
        fired = self._fired(row, s)
        surprise = due.any() & ~row.at_once
        is_due = due[fired] if due.size else jnp.asarray(True)
        late = row.at_once & ~row.scheduled & ~is_due
        left = flags.left | surprise | late | _has_left(row, flags.before, now)
        return flags._replace(before=now, left=left), due

    def _due(
        self, row: Row, s: Structure, course: Course, flags: Flags, now: Watched
    ) -> Bool[Array, " G"]:
        """The guards whose events happen at once where a jump has led (see `engine.events.rearm`):
        those beyond zero that fall and are new, or were still to fall."""
        guards = jnp.asarray([len(s.guards(a)) for a in self.form.charts])
        is_guard = jnp.arange(self.form.watched) < guards[row.chart]
        entry = flags.entry
        begins = jnp.isinf(flags.before.value)
        falls = now.rate < 0
        late = SAME_TIME * (course.ends[row.leg] - course.begin)
        beyond = now.value < -late * jnp.abs(now.rate)
        crossed = (falls & ~entry.known) | (entry.armed & (falls | beyond))
        return begins & is_guard & (now.value < 0) & crossed & now.enabled

    def _fired(self, row: Row, s: Structure) -> Int[Array, ""]:
        """The place of the guard of a jump among those of its chart."""
        places = []
        for kind in self.form.kinds:
            guards = s.guards(s.chart_index(s.transitions[kind[0]].source))
            places.append([guards.index(g) if g in guards else 0 for g in kind])
        most = max(map(len, places), default=0)
        table = [x + [0] * (most - len(x)) for x in places] + [[0] * most]
        return jnp.asarray(table)[row.kind, row.place] if most else jnp.zeros((), int)

    # Steps.

    def _step(self, motion: Motion, row: Row, course, flags: Flags, _):
        """A part of the leg, or a Newton step on a watched function."""
        course, _ = motion.apply(self._lane(self._departed, row), course, None)
        moving, error = self._advanced(motion, row, course)
        course, _ = motion.apply(_after_step, moving, None)
        flags = flags._replace(error=jnp.maximum(flags.error, error))
        return course, self._without_tick(motion, row, course, flags)

    def _departed(self, row: Row, s: Structure, _, course: Course, notes):
        """The course with the length of the step, and with columns that begin anew, if a piece
        begins. (`follow` keeps those of the piece before.)

        On a section, the first one is that of the time: who begins later is behind by the flow.
        """
        C, d = len(course.y) - 1, course.y.shape[1]
        delay = jnp.zeros(C)
        if self.inputs is None:
            unit = jnp.eye(C, d)
        else:
            unit = jnp.concatenate([-course.rate[None], jnp.eye(C - 1, d)])
            delay = delay.at[0].set(1.0)
        dims = jnp.asarray([s.dims[a] for a in self.form.charts])
        unit = jnp.where(jnp.arange(d) < dims[row.chart], unit, 0.0)
        begins = row.piece < self.form.pieces
        columns = jnp.where(begins, unit, course.y[1:])
        h = row.fraction * (course.ends[row.leg] - course.begin)
        is_correction = row.target >= 0
        # (Corrections converge, so that the rate of their function needs no derivative. Where none
        # is made, the rate may be zero, and NaN would enter reverse mode.)
        slope = jnp.where(is_correction, _still(course.slope), 1.0)
        course = course._replace(
            y=course.y.at[1:].set(columns),
            delay=jnp.where(begins, delay, course.delay),
            h=jnp.where(is_correction, -course.value / slope, h),
        )
        return course, notes

    def _advanced(self, motion: Motion, row: Row, course):
        """The course with the state and its columns after a step, and the error of the state
        relative to what is allowed."""
        charts = self.form.charts
        solvers = list(dict.fromkeys(self.solver(a) for a in charts))
        branches = [ft.partial(self._advanced_by, x, motion, row) for x in solvers]
        number = jnp.asarray([solvers.index(self.solver(a)) for a in charts])
        y, error = chosen(number[row.chart], branches, course)
        settings = motion.constants.settings
        assert settings.scale is not None and settings.rtol is not None
        scale = jnp.asarray(settings.scale)[jnp.asarray(charts)][row.chart]
        begin = motion.values(course).y[..., 0, :]
        end = motion.values(y)[..., 0, :]
        allowed = settings.rtol * jnp.maximum(jnp.abs(begin), jnp.abs(end))
        allowed = allowed + settings.atol * scale
        # (Numbers that a chart does not use have no error.)
        relative = jnp.where(error == 0, 0.0, jnp.abs(error) / allowed)
        error = _still(jnp.max(relative, axis=-1, initial=0.0))
        return motion.join(course, y), error

    def _advanced_by(self, solver: steps.Solver, motion: Motion, row: Row, course):
        """The state and its columns after a step of one of the solvers, and the error."""
        charts = [a for a in self.form.charts if self.solver(a) == solver]
        places = [charts.index(a) if a in charts else 0 for a in self.form.charts]
        place = jnp.asarray(places)[row.chart]
        if steps.is_implicit(solver):
            stages = [self._lane(self._implicit_step, solver, a) for a in charts]
            return choose(motion, place, stages, course)

        # (The time within the step runs from 0 to 1.)
        def rates(part, y):
            stages = [self._lane(self._rates, a, part) for a in charts]
            return choose(motion, place, stages, motion.join(course, y))[0]

        y, error = steps.unit_step(solver, rates, motion.part(course, "y"))
        return y, motion.values(error)[..., 0, :]

    def _rates(self, a: int, part, s: Structure, _, moving, notes):
        """Rates of the state and of its columns within a step of chart a."""
        course, y = moving
        t = course.t + part * course.h
        rates = steps.rates(s, a, t, y[:, : s.dims[a]], self.inputs)
        return _padded(course.h * rates, y), notes

    def _implicit_step(self, method, a: int, s: Structure, _, course: Course, notes):
        """The state and its columns after a step of chart a, and the error."""
        y = course.y[:, : s.dims[a]]
        end, error = steps.implicit_step(
            s, a, method, course.t, y, course.h, self.inputs
        )
        return _padded(end, course.y), _padded(_still(error), course.y[0])

    # Ends of legs.

    def _end(self, motion: Motion, row: Row, course, flags: Flags, seen):
        """The event, or the arrival on a level, with which a leg ends."""
        now, due = seen
        course, _ = self._in_chart(motion, row, self._aimed, course)
        course, _ = motion.apply(self._lane(self._shifted), course, None)
        flags = self._without_tick(motion, row, course, flags)
        kinds = self.form.kinds
        stages = [self._lane(self._reset, kind, row) for kind in kinds]
        if any(body.does == LEVEL for body in self.form.bodies):
            stages.append(lambda _, course, notes: (course, notes))
        disabled = jnp.zeros_like(flags.left)
        event = EventNotes(due, flags.entry, disabled)
        course, (_, event) = choose(motion, row.kind, stages, course, (now, event))
        ended = self._lane(self._ended, row)
        course, (flags, *_) = motion.apply(ended, course, (flags, now, event))
        return course, flags

    def _aimed(self, a: int, row: Row, s: Structure, constants, course: Course, notes):
        """The time to the end of a leg in chart a, with its columns: a watched function is zero
        then, or there is no time left."""
        delay = jnp.where(row.scheduled, 0.0, course.delay)
        course = course._replace(h=jnp.zeros(()), delay=delay)
        if not _count_watched(s, a, constants.levels):
            return course, notes
        q, u = _state(s, a, course), jnp.zeros(s.nu)

        def values(q, u):
            return _values(s, a, constants.levels, row, course.t, q, u)

        def along(v, w=u):
            return jax.jvp(values, (q, u), (v, w))[1][row.target]

        aims = row.target >= 0
        slope = jnp.where(aims, course.slope, 1.0)
        delay = -self._each(along, course.y[1:, : s.dims[a]]) / slope
        course = course._replace(
            h=jnp.where(aims, -course.value / slope, 0.0),
            delay=jnp.where(aims, delay, course.delay),
        )
        return course, notes

    def _shifted(self, s: Structure, _, course: Course, notes):
        """The state when the leg ends, and its columns at that time."""
        moved = jnp.outer(jnp.append(course.h, course.delay), course.rate)
        return course._replace(t=course.t + course.h, y=course.y + moved), notes

    def _reset(
        self, kind: Kind, row: Row, s: Structure, constants, course: Course, notes
    ):
        """The state and its columns after a jump, at a fixed time again."""
        tr = s.transitions[kind[0]]
        a, b = s.chart_index(tr.source), s.chart_index(tr.target)
        member = Member(kind, row.place)
        t, q, u = course.t, _state(s, a, course), jnp.zeros(s.nu)
        now, event = notes
        entry = self._entry(a, b, row, s, constants, *_still((now, event.due, t, q)))
        at_event = _still((t, q))
        disabled = ~s.enabled(member, at_event[0], at_event[1], u)
        notes = now, event._replace(entry=entry, disabled=disabled)

        def reset(t, q, u):
            return s.reset(member, t, q, u)

        after = reset(t, q, u)
        onward = jnp.where(row.onward, steps.field(s, b, t, after), 0.0)

        def column(v, delay, w=u):
            return jax.jvp(reset, (t, q, u), (delay, v, w))[1] - onward * delay

        columns = self._each(column, course.y[1:, : s.dims[a]], course.delay)
        y = jnp.concatenate([after[None], columns])
        return course._replace(y=_padded(y, course.y)), notes

    def _ended(self, row: Row, s: Structure, _, course: Course, notes):
        """The course where a leg has ended, and the next one begins."""
        flags, now, event = notes
        rival = row.is_jump & _has_rival(row, _still(course.begin), now)
        unknown = Watched.unknown(_still(course.t), self.form.watched)
        on_level = _leveled(row, flags).before
        select = ft.partial(jnp.where, row.is_jump)
        before = jax.tree_util.tree_map(select, unknown, on_level)
        left = flags.left | rival | event.disabled
        flags = flags._replace(before=before, entry=event.entry, left=left)
        course, flags = _arrived(row, course, flags, course.h)
        return course, (flags, now, event)

    def _entry(
        self, a: int, b: int, row: Row, s: Structure, constants, now: Watched, due, t, q
    ) -> Entry:
        """The guards of chart b in chart a, from where a jump leads to b: with these values, and
        those that were `due` besides."""
        width = self.form.watched
        armed = (now.value > 0) | due
        armed = armed & (jnp.arange(width) != row.target)
        if a == b:
            return Entry(jnp.ones(width, bool), armed)
        if s.dims[a] != s.dims[b] or not (s.guards(a) and s.guards(b)):
            return Entry.unknown(width)

        def values(chart, q):
            u = jnp.zeros(s.nu)
            watched = _values(s, chart, constants.levels, row, t, q, u)
            return watched[: len(s.guards(chart))]

        own = values(a, q)
        others = values(b, q)
        terms = jnp.abs(jax.jacfwd(values, 1)(b, q)) @ jnp.abs(q)
        noise = ROUNDING * (terms + jnp.abs(others))
        equal = jnp.abs(others[:, None] - own) <= noise[:, None]
        more = (0, width - len(others))
        known = jnp.pad(equal.any(axis=1), more)
        was_armed = (equal & armed[: len(own)]).any(axis=1)
        return Entry(known, jnp.pad(was_armed, more))

    def _each(self, function: Callable, *columns: Array) -> Array:
        """A function of each column, and of its inputs where there are any."""
        inputs = () if self.inputs is None else (self.inputs,)
        return jax.vmap(function)(*columns, *inputs)

    def _without_tick(self, motion: Motion, row: Row, course, flags: Flags) -> Flags:
        """The flags where a scheduled event may have been due since the leg began."""
        if not any(self.travelers.structure.schedules(a) for a in self.form.charts):
            return flags
        now = _still(motion.values(course))
        passed = now.begin, now.t
        alone = Alone(motion.constants)
        left, _ = self._in_chart(alone, row, _has_tick, flags.left, passed)
        return flags._replace(left=left)


# Functions of one lane.


def _state(s: Structure, a: int, course: Course) -> Float[Array, " n"]:
    return course.y[0, : s.dims[a]]


def _padded(
    x: Float[Array, "*C n"], like: Float[Array, "*C d"]
) -> Float[Array, "*C d"]:
    """`x` with zeros for numbers that a chart does not use."""
    more = like.shape[-1] - x.shape[-1]
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, more)]) if more else x


def _count_watched(s: Structure, a: int, levels: AbstractLevels | None) -> int:
    has_level = levels is not None and levels.present(s, a)
    return len(s.guards(a)) + has_level


def _values(s: Structure, a: int, levels, row: Row, t, q, u) -> Float[Array, " g"]:
    """The watched functions of chart a."""
    from ..kernels import watched_at

    return watched_at(a, s.guard_kinds(a), s, levels, t, q, u, row.section)


def _after_step(_, moving, notes):
    """The course after a step, with these states and columns."""
    course, y = moving
    return course._replace(t=course.t + course.h, y=y), notes


def _arrived(row: Row, course: Course, flags: Flags, late):
    """A course where a leg has ended, and the next one begins."""
    t = course.t
    flags = flags._replace(
        last=jnp.maximum(flags.last, jnp.abs(_still(late))),
        left=flags.left | _still(t < course.begin),
    )
    return course._replace(begin=t, ends=course.ends.at[row.leg].set(t)), flags


def _has_left(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether the itinerary is left between the row before and this one.

    - Where a leg begins, functions that were positive must be positive. One that was negative may
      have risen sooner, except at an event at once.
    - Within a leg, none may fall through zero, also if it comes back; one may rise sooner or later
      than recorded. (A fall is no event where its predicate does not hold.)
    - The one at whose zero the leg ends must have been positive, and must fall.
    """
    known = row.signs != 0
    known = known & (jnp.arange(len(row.signs)) != row.target)
    begins = jnp.isinf(before.value)
    # (Comparisons with NaN are false.)
    compared = known & ((row.signs > 0) | row.at_once)
    other = begins & compared & ~(jnp.sign(now.value) * row.signs > 0)
    unknown = known & ~jnp.isfinite(now.value) & ~begins
    returns = known & ~begins & dips(before, now, jnp.sign(now.value))
    positive = (before.value > 0) & ~begins
    falls = known & positive & ~(now.value > 0)
    enabled = falls & (before.enabled | now.enabled)
    left = (other | unknown | returns | enabled).any()
    return left | _misses(row, before, now)


def _misses(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether the function at whose zero a leg ends does not fall to it. (The row of its first
    correction has its sign in the row before.)"""
    if not now.value.size:
        return jnp.asarray(False)
    was_positive = (before.value[row.target] > 0) | (row.signs[row.target] <= 0)
    falls = now.rate[row.target] < 0
    return (row.target >= 0) & ~(was_positive & falls)


def _has_rival(row: Row, begin, now: Watched) -> Bool[Array, ""]:
    """Test whether another function falls to zero where an event happens, so that it may come first
    (see `Tape.rival`)."""
    other = (row.signs > 0) & (jnp.arange(len(row.signs)) != row.target)
    close = TOGETHER * (now.t - begin) * jnp.abs(now.rate)
    falls = (now.rate < 0) & (now.value <= close)
    return (other & falls & now.enabled).any()


def _has_tick(a: int, row: Row, s: Structure, _, left, passed):
    """Test whether the itinerary was left, or a scheduled event of chart a was due between two
    times."""
    begin, t = passed
    for g in s.schedules(a):
        guard = s.transitions[g].guard
        assert isinstance(guard, Scheduled)
        offset, period = guard.numbers(t)
        before = jnp.floor((begin - offset) / period + _SAME_TICK)
        last = jnp.ceil((t - offset) / period - _SAME_TICK) - 1
        left = left | _still(last > before)
    return left, passed


def _still(tree: Any) -> Any:
    return jax.lax.stop_gradient(tree)


def _leveled(row: Row, flags: Flags) -> Flags:
    """Flags on a section: of the level of the next one nothing is known. (Charts without a level
    have no such row: nothing is set.)"""
    value = flags.before.value
    if value.size:
        value = value.at[row.target].set(jnp.inf, mode="drop")
    return flags._replace(before=flags.before._replace(value=value))


def dips(before: Watched, now: Watched, signs) -> Bool[Array, " G"]:
    """Test whether functions with these signs at two times have had the other one in between:
    whether the cubic polynomials with their values and rates have."""
    h = now.t - before.t
    first, last = signs * before.value, signs * now.value
    rise = last - first
    slope0, slope1 = h * signs * before.rate, h * signs * now.rate
    third = slope0 + slope1 - 2 * rise
    second = 3 * rise - 2 * slope0 - slope1
    # The minimum is at the larger root of the derivative if the polynomial is of order 3.
    root = jnp.sqrt(jnp.maximum(second**2 - 3 * third * slope0, 0.0))
    place = -slope0 / (second + root)
    lowest = first + place * (slope0 + place * (second + place * third))
    within = (place > 0) & (place < 1)
    return jax.lax.stop_gradient((first > 0) & (last > 0) & within & (lowest < 0))
