"""A trajectory that follows an itinerary."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._core.loops import loop, pushed
from ...systems.structure import Structure
from ..settings import Settings
from ..target import AbstractLevels
from .bodies import Bodies, Course, Watched
from .rows import Body, Form, Rows
from .steps import Solver, solver_of


class Passage(NamedTuple):
    """A trajectory that has followed an itinerary."""

    t: Float[Array, ""]
    q: Float[Array, " d"]
    """The time and the state at the end."""
    ends: Float[Array, " E"]
    """Ends of legs."""
    legs_t: Float[Array, " K"]
    legs_q: Float[Array, "K d"]
    """Times and states at the beginnings of pieces."""
    rates: Float[Array, "K d"]
    """The field there."""
    factors: Float[Array, "K n m"]
    """Derivatives of the states at the ends of pieces by those at their beginnings; between
    sections, of times and states by times, states and inputs."""
    delay: Float[Array, " m"]
    """Derivatives of the time at the end by the beginning of the last piece."""
    error: Float[Array, ""]
    """Largest estimated error of a step, relative to what is allowed."""
    last: Float[Array, ""]
    """Largest last correction of the time of an event."""
    left: Bool[Array, ""]
    """Whether the itinerary was left."""


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
    nu: int = 0
    """Number of inputs; only columns between sections need it."""

    def each(self, function: Callable) -> Callable:
        """A function of the numbers and further arrays of one lane, for all."""
        return jax.vmap(function) if self.many else function


def follow(
    travelers: Travelers,
    levels: AbstractLevels | None,
    settings: Settings,
    form: Form,
    rows: Rows,
    count: Int[Array, ""] | None,
    begin: tuple[Float[Array, ""], Float[Array, " d"]],
    ends: Float[Array, " E"],
    *,
    solver: Solver | None = None,
    columns: bool = True,
    known: Float[Array, " E"] | None = None,
    passes: int = 1,
) -> Passage:
    """Follow an itinerary from a time and a state.

    **Arguments:** `levels`: of sections; None if there are none. `count`: of the rows that do
    something; None for a loop over all of them that reverse mode can differentiate. `begin`, `ends`
    (guessed ends of legs), and the result: of each lane. `solver`: for all charts; None for that of
    each chart. `columns`: whether derivatives are computed; otherwise factors are meaningless.
    `known`: ends of legs where they are known, otherwise infinite. `passes`: number of times the
    itinerary is followed, each with the ends that the one before has found.
    """
    d, reverse = begin[1].shape[-1], count is None
    inputs = _inputs_of_columns(travelers, form, d) if columns else None
    C = d if inputs is None else len(inputs)
    if not columns:
        C = 0
    along = jax.vmap if travelers.many else lambda function: function

    def depart(constants, ends) -> _State:
        begin, known = constants.begin, constants.known
        ends = jax.lax.stop_gradient(ends)
        if known is not None:
            ends = jnp.where(jnp.isfinite(known), known, ends)
        course = along(lambda t, q, ends: _departed(t, q, ends, C, form))(*begin, ends)
        # (Rows at which no piece begins write into one more place.)
        kept = lambda x: jnp.zeros((form.pieces + 1, *x.shape))  # noqa: E731
        begun = _Begun(*map(kept, (course.t, course.y, course.delay, course.rate)))
        return _State(course, begun)

    def branch(body: Body) -> Callable[..., Course]:
        def of_lane(constants, numbers, course, row):
            s = travelers.of(numbers)

            def pairs(a):
                return solver_of(s.method(a), reverse) if solver is None else solver

            levels, settings = constants.levels, constants.settings
            bodies = Bodies(s, levels, settings, form.watched, pairs, inputs)
            return bodies.of(body)(row, course)

        def of_all(constants, row, course):
            lane = lambda *lane: of_lane(constants, *lane, row)  # noqa: E731
            return along(lane)(constants.numbers, course)

        return of_all

    branches = [branch(body) for body in form.bodies]

    def take(constants, row: Rows, state: _State) -> _State:
        begun = state.begun.ended(row, state.course)
        # (Constants are no arguments: sections also hold names.)
        bound = [ft.partial(function, constants) for function in branches]
        course = jax.lax.switch(row.body, bound, row, state.course)
        return _State(course, begun.begun(row, course))

    def take_along(constants, by_constants, row: Rows, state: _State, columns: _State):
        # (Derivatives of the bodies, not of the choice among them: that takes many times as long.)
        def body(function):
            def of(row, course, by_course):
                one = lambda constants, course: function(constants, row, course)  # noqa: E731
                return pushed(one, constants, by_constants, course, by_course)

            return of

        both = state.course, columns.course
        begun = state.begun.ended(row, both[0]), columns.begun.ended(row, both[1], 1)
        both = jax.lax.switch(row.body, [*map(body, branches)], row, *both)
        begun = begun[0].begun(row, both[0]), begun[1].begun(row, both[1], 1)
        return _State(both[0], begun[0]), _State(both[1], begun[1])

    def restart(constants, state: _State) -> _State:
        return depart(constants, state.course.ends)

    def numbered(constants, k, state: _State) -> _State:
        if passes > 1:
            is_new = (k > 0) & (k % constants.count == 0)
            state = _chosen(is_new, restart(constants, state), state)
        return take(constants, _row(constants, k), state)

    def numbered_along(constants, by_constants, k, state: _State, columns: _State):
        if passes > 1:
            is_new = (k > 0) & (k % constants.count == 0)
            again = pushed(restart, constants, by_constants, state, columns)
            state, columns = _chosen(is_new, again, (state, columns))
        return take_along(constants, by_constants, _row(constants, k), state, columns)

    rows = jax.tree_util.tree_map(jnp.asarray, rows)
    constants = _Constants(
        travelers.numbers, levels, settings, rows, count, begin, known
    )
    state = depart(constants, ends)
    if count is None:
        one = lambda state, row: (take(constants, row, state), None)  # noqa: E731
        for _ in range(passes):
            state = depart(constants, state.course.ends)
            state, _ = jax.lax.scan(one, state, rows)
    else:
        state = loop(numbered, numbered_along, constants, state, passes * count)
    return _passage(state, form, columns, travelers.many)


def _chosen(mask: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return jax.tree_util.tree_map(lambda x, y: jnp.where(mask, x, y), yes, no)


def _row(constants: "_Constants", k: Int[Array, ""]) -> Rows:
    """Row k, of the first or a later pass."""
    place = k % constants.count
    return jax.tree_util.tree_map(lambda x: x[place], constants.rows)


def _departed(t, q: Float[Array, " d"], ends, C: int, form: Form) -> Course:
    """The course of a lane where it begins, with C columns."""
    zero, d = jnp.zeros_like(t), len(q)
    return Course(
        t=t,
        y=jnp.concatenate([q[None], jnp.eye(C, d)]),
        rate=jnp.zeros(d),
        begin=t,
        delay=jnp.zeros(C),
        ends=ends,
        before=Watched.unknown(t, form.watched),
        error=zero,
        last=zero,
        left=jnp.asarray(False),
    )


class _Constants(NamedTuple):
    """Numbers that all rows use; see `follow`."""

    numbers: Any
    levels: AbstractLevels | None
    settings: Settings
    rows: Rows
    count: Int[Array, ""] | None
    begin: tuple
    known: Float[Array, " E"] | None


class _State(NamedTuple):
    """What rows change."""

    course: Course
    begun: "_Begun"


def _passage(state: _State, form: Form, columns: bool, many: bool) -> Passage:
    """What has been passed at the end."""
    (course, begun), K = state, form.pieces
    # (Columns begin anew with each piece: those before are the factors.)
    factors = jnp.concatenate([begun.y[1:K], course.y[None]])[..., 1:, :]
    if form.sections and columns:
        delays = jnp.concatenate([begun.delay[1:K], course.delay[None]])
        factors = jnp.concatenate([delays[..., None], factors], axis=-1)
    last = lambda x: jnp.moveaxis(x, 0, 1) if many else x  # noqa: E731
    return Passage(
        course.t,
        course.y[..., 0, :],
        course.ends,
        last(begun.t[:K]),
        last(begun.y[:K, ..., 0, :]),
        last(begun.rate[:K]),
        jnp.swapaxes(last(factors), -1, -2),
        course.delay,
        course.error,
        course.last,
        course.left,
    )


class _Begun(NamedTuple):
    """Where pieces begin: the time, the state with the columns of the piece before, the columns of
    the time, and the field. Derivatives have directions on the first axis."""

    t: Array
    y: Array
    delay: Array
    rate: Array

    def ended(self, row: Rows, course: Course, axis: int = 0) -> "_Begun":
        """With the end of the piece before a row."""
        at = (slice(None),) * axis + (row.piece,)
        return self._replace(
            t=self.t.at[at].set(course.t),
            y=self.y.at[at].set(course.y),
            delay=self.delay.at[at].set(course.delay),
        )

    def begun(self, row: Rows, course: Course, axis: int = 0) -> "_Begun":
        """With the beginning of the piece at a row."""
        at = (slice(None),) * axis + (row.piece,)
        return self._replace(rate=self.rate.at[at].set(course.rate))


def _inputs_of_columns(
    travelers: Travelers, form: Form, d: int
) -> Float[Array, "C nu"] | None:
    """Inputs of the columns between sections, which are those of the time, the state and the
    inputs; None for columns of the state."""
    if not form.sections:
        return None
    nu = travelers.nu
    return jnp.eye(1 + d + nu, nu, -1 - d)
