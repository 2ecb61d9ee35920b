"""Lanes: the hybrid states of many trajectories that are computed side by side; and the tape, the
record of their moves. A *move* is one accepted step, with the event at its end if there is one.

`Lanes` is the state of a flow, and `Tape` the record of its moves: the search writes it, `replay`
follows it, and the package beyond `engine` reads it. Each chart has functions of its own, which
must not be evaluated at the states of another chart:

- `only` replaces the states of lanes in other charts.
- `needed` stops derivatives where a chart has no lane.
- `nan_where` marks lanes that failed, in values and derivatives.

If values are right and derivatives are NaN, look in these three. If pieces of a flow are joined in
a wrong way, look in `regrouped`, `side_by_side` and `stack_rows`. Lanes must stay on the last axis
of all arrays, and codes of events must stay indices of transitions (all others are negative).
(`_core/lanes.py` turns functions of single states into functions of lanes.)
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from .._core.executor import cond, lane, namespace, on_host, put, some
from ..errors import DefinitionError
from ..systems.structure import Structure
from .arrays import Array, Index, Mask, Padded, Times


class Lanes(NamedTuple):
    """L hybrid states. States are padded with zeros to the largest chart's dimension d."""

    t: Times
    chart: Index
    q: Padded
    armed: Bool[Array, "G L"]
    """Which transitions (rows, by index) are armed. An armed transition fires when its guard next
    falls through zero, or at once if the guard is below zero. An armed scheduled transition fires
    if it is due at t."""
    events: Index
    """Number of events so far."""
    pace: Float[Array, "4 L"]
    """For Zeno: time since the last event, the last interval between events, number of intervals
    in a row that shrank, and their sum."""


def start_lanes(s: Structure, t: Times, chart: Index, q: Padded) -> Lanes:
    """Lanes before their first step. No guard is armed yet: the search arms them."""
    # (A zero that depends on the lanes: with a constant, `jax.vmap` would trace loops a second
    # time.)
    zero = chart * 0
    armed = np.zeros((len(s.transitions), t.shape[0]), bool)
    return Lanes(
        t=t,
        chart=chart,
        q=q,
        armed=namespace(t).asarray(armed),
        events=zero,
        pace=pace_of(zero),
    )


def pace_of(events: Index) -> Float[Array, "4 L"]:
    """The pace (see `Lanes`) of lanes that have had no events, from an integer zero for each."""
    return np.array([[0.0], [np.inf], [0.0], [0.0]]) + 0 * events


def lane_at(s: Structure, chart: str, state: Array, t: ArrayLike, name: str) -> Lanes:
    """The lane of the host at a state that users give by this name.

    **Raises:** `DefinitionError` for another number of states.
    """
    a = s.chart_index(chart)
    q = np.asarray(state)
    if q.shape != (s.dims[a],):
        raise DefinitionError(
            f"{name} must give values for the {s.dims[a]} states {', '.join(s.charts[a].states)} "
            f"of chart '{chart}'; got {q}."
        )
    q = np.pad(q, (0, s.d - len(q)))[:, None]
    return start_lanes(s, np.array([t], float), np.array([a], np.int32), q)


def for_each_chart(s: Structure, chart: Index, mask: Mask, work: Callable, out):
    """Update `out` by `work(a, lanes_in_a, out)` for every chart a that has lanes of `mask`.

    Charts without lanes cost nothing: the branch is on a scalar of the whole batch. The branch
    also keeps XLA from computing its contents once for every use of its results.
    """
    for a in range(len(s.charts)):
        within = mask & (chart == a)

        def present(out, a=a, here=within):
            return work(a, here, out)

        out = cond(some(within), present, lambda out: out, out)
    return out


def only(mask: Mask, x: Array) -> Array:
    """`x`, with each lane outside of `mask` replaced by a lane inside of it. An array with a single
    entry for all lanes is returned as it is.

    Thus a chart's functions are never evaluated at states of another chart, where they might be
    undefined. NaN at such states would reach reverse-mode derivatives even if the value is masked
    afterwards.
    """
    if x.shape[-1] < mask.shape[0] or (on_host(mask) and mask.all()):
        return x
    xp = namespace(x)
    return xp.where(mask, x, lane(x, xp.argmax(mask)))


def fixed(tree):
    """The tree with its values, but without derivatives (`stop_gradient`)."""
    arrays, static = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), static)


# Any number but zero becomes infinite if it is multiplied twice by this number. Smaller: small
# derivatives of lanes that failed are kept. (It must be finite: zero times infinity is NaN.)
_LARGE = 1e300


def nan_where(failed: Mask, x: Float[Array, "*K n L"]) -> Float[Array, "*K n L"]:
    """x, with NaN for the lanes that failed, in values and in derivatives.

    In reverse mode, a lane whose result is not used has a cotangent of zero, which stays zero here.
    (Zero times NaN would be NaN, and would spoil the gradient by the parameters, which all lanes
    share.)
    """
    if on_host(x):
        return np.where(failed, np.nan, x)
    return _nan_where(failed, x)


@jax.custom_jvp
def _nan_where(failed, x):
    return jnp.where(failed, jnp.nan, x)


@_nan_where.defjvp
def _nan_where_jvp(primals, tangents):
    failed, x = primals
    _, t_x = tangents
    large = jnp.where(failed, _LARGE, 1.0)
    none = jnp.where(failed, 0.0, 1.0)
    # (Where a lane failed, the first two factors make a derivative infinite, and the zero then
    # makes it NaN. Reverse mode multiplies in the opposite order, so that the last two factors come
    # first.)
    spoiled = t_x * large * large * none * large * large
    # (A number whose own derivative is zero gets NaN, too, if another number of its lane has one.)
    others = jnp.sum(spoiled, axis=-2, keepdims=True)
    return _nan_where(failed, x), spoiled + jnp.where(failed, others, 0.0)


def needed(mask: Mask, tree):
    """`tree` itself, without derivatives if `mask` has no lanes.

    Where `jax.vmap` maps a branch, JAX computes both sides. The side that is not taken has
    cotangents of zero. At states of another chart its derivatives may be infinite, and zero times
    infinity is NaN, which must not reach states or parameters.
    """
    if on_host(mask):
        return tree
    present = mask.any()

    def cut(x):
        return (
            jnp.where(present, x, jax.lax.stop_gradient(x))
            if eqx.is_inexact_array(x)
            else x
        )

    return jax.tree_util.tree_map(cut, tree)


def side_by_side(tree):
    """Pieces of a flow as lanes: arrays (pieces, ..., L) become (..., pieces L)."""

    def join(x):
        *others, rows, columns = x.shape
        return x.reshape(*others, rows * columns)

    def move(x):
        return join(namespace(x).moveaxis(x, 0, -2)) if x.ndim > 1 else x

    return jax.tree_util.tree_map(move, tree)


# Codes on a tape: how a move ends. A code >= 0 is the index of the transition that fires at the
# end.
IDLE, MOVE, ARRIVE_TIME, ARRIVE_LEVEL = range(-4, 0)
# More events than any flow has.
MANY = np.iinfo(np.int32).max


class Tape(NamedTuple):
    """The moves of lanes: one row for each iteration of the search, one column for each lane. A
    `Tape` whose arrays lack the first axis is a single row."""

    h: Float[Array, "R L"]
    """Length of the move."""
    code: Int[Array, "R L"]
    """Its end: IDLE (no move), MOVE, ARRIVE_TIME, ARRIVE_LEVEL, or a transition's index."""
    t: Float[Array, "R L"]
    """Time at the end of the move."""
    before: Float[Array, "R d L"]
    """State at the end of the move, before a reset."""
    after: Float[Array, "R d L"]
    """State after the reset."""
    chart: Int[Array, "R L"]
    """Chart after the reset."""
    at_once: Bool[Array, "R L"]
    """Whether the move is an event at once: its guard was below zero right after the event before,
    and it happens at the same time."""
    rival: Int[Array, "R L"]
    """Another transition (by index; negative: none) whose armed guard is also zero at the event
    that ends the move. Neighboring trajectories may reach either event first."""
    events: Int[Array, "R L"]
    """Number of the lane's events so far; `MANY` in rows that have not been written."""


def blank_tape(rows: int, lanes: Lanes) -> Tape:
    """A tape without moves."""
    xp = namespace(lanes.q)
    d, L = lanes.q.shape

    def times():
        return xp.zeros((rows, L))

    def states():
        return xp.zeros((rows, d, L))

    code = xp.full((rows, L), IDLE, xp.int32)
    chart = xp.zeros((rows, L), xp.int32)
    at_once = xp.zeros((rows, L), bool)
    rival = xp.full((rows, L), -1, xp.int32)
    events = xp.full((rows, L), MANY, xp.int32)
    ends = states(), states()
    return Tape(times(), code, times(), *ends, chart, at_once, rival, events)


def regrouped(tape: Tape, group: Int[np.ndarray, " L"], lanes: Lanes) -> Tape:
    """Join columns of a tape: all lanes with the same number in `group` become one lane, whose
    moves follow each other. Groups are numbered from 0, in order."""
    lane, row = np.nonzero(tape.code.T != IDLE)
    group = group[lane]
    order = np.arange(len(group)) - np.searchsorted(group, group)
    out = blank_tape(order.max() + 1, lanes)
    for x, y in zip(out, tape, strict=True):
        x[order, ..., group] = y[row, ..., lane]
    return out


def stack_rows(parts: tuple[np.ndarray, ...]) -> np.ndarray:
    """Stack the arrays of several tapes. Shorter tapes get further rows without moves. (Only the
    code of such rows is read.)"""
    rows = max(map(len, parts))
    blank = IDLE if parts[0].dtype.kind == "i" else 0
    shape = (len(parts), rows, *parts[0].shape[1:])
    out = np.full(shape, blank, parts[0].dtype)
    for whole, part in zip(out, parts, strict=True):
        whole[: len(part)] = part
    return out


def write_row(tape: Tape, i: Int[Array, ""], row: Tape) -> Tape:
    """The tape with its row i filled in: in place on the host, and by XLA outside of branches."""
    if on_host(tape.h):
        for x, y in zip(tape, row, strict=True):
            x[i] = y
        return tape
    return Tape(*(put(x, i, y.astype(x.dtype)) for x, y in zip(tape, row, strict=True)))
