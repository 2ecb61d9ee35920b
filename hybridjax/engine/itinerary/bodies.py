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
from ..settings import Settings
from ..target import AbstractLevels
from . import steps
from .rows import JUMP, LEVEL, NOTHING, PIECE, SCHEDULE, STEP, TIME, Body, Rows


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
    """The field where the present piece began."""
    begin: Float[Array, ""]
    """Time at which the present leg began."""
    delay: Float[Array, " C"]
    """Columns of the time of the last event, or of the arrival on a section."""
    ends: Float[Array, " E"]
    """Ends of legs: as guessed, and as found once they are past."""
    before: "Watched"
    """Watched functions where the last row began, and since then."""
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


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Functions of a row and a course for every kind of row.

    **Fields:** `levels`: of the sections, if there are any; `width`: largest number of watched
    functions of a chart; `pairs`: a solver for each chart; `inputs`: those of each column, None for
    columns without inputs.
    """

    s: Structure
    levels: AbstractLevels | None
    settings: Settings
    width: int
    pairs: Callable[[int], steps.Solver]
    inputs: Float[Array, "C nu"] | None = None

    def of(self, body: Body) -> Callable[[Rows, Course], Course]:
        """The function of rows with this body."""
        work: Any = {
            NOTHING: lambda body, row, course: course,
            PIECE: self._piece,
            SCHEDULE: self._schedule,
            STEP: self._step,
            JUMP: self._jump,
            LEVEL: self._level,
            TIME: self._time,
        }[body.does]
        return lambda row, course: work(body, row, course)

    def _piece(self, body: Body, row: Rows, course: Course) -> Course:
        """A piece begins: columns begin anew. (`follow` keeps those of the last one.)

        On a section, the first one is that of the time: who begins later is behind by the flow.
        """
        n, d, C = self.s.dims[body.chart], course.y.shape[1], course.y.shape[0] - 1
        rate = self._field(body.chart, course.t, self._state(body.chart, course))
        rate = jnp.pad(rate, (0, d - n))
        delay = course.delay
        if self.inputs is None:
            unit = jnp.eye(C, d)
        else:
            unit = jnp.concatenate([-rate[None], jnp.eye(C - 1, d)])
            delay = jnp.zeros(C).at[0].set(1.0)
        unit = jnp.where(jnp.arange(d) < n, unit, 0.0)
        return course._replace(y=course.y.at[1:].set(unit), rate=rate, delay=delay)

    def _schedule(self, body: Body, row: Rows, course: Course) -> Course:
        """A leg begins whose end is known: the tick nearest to the guess."""
        guard = self.s.transitions[body.transition].guard
        assert isinstance(guard, Scheduled)
        tick = guard.nearest(course.ends[row.leg])
        return course._replace(ends=course.ends.at[row.leg].set(tick))

    def _step(self, body: Body, row: Rows, course: Course) -> Course:
        """A part of the leg, or a Newton step on a watched function."""
        a = body.chart
        q = self._state(a, course)
        field = self._field(a, course.t, q)
        now = self._watched(a, row, course.t, q, field)
        h = row.fraction * (course.ends[row.leg] - course.begin)
        if self._functions(a):
            is_correction = row.target >= 0
            # (Where none is made, the rate may be zero, and NaN would enter reverse mode.)
            rate = jnp.where(is_correction, now.rate, 1.0)
            newton = _newton(now._replace(rate=rate), row.target)
            h = jnp.where(is_correction, newton, h)
        y, error = self._advanced(a, course, h)
        return course._replace(
            t=course.t + h,
            y=y,
            before=now,
            error=jnp.maximum(course.error, error),
            left=course.left | self._has_left(a, row, course, now),
        )

    def _jump(self, body: Body, row: Rows, course: Course) -> Course:
        """An event, and the reset."""
        s, a, member = self.s, body.chart, Member(body.kind, row.place)
        b = s.chart_index(s.transitions[body.kind[0]].target)
        q, u = self._state(a, course), self._no_input
        field = self._field(a, course.t, q)
        now = self._watched(a, row, course.t, q, field)
        delay, late = course.delay, jnp.zeros(())
        if isinstance(s.transitions[body.kind[0]].guard, Scheduled):
            delay = jnp.zeros_like(delay)
        elif not body.at_once:
            late = _newton(now, row.target)
            delay = self._delay(a, row, course, q, now)
        left = course.left | self._has_left(a, row, course, now)
        left = left | self._has_rival(row, course, now)
        t, q = course.t + late, q + field * late
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
        left = left | self._has_tick(a, course, t)
        return course._replace(
            t=t,
            y=y,
            begin=t,
            delay=delay,
            ends=course.ends.at[row.leg].set(t),
            before=Watched.unknown(t, self.width),
            last=jnp.maximum(course.last, jnp.abs(late)),
            left=left | (t < course.begin),
        )

    def _level(self, body: Body, row: Rows, course: Course) -> Course:
        """The arrival on a level."""
        a = body.chart
        n, q = self.s.dims[a], self._state(a, course)
        field = self._field(a, course.t, q)
        now = self._watched(a, row, course.t, q, field)
        late = _newton(now, row.target)
        delay = self._delay(a, row, course, q, now)
        arrived = jnp.outer(jnp.append(late, delay), field)
        left = course.left | self._has_left(a, row, course, now)
        course = course._replace(y=course.y.at[:, :n].add(arrived), left=left)
        return self._arrived(a, row, course, now, late, delay)

    def _time(self, body: Body, row: Rows, course: Course) -> Course:
        """The arrival at a time that is known."""
        a, q = body.chart, self._state(body.chart, course)
        now = self._watched(a, row, course.t, q, self._field(a, course.t, q))
        left = course.left | self._has_left(a, row, course, now)
        # (The steps of a leg that lasts no time on the recorded trajectory do not arrive later.)
        misses = jnp.abs(course.ends[row.leg] - course.t)
        course = course._replace(left=left, last=jnp.maximum(course.last, misses))
        delay = jnp.zeros_like(course.delay)
        return self._arrived(a, row, course, now, jnp.zeros(()), delay)

    def _arrived(
        self, a: int, row: Rows, course: Course, now: Watched, late, delay
    ) -> Course:
        """A course on a section, where the next leg begins."""
        t = course.t + late
        before = now
        if self._has_level(a):  # (The next section has another one.)
            level = len(self.s.guards(a))
            before = now._replace(value=now.value.at[level].set(jnp.inf))
        return course._replace(
            t=t,
            begin=t,
            delay=delay,
            ends=course.ends.at[row.leg].set(t),
            before=before,
            last=jnp.maximum(course.last, jnp.abs(late)),
            left=course.left | self._has_tick(a, course, t) | (t < course.begin),
        )

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

    def _has_left(self, a: int, row: Rows, course: Course, now: Watched):
        """Test whether the itinerary is left between the row before and this one.

        - Where a leg begins, watched functions must have the signs of the recorded trajectory.
        - Within a leg, none may fall through zero, also if it comes back; one may rise sooner or
          later than recorded. (A fall is no event where its predicate does not hold.)
        - The one at whose zero the leg ends must have been positive, and must fall.
        """
        if not self._functions(a):
            return jnp.asarray(False)
        known, before = row.signs != 0, course.before
        known = known & (jnp.arange(self.width) != row.target)
        begins = jnp.isinf(before.value)
        # (Comparisons with NaN are false.)
        other = begins & known & ~(jnp.sign(now.value) * row.signs > 0)
        unknown = known & ~jnp.isfinite(now.value) & ~begins
        returns = known & ~begins & dips(before, now, jnp.sign(now.value))
        positive = (before.value > 0) & ~begins
        falls = known & positive & ~(now.value > 0)
        enabled = falls & (before.enabled | now.enabled)
        return (other | unknown | returns | enabled).any() | self._misses(
            row, before, now
        )

    def _has_rival(self, row: Rows, course: Course, now: Watched) -> Bool[Array, ""]:
        """Test whether another function falls to zero where an event happens, so that it may come
        first (see `Tape.rival`)."""
        other = (row.signs > 0) & (jnp.arange(self.width) != row.target)
        close = TOGETHER * (now.t - course.begin) * jnp.abs(now.rate)
        falls = (now.rate < 0) & (now.value <= close)
        return (other & falls & now.enabled).any()

    def _misses(self, row: Rows, before: Watched, now: Watched) -> Bool[Array, ""]:
        """Test whether the function at whose zero a leg ends does not fall to it. (The row of its
        first correction has its sign in the row before.)"""
        was_positive = (before.value[row.target] > 0) | (row.signs[row.target] <= 0)
        falls = now.rate[row.target] < 0
        return (row.target >= 0) & ~(was_positive & falls)

    def _has_tick(self, a: int, course: Course, t) -> Bool[Array, ""]:
        """Test whether a scheduled event was due in a leg that ends at t, before its end."""
        due = jnp.asarray(False)
        for g in self.s.schedules(a):
            guard = self.s.transitions[g].guard
            assert isinstance(guard, Scheduled)
            offset, period = guard.numbers(t)
            before = jnp.floor((course.begin - offset) / period + _SAME_TICK)
            last = jnp.ceil((t - offset) / period - _SAME_TICK) - 1
            due = due | (last > before)
        return jax.lax.stop_gradient(due)


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
