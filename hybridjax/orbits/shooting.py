"""Newton's method on the starts of all moves of a turn at once, on the host.

A *turn* is the flow from the section back to it, and a *move* is a step of it with the event at its
end. The turn is cut into *pieces*, and the search records its moves on a *tape*. A guard is *armed*
if its next fall through zero is an event. *Sizes* are magnitudes of states.

If a nearby turn was recorded, all its moves are computed side by side from other starts:
`fixed_point` changes the starts until the moves join to a cycle; `travel` then makes each move by
the search, to see that it is still right (its result must keep the form of `ReturnMap.travel`).
This needs few calls of compiled functions, instead of one call for every step. (Multiple shooting:
H. G. Bock and K. J. Plitt, IFAC Proceedings 17, 1984.)

A wrong Newton step comes from `_changes`. If a turn is refused without need, there are three
places: `_forwards` (a move would have a negative duration), `_searched` (a move fails, or ends in
another chart or with other armed guards than the next one begins), and `travel` (gaps between
moves). `newton.py`, `curve.py` and `batches.py` call this file, and so do sections that follow
recorded moves.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from .._core.results import Result
from ..engine.events import arm, belongs
from ..engine.lanes import ARRIVE_TIME, MOVE, Lanes, Tape, regrouped, start_lanes
from ..engine.move import Options, move, stride
from ..engine.replay import Moves, linear_moves, recorded_moves
from ..engine.search.attempt import deviation
from ..engine.search.state import Stride
from ..engine.target import Target, until
from .return_map import CLOSED, PIECES, SINGULAR, Return, ReturnMap
from .scale import has_implicit, in_sizes


# Newton's method ends with a step below `ATOL` (in sizes, the magnitudes of the states) plus `RTOL`
# times the state. Larger: it ends one step too early. Smaller: rounding keeps it from ending.
ATOL = 1e-12
RTOL = 1e-11


def newton_steps(
    jacobian: Float[np.ndarray, "S n n"],
    residual: Float[np.ndarray, "S n"],
    rcond: float = SINGULAR,
) -> Float[np.ndarray, "S n"]:
    """Newton steps of S systems of equations, on the host. For a singular system, the step of least
    norm; for a system that is not finite, NaN."""
    step = np.full(residual.shape, np.nan)
    good = np.isfinite(residual).all(axis=1)
    good = good & np.isfinite(jacobian).all(axis=(1, 2))
    inverse = np.linalg.pinv(jacobian[good], rcond=rcond)
    step[good] = -np.matvec(inverse, residual[good])
    return step


def excess(
    q: Float[np.ndarray, "S d"], step: Float[np.ndarray, "S d"]
) -> Float[np.ndarray, " S"]:
    """The largest entry of each step relative to the tolerance of Newton's method. All in sizes."""
    tolerance = ATOL + RTOL * np.abs(q)
    return np.max(np.abs(step) / tolerance, axis=1)


def fixed_point(
    map: ReturnMap, turn: tuple[Lanes, Tape], otherwise: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, " d"], Moves | None]:
    """The state, in sizes, from which a turn with the recorded moves returns to itself, and the
    moves from there. If Newton's steps do not halve each time, or a move would have a negative
    duration: `otherwise`, and None.

    **Arguments:** `turn`: the pieces of a turn and their tapes, side by side.

    Guards are not evaluated here: `travel` tests whether the moves are still right.
    """
    sizes = map.sizes
    target = map.ends()
    moves = recorded_moves(*turn)
    x = moves.q[:, 0] / sizes
    before = np.inf
    # (A piece without a move cannot be shifted.)
    if (moves.order == 0).sum() != PIECES:
        return otherwise, None
    while True:
        step, shift, h = _shift(map, moves, x, target)
        moved = shift[:, 1:]
        relative = moved / map.scale[moves.chart]
        length = np.max(np.abs(relative))
        if not length <= 0.5 * before:
            return otherwise, None
        x = x + step
        t = moves.t + shift[:, 0]
        q = moves.q + moved.T
        moves = moves._replace(t=t, q=q, h=h)
        # (Newton's method converges quadratically: after a step as short as this, the error is
        # about its square, and no further step is needed.)
        rtol = np.asarray(map.settings.rtol)
        if length <= np.maximum(CLOSED, rtol):
            return x, _forwards(moves)
        before = length


def _shift(
    map: ReturnMap, moves: Moves, x: Float[np.ndarray, " d"], target: Target
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "M n"], Float[np.ndarray, " M"]]:
    """One Newton step so that the gaps between moves close: the changes of the state at the anchor
    (in sizes), and of (t, q) at the starts of moves; and the lengths of moves after it."""
    n = 1 + len(x)
    end, by = linear_moves(map.structure, moves, target)
    by_point = by[:, :, :n]
    starts = np.concatenate([moves.t[None], moves.q]).T
    # (After the last move there is no start: its whole end is wanted.)
    between = end[:-1] - starts[1:]
    gaps = np.concatenate([between, end[-1:]])
    late = map.anchor.t[0] - starts[0, 0]
    changes = _changes(by_point, gaps, late)
    step = _step_of(map, x, changes[-1, 1:])
    moved = np.append(step * map.sizes, 1.0)
    shift = changes[:-1] @ moved

    end_after = end + np.matvec(by_point, shift)
    duration = end_after[:, 0] - starts[:, 0]
    h = duration - shift[:, 0]
    return step, shift, h


def _changes(
    by: Float[np.ndarray, "M n n"], gaps: Float[np.ndarray, "M n"], late: float
) -> Float[np.ndarray, "1+M n n"]:
    r"""Changes of (t, q) at the starts of moves, and at the end of the last move.

    The first columns C are derivatives by the state at the first start. The last column c is the
    change that closes all gaps; `late` is the gap in time at the first start. With the derivative
    $B_k$ of move k and the gap $g_k$ after it, $C_{k+1} = B_k C_k$ and $c_{k+1} = B_k c_k + g_k$.
    """
    n = by.shape[1]
    change = np.eye(n, k=-1)
    change[0, -1] = late
    changes = [change]
    for of_move, gap in zip(by, gaps, strict=True):
        change = of_move @ change
        change[:, -1] += gap
        changes.append(change)
    return np.stack(changes)


def _step_of(
    map: ReturnMap, x: Float[np.ndarray, " d"], end: Float[np.ndarray, "d n"]
) -> Float[np.ndarray, " d"]:
    """The Newton step, in sizes of the states, by the changes of the state at the end of a turn
    (see `_changes`)."""
    sizes = map.sizes
    q = x * sizes
    off, held = map.held(q)
    last = end[:, -1]
    returned = np.where(map.valid, last, 0.0)
    valid = map.valid[:, None]
    by_start = np.where(valid, end[:, :-1], 0.0)
    residual = returned - q - off
    jacobian = by_start - np.eye(len(x)) - held
    scaled = in_sizes(jacobian, sizes)
    (step,) = newton_steps(scaled[None], (residual / sizes)[None])
    return step


def _forwards(moves: Moves) -> Moves | None:
    """The moves, without any of negative duration.

    If a move would end before it starts, it is joined with the move before it. None if the move
    before ends with an event or belongs to another piece.
    """
    back = np.flatnonzero(moves.h < 0)
    is_first = moves.order[back] == 0
    follows_event = moves.code[back - 1] != MOVE
    if is_first.any() or follows_event.any():
        return None
    h = moves.h.copy()
    code = moves.code.copy()
    h[back - 1] += h[back]
    code[back - 1] = code[back]
    kept = moves.h >= 0
    changed = moves._replace(h=h, code=code)
    moves = Moves(*(x[..., kept] for x in changed))
    return moves if (moves.h >= 0).all() else None


def travel(map: ReturnMap, q: Float[np.ndarray, " d"], expected: Moves) -> tuple | None:
    """A turn, in the form of `ReturnMap.travel`, and the largest gap between its moves in sizes of
    the states. None if a search makes other moves than expected."""
    followed = follow_moves(map, map.departure(q), map.ends(), expected)
    if followed is None:
        return None
    pieces, moved, tape, gap = followed
    if gap > CLOSED:
        return None
    end = jax.tree_util.tree_map(lambda x: x[..., -1:], moved.lanes)
    returned = np.where(map.valid, end.q[:, 0], 0.0)
    off, _ = map.held(q)
    residual = returned - q - off
    same_chart = end.chart == map.anchor.chart
    residual = np.where(same_chart, residual, np.nan)
    turn = Return(
        residual=residual,
        period=end.t[0] - map.anchor.t[0],
        result=np.asarray(moved.result[-1]),
        end=end,
    )
    path = jax.tree_util.tree_map(one_by_one, (pieces, None, tape))
    return turn, path, gap


def one_by_one(x: np.ndarray) -> np.ndarray:
    """Arrays (..., pieces) as the pieces of one lane: (pieces, ..., 1)."""
    return np.moveaxis(x, -1, 0)[..., None]


def follow_moves(
    map: ReturnMap, begin: Lanes, ends: Target, expected: Moves
) -> tuple | None:
    """The flow to the `ends` one after the other, if its moves are known up to rounding: all moves
    are computed side by side by one search. None if a move does not end as the next one begins.

    **Arguments:** `expected`: the moves; their `lane` is the number of the piece.

    **Returns:** for each piece the lane before, the lane at the end, and the tape; and the largest
    gap between moves in sizes of the states.
    """
    moves = expected
    lanes = _starts(map, begin, moves)
    targets = _targets(moves, ends)
    followed = _searched(map, lanes, moves, targets, ends)
    if followed is None:
        return None
    lanes, moved, tape = followed
    gap = _largest_gap(map, begin, lanes, moved.lanes)
    first = np.flatnonzero(np.diff(moves.lane, prepend=-1))
    after_last = np.append(first[1:], len(moves.lane))
    last = after_last - 1
    pieces = jax.tree_util.tree_map(lambda x: x[..., first], lanes)
    moved = jax.tree_util.tree_map(lambda x: x[..., last], moved)
    # (Here each move is a lane of its own, which ends at a known time.)
    on_the_way = (tape.code == ARRIVE_TIME) & (moves.code == MOVE)
    tape = tape._replace(code=np.where(on_the_way, MOVE, tape.code))
    return pieces, moved, regrouped(tape, moves.lane, pieces), gap


def _starts(map: ReturnMap, begin: Lanes, moves: Moves) -> Lanes:
    """Lanes at the starts of moves. The first one is the beginning of the turn."""
    s = map.structure
    charts = moves.chart.astype(np.int32)
    lanes = start_lanes(s, moves.t, charts, moves.q)
    watched = map.watch(lanes, until(lanes.t))
    lanes = arm(s, lanes, watched, map.expected)
    lanes.armed[:, :1] = begin.armed
    happens = moves.code >= 0
    events_until = np.cumsum(happens, dtype=np.int32)
    return lanes._replace(events=begin.events + events_until - happens)


def _targets(moves: Moves, ends: Target) -> Target:
    """The targets of moves: the time at which the next move starts, or the end of a piece."""
    code = moves.code
    piece = moves.lane
    next_start = np.append(moves.t[1:], np.inf)
    time = np.where(code == MOVE, next_start, np.inf)
    time = np.where(code == ARRIVE_TIME, ends.time[piece], time)
    after_time = np.nextafter(time, np.inf)
    late = moves.t + 2 * moves.h
    shape = ends.time.shape
    index = np.broadcast_to(ends.index, shape)[piece]
    event_at_end = np.broadcast_to(ends.event, shape)[piece]
    event = np.where(code >= 0, code, event_at_end)
    return dataclasses.replace(
        ends,
        time=time,
        index=index,
        event=event.astype(np.int32),
        limit=np.where(np.isfinite(time), after_time, late),
    )


def _searched(
    map: ReturnMap, lanes: Lanes, moves: Moves, target: Target, ends: Target
) -> tuple[Lanes, Any, Tape] | None:
    """The lanes at the starts of moves, whose armed guards are corrected in place; the lanes at the
    ends; and the tape. None if a move fails, or does not end as the next one begins."""
    s = map.structure
    first_steps = _first_steps(map, lanes, moves, target, ends)
    u = np.zeros((s.nu, len(moves.code)))
    options = Options(True, new_input=False, tangents=True)
    here = belongs(s, lanes.chart)[:-1, 1:]
    # (Twice: the first search tells which guards are armed at the start of each move.)
    for _ in range(2):
        moved, tape = move(
            s, lanes, u, target, map.settings, first_steps, None, options
        )
        end = moved.lanes
        before = end.armed[:, :-1]
        after = lanes.armed[:, 1:]
        same = before == after
        armed = same[here].all()
        if armed:
            break
        lanes.armed[:, 1:] = end.armed[:, :-1]
    same_chart = end.chart[:-1] == lanes.chart[1:]
    in_chart = same_chart.all()
    same_events = end.events[:-1] == lanes.events[1:]
    in_order = same_events.all()
    ok = (moved.result == Result.OK).all()
    if not (armed and in_chart and in_order and ok):
        return None
    assert tape is not None
    return lanes, moved, tape


def _first_steps(
    map: ReturnMap, lanes: Lanes, moves: Moves, target: Target, ends: Target
) -> Stride:
    """The first steps of moves. They are longer than the moves: otherwise rounding might divide a
    move in two, and a crossing must lie within the step."""
    to_time = np.where(moves.h > 0, 2 * moves.h, map.expected)
    is_to_time = np.isfinite(target.time)
    h = np.where(is_to_time, to_time, 1.01 * moves.h)
    steps = stride(h)._replace(lead=0 * h)
    s = map.structure
    if not has_implicit(s):
        return steps
    # (Implicit methods estimate errors along a deviation of the state, which each move carries on
    # from the move before, unless a piece or an event ended in between.)
    along = deviation(s, lanes, map.settings)
    _, by = linear_moves(s, moves, ends)
    by_state = by[:, 1:, 1 : 1 + s.d]
    same_lane = np.diff(moves.lane) == 0
    no_event = moves.code[:-1] < 0
    goes_on = same_lane & no_event
    for k in np.flatnonzero(goes_on):
        carried = by_state[k] @ along[:, k]
        along[:, k + 1] = carried
    return steps._replace(along=along)


def _largest_gap(map: ReturnMap, begin: Lanes, lanes: Lanes, end: Lanes) -> float:
    """The largest gap between the end of a move and the start of the next one, in sizes of the
    states and in periods."""
    times = np.append(begin.t, end.t[:-1])
    states = np.column_stack([begin.q, end.q[:, :-1]])
    magnitude = np.abs(lanes.q.T)
    sizes = np.maximum(map.scale[lanes.chart], magnitude)
    late = (times - lanes.t) / map.expected
    apart = (states - lanes.q).T / sizes
    return max(np.abs(late).max(), np.abs(apart).max())
