"""Derivatives of recorded flow: the moves on a tape (see `lanes.py`) are integrated again.

The decisions of a search (step sizes, the order of events) are fixed here; only smooth arithmetic
is left. The times of crossings follow from two Newton steps on the true guard (`ChartFlow.locate`),
whose derivatives are those of the formula in `saltation.py`.

- `replay` is a function of JAX's arrays with exact derivatives in forward and reverse mode.
- `chain` multiplies the Jacobians of the moves on the host. A move has three of them: of the
  Runge-Kutta step, of the crossing at its end, and of the reset. Since every move starts at its
  recorded state, all moves in a chart are linearized by one call.
- `Variation` computes directional derivatives on the host, where the start of a record, the
  parameters of the system and the times of the targets change. It returns derivatives of the
  states, and of the Jacobians of `chain`.
- `recorded_moves` reads the moves of a tape, and `linear_moves` linearizes each. All code that
  works with recorded flow on the host begins with these two.

A wrong derivative has its cause in a single move: compare `linear_moves` with differences of the
three stages `_after_steps`, `_at_zeros` and `_after_resets`. If single moves are right, the order
of the moves is wrong, which `recorded_moves` reads from the tape. `_replayed` and `linear_moves`
must treat each code of a move alike (known times, ticks of clocks, zeros, events at once): a change
of one is due in the other.
"""

import dataclasses
import functools as ft
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Inexact, Int

from .._core.executor import namespace, some
from .._core.host_derivatives import NotOnHostError
from ..systems.structure import Member, Structure
from ..systems.transition import Scheduled
from ..systems.varied import Varied
from . import kernels
from .arrays import Array, Index, Inputs, Mask, Padded, Times
from .events import apply_resets, scheduled_time
from .lanes import (
    ARRIVE_LEVEL,
    ARRIVE_TIME,
    IDLE,
    Lanes,
    Tape,
    fixed,
    for_each_chart,
    needed,
    only,
)
from .linear_step import linear_step
from .runge_kutta import take_step
from .saltation import by_point, chained, delay_of_zero
from .target import Target
from .watch import ChartFlow, slopes


# Number of rows of a tape in a block. Blocks are skipped as a whole if they are empty, and reverse
# mode stores one state for each block. Higher: empty rows are computed. Lower: reverse mode stores
# more states.
_BLOCK = 16


class Ways(NamedTuple):
    """The rows of a tape, integrated again: where each of R moves of L lanes ends."""

    t: Float[Array, "R L"]
    before: Float[Array, "R d L"]
    """The state before a reset."""
    after: Float[Array, "R d L"]


def replay(
    s: Structure,
    lanes: Lanes,
    u: Inputs,
    target: Target,
    tape: Tape,
) -> tuple[Times, Padded]:
    """Times and states at the end of a recorded piece of flow, differentiable."""
    end, _ = _replayed(s, lanes, u, target, tape, keeps=False)
    return end


def replayed_ways(
    s: Structure, lanes: Lanes, u: Inputs, target: Target, tape: Tape
) -> Ways:
    """Times and states at the ends of all moves of a recorded piece of flow, differentiable."""
    _, ways = _replayed(s, lanes, u, target, tape, keeps=True)
    return Ways(*(x[: len(tape.h)] for x in ways))


def _replayed(
    s: Structure, lanes: Lanes, u: Inputs, target: Target, tape: Tape, keeps: bool
) -> tuple[tuple[Times, Padded], Any]:
    """Time and state at the end of a recorded piece of flow; with `keeps`, also those at the ends
    of all moves."""
    is_scheduled = [isinstance(x.guard, Scheduled) for x in s.transitions]
    scheduled = jnp.array([*is_scheduled, False])
    level = len(s.transitions)

    def row(carry, row):
        h, code, at_once = row

        def move(carry):
            t, q, chart = carry
            is_event = code >= 0
            by_clock = is_event & scheduled[code]
            due = scheduled_time(s, code, t + h)
            length = jnp.where(by_clock, due - t, h)
            length = jnp.where(code == ARRIVE_TIME, target.time - t, length)
            which = jnp.where(code == ARRIVE_LEVEL, level, code)
            which = jnp.where(by_clock | at_once, -1, which)
            begin = lanes._replace(t=t, q=q, chart=chart)
            is_move = code != IDLE
            t, q = _advance(s, begin, is_move, u, target, length, which)
            event = jnp.maximum(code, -1)
            after, chart = apply_resets(s, t, chart, q, u, event)
            return (t, after, chart), kept(t, q, after)

        def stay(carry):
            t, q, _ = carry
            return carry, kept(t, q, q)

        return jax.lax.cond(some(code != IDLE), move, stay, carry)

    def kept(*ends):
        return ends if keeps else None

    @ft.partial(jax.checkpoint, prevent_cse=False)
    def block(carry, rows):
        def follow(carry):
            return jax.lax.scan(row, carry, rows)

        def stay(carry):
            t, q, _ = carry
            repeated = (jnp.broadcast_to(x, (_BLOCK, *x.shape)) for x in (t, q, q))
            return carry, kept(*repeated)

        _, code, _ = rows
        return jax.lax.cond(some(code != IDLE), follow, stay, carry)

    # Most tapes have moves in their first rows only. Empty blocks of rows are skipped, and reverse
    # mode stores only the state at the start of each block.
    rows, L = tape.h.shape
    fill = ((0, -rows % _BLOCK), (0, 0))
    padded = jnp.pad(tape.h, fill)
    h = padded.reshape(-1, _BLOCK, L)
    padded_at_once = jnp.pad(tape.at_once, fill)
    at_once = padded_at_once.reshape(-1, _BLOCK, L)
    padded_code = jnp.pad(tape.code, fill, constant_values=IDLE)
    code = padded_code.reshape(-1, _BLOCK, L)
    begin = lanes.t, lanes.q, lanes.chart
    rows_of_blocks = (h, code, at_once)
    (t, q, _), ways = jax.lax.scan(block, begin, rows_of_blocks)
    in_rows = jax.tree_util.tree_map(lambda x: x.reshape(-1, *x.shape[2:]), ways)
    return (t, q), in_rows


def _advance(
    s: Structure,
    lanes: Lanes,
    moving: Mask,
    u: Inputs,
    target: Target,
    h: Times,
    which: Index,
) -> tuple[Times, Padded]:
    """One step of every lane that moves. If the move ends in a crossing, the step is corrected to
    the zero of that function."""
    t = lanes.t
    q = lanes.q
    chart = lanes.chart

    def work(a, here, out):
        t_out, q_out = out
        n = s.dims[a]
        system, levels = needed(here, (s, target.levels))
        goal = levels, only(here, target.index)
        start = [only(here, x) for x in (t, q[:n], u, h)]
        t0, q0, u0, h0 = needed(here, start)
        flow = ChartFlow(system, a, u0, *goal)
        still = ChartFlow(fixed(system), a, fixed(u0), *goal)
        # (The method is read outside of the branch: making the charts may create traced values.)
        method = flow.method
        crossing = jnp.where(here, which, -1)

        # (In a branch: otherwise XLA would mask the states again in every stage.)
        def step():
            end = take_step(method, flow.field, t0, q0, h0, still.field)
            return end.q, end.f1

        q1, f1 = jax.lax.cond(some(here), step, lambda: (q0, q0))
        t1 = t0 + h0

        def land():
            zero = flow.locate(t1, q1, f1, crossing)
            return t1 + zero.past, zero.q

        if flow.rows:
            t1, q1 = jax.lax.cond(some(crossing >= 0), land, lambda: (t1, q1))
        t_out = jnp.where(here, t1, t_out)
        moved = jnp.where(here, q1, q_out[:n])
        q_out = q_out.at[:n].set(moved)
        return t_out, q_out

    return for_each_chart(s, chart, moving, work, (t, q))


class Moves(NamedTuple):
    """Moves of lanes, one after the other on the last axis."""

    t: Float[np.ndarray, " M"]
    chart: Int[np.ndarray, " M"]
    q: Float[np.ndarray, "d M"]
    h: Float[np.ndarray, " M"]
    code: Int[np.ndarray, " M"]
    lane: Int[np.ndarray, " M"]
    order: Int[np.ndarray, " M"]
    """Number of earlier moves of the same lane."""
    at_once: Bool[np.ndarray, " M"]
    """See `Tape`."""


def chain(
    s: Structure,
    lanes: Lanes,
    target: Target,
    tape: Tape,
    of_states: bool,
    across: Float[np.ndarray, "A d"] | None = None,
) -> tuple[Float[np.ndarray, "L n m"], Float[np.ndarray, "n L"]]:
    """Derivatives of (t, q) at the end of a record by (t, q, u) at its start, at u = 0, or by q
    only. Also returns (t, q) at the end.

    **Arguments:** `across`: magnitudes of states by chart, for autonomous systems and targets at
    which a deviation along the flow has no meaning. Deviations along the flow are then projected
    out of every move. Otherwise they would drown all other deviations where the flow contracts
    strongly.
    """
    n = 1 + s.d
    moves = recorded_moves(lanes, tape)
    end, by = linear_moves(s, moves, target)
    if across is not None:
        u = np.zeros((s.nu, 1))
        f = slopes(s, moves.t, moves.chart, moves.q, u).T
        flows = ~moves.at_once  # (there is no flow before an event at once)
        sizes = np.asarray(across)[moves.chart[flows]]
        project = projections(f[flows], sizes)
        by_state = by[flows, :, 1:n]
        by[flows, :, 1:n] = by_state @ project
    columns = _products(moves, by, len(lanes.t))
    ends = np.concatenate([lanes.t[None], lanes.q])
    ends[:, moves.lane] = end.T  # (the last move of a lane comes last)
    return columns[:, :, 1:n] if of_states else columns, ends


def _products(moves: "Moves", by: Float[np.ndarray, "M n m"], L: int) -> np.ndarray:
    """Derivatives of (t, q) at the ends of lanes by (t, q, u) at their starts."""
    n, m = by.shape[1:]
    unit = np.eye(n, m, dtype=by.dtype)
    columns = np.tile(unit, (L, 1, 1))
    by_start = by[:, :, :n]
    by_input = by[:, :, n:]
    for order in range(1 + max(moves.order, default=-1)):
        now = moves.order == order
        lane = moves.lane[now]
        columns[lane] = by_start[now] @ columns[lane]
        columns[lane, :, n:] += by_input[now]
    return columns


class Variation:
    """Derivatives of recorded flow in P directions.

    The lanes follow each other: each begins where the last one ended. A direction is a change of
    the parameters in `s` and of the `times` (P, L) of the targets.

    **Arguments:** `twice`: whether `jacobians` will be called, which needs second derivatives of
    every move.
    """

    def __init__(
        self,
        s: kernels.Tangents,
        lanes: Lanes,
        target: Target,
        tape: Tape,
        times,
        twice,
    ):
        moves = recorded_moves(lanes, tape)
        n = 1 + s.d
        P = s.directions
        self._s = s
        self._moves = moves
        self.first = np.flatnonzero(moves.order == 0)
        if len(self.first) < len(lanes.t):
            raise NotOnHostError

        # Every move is varied in all directions of its start, and in the P given ones.
        def many(x):
            return np.repeat(x, n + P, axis=-1)

        M = len(moves.t)
        each_start = np.tile(np.eye(n, n + P), M)
        aside = 1j * kernels.TINY * each_start
        along = Moves(*map(many, moves))
        direction = np.arange(len(along.t)) % (n + P)
        lane = along.lane * (n + P) + direction
        t = along.t + aside[0]
        q = along.q + aside[1:]
        h = _until_ticks(s, along, t, q, lane)
        along = along._replace(t=t, q=q, h=h, lane=lane)
        # A direction that moves only the start of the flow needs no lanes of its own: the start of
        # each move is varied anyway.
        moves_more = s.moving | times.any(axis=1)
        is_first = np.arange(P) == 0
        self._unit = np.eye(P)[moves_more | is_first]
        own_lane = self._unit.any(axis=0)
        needed = np.append(np.full(n, twice), own_lane)
        of_moves = np.tile(needed, M)
        along = Moves(*(x[..., of_moves] for x in along))
        unmoved = np.zeros((n, len(lanes.t)))
        later = np.concatenate([unmoved, times]).T.ravel()
        index = np.broadcast_to(target.index, target.time.shape)
        target = dataclasses.replace(
            target,
            time=many(target.time) + 1j * kernels.TINY * later,
            index=many(index),
        )
        end, by = linear_moves(s, along, target)
        shape = by.shape[1:]
        by = by.reshape(M, -1, *shape)
        end = end.reshape(M, -1, n)
        self._by = np.real(by[:, 0])
        self._change = np.imag(by) / kernels.TINY
        of_directions = end[:, -len(self._unit) :]
        kick = np.imag(of_directions) / kernels.TINY
        self._kick = np.moveaxis(kick, 1, 2) @ self._unit

    def tangents(
        self, begin: Float[np.ndarray, "n P"]
    ) -> Float[np.ndarray, "moves n P"]:
        """Tangents of (t, q) where moves start, and at the last end."""
        starts = [begin]
        by_start = self._by[:, :, : len(begin)]
        for by, kick in zip(by_start, self._kick, strict=True):
            carried = by @ starts[-1]
            starts.append(carried + kick)
        return np.stack(starts)

    def jacobians(
        self, tangents: Float[np.ndarray, "moves n P"], sizes: Any = None
    ) -> Any:
        """Derivatives (L, P, n, m) of (t, q) at the ends of lanes by (t, q, u) at their starts, as
        complex numbers: the imaginary part is the derivative in each direction (see
        `kernels.Tangents`). `sizes`: as `across` in `chain`."""
        moves = self._moves
        M, n, m = self._by.shape
        P = tangents.shape[2]
        unit = np.tile(self._unit, (M, 1, 1))
        along = np.concatenate([tangents[:-1], unit], axis=1)
        shape = along.shape[:2]
        by_direction = self._change.reshape(*shape, n * m)
        change = np.moveaxis(along, 1, 2) @ by_direction
        change = change.reshape(M, P, n, m)
        aside = 1j * kernels.TINY * change
        by = self._by[:, None] + aside
        if sizes is not None:
            points = self.points(tangents, np.arange(M))
            f = slopes(self._s, *points)
            f = f.T.reshape(M, P, n - 1)
            flows = ~moves.at_once
            size = sizes[moves.chart[flows]]
            project = projections(f[flows], size[:, None])
            by_state = by[flows, ..., 1:n]
            by[flows, ..., 1:n] = by_state @ project
        direction = np.arange(M * P) % P
        lane = np.repeat(moves.lane, P) * P + direction
        order = np.repeat(moves.order, P)
        each = moves._replace(lane=lane, order=order)
        lanes = len(self.first) * P
        columns = _products(each, by.reshape(-1, n, m), lanes)
        return columns.reshape(-1, P, n, m)

    def points(self, tangents: Float[np.ndarray, "moves n P"], move: Any) -> tuple:
        """Times, charts, states and inputs where some moves start, in each direction."""
        moves = self._moves
        n, P = tangents.shape[1:]
        moved = np.moveaxis(tangents[move], 1, 0)
        by_direction = moved.reshape(n, -1)
        aside = 1j * kernels.TINY * by_direction
        t = np.repeat(moves.t[move], P)
        chart = np.repeat(moves.chart[move], P)
        q = np.repeat(moves.q[:, move], P, axis=-1)
        direction = np.arange(len(t)) % P
        inputs = self._s.pushed(direction)
        time = t + aside[0]
        return time, chart, q + aside[1:], inputs


def _until_ticks(
    s: kernels.Tangents, moves: Moves, t: np.ndarray, q: np.ndarray, lane: np.ndarray
) -> np.ndarray:
    """Lengths of moves. A move that ends at the tick of a clock changes with the time of the
    tick."""
    h = moves.h + 0j
    for g, transition in enumerate(s.transitions):
        at = moves.code == g
        if isinstance(transition.guard, Scheduled) and at.any():
            end = (t + h).real[at] + 0j
            u = kernels.unpushed(s, lane[at])
            rows_due = kernels.due(s, g, end, q[:, at], u)
            late = rows_due[0, 0]
            h[at] = end + late - t[at]
    return h


def linear_moves(
    s: Structure, moves: Moves, target: Target
) -> tuple[np.ndarray, np.ndarray]:
    """(t, q) after some moves, (M, n); and the derivatives of these by (t, q, u) before the moves,
    (M, n, m)."""
    n = 1 + s.d
    M = len(moves.t)
    number = target.time.dtype
    end = np.zeros((M, n), number)
    by = np.zeros((M, n, n + s.nu), number)
    for a in np.unique(moves.chart).tolist():
        here = np.flatnonzero(moves.chart == a)
        of_chart = Moves(*(x[..., here] for x in moves))
        system = s.at(of_chart.lane)
        end[here], by[here] = _linear(system, a, of_chart, target)
    return end, by


def projections(
    f: Float[Array, "*K d"], sizes: Float[Array, "*K d"]
) -> Float[Array, "*K d d"]:
    """Projections of states along the flow f, orthogonal in sizes."""
    xp = namespace(f)
    f = f / sizes
    square = xp.sum(f * f, axis=-1, keepdims=True)
    length = xp.sqrt(square)
    f = f / length
    column = f[..., :, None]
    line = f[..., None, :]
    along = column * line
    project = np.eye(f.shape[-1]) - along
    in_sizes = project * sizes[..., :, None]
    return in_sizes / sizes[..., None, :]


def recorded_moves(lanes: Lanes, tape: Tape) -> Moves:
    """The moves of a tape, lane by lane."""
    lane, row = np.nonzero(tape.code.T != IDLE)
    first = np.diff(lane, prepend=-1) > 0
    last = np.roll(row, 1)  # the move before, but for the first of a lane
    begins = np.flatnonzero(first)
    counts = np.diff(begins, append=len(lane))
    order = np.arange(len(lane)) - np.repeat(begins, counts)
    return Moves(
        t=np.where(first, lanes.t[lane], tape.t[last, lane]),
        chart=np.where(first, lanes.chart[lane], tape.chart[last, lane]),
        q=np.where(first, lanes.q[:, lane], tape.after[last, :, lane].T),
        h=np.asarray(tape.h)[row, lane],
        code=np.asarray(tape.code)[row, lane],
        lane=lane,
        order=order,
        at_once=np.asarray(tape.at_once)[row, lane],
    )


class _Ends(NamedTuple):
    """Ends of M moves in a chart of n states, with derivatives by (t, q, u) at their starts."""

    t: Inexact[np.ndarray, " M"]
    q: Inexact[np.ndarray, "n M"]
    field: Inexact[np.ndarray, "n M"]
    dt: Inexact[np.ndarray, "M 1 m"]
    dq: Inexact[np.ndarray, "M n m"]


def _linear(
    s: Structure, a: int, moves: Moves, target: Target
) -> tuple[np.ndarray, np.ndarray]:
    """Moves that start in chart a: (t, q) after them, padded, and the derivatives."""
    u = kernels.unpushed(s, moves.lane)
    ends = _after_steps(s, a, moves, target, u)
    ends = _at_zeros(s, a, moves, target, u, ends)
    return _after_resets(s, moves, u, ends)


def _after_steps(s: Structure, a: int, moves: Moves, target: Target, u) -> _Ends:
    """The ends of the steps."""
    n = s.dims[a]
    code = moves.code
    by_clock = np.isin(code, s.schedules(a))
    on_time = code == ARRIVE_TIME
    goal = target.time[moves.lane]
    h = np.where(moves.at_once, 0.0, moves.h)
    h = np.where(on_time, goal - moves.t, h)
    t = np.where(on_time, goal, moves.t + h)
    state = moves.q[:n]
    expanded = linear_step(s, a, moves.t, state, u, h)
    expanded = np.array(np.moveaxis(expanded, -1, 0))
    q = expanded[:, :, 0].T
    field = expanded[:, :, 1].T
    by_start = expanded[:, :, 2:-1]
    by_length = expanded[:, :, -1:]
    # The length of a step to a known time shrinks as t grows; a step to a scheduled event ends at
    # its schedule.
    shape = (len(t), 1, by_start.shape[2])
    longer = np.zeros(shape, by_start.dtype)
    longer[:, 0, 0] = -1.0 * (by_clock | on_time)
    # (Only a varied parameter moves a schedule.)
    varied = s.schedules(a) if isinstance(s, Varied) else []
    moved = np.intersect1d(code, varied).astype(int)
    for g in moved.tolist():
        now = np.flatnonzero(code == g)
        rows_due = kernels.due(s, g, t[now], q[:, now], u[:, now])
        due = rows_due[0]
        by_parameter = due[2 + n :].T
        longer[now, 0, 1 + n :] = by_parameter
    dt = longer.copy()
    dt[:, 0, 0] += 1.0
    dq = by_start + by_length * longer
    return _Ends(
        t=t,
        q=q,
        field=field,
        dt=dt,
        dq=dq,
    )


def _at_zeros(
    s: Structure, a: int, moves: Moves, target: Target, u, ends: _Ends
) -> _Ends:
    """The ends moved to the zeros of the functions that end their moves."""
    n = s.dims[a]
    code = moves.code
    by_clock = np.isin(code, s.schedules(a))
    crossed = np.where(by_clock | moves.at_once, -1, code)
    crossed = np.where(code == ARRIVE_LEVEL, len(s.transitions), crossed)
    lands = np.flatnonzero(crossed >= 0)
    if not len(lands):
        return ends
    crossed = crossed[lands]
    index_of_lane = np.broadcast_to(target.index, target.time.shape)
    index = index_of_lane[moves.lane[lands]]
    landing = s.at(lands)
    flow = ChartFlow(
        s=landing,
        a=a,
        u=u[:, lands],
        levels=target.levels,
        index=index,
    )
    state_at_end = ends.q[:, lands]
    field_at_end = ends.field[:, lands]
    at_end = ends.t[lands], state_at_end, field_at_end
    zero = flow.locate(*at_end, crossed)
    t = ends.t.copy()
    q = ends.q.copy()
    t[lands] += zero.past
    q[:, lands] = zero.q
    at = t[lands], q[:, lands], u[:, lands]
    rows = kernels.field(landing, a, *at)
    expanded = np.moveaxis(rows, -1, 0)
    field = expanded[:, :, :1]
    by_field = by_point(expanded, n)

    # Each move ends at the zero of its own watched function.
    watched = kernels.watched(landing, a, target.levels, *at, index=index)
    is_crossed = np.array(flow.rows)[:, None] == crossed
    row = np.argmax(is_crossed, axis=0)
    own = watched[row, :, np.arange(len(lands))]
    watched = own[:, None]

    # (The time `past` is a rounding error, but it has derivatives.)
    past = zero.past[:, None, None]
    before = ends.dq[lands]
    dt = ends.dt[lands]
    moved = before + past * chained(by_field, dt, before)
    delay = delay_of_zero(by_point(watched, n), field, dt, moved)
    all_dt = ends.dt.copy()
    all_dq = ends.dq.copy()
    all_dt[lands] = dt + delay
    all_dq[lands] = moved + field @ delay
    return _Ends(
        t=t,
        q=q,
        field=ends.field,
        dt=all_dt,
        dq=all_dq,
    )


def _after_resets(
    s: Structure, moves: Moves, u, ends: _Ends
) -> tuple[np.ndarray, np.ndarray]:
    """The ends after the events of moves, padded to the states of all charts."""
    M = len(ends.t)
    n = len(ends.q)
    end = np.zeros((M, 1 + s.d), ends.dq.dtype)
    shape = (M, 1 + s.d, 1 + s.d + s.nu)
    by = np.zeros(shape, ends.dq.dtype)
    inputs = slice(1 + s.d, 1 + s.d + s.nu)
    columns = np.r_[: 1 + n, inputs]
    end[:, 0] = ends.t
    by[:, :1, columns] = ends.dt
    event = np.maximum(moves.code, -1)
    for kind in [(-1,), *s.kinds]:
        now = np.flatnonzero(np.isin(event, kind))
        if not len(now):
            continue
        after = ends.q[:, now]
        by_start = ends.dq[now]
        if kind != (-1,):
            members = np.array(kind)[:, None]
            is_member = members == event[now]
            place = np.argmax(is_member, axis=0)
            member = Member(kind, place.astype(np.int32))
            times = ends.t[now]
            reset = kernels.reset(s.at(now), member, times, after, u[:, now])
            after = reset[:, 0]
            by_reset = by_point(np.moveaxis(reset, -1, 0), n)
            by_start = chained(by_reset, ends.dt[now], by_start)
        m = len(after)
        rows = np.arange(1, 1 + m)
        end[now, 1 : 1 + m] = after.T
        by[np.ix_(now, rows, columns)] = by_start
    return end, by
