"""The flow along a cycle to one section after the other, from a recorded turn on the host.

The moves of the turn are cut where a section lies within them, without another search.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from ..engine import kernels, lanes
from ..engine.events import Entry, arm, rearm
from ..engine.lanes import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, MOVE, Lanes, Tape
from ..engine.replay import Moves, linear_moves, recorded_moves
from ..engine.search.state import Moved
from ..engine.target import Target, until
from ..orbits.return_map import ReturnMap
from ..orbits.scale import has_implicit
from ..orbits.shooting import one_by_one
from ..systems.structure import Structure
from ..systems.transition import TOGETHER


def flow_along(
    map: ReturnMap,
    turn: tuple[Lanes, Tape],
    carry: tuple[Lanes, Any, Any],
    targets: Target,
) -> tuple[tuple[Lanes, Any, Any], Any] | None:
    """The flow along a cycle from a lane on it to one of the `targets` after the other, all at
    known times or all at states: what `through` returns. None if a target is not reached once in a
    turn, and for implicit methods, whose steps have errors that decay before the turn ends."""
    s, begin, period, late = (
        map.structure,
        carry[0],
        map.expected,
        TOGETHER * map.expected,
    )
    if has_implicit(s):
        return None
    moves, M = recorded_moves(*turn), np.sum(turn[1].code != IDLE)
    before = turn[1].before.transpose(2, 0, 1)[turn[1].code.T != IDLE].T
    # (Targets lie in the first two turns, and what follows them at most at the begin of a third.)
    moves = Moves(*(np.concatenate([x] * 3, axis=-1) for x in moves))
    later = period * np.repeat([0, 1, 2], M)
    moves = moves._replace(
        t=moves.t + later, code=np.where(moves.code < 0, MOVE, moves.code)
    )
    if (places := _places_on(map, moves, before, begin, targets)) is None:
        return None
    # Moves start at the beginning, where recorded moves do, and at targets, which take the place of
    # a recorded start at the same time.
    first, key, time, state = places
    replaced = time - moves.t[key] <= late
    between = np.setdiff1d(np.arange(first[0] + 1, key[-1] + 1), key[replaced])
    keys = np.concatenate([first, between, key])
    times = np.concatenate([begin.t, moves.t[between], time])
    order = np.lexsort((times, keys))
    keys, times, is_target = keys[order], times[order], order > len(between)
    q = np.concatenate([begin.q, moves.q[:, between], state], axis=1)[:, order]
    piece, event = np.cumsum(is_target)[:-1], np.broadcast_to(targets.event, key.shape)
    h, ends_in, new = np.diff(times), moves.code[keys[:-1]], np.diff(keys) > 0
    arrives = is_target[1:] & (event[np.minimum(piece, len(key) - 1)] < 0)
    code = np.where(
        arrives, ARRIVE_TIME if np.isfinite(targets.time[0]) else ARRIVE_LEVEL, ends_in
    )
    # (Where events and sections coincide, a search decides which comes first.)
    if (arrives & new & (ends_in >= 0) | (code >= 0) & (h == 0) | (h < 0)).any():
        return None
    at, chart, none = (
        np.flatnonzero(is_target),
        moves.chart[keys],
        np.zeros(len(key), np.int32),
    )
    fired, count = (
        np.maximum(code[at - 1], -1),
        begin.events + np.cumsum(code >= 0, dtype=np.int32),
    )
    ends = lanes.start_lanes(s, times[at], chart[at], q[:, at])._replace(
        events=count[at - 1]
    )
    watched, u = map.watch(ends, until(ends.t)), np.zeros((s.nu, 1))
    ends = rearm(
        s,
        arm(s, ends, watched, period),
        watched,
        fired,
        none > 0,
        period,
        u,
        none,
        Entry(ends.armed, ends.armed),
    )
    legs = Lanes(
        *(np.append(x, y[..., :-1], axis=-1) for x, y in zip(begin, ends, strict=True))
    )
    before = np.where(code >= 0, before[:, keys[:-1] % M], q[:, 1:])
    rows = h, code, times[1:], before, q[:, 1:], chart[1:], np.zeros(len(h), bool)
    tape = Tape(*(x[None] for x in rows))
    flow = legs, Moved(ends, none, none, none), lanes.regrouped(tape, piece, legs)
    last = Lanes(*(x[..., -1:] for x in ends))
    return (last, *carry[1:]), jax.tree_util.tree_map(one_by_one, flow)


def _places_on(map: ReturnMap, moves: Moves, ends: Any, begin: Lanes, targets: Target):
    """The numbers of the moves in which `begin` lies, and that start at targets, or in which these
    lie, and the times and states (d, K) of the targets, which follow each other. `ends` are those
    of one turn."""
    s, period, late = map.structure, map.expected, TOGETHER * map.expected
    M, K, clock = ends.shape[1], len(targets.time), np.isfinite(targets.time[0])
    event = np.broadcast_to(targets.event, K)
    place = lambda time: np.searchsorted(moves.t, time + late, side="right") - 1  # noqa: E731
    if clock:
        move = place(targets.time)
        h = targets.time - moves.t[move]
    else:
        level = _levels_on(s, Moves(*(x[..., :M] for x in moves)), ends, targets)
        falls = (level[0] > 0) & (level[1] <= 0)
        reached = np.where(event[:, None] < 0, falls, moves.code[:M] == event[:, None])
        if (reached.sum(axis=1) != 1).any():
            return None
        move = np.argmax(reached, axis=1)
        start, end = level[:, np.arange(K), move]
        part = np.where(event < 0, start / (start - end), 1.0)
        h = part * np.diff(moves.t)[move]
    cut, change = np.flatnonzero(event < 0), period
    start = Moves(*(x[..., move[cut]] for x in moves))
    start = start._replace(
        code=np.full(len(cut), ARRIVE_TIME if clock else ARRIVE_LEVEL), lane=cut
    )
    while change > late:  # (Newton's method finds levels.)
        goal = dataclasses.replace(targets, time=moves.t[move] + h)
        end, _ = linear_moves(s, start._replace(h=h[cut]), goal)
        last, change = change, np.abs(end[:, 0] - start.t - h[cut]).max(initial=0.0)
        if not change <= last:
            return None
        h[cut] = end[:, 0] - start.t
    time, turns = moves.t[move] + h, 0
    if not clock:
        turns = np.ceil((begin.t[0] + late - time[0]) / period)
        turns = turns + np.cumsum(np.append(False, time[1:] <= time[:-1] + late))
    time = time + turns * period
    key = np.where(event < 0, place(time), turns * M + move + 1).astype(int)
    state = moves.q[:, key]
    state[:, cut] = end[:, 1:].T
    return place(begin.t), key, time, state


def _levels_on(
    s: Structure, once: Moves, ends: Float[np.ndarray, "d M"], targets: Target
) -> Float[np.ndarray, "2 K M"]:
    """Levels of targets at the starts and the ends of moves; the same where a move follows another
    without an event, so that each crossing lies in one of them."""
    index = np.broadcast_to(targets.index, targets.time.shape)
    point = (
        np.tile(once.t, 2),
        np.tile(once.chart, 2),
        np.concatenate([once.q, ends], axis=1),
    )
    level = levels_at(s, targets.levels, 1 + max(index), *point)[0]
    start, end = np.split(level, 2, axis=1)
    start = np.where(np.roll(once.code, 1) < 0, np.roll(end, 1, axis=1), start)
    return np.stack([start, end])[:, index]


def levels_at(
    s: Structure,
    levels: Any,
    N: int,
    t: Float[np.ndarray, " K"],
    chart: Int[np.ndarray, " K"],
    q: Float[np.ndarray, "d K"],
) -> Float[np.ndarray, "2 N K"]:
    """The levels of N sections at K points of a cycle, and their rates; NaN in charts that have
    none."""
    out = np.full((2, N, len(t)), np.nan)
    for a in np.unique(chart).tolist():
        if levels is not None and levels.present(s, a):
            rows = np.flatnonzero(chart == a)
            both = kernels.levels(s, a, levels, N, t[rows], q[: s.dims[a], rows])
            out[:, :, rows] = both.swapaxes(0, 1)
    return out
