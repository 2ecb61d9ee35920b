"""The flow along a cycle to one section after the other, from recorded steps, on the host.

`locate.py` calls `flow_along`. The *moves* of the cycle (its recorded steps, with the events at
their ends) are cut where a section lies within them, without another search. In doubt `flow_along`
returns None, and `locate.py` searches: this must stay so. (`_Walk` here is a list of moves, and has
nothing to do with `walk.py`.)

If a section is found in the wrong place, look at `_levels_met` (in which move it lies) and
`_until_settled` (where in the move); if an event after a section is missed or repeated, at
`_ends_at_targets` (armed guards); if there is a search without need, at the cases of None.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

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
    """The flow along a cycle, from a lane on it to the `targets` one after the other, in the form
    that `through` returns. The targets are all at known times, or all depend on the state.

    None if a target is not reached exactly once in a period. None for implicit methods, too: their
    steps have errors that decay only until the end of the period.
    """
    s = map.structure
    begin = carry[0]
    if has_implicit(s):
        return None
    moves, before = _three_turns(map, turn)
    places = _places_on(map, moves, before, begin, targets)
    if places is None:
        return None
    # Moves from target to target, and by what each ends.
    walk = _walk(map, moves, begin, places)
    by_clock = np.isfinite(targets.time[0])
    arrival = ARRIVE_TIME if by_clock else ARRIVE_LEVEL
    event = np.broadcast_to(targets.event, len(places.key))
    last_piece = len(event) - 1
    event_at_end = event[np.minimum(walk.piece, last_piece)]
    arrives = walk.at_target[1:] & (event_at_end < 0)
    move = walk.key[:-1]
    ends_in = moves.code[move]
    h = np.diff(walk.t)
    code = np.where(arrives, arrival, ends_in)
    happens = code >= 0
    # (Where events and sections coincide, a search decides which comes first.)
    at_event = arrives & (np.diff(walk.key) > 0) & (ends_in >= 0)
    at_once = happens & (h == 0)
    if (at_event | at_once | (h < 0)).any():
        return None
    # Lanes at the beginning and the end of each piece.
    chart = moves.chart[walk.key]
    ends = _ends_at_targets(map, walk, chart, code, begin.events)
    begins = []
    for first, others in zip(begin, ends, strict=True):
        begins.append(np.append(first, others[..., :-1], axis=-1))
    pieces = Lanes(*begins)

    # The recorded steps of each piece.
    M = before.shape[1]
    after = walk.q[:, 1:]
    rows = Tape(
        h=h,
        code=code,
        t=walk.t[1:],
        before=np.where(happens, before[:, move % M], after),
        after=after,
        chart=chart[1:],
        at_once=np.zeros(len(h), bool),
        rival=np.full(len(h), -1),
        events=np.cumsum(happens),
    )
    tape = lanes.regrouped(Tape(*(x[None] for x in rows)), walk.piece, pieces)
    none = np.zeros(len(event), np.int32)
    flow = (
        pieces,
        Moved(
            lanes=ends,
            h=none,
            error=none,
            result=none,
        ),
        tape,
    )
    last = Lanes(*(x[..., -1:] for x in ends))
    return (last, *carry[1:]), jax.tree_util.tree_map(one_by_one, flow)


def _three_turns(
    map: ReturnMap, turn: tuple[Lanes, Tape]
) -> tuple[Moves, Float[np.ndarray, "d M"]]:
    """The moves of one period, repeated three times, and the states before the events of one
    period. (Targets lie in the first two periods, and the moves after them at most at the beginning
    of a third.)"""
    starts, tape = turn
    is_move = tape.code.T != IDLE
    before = tape.before.transpose(2, 0, 1)[is_move].T
    once = recorded_moves(starts, tape)
    moves = Moves(*(np.concatenate([x, x, x], axis=-1) for x in once))
    number_of_turn = np.repeat([0, 1, 2], before.shape[1])
    t = moves.t + map.expected * number_of_turn
    code = np.where(moves.code < 0, MOVE, moves.code)
    return moves._replace(t=t, code=code), before


class _Places(NamedTuple):
    """The places of K targets on the recorded moves."""

    first: Int[np.ndarray, "1"]
    """Number of the move in which the flow begins."""
    key: Int[np.ndarray, " K"]
    """For each target, the number of the move that starts at it or contains it."""
    t: Float[np.ndarray, " K"]
    q: Float[np.ndarray, "d K"]


class _Walk(NamedTuple):
    """Starts of the moves of the flow: its beginning, the starts of recorded moves, and the
    targets. (If a recorded move starts at a target, only the target counts.)"""

    key: Int[np.ndarray, " W"]
    """Numbers of the recorded moves."""
    t: Float[np.ndarray, " W"]
    q: Float[np.ndarray, "d W"]
    at_target: Bool[np.ndarray, " W"]

    @property
    def piece(self) -> Int[np.ndarray, " W-1"]:
        """Number of the target to which each move leads."""
        return np.cumsum(self.at_target)[:-1]


def _walk(map: ReturnMap, moves: Moves, begin: Lanes, places: _Places) -> _Walk:
    """The starts of moves from the beginning of the flow to the last target, in order of time."""
    late = places.t - moves.t[places.key]
    is_replaced = late <= TOGETHER * map.expected
    first = places.first[0]
    last = places.key[-1]
    passed = np.arange(first + 1, last + 1)
    between = np.setdiff1d(passed, places.key[is_replaced])
    keys = np.concatenate([places.first, between, places.key])
    times = np.concatenate([begin.t, moves.t[between], places.t])
    of_moves = moves.q[:, between]
    states = np.concatenate([begin.q, of_moves, places.q], axis=1)
    order = np.lexsort((times, keys))
    return _Walk(
        key=keys[order],
        t=times[order],
        q=states[:, order],
        at_target=order > len(between),
    )


def _ends_at_targets(
    map: ReturnMap, walk: _Walk, chart, code, events_before: Int[np.ndarray, "1"]
) -> Lanes:
    """Lanes at the targets, with the transitions that are armed there."""
    s = map.structure
    period = map.expected
    at = np.flatnonzero(walk.at_target)
    fired = np.maximum(code[at - 1], -1)
    count = events_before + np.cumsum(code >= 0, dtype=np.int32)
    states = walk.q[:, at]
    ends = lanes.start_lanes(s, walk.t[at], chart[at], states)
    ends = ends._replace(events=count[at - 1])
    watched = map.watch(ends, until(ends.t))
    armed = arm(s, ends, watched, period)
    return rearm(
        s,
        armed,
        watched,
        fired,
        span=period,
        u=np.zeros((s.nu, 1)),
        residue=np.zeros(len(at), np.int32),
        entry=Entry(ends.armed, ends.armed),
    )


def _places_on(
    map: ReturnMap, moves: Moves, ends: Any, begin: Lanes, targets: Target
) -> _Places | None:
    """The places of the targets, in their order, on the moves of one period, which end at `ends`.
    None if a target is not met exactly once."""
    s = map.structure
    period = map.expected
    late = TOGETHER * period
    M = ends.shape[1]
    K = len(targets.time)
    by_clock = np.isfinite(targets.time[0])
    event = np.broadcast_to(targets.event, K)

    def move_at(time):
        return np.searchsorted(moves.t, time + late, side="right") - 1

    if by_clock:
        move = move_at(targets.time)
        h = targets.time - moves.t[move]
    else:
        once = Moves(*(x[..., :M] for x in moves))
        guessed = _levels_met(s, once, ends, targets, event, np.diff(moves.t))
        if guessed is None:
            return None
        move, h = guessed
    is_inside = np.flatnonzero(event < 0)
    end = _until_settled(s, moves, targets, move, h, is_inside, by_clock, period)
    if end is None:
        return None
    time = moves.t[move] + h
    turns = 0
    if not by_clock:
        since = begin.t[0] + late - time[0]
        turns = np.ceil(since / period)
        comes_again = time[1:] <= time[:-1] + late
        is_next = np.append(False, comes_again)
        turns = turns + np.cumsum(is_next)
    time = time + turns * period
    after_event = turns * M + move + 1
    key = np.where(event < 0, move_at(time), after_event).astype(int)
    state = moves.q[:, key]
    state[:, is_inside] = end[:, 1:].T
    return _Places(
        first=move_at(begin.t),
        key=key,
        t=time,
        q=state,
    )


def _levels_met(s: Structure, once: Moves, ends, targets: Target, event, lengths):
    """For each target, the move in which it lies, and the time from the start of the move to the
    target, to first order; both (K,). None if a target is not met exactly once."""
    K = len(targets.time)
    start, end = _levels_on(s, once, ends, targets)
    falls = (start > 0) & (end <= 0)
    wanted = event[:, None]
    is_reached = np.where(wanted < 0, falls, once.code == wanted)
    times_reached = is_reached.sum(axis=1)
    if (times_reached != 1).any():
        return None
    move = np.argmax(is_reached, axis=1)
    target = np.arange(K)
    start = start[target, move]
    end = end[target, move]
    part = np.where(event < 0, start / (start - end), 1.0)
    return move, part * lengths[move]


def _until_settled(
    s: Structure,
    moves: Moves,
    targets: Target,
    move: Int[np.ndarray, " K"],
    h: Float[np.ndarray, " K"],
    inside: Int[np.ndarray, " C"],
    by_clock: bool,
    period: float,
) -> Float[np.ndarray, "C n"] | None:
    """(t, q) at the targets. Newton's method on the levels changes the time `h` from the start of
    each move to its target. None if it does not converge."""
    start = Moves(*(x[..., move[inside]] for x in moves))
    arrival = ARRIVE_TIME if by_clock else ARRIVE_LEVEL
    start = start._replace(code=np.full(len(inside), arrival), lane=inside)
    change = period
    while True:
        goal = dataclasses.replace(targets, time=moves.t[move] + h)
        end, _ = linear_moves(s, start._replace(h=h[inside]), goal)
        last = change
        duration = end[:, 0] - start.t
        change_of_each = np.abs(duration - h[inside])
        change = change_of_each.max(initial=0.0)
        if not change <= last:
            return None
        h[inside] = end[:, 0] - start.t
        if change <= TOGETHER * period:
            return end


def _levels_on(
    s: Structure, once: Moves, ends: Float[np.ndarray, "d M"], targets: Target
) -> Float[np.ndarray, "2 K M"]:
    """Levels of targets at the starts and the ends of moves. If no event lies between two moves,
    the end of one and the start of the next have the same number, so that each crossing lies in
    exactly one move."""
    index = np.broadcast_to(targets.index, targets.time.shape)
    point = (
        np.tile(once.t, 2),
        np.tile(once.chart, 2),
        np.concatenate([once.q, ends], axis=1),
    )
    level = levels_at(s, targets.levels, 1 + max(index), *point)[0]
    start, end = np.split(level, 2, axis=1)
    end_of_last = np.roll(end, 1, axis=1)
    no_event = np.roll(once.code, 1) < 0
    start = np.where(no_event, end_of_last, start)
    return np.stack([start, end])[:, index]


def levels_at(
    s: Structure,
    levels: Any,
    N: int,
    t: Float[np.ndarray, " K"],
    chart: Int[np.ndarray, " K"],
    q: Float[np.ndarray, "d K"],
) -> Float[np.ndarray, "2 N K"]:
    """The levels of N sections at K points of a cycle, and their rates; NaN in charts without
    levels."""
    out = np.full((2, N, len(t)), np.nan)
    for a in np.unique(chart).tolist():
        if levels is not None and levels.present(s, a):
            rows = np.flatnonzero(chart == a)
            q_of_chart = q[: s.dims[a], rows]
            both = kernels.levels(s, a, levels, N, t[rows], q_of_chart)
            out[:, :, rows] = both.swapaxes(0, 1)
    return out
