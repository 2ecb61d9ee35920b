"""The flow along a cycle to one section after the other, from a recorded turn on the host.

The moves of the turn are cut where a section lies within them. One search then makes all of them
side by side, in place of one after the other.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from ..engine import kernels
from ..engine.lanes import ARRIVE_LEVEL, ARRIVE_TIME, IDLE, MOVE, Lanes, Tape
from ..engine.replay import Moves, linear_moves, recorded_moves
from ..engine.target import Target
from ..orbits.return_map import ReturnMap
from ..orbits.scale import has_implicit
from ..orbits.shooting import ATOL, follow_moves, one_by_one
from ..systems.structure import Structure
from ..systems.transition import TOGETHER


def flow_along(
    map: ReturnMap, turn: tuple[Lanes, Tape], carry: tuple[Lanes, Any, Any], targets: Target
) -> tuple[tuple[Lanes, Any, Any], Any] | None:
    """The flow along a cycle from a lane on it to one of the `targets` after the other, all at
    known times or all at states: what `through` returns. None if a target is not reached once in a
    turn, if the search makes other moves than the recorded `turn`, and for implicit methods, whose
    steps have errors that decay before the turn ends."""
    if has_implicit(map.structure):
        return None
    begin, period, late = carry[0], map.expected, TOGETHER * map.expected
    once = recorded_moves(*turn)
    once, M = once._replace(code=np.where(once.code < 0, MOVE, once.code)), len(once.t)
    places = _places_on(map, once, turn[1], begin, targets)
    if places is None:
        return None
    # Moves start at the beginning, where recorded moves do, and at targets, which take the place of
    # a recorded start at the same time.
    key, time, state = places
    (first,), at = _place(map, once, begin.t), lambda key: once.t[key % M] + key // M * period
    replaced = time - at(key) <= late
    between = np.setdiff1d(np.arange(first + 1, key[-1] + 1), key[replaced])
    keys = np.concatenate([[first], between, key])
    times = np.concatenate([begin.t, at(between), time])
    order = np.lexsort((times, keys))
    keys, times, is_target = keys[order], times[order], order > len(between)
    q = np.concatenate([begin.q, once.q[:, between % M], state], axis=1)[:, order]
    piece, event = np.cumsum(is_target)[:-1], np.broadcast_to(targets.event, key.shape)
    h, ends_in, new = np.diff(times), once.code[keys[:-1] % M], np.diff(keys) > 0
    arrives = is_target[1:] & (event[np.minimum(piece, len(key) - 1)] < 0)
    code = np.where(arrives, ARRIVE_TIME if np.isfinite(targets.time[0]) else ARRIVE_LEVEL, ends_in)
    # (Where events and sections coincide, the search decides which comes first.)
    if (arrives & new & (ends_in >= 0) | (code >= 0) & (h == 0) | (h < 0)).any():
        return None
    chart = np.append(begin.chart, once.chart[keys[1:-1] % M])
    flow = follow_moves(
        map, begin, targets, Moves(times[:-1], chart, q[:, :-1], h, code, piece, order)
    )
    assert map.settings.rtol is not None
    # (As for a turn of Newton's method.)
    if flow is None or flow[-1] >= ATOL + map.settings.rtol:
        return None
    legs, moved, tape, _ = flow
    end = jax.tree_util.tree_map(lambda x: x[..., -1:], moved.lanes)
    return (end, *carry[1:]), jax.tree_util.tree_map(one_by_one, (legs, moved, tape))


def _place(map: ReturnMap, once: Moves, time: Float[np.ndarray, " K"]) -> Int[np.ndarray, " K"]:
    """Numbers of the moves of a turn in which times lie, those of the second turn after them."""
    t0, period = map.anchor.t[0], map.expected
    turns, since = np.divmod(time - t0 + TOGETHER * period, period)
    return (turns * len(once.t) + np.searchsorted(once.t, t0 + since, side="right") - 1).astype(int)


def _places_on(map: ReturnMap, once: Moves, tape: Tape, begin: Lanes, targets: Target):
    """The numbers of the moves that start at targets, or in which these lie, and the times and
    states (d, K) of the targets, which follow each other."""
    s, period, late = map.structure, map.expected, TOGETHER * map.expected
    M, K, clock = len(once.t), len(targets.time), np.isfinite(targets.time[0])
    event = np.broadcast_to(targets.event, K)
    if clock:
        turns, move = np.divmod(_place(map, once, targets.time), M)
        h = targets.time - turns * period - once.t[move]
    else:
        level = _levels_on(s, once, tape, targets)
        falls = (level[0] > 0) & (level[1] <= 0)
        reached = np.where(event[:, None] < 0, falls, once.code == event[:, None])
        if (reached.sum(axis=1) != 1).any():
            return None
        move = np.argmax(reached, axis=1)
        start, end = level[:, np.arange(K), move]
        part = np.where(event < 0, start / (start - end), 1.0)
        h = part * (np.append(once.t[1:], map.anchor.t[0] + period)[move] - once.t[move])
    cut, change = np.flatnonzero(event < 0), period
    start = Moves(*(x[..., move[cut]] for x in once))
    start = start._replace(code=np.full(len(cut), ARRIVE_TIME if clock else ARRIVE_LEVEL), lane=cut)
    while change > late:  # (Newton's method finds levels.)
        goal = dataclasses.replace(targets, time=once.t[move] + h)
        end, _ = linear_moves(s, start._replace(h=h[cut]), goal)
        last, change = change, np.abs(end[:, 0] - start.t - h[cut]).max(initial=0.0)
        if not change <= last:
            return None
        h[cut] = end[:, 0] - start.t
    time = once.t[move] + h
    if not clock:
        turns = np.ceil((begin.t[0] + late - time[0]) / period)
        turns = turns + np.cumsum(np.append(False, time[1:] <= time[:-1] + late))
    time = time + turns * period
    key = np.where(event < 0, _place(map, once, time), turns * M + move + 1).astype(int)
    state = once.q[:, key % M]
    state[:, cut] = end[:, 1:].T
    return key, time, state


def _levels_on(
    s: Structure, once: Moves, tape: Tape, targets: Target
) -> Float[np.ndarray, "2 K M"]:
    """Levels of targets at the starts and the ends of moves; the same where a move follows another
    without an event, so that each crossing lies in one of them."""
    after = tape.before.transpose(2, 0, 1)[tape.code.T != IDLE].T
    index = np.broadcast_to(targets.index, targets.time.shape)
    if targets.levels is None:
        return np.full((2, len(index), len(once.t)), np.nan)
    N, ends = 1 + max(index), (once.q, after)
    start, end = (levels_at(s, targets.levels, N, once.t, once.chart, q)[0] for q in ends)
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
        if levels.present(s, a):
            rows = np.flatnonzero(chart == a)
            both = kernels.levels(s, a, levels, N, t[rows], q[: s.dims[a], rows])
            out[:, :, rows] = both.swapaxes(0, 1)
    return out
