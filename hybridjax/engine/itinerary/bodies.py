r"""What the rows of an itinerary do: steps in charts, jumps at events, arrivals on sections.

Beside the state $q$ run columns $v$, its derivatives in some directions at a fixed time. Between
events they obey $\dot v = f_q v + f_u w$, where w is the constant input of the direction. An event
of the guard h takes place later by $\delta = -(h_q v + h_u w) / \dot h$. At its time the columns
are $v + f^- \delta$; after the reset R, and at a fixed time again, they are
$R_q (v + f^- \delta) + R_t \delta + R_u w - f^+ \delta$: the saltation formula (M. A. Aizerman and
F. R. Gantmacher, Quarterly J. Mechanics and Applied Mathematics 11, 1958). On a section they are
$v + f \delta$ where the section is a level, and v where it is a time.

| row | functions, in order |
|---|---|
| all that begin in a chart | `_observe` (field, watched functions), `_compare` (flags) |
| STEP | `_departed` (length of the step, new columns), `_advanced` (the step), `_after_step` |
| JUMP | `_aimed` (δ), `_shifted` (to the time of the event), `_reset` (saltation), `_ended` |
| LEVEL | the same without `_reset` |
| SCHEDULE, TIME | `_schedule`, `_time`: no field is needed |

All rows that do the same share one piece of the program. Only the functions of a system (fields,
guards, resets) are chosen among, by the number of the chart or of the kind of transition.
Functions of one lane end with the arguments of a stage (`motion.py`): the structure, constants,
what moves, and notes.

The order in the table must stay: each function reads what the one before has put into the course.
If the time of an event is wrong, look at `_aimed`; if the state after it is, at `_shifted` and
`_reset`; if states are right and derivatives are not, compare the columns in these three with the
formula. A trajectory that leaves its itinerary without need has its cause in `flags.py`.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ...systems.structure import Kind, Member, Structure
from ...systems.transition import SAME_TIME, Scheduled
from ..arrays import Array
from ..kernels import count_watched
from . import steps
from .course import Constants, Course, Travelers, padded_like
from .flags import (
    Flags,
    Jumping,
    entry_of_jump,
    flags_at_row,
    has_rival,
    without_level,
)
from .motion import Alone, Motion, choose, chosen, still
from .rows import JUMP, LEVEL, NOTHING, SCHEDULE, STEP, TIME, Body, Form
from .table import Row
from .watched import (
    Watched,
    watched_values,
    with_predicates,
)


# Times of a schedule are equal if they differ by less than this part of its period. Larger: an
# event that is due shortly before another one is left out. Smaller: rounding separates the
# beginning of a leg from the tick with which it begins.
_SAME_TICK = 10 * SAME_TIME


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
        course, now = self._in_chart(motion, row, self._observe, course, flags.before)
        seen = still(motion.values(course)), now
        alone = Alone(motion.constants)
        flags, due = alone.apply(self._lane(self._compare, row), flags, seen)
        does = {body.does for body in self.form.bodies}
        branches = []
        if STEP in does:
            branches.append(ft.partial(self._step, motion, row))
        if does & {JUMP, LEVEL}:
            branches.append(ft.partial(self._end, motion, row))
        which = row.ends_leg.astype(int)
        return chosen(which, branches, course, flags, (now, due))

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
        ends = course.ends.at[row.leg].set(tick)
        return course._replace(ends=ends), flags

    def _time(self, row: Row, s: Structure, _, course: Course, flags: Flags):
        """The arrival at a time that is known."""
        # (The steps of a leg that lasts no time on the recorded trajectory do not arrive later.)
        misses = course.ends[row.leg] - course.t
        course = course._replace(delay=jnp.zeros_like(course.delay))
        flags = flags._replace(before=without_level(row, flags.before))
        return _arrived(row, course, flags, misses)

    # What a row sees where it begins.

    def _observe(
        self, a: int, row: Row, s: Structure, constants, course: Course, before: Watched
    ):
        """The field of chart a, and its watched functions, which had values `before`."""
        q = course.state(s, a)
        t = course.t
        u = jnp.zeros(s.nu)
        field = steps.field(s, a, t, q)
        field_before = course.rate
        course = course._replace(rate=padded_like(field, course.rate))
        padded = still(course.y[0])
        if not count_watched(s, a, constants.levels):
            return course, Watched.unknown(still(t), self.form.watched, padded)

        def values(t, q):
            return watched_values(s, a, constants.levels, row, t, q, u)

        along = (jnp.ones_like(t), field)
        value, rate = jax.jvp(values, (t, q), along)
        course = course._replace(value=value[row.target], slope=rate[row.target])
        more = self.form.watched - len(value)
        # (Rates of what is not watched are 1: nothing divides by zero.)
        value = jnp.pad(value, (0, more), constant_values=jnp.inf)
        rate = jnp.pad(rate, (0, more), constant_values=1.0)
        enabled = jnp.ones(self.form.watched, bool)
        now = still(Watched(t, value, rate, enabled, ~enabled, padded))
        fields = still((field_before, course.rate))
        now = with_predicates(a, s, before, now, fields)
        return course, now

    def _compare(self, row: Row, s: Structure, _, flags: Flags, seen):
        """The flags, and the guards that are due at once."""
        course, now = seen
        duration = course.ends[row.leg] - course.begin
        return flags_at_row(self.form, s, row, flags, now, duration)

    # Steps.

    def _step(self, motion: Motion, row: Row, course, flags: Flags, _):
        """A part of the leg, or a Newton step on a watched function."""
        departed = self._lane(self._departed, row)
        course, _ = motion.apply(departed, course, None)
        moving, error = self._advanced(motion, row, course)
        course, _ = motion.apply(_after_step, moving, None)
        flags = flags._replace(error=jnp.maximum(flags.error, error))
        return course, self._without_tick(motion, row, course, flags)

    def _departed(self, row: Row, s: Structure, _, course: Course, notes):
        """The course with the length of the step, and with columns that begin anew, if a piece
        begins. (`follow` keeps those of the piece before.)

        On a section, the first one is that of the time: who begins later is behind by the flow.
        """
        C = len(course.y) - 1
        d = course.y.shape[1]
        delay = jnp.zeros(C)
        if self.inputs is None:
            unit = jnp.eye(C, d)
        else:
            by_time = -course.rate[None]
            by_state = jnp.eye(C - 1, d)
            unit = jnp.concatenate([by_time, by_state])
            delay = delay.at[0].set(1.0)
        counts = [s.dims[a] for a in self.form.charts]
        dims = jnp.asarray(counts)
        is_used = jnp.arange(d) < dims[row.chart]
        unit = jnp.where(is_used, unit, 0.0)
        begins = row.piece < self.form.pieces
        columns = jnp.where(begins, unit, course.y[1:])
        h = row.fraction * (course.ends[row.leg] - course.begin)
        is_correction = row.target >= 0
        # (Corrections converge, so that the rate of their function needs no derivative. Where none
        # is made, the rate may be zero, and NaN would enter reverse mode.)
        slope = jnp.where(is_correction, still(course.slope), 1.0)
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
        solver_of = [self.solver(a) for a in charts]
        solvers = list(dict.fromkeys(solver_of))
        branches = [ft.partial(self._advanced_by, x, motion, row) for x in solvers]
        number = jnp.asarray([solvers.index(x) for x in solver_of])
        y, error = chosen(number[row.chart], branches, course)
        settings = motion.constants.settings
        assert settings.scale is not None
        assert settings.rtol is not None
        scales = jnp.asarray(settings.scale)[jnp.asarray(charts)]
        scale = scales[row.chart]
        begin = motion.values(course).y[..., 0, :]
        end = motion.values(y)[..., 0, :]
        larger = jnp.maximum(jnp.abs(begin), jnp.abs(end))
        allowed = settings.rtol * larger
        allowed = allowed + settings.atol * scale
        # (Numbers that a chart does not use have no error.)
        relative = jnp.where(error == 0, 0.0, jnp.abs(error) / allowed)
        error = still(jnp.max(relative, axis=-1, initial=0.0))
        return motion.join(course, y), error

    def _advanced_by(self, solver: steps.Solver, motion: Motion, row: Row, course):
        """The state and its columns after a step of one of the solvers, and the error."""
        charts = [a for a in self.form.charts if self.solver(a) == solver]
        all_charts = self.form.charts
        places = [charts.index(a) if a in charts else 0 for a in all_charts]
        place = jnp.asarray(places)[row.chart]
        if steps.is_implicit(solver):
            stages = [self._lane(self._implicit_step, solver, a) for a in charts]
            return choose(motion, place, stages, course)

        # (The time within the step runs from 0 to 1.)
        def rates(part, y):
            stages = [self._lane(self._rates, a, part) for a in charts]
            return choose(motion, place, stages, motion.join(course, y))[0]

        def packed_rates(part, y):
            return motion.pack(rates(part, motion.unpack(y)))

        begin = motion.pack(motion.part(course, "y"))
        y, error = steps.unit_step(solver, packed_rates, begin)
        end = motion.unpack(y)
        of_state = motion.values(motion.unpack(error))[..., 0, :]
        return end, of_state

    def _rates(self, a: int, part, s: Structure, _, moving, notes):
        """Rates of the state and of its columns within a step of chart a."""
        course, y = moving
        t = course.t + part * course.h
        used = y[:, : s.dims[a]]
        rates = steps.rates(s, a, t, used, self.inputs)
        return padded_like(course.h * rates, y), notes

    def _implicit_step(self, method, a: int, s: Structure, _, course: Course, notes):
        """The state and its columns after a step of chart a, and the error."""
        y = course.y[:, : s.dims[a]]
        end, error = steps.implicit_step(
            s, a, method, course.t, y, course.h, self.inputs
        )
        state = course.y[0]
        return padded_like(end, course.y), padded_like(still(error), state)

    # Ends of legs.

    def _end(self, motion: Motion, row: Row, course, flags: Flags, seen):
        """The event, or the arrival on a level, with which a leg ends."""
        now, due = seen
        course, _ = self._in_chart(motion, row, self._aimed, course)
        shifted = self._lane(self._shifted)
        course, _ = motion.apply(shifted, course, None)
        flags = self._without_tick(motion, row, course, flags)
        kinds = self.form.kinds
        stages = [self._lane(self._reset, kind, row) for kind in kinds]
        if any(body.does == LEVEL for body in self.form.bodies):
            stages.append(lambda _, course, notes: (course, notes))
        jumping = Jumping(due, flags.entry, disabled=jnp.zeros_like(flags.left))
        notes = (now, jumping)
        course, (_, jumping) = choose(motion, row.kind, stages, course, notes)
        ended = self._lane(self._ended, row)
        notes = (flags, now, jumping)
        course, (flags, *_) = motion.apply(ended, course, notes)
        return course, flags

    def _aimed(self, a: int, row: Row, s: Structure, constants, course: Course, notes):
        """The time to the end of a leg in chart a, with its columns: a watched function is zero
        then, or there is no time left."""
        delay = jnp.where(row.scheduled, 0.0, course.delay)
        course = course._replace(h=jnp.zeros(()), delay=delay)
        if not count_watched(s, a, constants.levels):
            return course, notes
        q = course.state(s, a)
        u = jnp.zeros(s.nu)

        def values(q, u):
            return watched_values(s, a, constants.levels, row, course.t, q, u)

        def along(v, w=u):
            _, changes = jax.jvp(values, (q, u), (v, w))
            return changes[row.target]

        aims = row.target >= 0
        slope = jnp.where(aims, course.slope, 1.0)
        columns = course.y[1:, : s.dims[a]]
        delay = -self._each(along, columns) / slope
        course = course._replace(
            h=jnp.where(aims, -course.value / slope, 0.0),
            delay=jnp.where(aims, delay, course.delay),
        )
        return course, notes

    def _shifted(self, s: Structure, _, course: Course, notes):
        """The state when the leg ends, and its columns at that time."""
        later = jnp.append(course.h, course.delay)
        moved = jnp.outer(later, course.rate)
        course = course._replace(t=course.t + course.h, y=course.y + moved)
        return course, notes

    def _reset(
        self, kind: Kind, row: Row, s: Structure, constants, course: Course, notes
    ):
        """The state and its columns after a jump, at a fixed time again."""
        tr = s.transitions[kind[0]]
        a = s.chart_index(tr.source)
        b = s.chart_index(tr.target)
        member = Member(kind, row.place)
        t = course.t
        q = course.state(s, a)
        u = jnp.zeros(s.nu)
        at = still((t, q))
        notes = self._jumping(a, b, member, row, s, constants, at, notes)

        def reset(t, q, u):
            return s.reset(member, t, q, u)

        after = reset(t, q, u)
        rate_after = steps.field(s, b, t, after)
        onward = jnp.where(row.onward, rate_after, 0.0)

        def column(v, delay, w=u):
            _, change = jax.jvp(reset, (t, q, u), (delay, v, w))
            return change - onward * delay

        before = course.y[1:, : s.dims[a]]
        columns = self._each(column, before, course.delay)
        y = jnp.concatenate([after[None], columns])
        return course._replace(y=padded_like(y, course.y)), notes

    def _jumping(
        self, a: int, b: int, member: Member, row: Row, s, constants, at, notes
    ):
        """The notes of a jump from chart a to chart b, at this time and state."""
        now, jumping = notes
        t, q = at
        pending = (now.value > 0) | jumping.due
        pending = pending & (jnp.arange(self.form.watched) != row.target)
        entry = entry_of_jump(s, a, b, constants.levels, row, t, q, pending)
        no_input = jnp.zeros(s.nu)
        disabled = ~s.enabled(member, t, q, no_input)
        return now, jumping._replace(entry=entry, disabled=disabled)

    def _ended(self, row: Row, s: Structure, _, course: Course, notes):
        """The course where a leg has ended, and the next one begins."""
        flags, now, jumping = notes
        rival = row.is_jump & has_rival(row, still(course.begin), now)
        at = still((course.t, course.y[0]))
        unknown = Watched.unknown(at[0], self.form.watched, at[1])
        on_level = without_level(row, flags.before)
        select = ft.partial(jnp.where, row.is_jump)
        before = jax.tree_util.tree_map(select, unknown, on_level)
        left = flags.left | rival | jumping.disabled
        flags = flags._replace(before=before, entry=jumping.entry, left=left)
        course, flags = _arrived(row, course, flags, course.h)
        return course, (flags, now, jumping)

    def _each(self, function: Callable, *columns: Array) -> Array:
        """A function of each column, and of its inputs where there are any."""
        inputs = () if self.inputs is None else (self.inputs,)
        return jax.vmap(function)(*columns, *inputs)

    def _without_tick(self, motion: Motion, row: Row, course, flags: Flags) -> Flags:
        """The flags where a scheduled event may have been due since the leg began."""
        if not any(self.travelers.structure.schedules(a) for a in self.form.charts):
            return flags
        now = still(motion.values(course))
        passed = now.begin, now.t
        alone = Alone(motion.constants)
        left, _ = self._in_chart(alone, row, _has_tick, flags.left, passed)
        return flags._replace(left=left)


# Functions of one lane.


def _after_step(_, moving, notes):
    """The course after a step, with these states and columns."""
    course, y = moving
    return course._replace(t=course.t + course.h, y=y), notes


def _arrived(row: Row, course: Course, flags: Flags, late):
    """A course where a leg has ended, and the next one begins."""
    t = course.t
    flags = flags._replace(
        last=jnp.maximum(flags.last, jnp.abs(still(late))),
        left=flags.left | still(t < course.begin),
    )
    ends = course.ends.at[row.leg].set(t)
    return course._replace(begin=t, ends=ends), flags


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
        left = left | still(last > before)
    return left, passed
