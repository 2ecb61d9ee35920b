"""Experiments near a limit cycle, computed along a table of steps and events, without a search.

`run.py` calls `program` (the compiled `follow_table`) with a table from `rows.py`. It returns the
outputs at the sections, and which experiments have left the table; these are computed again by
other programs. All experiments are moved at once: each is a *lane*, an entry on the last axis of
arrays. Each row of the table moves the lanes that are at its *place* (section and number of events
passed). A *leg* is the way from one event or section to the next.

A lane has left the table if a watched function (a guard, or the level of a section) has another
sign than on the cycle or has dipped below zero (`_has_left`), a leg would last a negative time, a
step has a larger error than planned, or an event was not found. These tests must stay strict: only
lanes that have left are computed again, all others are results.

If results differ from those of a search, look first at `_has_left`, then at `_landed` (times of
events); if `error` does, at `share` in `_leg`. If too many lanes leave the table, look at
`rows.py`.
"""

import dataclasses
import functools as ft
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from .._core.compilation import Program
from ..engine import kernels
from ..engine.arrays import Array
from ..engine.cubic import dips
from ..engine.runge_kutta import looped_step
from ..engine.settings import Settings, size
from ..systems.solver import Method
from ..systems.structure import Member, Structure
from .plan import ROUNDING, Plan
from .response import Course, Feedback, Response
from .rows import BEGIN, Body, Form, Rows


# Limit of the last correction of the time of an event, in units of the period times the square root
# of the accuracy. (After a correction, the error is about its square.) Larger: events have errors
# that are not reported. Smaller: more experiments leave the table.
_LAST = 5e-3


# The classical method of order 4, for short steps.
_CLASSICAL = Method(
    "classical",
    a=((0, 0, 0, 0), (0.5, 0, 0, 0), (0, 0.5, 0, 0), (0, 0, 1, 0)),
    b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    c=(0, 0.5, 0.5, 1),
    error=(0, 0, 0, 0),
    order=5.0,
)


class Passage(NamedTuple):
    """The state of L experiments (lanes) between two rows of the table."""

    t: Float[Array, " L"]
    q: Float[Array, "d L"]
    place: Int[Array, " L"]
    """The place of the lane (see `Rows.at`)."""
    fresh: Bool[Array, " L"]
    """Whether the lane is on the section."""
    h: Float[Array, " L"]
    """Length of the last step."""
    value: Float[Array, "G L"]
    """Watched functions at the beginning of the last step."""
    rate: Float[Array, "G L"]
    error: Float[Array, " L"]
    """Error in the present period so far."""
    largest: Float[Array, " L"]
    """Largest error in a period."""
    left: Bool[Array, " L"]
    """Whether the table was left."""
    output: Float[Array, "ny L"]
    """Outputs at the last section."""
    answer: Float[Array, "nu L"] | None
    """What a controller adds to the inputs."""
    controller: Float[Array, "c L"] | None
    """States of the controller."""


class Kept(NamedTuple):
    """The passage at the beginning of the present leg. If an event turns out to lie beyond the next
    section, the lane goes back to it."""

    t: Float[Array, " L"]
    q: Float[Array, "d L"]
    fresh: Bool[Array, " L"]
    error: Float[Array, " L"]
    left: Bool[Array, " L"]

    @classmethod
    def of(cls, x: Passage) -> "Kept":
        return cls(x.t, x.q, x.fresh, x.error, x.left)


def follow_table(
    course: Course,
    plan: Plan,
    start: Float[Array, "m S"],
    u: Float[Array, "S n nu"],
    settings: Settings,
    feedback: Feedback | None,
    form: Form,
    rows: Rows,
    count: Int[Array, ""] | int,
) -> tuple[Response, Bool[Array, " S"]]:
    """Flow S experiments as `response.flow_batch` does, along a table.

    **Arguments:** `count`: number of rows that are used; an integer if the result is differentiated
    in reverse mode.

    **Returns:** the response, and which experiments have left the table: their responses are
    meaningless.
    """
    N = len(course.bound.time)
    S, n, nu = u.shape
    moves = _Moves(course, plan, settings, feedback, form)
    # One function for each kind of row.
    branches = [moves.of(body) for body in form.bodies]
    # Axes: periods, sections, inputs, lanes.
    held = jnp.transpose(u, (1, 2, 0)).reshape(n // N, N, nu, S)

    def turn(carry, held):
        """All rows of one period, and the outputs (N, ny, S) at its sections."""
        outputs = jnp.zeros((N, len(moves.outputs.names), S))
        answers = jnp.zeros((N, nu, S))

        def move(r, carry):
            passage, kept, outputs, answers = carry
            row = jax.tree_util.tree_map(lambda x: _at(x, r), rows)
            now = _at(held, row.section)
            passage, kept = jax.lax.switch(row.body, branches, row, now, passage, kept)
            outputs = _put(outputs, passage.output, row.section, 0)
            if feedback is not None:
                answers = _put(answers, passage.answer, row.section, 0)
            return passage, kept, outputs, answers

        *carry, outputs, answers = jax.lax.fori_loop(
            0, count, move, (*carry, outputs, answers)
        )
        return tuple(carry), (outputs, answers)

    begin = moves.begin(start, S)
    carry = (begin, Kept.of(begin))
    (end, _), (y, answers) = jax.lax.scan(turn, carry, held)

    def to_experiments(x):
        return jnp.moveaxis(x, -1, 0).reshape(S, n, -1)

    y = to_experiments(y)
    # A lane has left the table, too, if it is not back on section 0.
    finite = jnp.isfinite(end.q).all(axis=0) & jnp.isfinite(end.largest)
    left = end.left | ~finite | (end.place != BEGIN)
    response = Response(
        y=y,
        result=jnp.zeros(S, jnp.int32),
        failed_at=jnp.full(S, -1),
        error=ROUNDING + plan.least + end.largest,
        end=jnp.concatenate([end.t[None], end.q]).T,
        feedback=None if feedback is None else to_experiments(answers),
    )
    return response, left


_put = jax.lax.dynamic_update_index_in_dim


def _at(x: Array, k: Int[Array, ""]) -> Array:
    """Entry k. (The index is known to be valid; `x[k]` would test it.)"""
    return jax.lax.dynamic_index_in_dim(x, k, 0, keepdims=False)


@dataclasses.dataclass(eq=False)
class _Moves:
    """The functions that rows of the table call."""

    course: Course
    plan: Plan
    settings: Settings
    feedback: Feedback | None
    form: Form

    def __post_init__(self):
        course = self.course
        self.s = Structure(course.system)
        self.outputs = self.s.resolve_outputs(course.outputs)
        self.levels = course.bound.levels
        self.N = len(course.bound.time)
        following = (jnp.arange(self.N) + 1) % self.N
        turns = jnp.where(following == 0, course.period, 0.0)
        self.ends = course.bound.time[following] + turns
        assert self.settings.rtol is not None
        self.allowed = _LAST * course.period * jnp.sqrt(self.settings.rtol)

    def begin(self, start: Float[Array, "m S"], S: int) -> Passage:
        zero = jnp.zeros(S)
        value, rate = self._unknown(S)
        answer = None
        controller = None
        if self.feedback is not None:
            answer = jnp.zeros((self.s.nu, S))
            controller = jnp.zeros((self.feedback.matrices.A.shape[1], S))
        return Passage(
            t=start[0],
            q=start[1:],
            place=jnp.full(S, BEGIN, jnp.int32),
            fresh=jnp.ones(S, bool),
            h=zero,
            value=value,
            rate=rate,
            error=zero,
            largest=zero,
            left=jnp.zeros(S, bool),
            output=jnp.zeros((len(self.outputs.names), S)),
            answer=answer,
            controller=controller,
        )

    def of(self, body: Body):
        """The function (row, inputs, passage, kept) that computes rows with this body."""
        work = self._event if body.kind else self._leg

        def move(row: Rows, u, passage: Passage, kept: Kept):
            acts = passage.place == row.at
            moved, kept = work(body, row, u, passage, kept, acts)
            return _where(acts, moved, passage), kept

        return move

    def _leg(self, body: Body, row: Rows, u, x: Passage, kept: Kept, acts):
        """A step toward the end of a leg, or a correction of the time at which it ends."""
        a = body.chart
        q = x.q[: self.s.dims[a]]
        # Outputs on a section; then the watched functions at the beginning of the step.
        x = self._observed(a, row, u, q, x)
        kept = _where(acts & row.begins, Kept.of(x), kept)
        u = self._applied(u, x)
        f = self._field(a, u)(x.t, q)
        value, rate = self._watched(a, row, u, x.t, q, f)
        left = x.left | self._has_left(a, row, x, value, rate)
        # The length of the step: a part of the time to the end of the leg, a fixed length, or the
        # last one.
        to_end = _at(self.ends, row.section) - x.t
        target = jnp.maximum(row.target, 0)
        if self._functions(a):
            to_zero = -_at(value, target) / _at(rate, target)
            to_end = jnp.where(row.target >= 0, to_zero, to_end)
        planned = jnp.where(row.fixed > 0, row.fixed, row.part * to_end)
        h = jnp.where(row.begins | row.corrects, planned, x.h)
        # The step, with its tests.
        end, error = self._stepped(a, u, x.t, q, h)
        left |= row.begins & (h < 0)
        left |= ~row.corrects & (error > _at(self.plan.slack, row.section))
        share = jnp.where(row.corrects, 0.0, error * _at(self.plan.weight, row.section))
        t = x.t + h
        # On the next section: at its time, or at the zero of its level.
        by_time = row.arrives & (row.target < 0)
        t = jnp.where(by_time, _at(self.ends, row.section), t)
        if self._has_level(a):
            arrived, late = self._landed(a, row, u, t, end)
            at_level = row.arrives & (row.target >= 0)
            t, end = _where(at_level, arrived, (t, end))
            left |= at_level & ~(jnp.abs(late) <= self.allowed)
        x = x._replace(
            t=t,
            q=x.q.at[: self.s.dims[a]].set(end),
            fresh=jnp.zeros_like(x.fresh),
            h=h,
            value=value,
            rate=rate,
            error=x.error + jax.lax.stop_gradient(share),
            left=left,
        )
        return self._arrived(row, x), kept

    def _event(self, body: Body, row: Rows, u, x: Passage, kept: Kept, acts):
        """An event with its reset. If the next section comes first, the lane goes back to the
        beginning of the leg."""
        a = body.chart
        s = self.s
        b = s.chart_index(s.transitions[body.kind[0]].target)
        q = x.q[: s.dims[a]]
        u = self._applied(u, x)
        f = self._field(a, u)(x.t, q)
        value, rate = self._watched(a, row, u, x.t, q, f)
        late = -_at(value, row.target) / _at(rate, row.target)
        t = x.t + late
        member = Member(body.kind, row.place)
        reset = s.by_lane(lambda s, t, q, u: s.reset(member, t, q, u))
        after = reset(t, q + f * late, u)
        # If the next section comes first, the event is left for a later row.
        due = t <= _at(self.ends, row.section)
        if self._has_level(a):
            due &= value[len(s.guards(a))] > 0
        found = (jnp.abs(late) <= self.allowed) & (_at(rate, row.target) < 0)
        happens = due & found & (t >= kept.t)
        left = x.left | self._has_left(a, row, x, value, rate)
        value, rate = self._unknown(len(t))
        moved = x._replace(
            t=t,
            q=jnp.zeros_like(x.q).at[: s.dims[b]].set(after),
            value=value,
            rate=rate,
            left=left | ~(happens | row.may_wait),
        )
        moved = self._arrived(row, moved)
        waits = row.may_wait & ~happens
        back = x._replace(**kept._asdict(), value=value, rate=rate)
        return _where(waits, back, moved), kept

    def _observed(self, a: int, row: Rows, u, q, x: Passage) -> Passage:
        """The outputs of lanes that are on a section, and the response of a controller to them."""
        observe = self.s.by_lane(lambda s, t, q, u: self.outputs(a, t, q, u))
        if self.feedback is not None:
            assert x.answer is not None and x.controller is not None
            A, B, C, D, _ = (m[row.section] for m in self.feedback.matrices)
            on_cycle = self.feedback.on_cycle[row.section][:, None]
            deviation = observe(x.t, q, u) - on_cycle
            answer = -(C @ x.controller + D @ deviation)
            states = A @ x.controller + B @ deviation
            x = x._replace(
                answer=jnp.where(x.fresh, answer, x.answer),
                controller=jnp.where(x.fresh, states, x.controller),
            )
        output = observe(x.t, q, self._applied(u, x))
        return x._replace(output=jnp.where(x.fresh, output, x.output))

    def _stepped(self, a: int, u, t, q, h):
        """The state after a step, and the error of the step relative to the allowed one."""
        # (Not by diffrax, whose step takes twice as long, since it writes stages by `K.at[k].set`.)
        field = self._field(a, u)
        end, error = looped_step(self.s.method(a), field, t, q, h)
        allowed = self.settings.rtol * size(self.settings, a, q, end)
        return end, jnp.max(jnp.abs(error) / allowed, axis=0, initial=0.0)

    def _landed(self, a: int, row: Rows, u, t, q):
        """Time and state at the zero of the row's watched function near (t, q), and the last
        correction of the time."""
        field = self._field(a, u)

        def correct(_, carry):
            (t, q), _ = carry
            value, rate = self._watched(a, row, u, t, q, field(t, q))
            h = -_at(value, row.target) / _at(rate, row.target)
            end, _ = looped_step(_CLASSICAL, field, t, q, h)
            return (t + h, end), h

        return jax.lax.fori_loop(0, 2, correct, ((t, q), jnp.zeros_like(t)))

    def _arrived(self, row: Rows, x: Passage) -> Passage:
        """The passage after a row, on the next section if the row ends there."""
        ends_turn = row.arrives & (row.section == self.N - 1)
        return x._replace(
            t=x.t - jnp.where(ends_turn, self.course.period, 0.0),
            place=jnp.full_like(x.place, 0) + row.then,
            fresh=x.fresh | row.arrives,
            error=jnp.where(ends_turn, 0.0, x.error),
            largest=jnp.where(ends_turn, jnp.maximum(x.largest, x.error), x.largest),
        )

    def _applied(self, u, x: Passage):
        """The inputs, with what a controller adds."""
        return u if x.answer is None else u + x.answer

    # Functions of a chart.

    def _field(self, a: int, u):
        def of_lane(s, t, q, u):
            return s.field(a, t, q, u)

        field = self.s.by_lane(of_lane, name=("field", a), by_row=False)
        return lambda t, q: field(t, q, u)

    def _has_level(self, a: int) -> bool:
        return kernels.has_level(self.s, a, self.levels)

    def _functions(self, a: int) -> int:
        """Number of watched functions."""
        return kernels.count_watched(self.s, a, self.levels)

    def _unknown(self, lanes: int):
        """Placeholders for watched functions and their rates, before any is evaluated."""
        known = jnp.zeros((self.form.watched, lanes))
        return known + jnp.inf, known + 1.0

    def _watched(self, a: int, row: Rows, u, t, q, f):
        """The guards of a chart and the level of the next section, and their rates."""
        if not self._functions(a):
            return self._unknown(len(t))
        at = ft.partial(kernels.watched_at, a, self.s.guard_kinds(a))
        watched = self.s.by_lane(at, self.levels, name=("watched", a), by_row=False)
        index = ((row.section + 1) % self.N).astype(jnp.int32)[None]

        def values(t, q):
            return watched(t, q, u, index)

        value, rate = jax.jvp(values, (t, q), (jnp.ones_like(t), f))
        more = (0, self.form.watched - len(value)), (0, 0)
        # (Unused entries have the rate 1, so that nothing divides by zero.)
        value = jnp.pad(value, more, constant_values=jnp.inf)
        return value, jnp.pad(rate, more, constant_values=1.0)

    def _has_left(self, a: int, row: Rows, x: Passage, value, rate):
        """Test which lanes have left the table: a watched function has another sign than on the
        cycle, or a guard has fallen below zero and come back within the last step."""
        count = self._functions(a)
        guards = len(self.s.guards(a))
        signs = row.signs[:, None]
        # (Comparisons with NaN are false.)
        is_known = signs != 0
        same = jnp.sign(value) * signs > 0
        other = (is_known & ~same)[:count]
        values = signs * x.value, signs * value
        slopes = signs * x.h * x.rate, signs * x.h * rate
        returns = dips(*values, *slopes) & is_known
        return other.any(axis=0) | returns[:guards].any(axis=0)


def _where(mask: Bool[Array, " L"], yes: Any, no: Any) -> Any:
    """For each lane, the values of one of two trees."""
    return jax.tree_util.tree_map(ft.partial(jnp.where, mask), yes, no)


# (XLA's newer code generator compiles these programs for twice as long.)
program = Program(follow_table, loops=True)
