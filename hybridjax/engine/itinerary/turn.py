"""A trajectory that follows an itinerary.

`follow` loops over the rows of a table, and each row does what `bodies.py` has for its kind. With
`columns`, derivatives are carried along. What the loop changes is

| | |
|---|---|
| `_State.course` | where the trajectory is now |
| `_State.begun` | where its pieces have begun: what the `Passage` returns of them |
| `Flags` | whether the itinerary was kept: reported as `left` |

`_Steps` has the loop: `loop` over a count of rows, or `scan`, which reverse mode can differentiate,
over all of them. (A step of this loop is a row; steps of integration are in `steps.py`.) The order
in `_Steps.row` must stay: the end of a piece is written before the row acts (`_Begun.ended`),
because the row makes its columns begin anew. `_Steps.take_along` does the same with derivatives.

A wrong state comes from `bodies.py` or `steps.py`; a trajectory that leaves without need, from
`flags.py`; wrong factors of pieces with right states, from `_Begun` or `_passage`.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._core.loops import loop, pushed
from ..settings import Settings
from ..target import AbstractLevels
from .bodies import Bodies
from .course import Constants, Course, Travelers
from .flags import Flags, entry_at_departure
from .motion import Alone, InDirections, still
from .rows import Form, Rows
from .steps import Solver, solver_of
from .table import Row, Table, read, tabulated
from .watched import Watched


class Passage(NamedTuple):
    """A trajectory that has followed an itinerary."""

    t: Float[Array, ""]
    q: Float[Array, " d"]
    """The time and the state at the end."""
    ends: Float[Array, " E"]
    """Ends of legs."""
    pieces_t: Float[Array, " K"]
    pieces_q: Float[Array, "K d"]
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
    d = begin[1].shape[-1]
    inputs = _inputs_of_columns(travelers, form, d) if columns else None
    steps = _Steps(
        travelers,
        form,
        inputs=inputs,
        columns=_number_of_columns(columns, inputs, d),
        solver=solver,
        reverse=count is None,
        passes=passes,
    )
    table = tabulated(travelers.structure, form, rows)
    numbers = travelers.numbers
    constants = Constants(numbers, levels, settings, table, count, begin, known)
    rows_done = steps.scan if count is None else steps.loop
    state, flags = rows_done(constants, ends)
    return _passage(state, flags, form, columns, travelers.many)


def _number_of_columns(columns: bool, inputs: Array | None, d: int) -> int:
    if not columns:
        return 0
    return d if inputs is None else len(inputs)


@dataclasses.dataclass(frozen=True, eq=False)
class _Steps:
    """The steps of the loop over the rows, of all lanes; see `follow`."""

    travelers: Travelers
    form: Form
    inputs: Float[Array, "C nu"] | None
    columns: int
    solver: Solver | None
    reverse: bool
    passes: int

    def depart(self, constants: Constants, ends) -> "tuple[_State, Flags]":
        """The beginning, with guessed ends of legs."""
        known = constants.known
        ends = still(ends)
        if known is not None:
            ends = jnp.where(jnp.isfinite(known), known, ends)

        def of_lane(t, q, ends):
            return _departed(t, q, ends, self.columns, self.form)

        course, flags = self.travelers.each(of_lane)(*constants.begin, ends)
        return _State(course, _Begun.none(self.form.pieces, course)), flags

    def loop(self, constants: Constants, ends) -> "tuple[_State, Flags]":
        """The rows that do something, which carry their derivatives along."""
        assert constants.count is not None
        state, flags = self.depart(constants, ends)
        every = self.passes * constants.count
        return loop(self.take, self.take_along, constants, state, flags, every)

    def scan(self, constants: Constants, ends) -> "tuple[_State, Flags]":
        """All rows, in a loop that reverse mode can differentiate."""

        def take(carry: tuple[_State, Flags], line: Table):
            return self.row(constants, read(line), *carry), None

        for _ in range(self.passes):
            carry = self.depart(constants, ends)
            (state, flags), _ = jax.lax.scan(take, carry, constants.rows)
            ends = state.course.ends
        return state, flags

    def take(self, constants: Constants, k, state: "_State", flags: Flags):
        """Step k, which may be the first of another pass."""
        if self.passes > 1:
            again = self._restart(constants, state, flags)
            is_new = _is_new(constants, k)
            state, flags = _chosen(is_new, again, (state, flags))
        return self.row(constants, _row(constants, k), state, flags)

    def take_along(
        self, constants, by_constants, k, state: "_State", columns: "_State", flags
    ):
        """The same, with derivatives in directions on the first axis."""
        if self.passes > 1:
            carry = state, columns, flags
            again = pushed(self._restart, constants, by_constants, *carry)
            state, columns, flags = _chosen(_is_new(constants, k), again, carry)
        row = _row(constants, k)

        motion = InDirections(constants, by_constants)
        ended = state.begun.ended(row, state.course)
        by_ended = columns.begun.ended(row, columns.course, 1)
        both = state.course, columns.course
        (course, by_course), flags = self._bodies.take(motion, row, both, flags)
        begun = ended.begun(row, course)
        by_begun = by_ended.begun(row, by_course, 1)
        return _State(course, begun), _State(by_course, by_begun), flags

    def row(self, constants: Constants, row: Row, state: "_State", flags: Flags):
        """What a row does."""
        ended = state.begun.ended(row, state.course)
        alone = Alone(constants)
        course, flags = self._bodies.take(alone, row, state.course, flags)
        return _State(course, ended.begun(row, course)), flags

    def _restart(self, constants: Constants, state: "_State", flags: Flags):
        return self.depart(constants, state.course.ends)

    @property
    def _bodies(self) -> Bodies:
        return Bodies(self.travelers, self.form, self._solver, self.inputs)

    def _solver(self, a: int) -> Solver:
        """The solver of a chart."""
        if self.solver is not None:
            return self.solver
        return solver_of(self.travelers.structure.method(a), self.reverse)


def _is_new(constants: Constants, k: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether step k is the first of a later pass."""
    assert constants.count is not None
    return (k > 0) & (k % constants.count == 0)


def _chosen(mask: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return jax.tree_util.tree_map(lambda x, y: jnp.where(mask, x, y), yes, no)


def _row(constants: Constants, k: Int[Array, ""]) -> Row:
    """Row k, of the first or a later pass."""
    assert constants.count is not None
    place = k % constants.count
    return constants.rows.row(place)


def _departed(
    t, q: Float[Array, " d"], ends, C: int, form: Form
) -> tuple[Course, Flags]:
    """The course of a lane where it begins, with C columns."""
    d = len(q)
    course = Course(
        t=t,
        y=jnp.concatenate([q[None], jnp.eye(C, d)]),
        begin=t,
        delay=jnp.zeros(C),
        ends=ends,
        rate=jnp.zeros(d),
        value=jnp.zeros(()),
        slope=jnp.ones(()),
        h=jnp.zeros(()),
    )
    t = still(t)
    zero = jnp.zeros_like(t)
    flags = Flags(
        before=Watched.unknown(t, form.watched, still(q)),
        entry=entry_at_departure(form.watched),
        error=zero,
        last=zero,
        left=jnp.asarray(False),
    )
    return course, flags


class _State(NamedTuple):
    """What rows change."""

    course: Course
    begun: "_Begun"


def _passage(
    state: _State, flags: Flags, form: Form, columns: bool, many: bool
) -> Passage:
    """The result, at the end."""
    course = state.course
    begun = state.begun
    K = form.pieces
    # (Columns begin anew with each piece: those before are the factors.)
    ends = jnp.concatenate([begun.y[1:K], course.y[None]])
    factors = ends[..., 1:, :]
    if form.sections and columns:
        delays = jnp.concatenate([begun.delay[1:K], course.delay[None]])
        of_time = delays[..., None]
        factors = jnp.concatenate([of_time, factors], axis=-1)

    def lanes_first(x):
        return jnp.moveaxis(x, 0, 1) if many else x

    return Passage(
        t=course.t,
        q=course.y[..., 0, :],
        ends=course.ends,
        pieces_t=lanes_first(begun.t[:K]),
        pieces_q=lanes_first(begun.y[:K, ..., 0, :]),
        rates=lanes_first(begun.rate[:K]),
        factors=jnp.swapaxes(lanes_first(factors), -1, -2),
        delay=course.delay,
        error=flags.error,
        last=flags.last,
        left=flags.left,
    )


class _Begun(NamedTuple):
    """Where pieces begin. The first axis of arrays is the piece; in derivatives it is the second,
    behind directions. Rows at which no piece begins write into one more place, after all pieces."""

    t: Array
    """Times."""
    y: Array
    """States, with the columns at the end of the piece before."""
    delay: Array
    """Columns of the time, at the end of the piece before."""
    rate: Array
    """The field."""

    @classmethod
    def none(cls, pieces: int, course: Course) -> "_Begun":
        """No piece has begun."""

        def places(x):
            return jnp.zeros((pieces + 1, *x.shape))

        return cls(
            t=places(course.t),
            y=places(course.y),
            delay=places(course.delay),
            rate=places(course.rate),
        )

    def ended(self, row: Row, course: Course, axis: int = 0) -> "_Begun":
        """With the end of the piece before a row."""
        at = (slice(None),) * axis + (row.piece,)
        return self._replace(
            t=self.t.at[at].set(course.t),
            y=self.y.at[at].set(course.y),
            delay=self.delay.at[at].set(course.delay),
        )

    def begun(self, row: Row, course: Course, axis: int = 0) -> "_Begun":
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
    nu = travelers.structure.nu
    return jnp.eye(1 + d + nu, nu, -1 - d)
