"""The rows of an itinerary as its program reads them.

`tabulated` replaces the number of a row's body by the numbers that the program chooses by (chart,
kind of jump, and so on). A `Table` has all of them in two arrays, because the program reads a line
of an array at once: a line of `numbers` is the first fields of `Row`, in order, then the signs.

A new number of a row is a field of `Row`, and a column at the same place in `tabulated` (and a name
in the list of `read`, if it is true or false). The fields `fraction` and `signs` must stay last. If
rows are recorded rightly and the program does something else, look at `tabulated`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ...systems.structure import Structure
from ...systems.transition import Scheduled
from ..arrays import Array
from .rows import JUMP, STEP, Body, Form, Rows


class Row(NamedTuple):
    """One row for the program: its columns (see `Rows`), and numbers by its body. (The order of the
    fields is that of `Table.numbers`.)"""

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
    """R rows."""

    numbers: Int[Array, "R K"]
    fraction: Float[Array, " R"]

    def row(self, k: Int[Array, ""]) -> Row:
        return read(Table(self.numbers[k], self.fraction[k]))


def read(one: Table) -> Row:
    """The row in one line of a table."""
    fields = Row._fields[:-2]
    values = {name: one.numbers[i] for i, name in enumerate(fields)}
    for name in ("onward", "ends_leg", "is_jump", "at_once", "scheduled"):
        values[name] = values[name] > 0
    return Row(**values, fraction=one.fraction, signs=one.numbers[len(fields) :])


def tabulated(s: Structure, form: Form, rows: Rows) -> Table:
    """The rows of an itinerary for its program."""
    ways = form.ways
    kinds = form.kinds
    chart = {a: k for k, a in enumerate(form.charts)}

    # (In the order of the fields of `Row`.)
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
    of_row = rows.leg, rows.target, rows.place, rows.piece, rows.onward, rows.section
    columns = jnp.stack([jnp.asarray(x, jnp.int32) for x in of_row], axis=1)
    signs = jnp.asarray(rows.signs, jnp.int32)
    numbers = [columns, by_body[jnp.asarray(rows.body)], signs]
    return Table(jnp.concatenate(numbers, axis=1), jnp.asarray(rows.fraction))
