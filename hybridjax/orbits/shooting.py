"""Newton's method on the starts of all moves (steps and events) of a turn, on the host.

Near a turn that was recorded, all moves of the next one are computed side by side: first without
decisions (`fixed_point`), then as the search would make them (`travel`). This takes a few calls of
the kernels instead of one after the other for every step. (Multiple shooting: H. G. Bock and K. J.
Plitt, IFAC Proceedings 17, 1984.)
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from .._core.results import Result
from ..engine.events import arm, belongs
from ..engine.lanes import ARRIVE_TIME, MOVE, Lanes, Tape, regrouped, start_lanes
from ..engine.move import Options, move, stride
from ..engine.replay import Moves, linear_moves, recorded_moves
from ..engine.search.attempt import deviation
from ..engine.target import Target, until
from .return_map import CLOSED, LEGS, SINGULAR, Return, ReturnMap
from .scale import has_implicit


# Newton's method ends with a step below this, in sizes of the states and relative to the state.
# Larger: it ends one step too early. Smaller: rounding keeps it from ending.
ATOL, RTOL = 1e-12, 1e-11


def newton_steps(
    jacobian: Float[np.ndarray, "S n n"],
    residual: Float[np.ndarray, "S n"],
    rcond: float = SINGULAR,
) -> Float[np.ndarray, "S n"]:
    """Newton steps of S systems of equations, on the host: the shortest ones for singular systems,
    NaN for systems that are not finite."""
    step = np.full(residual.shape, np.nan)
    good = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    step[good] = -(
        np.linalg.pinv(jacobian[good], rcond=rcond) @ residual[good, :, None]
    )[..., 0]
    return step


def excess(
    q: Float[np.ndarray, "S d"], step: Float[np.ndarray, "S d"]
) -> Float[np.ndarray, " S"]:
    """The largest part of each step relative to the tolerance of `solve`, all in sizes."""
    return np.max(np.abs(step) / (ATOL + RTOL * np.abs(q)), axis=1)


def fixed_point(
    map: ReturnMap, turn: tuple[Lanes, Tape], otherwise: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, " d"], Moves | None]:
    """The state, in sizes, from which a turn with the recorded moves returns to itself, and these
    moves, if all last forwards; `otherwise` and no moves, if steps do not halve each time.

    **Arguments:** `turn`: the pieces of a turn and their tapes, side by side.

    Guards are not watched here: `travel` tests whether the moves are still right.
    """
    sizes, target = map.sizes, map.ends()
    moves, last = recorded_moves(*turn), np.inf
    x = moves.q[:, 0] / sizes
    while True:
        end, by = linear_moves(map.structure, moves, target)
        by = by[:, :, : 1 + len(x)]  # by (t, q)
        starts = np.concatenate([moves.t[None], moves.q]).T
        gaps = np.concatenate([end[:-1] - starts[1:], end[-1:]])
        changes = _changes(by, gaps, map.anchor.t[0] - starts[0, 0])
        step = _step_of(map, x, changes[-1, 1:])
        shift = changes[:-1] @ np.append(step * sizes, 1.0)
        ends_moved = end + (by @ shift[:, :, None])[:, :, 0]
        h = (ends_moved - starts - shift)[:, 0]
        length = np.max(np.abs(shift[:, 1:] / map.scale[moves.chart]))
        whole = (moves.order == 0).sum() == LEGS
        if not (length <= 0.5 * last and whole):
            return otherwise, None
        x, last, starts = x + step, length, starts + shift
        moves = moves._replace(t=starts[:, 0], q=starts[:, 1:].T, h=h)
        # (The error after a step is about its square.)
        if length <= np.maximum(CLOSED, np.asarray(map.settings.rtol)):
            return x, _forwards(moves)


def _changes(
    by: Float[np.ndarray, "M n n"], gaps: Float[np.ndarray, "M n"], late: float
) -> Float[np.ndarray, "1+M n n"]:
    """Changes of (t, q) where moves start, and at the last end, by the state at the first start,
    and in the last column by the gaps between moves. The first one is `late`."""
    n = by.shape[1]
    changes = [np.eye(n, k=-1)]
    changes[0][0, -1] = late
    for of_move, gap in zip(by, gaps, strict=True):
        change = of_move @ changes[-1]
        change[:, -1] += gap
        changes.append(change)
    return np.stack(changes)


def _step_of(
    map: ReturnMap, x: Float[np.ndarray, " d"], end: Float[np.ndarray, "d n"]
) -> Float[np.ndarray, " d"]:
    """The Newton step, in sizes of the states, by the changes of the state at the end of a turn
    (see `_changes`)."""
    sizes = map.sizes
    off, held = map.held(x * sizes)
    residual = np.where(map.valid, end[:, -1], 0.0) - x * sizes - off
    returned = np.where(map.valid[:, None], end[:, :-1], 0.0)
    jacobian = (returned - np.eye(len(x)) - held) * sizes / sizes[:, None]
    (step,) = newton_steps(jacobian[None], (residual / sizes)[None])
    return step


def _forwards(moves: Moves) -> Moves | None:
    """The moves without those that end before they start, in whose places the moves before them
    end; None where an event or another piece comes before."""
    back = np.flatnonzero(moves.h < 0)
    if (moves.order[back] == 0).any() or (moves.code[back - 1] != MOVE).any():
        return None
    h, code = moves.h.copy(), moves.code.copy()
    h[back - 1], code[back - 1] = h[back - 1] + h[back], code[back]
    kept = moves.h >= 0
    moves = Moves(*(x[..., kept] for x in moves._replace(h=h, code=code)))
    return moves if (moves.h >= 0).all() else None


def travel(map: ReturnMap, q: Float[np.ndarray, " d"], expected: Moves) -> tuple | None:
    """A turn, as by `ReturnMap.travel`, and the largest gap between its moves, in sizes of the
    states; None if it has other moves than expected."""
    pieces = follow_moves(map, map.departure(q), map.ends(), expected)
    if pieces is None or pieces[-1] > CLOSED:
        return None
    legs, moved, tape, gap = pieces
    end = jax.tree_util.tree_map(lambda x: x[..., -1:], moved.lanes)
    residual = np.where(map.valid, end.q[:, 0], 0.0) - q - map.held(q)[0]
    residual = np.where(end.chart == map.anchor.chart, residual, np.nan)
    period = end.t[0] - map.anchor.t[0]
    turn = Return(residual, period, np.asarray(moved.result[-1]), end)
    return turn, jax.tree_util.tree_map(one_by_one, (legs, None, tape)), gap


def one_by_one(x: np.ndarray) -> np.ndarray:
    """Lanes as pieces of the flow of one (as `engine.lanes.side_by_side` takes them)."""
    return np.moveaxis(x, -1, 0)[..., None]


def follow_moves(
    map: ReturnMap, begin: Lanes, ends: Target, expected: Moves
) -> tuple | None:
    """The flow to one of the `ends` after the other, where its moves are known but for rounding:
    each is a lane of one search. None if one does not end as the next one begins.

    **Arguments:** `expected`: moves whose `lane` is the piece.

    **Returns:** by piece the lanes before, their ends, and the tape; and the largest gap between
    moves, in sizes of the states.
    """
    s, moves, settings = map.structure, expected, map.settings
    code, piece, later = moves.code, moves.lane, np.append(moves.t[1:], np.inf)
    time = np.where(
        code == ARRIVE_TIME, ends.time[piece], np.where(code == MOVE, later, np.inf)
    )
    timed = np.isfinite(time)
    index, event = (
        np.broadcast_to(x, ends.time.shape)[piece] for x in (ends.index, ends.event)
    )
    target = dataclasses.replace(
        ends,
        time=time,
        index=index,
        event=np.where(code >= 0, code, event).astype(np.int32),
        limit=np.where(timed, np.nextafter(time, np.inf), moves.t + 2 * moves.h),
    )
    lanes = start_lanes(s, moves.t, moves.chart.astype(np.int32), moves.q)
    lanes = arm(s, lanes, map.watch(lanes, until(lanes.t)), map.expected)
    lanes = lanes._replace(
        events=begin.events + np.cumsum(code >= 0, dtype=np.int32) - (code >= 0)
    )
    lanes.armed[:, :1] = begin.armed
    # (Longer ones: rounding may divide those to a known time; a crossing is met within a step.)
    h = np.where(
        timed, np.where(moves.h > 0, 2 * moves.h, map.expected), 1.01 * moves.h
    )
    setout = stride(h)._replace(lead=0 * h)
    if has_implicit(s):  # (a deviation goes on until a piece ends or an event happens)
        along, (_, by) = deviation(s, lanes, settings), linear_moves(s, moves, ends)
        for k in np.flatnonzero((np.diff(piece) == 0) & (code[:-1] < 0)):
            along[:, k + 1] = by[k, 1:, 1 : 1 + s.d] @ along[:, k]
        setout = setout._replace(along=along)
    u, options = (
        np.zeros((s.nu, len(code))),
        Options(True, new_input=False, tangents=True),
    )
    for _ in range(2):
        moved, tape = move(s, lanes, u, target, settings, setout, None, options)
        end, in_chart = moved.lanes, belongs(s, lanes.chart)[:-1, 1:]
        if same := (end.armed[:, :-1] == lanes.armed[:, 1:])[in_chart].all():
            break
        lanes.armed[:, 1:] = end.armed[:, :-1]
    pairs = (end.chart, lanes.chart), (end.events, lanes.events)
    same = same and all((ended[:-1] == begun[1:]).all() for ended, begun in pairs)
    late = np.append(begin.t, end.t[:-1]) - lanes.t
    apart = np.column_stack([begin.q, end.q[:, :-1]]) - lanes.q
    sizes = np.maximum(map.scale[lanes.chart], np.abs(lanes.q.T))
    gap = max(np.abs(late / map.expected).max(), np.abs(apart.T / sizes).max())
    if not (same and (moved.result == Result.OK).all()):
        return None
    assert tape is not None
    first = np.flatnonzero(np.diff(piece, prepend=-1))
    last = np.append(first[1:], len(piece)) - 1
    legs = jax.tree_util.tree_map(lambda x: x[..., first], lanes)
    moved = jax.tree_util.tree_map(lambda x: x[..., last], moved)
    on_the_way = (tape.code == ARRIVE_TIME) & (code == MOVE)
    tape = regrouped(
        tape._replace(code=np.where(on_the_way, MOVE, tape.code)), piece, legs
    )
    return legs, moved, tape, gap
