r"""What the rows of an itinerary do: steps in charts, jumps at events, arrivals on sections.

Beside the state $q$ run columns $v$, its derivatives in some directions at a fixed time. Between
events they obey $\dot v = f_q v + f_u w$, where w is the constant input of the direction. An event
of the guard h takes place later by $\delta = -(h_q v + h_u w) / \dot h$, and leaves
$v^+ = R_q (v + f^- \delta) + R_t \delta + R_u w - f^+ \delta$ with the reset R: the saltation
formula (M. A. Aizerman and F. R. Gantmacher, Quarterly J. Mechanics and Applied Mathematics 11,
1958). On a section the state has moved by $v + f \delta$ where the section is a level, and by v
where it is a time.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from ...systems.structure import Member, Structure
from ...systems.transition import SAME_TIME, TOGETHER, Scheduled
from ..arrays import Array
from ..settings import ROUNDING, Settings
from ..target import AbstractLevels
from . import steps
from .rows import JUMP, LEVEL, NOTHING, SCHEDULE, STEP, TIME, Body, Rows


# Times of a schedule are equal if they differ by less than this part of its period. Larger: an
# event that is due shortly before another one is left out. Smaller: rounding separates the
# beginning of a leg from the tick with which it begins.
_SAME_TICK = 10 * SAME_TIME


class Course(NamedTuple):
    """A trajectory on its way, with C columns; the state is padded to d numbers."""

    t: Float[Array, ""]
    y: Float[Array, "1+C d"]
    """The state, then its columns."""
    rate: Float[Array, " d"]
    """The field where the last step began."""
    begin: Float[Array, ""]
    """Time at which the present leg began."""
    delay: Float[Array, " C"]
    """Columns of the time of the last event, or of the arrival on a section."""
    ends: Float[Array, " E"]
    """Ends of legs: as guessed, and as found once they are past."""


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


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Functions of a row and a course for every kind of row.

    **Fields:** `levels`: of the sections, if there are any; `width`: largest number of watched
    functions of a chart; `pieces`: their number; `pairs`: a solver for each chart; `inputs`: those
    of each column, None for columns without inputs.
    """

    s: Structure
    levels: AbstractLevels | None
    settings: Settings
    width: int
    pieces: int
    pairs: Callable[[int], steps.Solver]
    inputs: Float[Array, "C nu"] | None = None

    def of(self, body: Body) -> Callable[[Rows, Course, Flags], tuple[Course, Flags]]:
        """The function of rows with this body."""
        work: Any = {
            NOTHING: lambda body, row, course, flags: (course, flags),
            SCHEDULE: self._schedule,
            STEP: self._step,
            JUMP: self._jump,
            LEVEL: self._level,
            TIME: self._time,
        }[body.does]
        return lambda row, course, flags: work(body, row, course, flags)

    def _schedule(self, body: Body, row: Rows, course: Course, flags: Flags):
        """A leg begins whose end is known: the tick nearest to the guess."""
        guard = self.s.transitions[body.transition].guard
        assert isinstance(guard, Scheduled)
        tick = guard.nearest(course.ends[row.leg])
        return course._replace(ends=course.ends.at[row.leg].set(tick)), flags

    def _step(self, body: Body, row: Rows, course: Course, flags: Flags):
        """A part of the leg, or a Newton step on a watched function."""
        a = body.chart
        q = self._state(a, course)
        field = self._field(a, course.t, q)
        # (Corrections converge, so that the rate of their function needs no derivative.)
        now = self._watched(a, row, *_still((course.t, q, field)))
        flags = self._noted(a, row, course, flags, now)
        course = self._begun(a, row, course, field)
        h = row.fraction * (course.ends[row.leg] - course.begin)
        if self._functions(a):
            is_correction = row.target >= 0
            value = self._values(a, row, course.t, q, self._no_input)[row.target]
            # (Where none is made, the rate may be zero, and NaN would enter reverse mode.)
            rate = jnp.where(is_correction, now.rate[row.target], 1.0)
            h = jnp.where(is_correction, -value / rate, h)
        y, error = self._advanced(a, course, h)
        course = course._replace(t=course.t + h, y=y)
        flags = flags._replace(
            error=jnp.maximum(flags.error, error),
            left=flags.left | self._has_tick(a, course),
        )
        return course, flags

    def _begun(self, a: int, row: Rows, course: Course, field) -> Course:
        """The course with columns that begin anew, if a piece begins. (`follow` keeps those of the
        piece before.)

        On a section, the first one is that of the time: who begins later is behind by the flow.
        """
        n, d, C = self.s.dims[a], course.y.shape[1], course.y.shape[0] - 1
        rate = jnp.pad(field, (0, d - n))
        delay = jnp.zeros(C)
        if self.inputs is None:
            unit = jnp.eye(C, d)
        else:
            unit = jnp.concatenate([-rate[None], jnp.eye(C - 1, d)])
            delay = delay.at[0].set(1.0)
        unit = jnp.where(jnp.arange(d) < n, unit, 0.0)
        begins = row.piece < self.pieces
        columns = jnp.where(begins, unit, course.y[1:])
        return course._replace(
            y=course.y.at[1:].set(columns),
            rate=rate,
            delay=jnp.where(begins, delay, course.delay),
        )

    def _jump(self, body: Body, row: Rows, course: Course, flags: Flags):
        """An event, and the reset."""
        s, a, member = self.s, body.chart, Member(body.kind, row.place)
        b = s.chart_index(s.transitions[body.kind[0]].target)
        q, u = self._state(a, course), self._no_input
        field = self._field(a, course.t, q)
        now = self._watched(a, row, course.t, q, field)
        due = self._due(a, row, *_still((course, flags, now)))
        flags = self._noted(a, row, course, flags, _still(now), same=body.at_once)
        if body.at_once and not _is_scheduled(s, body.kind[0]):
            flags = flags._replace(left=flags.left | ~due[self._fired(body, row)])
        delay, late = course.delay, jnp.zeros(())
        if _is_scheduled(s, body.kind[0]):
            delay = jnp.zeros_like(delay)
        elif not body.at_once:
            late = _newton(now, row.target)
            delay = self._delay(a, row, course, q, now)
        has_rival = self._has_rival(row, *_still((course.begin, now)))
        t, q = course.t + late, q + field * late
        is_disabled = ~s.enabled(member, *_still((t, q)), u)
        entry = self._entry(a, b, row, *_still((now, due, t, q)))
        after = s.reset(member, t, q, u)
        onward = jnp.where(row.onward, self._field(b, t, after), 0.0)

        def reset(t, q, u):
            return s.reset(member, t, q, u)

        def column(v, delay, w=u):
            along = delay, v + field * delay, w
            return jax.jvp(reset, (t, q, u), along)[1] - onward * delay

        columns = self._each(column, course.y[1:, : s.dims[a]], delay)
        moved = jnp.concatenate([after[None], columns])
        y = jnp.zeros_like(course.y).at[:, : s.dims[b]].set(moved)
        moved = course._replace(t=t, y=y)
        unknown = Watched.unknown(_still(t), self.width)
        left = flags.left | has_rival | is_disabled | self._has_tick(a, moved)
        flags = flags._replace(before=unknown, entry=entry, left=left)
        return self._arrived(row, moved, flags, late, delay)

    def _fired(self, body: Body, row: Rows):
        """The place of the guard of a jump among those of its chart."""
        guards = self.s.guards(body.chart)
        return jnp.array([guards.index(g) for g in body.kind])[row.place]

    def _entry(
        self, a: int, b: int, row: Rows, now: Watched, due, t, q: Float[Array, " n"]
    ) -> Entry:
        """The guards of chart b in chart a, from where a jump leads to b: with these values, and
        those that were `due` besides."""
        s = self.s
        armed = (now.value > 0) | due
        armed = armed & (jnp.arange(self.width) != row.target)
        if a == b:
            return Entry(jnp.ones(self.width, bool), armed)
        none = Entry(jnp.zeros(self.width, bool), jnp.zeros(self.width, bool))
        if s.dims[a] != s.dims[b] or not (s.guards(a) and s.guards(b)):
            return none

        def values(chart, q):
            guards = self._values(chart, row, t, q, self._no_input)
            return guards[: len(s.guards(chart))]

        own = values(a, q)
        others = values(b, q)
        terms = jnp.abs(jax.jacfwd(values, 1)(b, q)) @ jnp.abs(q)
        noise = ROUNDING * (terms + jnp.abs(others))
        equal = jnp.abs(others[:, None] - own) <= noise[:, None]
        more = (0, self.width - len(others))
        known = jnp.pad(equal.any(axis=1), more)
        was_armed = (equal & armed[: len(own)]).any(axis=1)
        return Entry(known, jnp.pad(was_armed, more))

    def _level(self, body: Body, row: Rows, course: Course, flags: Flags):
        """The arrival on a level."""
        a = body.chart
        n, q = self.s.dims[a], self._state(a, course)
        field = self._field(a, course.t, q)
        now = self._watched(a, row, course.t, q, field)
        flags = self._noted(a, row, course, flags, _still(now))
        late = _newton(now, row.target)
        delay = self._delay(a, row, course, q, now)
        arrived = jnp.outer(jnp.append(late, delay), field)
        y = course.y.at[:, :n].add(arrived)
        course = course._replace(t=course.t + late, y=y)
        left = flags.left | self._has_tick(a, course)
        flags = _leveled(flags._replace(left=left), row)
        return self._arrived(row, course, flags, late, delay)

    def _time(self, body: Body, row: Rows, course: Course, flags: Flags):
        """The arrival at a time that is known."""
        # (The steps of a leg that lasts no time on the recorded trajectory do not arrive later.)
        misses = course.ends[row.leg] - course.t
        delay = jnp.zeros_like(course.delay)
        return self._arrived(row, course, _leveled(flags, row), misses, delay)

    def _arrived(self, row: Rows, course: Course, flags: Flags, late, delay):
        """A course where a leg has ended, and the next one begins."""
        t, late = course.t, _still(late)
        flags = flags._replace(
            last=jnp.maximum(flags.last, jnp.abs(late)),
            left=flags.left | _still(t < course.begin),
        )
        ends = course.ends.at[row.leg].set(t)
        return course._replace(begin=t, delay=delay, ends=ends), flags

    # Functions of a chart.

    @property
    def _no_input(self) -> Float[Array, " nu"]:
        return jnp.zeros(self.s.nu)

    def _state(self, a: int, course: Course) -> Float[Array, " n"]:
        return course.y[0, : self.s.dims[a]]

    def _field(self, a: int, t, q) -> Float[Array, " n"]:
        return steps.field(self.s, a, t, q)

    def _advanced(self, a: int, course: Course, h):
        """The state and its columns after a step, and the error relative to what is allowed."""
        n = self.s.dims[a]
        solver, y = self.pairs(a), course.y[:, :n]
        y, error = steps.step(self.s, a, solver, course.t, y, h, self.inputs)
        settings = self.settings
        assert settings.scale is not None and settings.rtol is not None
        scale = settings.scale[a, :n]
        allowed = settings.rtol * jnp.maximum(jnp.abs(course.y[0, :n]), jnp.abs(y[0]))
        allowed = allowed + settings.atol * scale
        error = jax.lax.stop_gradient(jnp.max(jnp.abs(error) / allowed, initial=0.0))
        return course.y.at[:, :n].set(y), error

    def _has_level(self, a: int) -> bool:
        return self.levels is not None and self.levels.present(self.s, a)

    def _functions(self, a: int) -> int:
        """Number of watched functions."""
        return len(self.s.guards(a)) + self._has_level(a)

    def _values(self, a: int, row: Rows, t, q, u) -> Float[Array, " g"]:
        """The watched functions."""
        from ..kernels import watched_at

        kinds = self.s.guard_kinds(a)
        return watched_at(a, kinds, self.s, self.levels, t, q, u, row.section)

    def _watched(self, a: int, row: Rows, t, q, field) -> Watched:
        if not self._functions(a):
            return Watched.unknown(t, self.width)

        def values(t, q):
            return self._values(a, row, t, q, self._no_input)

        value, rate = jax.jvp(values, (t, q), (jnp.ones_like(t), field))
        more = self.width - len(value)
        # (Rates of what is not watched are 1: nothing divides by zero.)
        value = jnp.pad(value, (0, more), constant_values=jnp.inf)
        rate = jnp.pad(rate, (0, more), constant_values=1.0)
        enabled = jnp.ones(self.width, bool)
        for place, g in enumerate(self.s.guards(a)):
            if self.s.transitions[g].enabled is not None:
                holds = self.s.enabled(g, t, q, self._no_input)
                enabled = enabled.at[place].set(holds)
        return Watched(t, value, rate, enabled)

    def _delay(self, a: int, row: Rows, course: Course, q, now: Watched):
        """Columns of the time at which a watched function is zero."""
        u = self._no_input

        def values(q, u):
            return self._values(a, row, course.t, q, u)

        def along(v, w=u):
            return jax.jvp(values, (q, u), (v, w))[1][row.target]

        columns = course.y[1:, : self.s.dims[a]]
        return -self._each(along, columns) / now.rate[row.target]

    def _each(self, function: Callable, *columns: Array) -> Array:
        """A function of each column, and of its inputs where there are any."""
        inputs = () if self.inputs is None else (self.inputs,)
        return jax.vmap(function)(*columns, *inputs)

    def _noted(
        self,
        a: int,
        row: Rows,
        course: Course,
        flags: Flags,
        now: Watched,
        same: bool = False,
    ) -> Flags:
        """The flags at a row, where watched functions have these values; `same`: they must have the
        signs of the recorded trajectory."""
        if not self._functions(a):
            return flags._replace(before=now)
        left = flags.left | self._has_left(row, flags.before, now, same)
        if not same:
            due = self._due(a, row, *_still((course, flags, now)))
            left = left | due.any()
        return flags._replace(before=now, left=left)

    def _due(
        self, a: int, row: Rows, course: Course, flags: Flags, now: Watched
    ) -> Bool[Array, " G"]:
        """The guards of chart a whose events happen at once where a jump has led there (see
        `engine.events.rearm`): those beyond zero that fall and are new, or were still to fall."""
        entry = flags.entry
        begins = jnp.isinf(flags.before.value)
        is_guard = jnp.arange(self.width) < len(self.s.guards(a))
        falls = now.rate < 0
        late = SAME_TIME * (course.ends[row.leg] - course.begin)
        beyond = now.value < -late * jnp.abs(now.rate)
        crossed = (falls & ~entry.known) | (entry.armed & (falls | beyond))
        return begins & is_guard & (now.value < 0) & crossed & now.enabled

    def _has_left(
        self, row: Rows, before: Watched, now: Watched, same: bool
    ) -> Bool[Array, ""]:
        """Test whether the itinerary is left between the row before and this one.

        - Where a leg begins, functions that were positive must be positive. One that was negative
          may have risen sooner, unless signs must be the `same`: at an event at once.
        - Within a leg, none may fall through zero, also if it comes back; one may rise sooner or
          later than recorded. (A fall is no event where its predicate does not hold.)
        - The one at whose zero the leg ends must have been positive, and must fall.
        """
        known = row.signs != 0
        known = known & (jnp.arange(self.width) != row.target)
        begins = jnp.isinf(before.value)
        # (Comparisons with NaN are false.)
        compared = known if same else known & (row.signs > 0)
        other = begins & compared & ~(jnp.sign(now.value) * row.signs > 0)
        unknown = known & ~jnp.isfinite(now.value) & ~begins
        returns = known & ~begins & dips(before, now, jnp.sign(now.value))
        positive = (before.value > 0) & ~begins
        falls = known & positive & ~(now.value > 0)
        enabled = falls & (before.enabled | now.enabled)
        return (other | unknown | returns | enabled).any() | self._misses(
            row, before, now
        )

    def _has_rival(self, row: Rows, begin, now: Watched) -> Bool[Array, ""]:
        """Test whether another function falls to zero where an event happens, so that it may come
        first (see `Tape.rival`)."""
        other = (row.signs > 0) & (jnp.arange(self.width) != row.target)
        close = TOGETHER * (now.t - begin) * jnp.abs(now.rate)
        falls = (now.rate < 0) & (now.value <= close)
        return (other & falls & now.enabled).any()

    def _misses(self, row: Rows, before: Watched, now: Watched) -> Bool[Array, ""]:
        """Test whether the function at whose zero a leg ends does not fall to it. (The row of its
        first correction has its sign in the row before.)"""
        was_positive = (before.value[row.target] > 0) | (row.signs[row.target] <= 0)
        falls = now.rate[row.target] < 0
        return (row.target >= 0) & ~(was_positive & falls)

    def _has_tick(self, a: int, course: Course) -> Bool[Array, ""]:
        """Test whether a scheduled event has been due since the leg began, and before now."""
        due, t = jnp.asarray(False), course.t
        for g in self.s.schedules(a):
            guard = self.s.transitions[g].guard
            assert isinstance(guard, Scheduled)
            offset, period = guard.numbers(t)
            before = jnp.floor((course.begin - offset) / period + _SAME_TICK)
            last = jnp.ceil((t - offset) / period - _SAME_TICK) - 1
            due = due | (last > before)
        return jax.lax.stop_gradient(due)


def _is_scheduled(s: Structure, g: int) -> bool:
    return isinstance(s.transitions[g].guard, Scheduled)


def _still(tree: Any) -> Any:
    return jax.lax.stop_gradient(tree)


def _leveled(flags: Flags, row: Rows) -> Flags:
    """Flags on a section: of the level of the next one nothing is known. (Charts without a level
    have no such row: nothing is set.)"""
    value = flags.before.value
    if value.size:
        value = value.at[row.target].set(jnp.inf, mode="drop")
    return flags._replace(before=flags.before._replace(value=value))


def _newton(now: Watched, target) -> Float[Array, ""]:
    """The time to the zero of a watched function."""
    return -now.value[target] / now.rate[target]


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
