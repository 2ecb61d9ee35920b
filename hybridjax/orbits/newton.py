"""Newton's method on the return map, and further attempts if it fails.

`find.py` calls `search`, with a return map whose anchor is the initial state, and gets a
`Solution`. A *turn* is one application of the return map: the flow from the section back to it,
which consists of *moves* (steps with the events at their ends). Steps are taken, and convergence is
tested, in *sizes* of the states (their magnitudes, `scale.py`). `search` lists the attempts: a
further kind of attempt, such as a restart from a random state, is added there. On the host,
`_root_on_host` has the iteration; inside of programs of JAX, `_root`. Both must keep the same
tolerances (`ATOL`, `RTOL`). Derivatives of the result are implicit (`_root_jvp`, `_solve_along`).

If a search fails without need, look at the attempts in turn; if its result depends on the executor,
compare the two iterations. If a derivative is wrong, look at `_solve_along`, and inside of programs
at `_root_jvp`.
"""

import dataclasses
import functools as ft
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import on_the_host
from .._core.executor import Array, on_host
from .._core.host_derivatives import NotOnHostError, by_columns
from .._core.progress import say
from .._core.results import Result
from ..engine import kernels
from ..engine.lanes import IDLE, Lanes, side_by_side
from ..engine.replay import Moves, Variation
from ..engine.settings import TRANSIENT, Settings
from ..engine.watch import slopes
from .crossing import ListLevels
from .return_map import CLOSED, SINGULAR, Return, ReturnMap, Turn, across
from .scale import in_sizes
from .shooting import (
    ATOL,
    RTOL,
    excess,
    fixed_point,
    follow_moves,
    newton_steps,
    travel,
)


# Newton steps that a good guess needs. With fewer steps, a continuation takes longer steps along
# the branch; systems of a sweep that need more wait for the others. More: a continuation steps too
# far, and calls of a sweep run for few of their systems. Fewer: steps stay short, and most systems
# wait.
USUAL_STEPS = 3
# Steps before a point of a branch, or a system of a sweep, is given up. Fewer: cycles far from the
# guess are lost. More: searches where there is no cycle take longer.
FEW_STEPS = 8
# Steps before a cycle is given up. Fewer: cycles far from the guess are lost. More: hopeless
# searches last longer.
MAX_STEPS = 32
# The search ends after this many Levenberg-Marquardt steps in which the residual falls by less than
# a tenth. Fewer: slow searches are given up. More: searches where there is no cycle last longer.
STALLED = 10
# Total number of steps of the flow after which Levenberg-Marquardt iterations end. Fewer: cycles
# with long turns are lost. More: vain searches among fast oscillations last for minutes.
_WORK = 40_000
# Levenberg-Marquardt iterations use rough turns (of low accuracy) until the residual, in sizes, is
# below this. Larger: accurate turns, which are four times as expensive, are computed where there is
# no cycle. Smaller: errors of rough turns keep the residual from falling.
_ROUGH = 1e-3


class Solution(NamedTuple):
    """The end of Newton's method."""

    anchor: Lanes
    """The lane at the beginning of the last turn."""
    turn: Turn
    """The last turn."""
    steps: Int[Array, ""]
    result: Int[Array, ""]
    """`Result` code: whether this is a cycle."""

    @property
    def is_fixed_point(self) -> bool:
        """True if the turn closes, on an isolated cycle or on one of a family."""
        return int(self.result) in (Result.OK, Result.SINGULAR)


def search(map: ReturnMap, patient: bool = False, near: Any = None) -> Solution:
    """Newton's method from the anchor's state. If it fails, it is repeated with another period,
    then with Levenberg-Marquardt steps. If `patient`, it ends when a turn reaches the limit on
    steps. `near`: see `solve`."""
    say("Newton's method")
    solution = solve(map, False, True, near)
    if int(solution.result) == Result.EXTRA_TURNS:
        turn = solution.turn
        expected = turn.period * map.multiplicity / turn.meetings
        solution = solve(
            dataclasses.replace(map, anchor=solution.anchor, expected=expected)
        )
    code = int(solution.result)
    strays = code == Result.STEP_LIMIT and _ends(map)
    final = code == Result.STEP_LIMIT and patient and not strays
    if not solution.is_fixed_point and code != Result.EQUILIBRIUM and not final:
        # Newton's method may have left the domain of the return map.
        say("Levenberg-Marquardt steps")
        second = _solve_damped(map)
        better = strays or int(second.result) == Result.OK
        solution = second if better else solution
    return solution


def _ends(map: ReturnMap) -> bool:
    """Test whether the turn from the anchor's state ends within the limit on steps. If it does, a
    search that reaches the limit has moved too far from the anchor."""
    return int(_first_turn(map).result) == Result.OK


@on_the_host
def _first_turn(map: ReturnMap) -> Return:
    return map.turn(map.anchor.q[:, 0])


def _solve(map: ReturnMap, once_more: bool, _: bool, near: Any) -> Solution:
    """See `solve`. (The argument without a name is `factors`, which only derivatives use.)"""
    q, turn, steps = root(map, MAX_STEPS, near)
    if (
        on_host(q) or not once_more
    ):  # (the last turn on the host begins at q up to rounding)
        result = map.judge(q, turn)
    else:
        begin = turn.pieces.q[:, 0]
        turn = map.turn_with_jacobian(q, record=turn.record)
        result = map.judge(q, turn)
        # (Far from its recorded beginning, a turn has other events than its record.)
        apart = jnp.abs(q - begin) / map.sizes
        is_near = jnp.max(apart) <= CLOSED
        is_fixed = (result == Result.OK) | (result == Result.SINGULAR)
        strays = is_fixed & ~is_near
        result = jnp.where(strays, jnp.int32(Result.NOT_CONVERGED), result)
    return Solution(map.departure(q), turn._replace(record=None), steps, result)


def _solve_along(arguments: tuple, directions: tuple) -> tuple[Solution, Solution]:
    """`solve` on the host, with derivatives: first of the state, by the implicit function theorem,
    then of the recorded turn."""
    map, _, factors, _ = arguments
    by, *_ = directions
    solution = _solve(*arguments)
    turn = solution.turn
    ends = map.ends()
    sizes = map.sizes
    if map.conserved or not solution.is_fixed_point:
        raise NotOnHostError
    # How the beginning and the ends of pieces move in P directions.
    P = len(jax.tree_util.tree_leaves(by)[0])
    levels = None if ends.levels is None else ListLevels((by.base,))
    s = kernels.Tangents(map.structure, by.structure, ends.levels, levels, P)
    begin = np.zeros((1 + len(sizes), P))
    if by.anchor.t is not None:
        begin[0] = by.anchor.t[:, 0]
    longer = np.zeros(P) if by.expected is None else by.expected
    along = begin[0][:, None] + np.outer(
        longer, (ends.time - map.anchor.t) / map.expected
    )
    times = np.where(np.isfinite(ends.time), along, 0.0)
    tape = side_by_side(turn.tapes)
    orbit = Variation(s, turn.pieces, ends, tape, times, factors)
    # 0 = P(q, p) - q moves q by -(J - I)^-1 dP/dp.
    end = orbit.tangents(begin)[-1, 1:].T
    moved = np.where(map.valid, end, 0.0) / sizes
    jacobian = in_sizes(turn.jacobian, sizes)
    each = np.tile(jacobian, (P, 1, 1))
    begin[1:] = (newton_steps(each, moved) * sizes).T
    tangents = orbit.tangents(begin)
    # From the moved state: the period, and with `factors`, the pieces and their Jacobians.
    nothing = jax.tree_util.tree_map(lambda _: None, solution)
    longer_period = tangents[-1, 0] - begin[0]
    moving = nothing.turn._replace(period=longer_period)
    if factors:
        pieces = turn.pieces
        by_all = orbit.jacobians(tangents)
        by_factor = by_all[..., 1:, 1 : 1 + len(sizes)]
        if map.base is not None:
            f = slopes(s, *orbit.points(tangents, orbit.first)).T.reshape(
                *by_factor.shape[:3]
            )
            sizes_of_charts = map.scale[pieces.chart][:, None]
            by_factor = across(f, sizes_of_charts, by_factor)
        t_pieces = np.moveaxis(tangents[orbit.first], 0, -1)
        moving = moving._replace(
            pieces=moving.pieces._replace(
                t=t_pieces[0], q=np.moveaxis(t_pieces[1:], 1, 0)
            ),
            factors=np.moveaxis(by_factor.imag / kernels.TINY, 1, 0),
        )
    t_anchor = None
    if by.anchor.t is not None:
        t_anchor = begin[0][:, None]
    q = begin[1:].T[..., None]
    anchor = nothing.anchor._replace(t=t_anchor, q=q)
    return solution, nothing._replace(anchor=anchor, turn=moving)


@ft.partial(on_the_host, derived=ft.partial(by_columns, along=_solve_along))
def solve(
    map: ReturnMap, once_more: bool = False, factors: bool = True, near: Any = None
) -> Solution:
    """Newton's method from the anchor's state.

    **Arguments:** (Give all of them if there are derivatives.) `once_more`: whether to compute one
    more turn on the cycle, which gives the result its derivatives. `factors`: whether the Jacobians
    of the pieces also have derivatives. `near`: recorded pieces of the turn of a similar cycle,
    with which the iteration on the host begins.
    """
    return _solve(map, once_more, factors, near)


@on_the_host
def _solve_damped(map: ReturnMap) -> Solution:
    """The end of Levenberg-Marquardt steps from the anchor's state."""
    q, turn, steps = _damped(map)
    return Solution(
        map.departure(q), turn._replace(record=None), steps, map.judge(q, turn)
    )


def root(
    map: ReturnMap, max_steps: int, near: Any = None
) -> tuple[Float[Array, " d"], Turn, Int[Array, ""]]:
    """The fixed point of the return map, the turn from it, and the number of steps.

    Differentiable once and twice; only the state has derivatives.
    """
    if on_host(map.expected):
        return _root_on_host(map, max_steps, near)
    return _root(map, max_steps)


def _root_on_host(
    map: ReturnMap, max_steps: int, near: Any
) -> tuple[np.ndarray, Turn, np.ndarray]:
    """Newton's method from the best beginning: the fixed point of the moves of a `near` turn, or
    the state to which rough turns lead; if these fail, the anchor's state."""
    begin = map.anchor.q[:, 0] / map.sizes
    if near is not None:
        return _newton(map, *fixed_point(map, near, begin), 0, max_steps)
    x, moves, steps, turn = _by_rough_turns(map, begin)
    end = x * map.sizes, turn, np.asarray(steps)
    if np.isfinite(x).all():
        end = _newton(map, x, moves, steps, max_steps)
    if np.isfinite(end[0]).all():
        return end
    # (Accurate turns take more steps: one turn shows whether the limit suffices.)
    vain = int(end[1].result) == Result.STEP_LIMIT
    return _newton(map, begin, None, 0, 1 if vain else max_steps)


def _rough(map: ReturnMap) -> ReturnMap:
    """The map with errors of `TRANSIENT`."""
    accuracy = np.array(TRANSIENT)
    settings = Settings(accuracy, accuracy, map.settings.max_steps, map.scale)
    return dataclasses.replace(map, settings=settings)


def _by_rough_turns(
    map: ReturnMap, x: np.ndarray
) -> tuple[np.ndarray, Moves | None, int, Turn]:
    """Newton's method on rough turns (of low accuracy), until the recorded moves of one have a
    fixed point. The moves are then divided into accurate steps. Returns the fixed point of these,
    the divided moves, the number of Newton steps, and the last rough turn."""
    rough_map = _rough(map)
    moves = None
    for steps in range(1, FEW_STEPS + 1):  # noqa: B007
        turn, step = _step_from(rough_map, x)
        x = newton = x + step
        if np.isfinite(x).all():
            x, moves = fixed_point(
                rough_map, (turn.pieces, side_by_side(turn.tapes)), newton
            )
        if x is not newton or not np.isfinite(x).all():
            break
    pieces = moves and follow_moves(
        map, map.departure(x * map.sizes), map.ends(), moves
    )
    moves = None
    if pieces:
        x, moves = fixed_point(map, pieces[::2], x)
    return x, moves, steps, turn


def _newton(
    map: ReturnMap, x: np.ndarray, moves: Moves | None, first: int, max_steps: int
) -> tuple[np.ndarray, Turn, np.ndarray]:
    """Newton's method from a state, in sizes, with the same steps and test of convergence as in
    optimistix. `moves`: expected moves of the first turn. `first`: number of steps that were taken
    before."""
    for steps in itertools.count(first + 1):
        travelled = None
        if moves is not None:
            travelled = travel(map, x * map.sizes, moves)
        turn, step = _step_from(map, x, travelled)
        x = x + step
        # (Gaps between moves are allowed to be as large as errors of steps.)
        close = turn.distance < ATOL + (
            np.asarray(map.settings.rtol) if travelled else 0.0
        )
        # (The initial state may be less accurate than a state after a Newton step.)
        small = excess(x[None], step[None])[0] < 1
        done = small and close and (travelled or steps > first + 1)
        # (Far away, Newton steps may be small relative to the states although no turn closes.)
        stands = small and not travelled and steps > first + 1
        if done or stands or steps == max_steps or not np.isfinite(x).all():
            break
        moves = None
        # (Later ones have not helped before.)
        if steps < FEW_STEPS:
            recorded = (turn.pieces, side_by_side(turn.tapes))
            x, moves = fixed_point(map, recorded, x)
    return x * map.sizes, turn, np.asarray(steps)


def _step_from(
    map: ReturnMap, x: np.ndarray, travelled: Any = None
) -> tuple[Turn, np.ndarray]:
    """The turn from a state, and the Newton step, both in sizes."""
    turn = map.turn_with_jacobian(x * map.sizes, travelled=travelled)
    sizes = map.sizes
    jacobian = in_sizes(turn.jacobian, sizes)
    residual = turn.residual / sizes
    return turn, newton_steps(jacobian[None], residual[None])[0]


class _Descent(NamedTuple):
    """The end of Levenberg-Marquardt steps, in sizes of the states."""

    x: Float[np.ndarray, " d"]
    turn: Turn
    """The turn from the state `x`."""
    residual: float
    """Norm of the residual; infinite if no turn has closed."""
    damping: float
    """The square of the damping of the next step."""
    steps: int


def _damped(map: ReturnMap) -> tuple[np.ndarray, Turn, np.ndarray]:
    """Levenberg-Marquardt steps from the anchor's state: on rough turns until one nearly closes,
    then on accurate turns."""
    begin = map.anchor.q[:, 0] / map.sizes
    damping = 1.0
    rough = _descent(_rough(map), begin, damping, _ROUGH)
    if rough.residual <= _ROUGH:
        begin = rough.x
        damping = rough.damping
    # (Rough turns may fail where accurate ones do not.)
    useful = rough.residual <= _ROUGH or not np.isfinite(rough.residual)
    end = _descent(map, begin, damping, 0.0) if useful else rough
    state = end.x * map.sizes
    return state, end.turn, np.asarray(end.steps)


def _descent(map: ReturnMap, x: np.ndarray, damping: float, enough: float) -> _Descent:
    """Levenberg-Marquardt steps on the host from a state, in sizes, with the constants of
    optimistix. They end at a residual of `enough`."""
    sizes = map.sizes
    least = np.inf
    best = None
    history: list[float] = []
    step = np.zeros_like(x)
    work = 0
    for steps in itertools.count(1):
        turn = map.turn_with_jacobian((x + step) * sizes)
        residual = turn.residual / sizes
        size = float(np.linalg.norm(residual))
        if size < least:
            x = x + step
            least = size
            damping = damping / 3.5
            best = turn
            scaled = in_sizes(turn.jacobian, sizes)
            jacobian = np.vstack([scaled, np.eye(len(x))])
            error = np.append(residual, 0 * x)
        elif best is None:  # (no turn closes from here)
            break
        else:
            damping *= 4
        penalty = np.sqrt(damping) * np.eye(len(x))
        jacobian[len(x) :] = penalty
        step = -np.linalg.lstsq(jacobian, error)[0]
        # (Steps are short near the end, or where no step reduces the residual.)
        history.append(least)
        stalls = steps > STALLED and least > 0.9 * history[-1 - STALLED]
        excess_of_step = excess(x[None], step[None])
        short = excess_of_step[0] < 1
        work += _moves(turn)
        if least <= enough or short or stalls or work > _WORK:
            break
        if steps == 2 * MAX_STEPS:
            break
    return _Descent(
        x=x,
        turn=best or turn,
        residual=least,
        damping=damping,
        steps=steps,
    )


def _moves(turn: Turn) -> int:
    """Number of moves that a turn has taken."""
    assert turn.tapes is not None
    is_move = np.asarray(turn.tapes.code) != IDLE
    return int(np.sum(is_move))


@eqx.filter_custom_jvp
def _root(map, max_steps):
    import optimistix as optx  # (a fifth of a second, as lineax below)

    solver = optx.Newton(rtol=RTOL, atol=ATOL, linear_solver=_linear_solver())
    solution = optx.root_find(
        _residual,
        solver,
        map.anchor.q[:, 0] / map.sizes,
        map,
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    # An integer of JAX with a strong type: later programs would be compiled again for a weak one.
    return (
        solution.value * map.sizes,
        solution.aux,
        jnp.asarray(solution.stats["num_steps"], int),
    )


@_root.def_jvp
def _root_jvp(primals, tangents):
    """The implicit derivative: 0 = P(q, p) - q moves q by -(J - I)^-1 dP/dp. (The derivative of
    optimistix cannot be taken twice, since JAX cannot vectorize that of `flow_jacobian`.)"""
    map = primals[0]
    t_map = tangents[0]
    sizes = primals[0].sizes
    q, turn, steps = root(*primals)
    fixed = jax.tree_util.tree_map(lambda _: None, map.settings)
    t_map = eqx.tree_at(lambda m: m.settings, t_map, fixed, is_leaf=lambda x: x is None)

    # (The steps of the last turn are taken again: a search would take as long to compile.)
    def again(map):
        return map.turn(q, turn.record).residual

    _, by_parameters = eqx.filter_jvp(again, (map,), (t_map,))
    again_with_jacobian = map.turn_with_jacobian(q, record=turn.record)
    jacobian = in_sizes(again_with_jacobian.jacobian, sizes)
    # (Solvers of lineax raise errors in reverse mode where derivatives are NaN.)
    step = jnp.linalg.pinv(jacobian, rtol=SINGULAR) @ (by_parameters / sizes)
    nothing = jax.tree_util.tree_map(lambda _: None, (turn, steps))
    return (q, turn, steps), (-step * sizes, *nothing)


def _linear_solver():
    """A linear solver that takes no step along directions in which J - I is singular."""
    import lineax as lx

    return lx.SVD(rcond=SINGULAR)


def _residual(x, map: ReturnMap):
    """(P(q) - q) in sizes for q = x sizes, and the `Turn`.

    Its derivative is the Jacobian that is computed with the turn, so that the turn is not traced
    again.
    """
    fixed = jax.lax.stop_gradient(x * map.sizes)
    turn = map.turn_with_jacobian(fixed)
    moved = x * map.sizes - fixed
    residual = turn.residual + turn.jacobian @ moved
    return residual / map.sizes, turn
