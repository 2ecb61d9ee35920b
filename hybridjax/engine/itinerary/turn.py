"""A trajectory that follows an itinerary."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...systems.structure import Structure
from ..settings import Settings
from ..target import AbstractLevels
from .bodies import Bodies, Course, Watched
from .rows import LEGS, Body, Form, Rows
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
    factors: Float[Array, "K d d"]
    """Derivatives of the states at the ends of pieces by those at their beginnings."""
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
    reverse: bool = False,
) -> Passage:
    """Follow an itinerary from a time and a state.

    **Arguments:** `count`: of the rows that do something; None for a loop over all of them, which
    reverse mode needs. `levels`: of the section at the end; None for a turn that ends at a time.
    `begin`, `ends` (guessed ends of legs), and the result: of each lane. `solver`: for all charts;
    None for that of each chart. `columns`: whether derivatives are computed; otherwise factors are
    meaningless. `reverse`: whether reverse mode will differentiate it.
    """
    d = begin[1].shape[-1]
    C = d if columns else 0

    def depart(t, q, ends):
        zero = jnp.zeros_like(t)
        y = jnp.concatenate([q[None], jnp.eye(C, d)])
        return Course(
            t=t,
            y=y,
            rate=jnp.zeros(d),
            begin=t,
            delay=jnp.zeros(C),
            ends=ends,
            before=Watched.unknown(t, form.watched),
            error=zero,
            last=zero,
            left=jnp.asarray(False),
        )

    def branch(body: Body) -> Callable[[Rows, Course], Course]:
        def of_lane(numbers, course, row):
            s = travelers.of(numbers)

            def pairs(a):
                return solver_of(s.method(a), reverse) if solver is None else solver

            bodies = Bodies(s, levels, settings, form.watched, pairs)
            return bodies.of(body)(row, course)

        def of_all(row, course):
            one = travelers.each(lambda *lane: of_lane(*lane, row))
            return one(travelers.numbers, course)

        return of_all

    branches = [branch(body) for body in form.bodies]

    def one(carry, row: Rows):
        course, times, states, rates = carry
        times = times.at[row.piece].set(course.t)
        states = states.at[row.piece].set(course.y)
        course = jax.lax.switch(row.body, branches, row, course)
        return (course, times, states, rates.at[row.piece].set(course.rate)), None

    def numbered(k, carry):
        return one(carry, jax.tree_util.tree_map(lambda x: x[k], rows))[0]

    along = jax.vmap if travelers.many else lambda function: function
    course = along(depart)(*begin, ends)
    # (Rows at which no piece begins write into one more place.)
    kept = lambda x: jnp.zeros((LEGS + 1, *x.shape))  # noqa: E731
    carry = course, kept(course.t), kept(course.y), kept(course.rate)
    if count is None:
        (course, times, states, rates), _ = jax.lax.scan(one, carry, rows)
    else:
        rows = jax.tree_util.tree_map(jnp.asarray, rows)
        course, times, states, rates = jax.lax.fori_loop(0, count, numbered, carry)
    # (Columns begin anew with each piece: those before are the factors.)
    factors = jnp.concatenate([states[1:LEGS], course.y[None]])[..., 1:, :]
    last = lambda x: jnp.moveaxis(x, 0, 1) if travelers.many else x  # noqa: E731
    return Passage(
        course.t,
        course.y[..., 0, :],
        course.ends,
        last(times[:LEGS]),
        last(states[:LEGS, ..., 0, :]),
        last(rates[:LEGS]),
        jnp.swapaxes(last(factors), -1, -2),
        course.error,
        course.last,
        course.left,
    )
