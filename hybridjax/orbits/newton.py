"""Newton's method on the return map, under transformations and on the host.

Steps are taken, and convergence is judged, in sizes of the states.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import host_first, quick_jit
from .._core.executor import Array, on_host
from ..engine.lanes import Lanes
from .return_map import SINGULAR, ReturnMap, Turn


# Newton's method ends with a step below this, in sizes of the states and relative to the state.
# Doubled, it sometimes ends one step earlier; halved, rounding may keep it from ending.
_ATOL, _RTOL = 1e-12, 1e-11
# Newton steps before a cycle is given up. Doubled, hopeless ones take twice as long.
MAX_STEPS = 32
# Steps of Levenberg and Marquardt before it is given up.
_DAMPED_STEPS = 64


class Solution(NamedTuple):
    """Where Newton's method ended."""

    anchor: Lanes
    """The lane there, ready to be left."""
    turn: Turn
    """The last turn that it saw."""
    steps: Int[Array, ""]
    result: Int[Array, ""]
    """`Result` code: whether this is a cycle."""


@host_first
def solve(map: ReturnMap, once_more: bool = False) -> Solution:
    """Newton's method from the anchor's state.

    **Arguments:** `once_more` goes round once more on the cycle found, so that what is seen has the
    derivatives of the cycle.
    """
    q, turn, steps = root(map, False, MAX_STEPS)
    if once_more:
        turn = map.turn_with_jacobian(q)
    return Solution(map.departure(q), turn, steps, map.judge(q, turn))


@quick_jit
def solve_damped(map: ReturnMap) -> Solution:
    """As `solve`, by the smaller steps of Levenberg and Marquardt."""
    q, turn, steps = root(map, True, _DAMPED_STEPS)
    return Solution(map.departure(q), turn, steps, map.judge(q, turn))


def newton_steps(
    jacobian: Float[np.ndarray, "S n n"],
    residual: Float[np.ndarray, "S n"],
    rcond: float = SINGULAR,
) -> Float[np.ndarray, "S n"]:
    """Newton's steps of S systems of equations, on the host: the shortest that are left where a
    system is singular, NaN where it is not finite."""
    step = np.full(residual.shape, np.nan)
    good = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    inverse = np.linalg.pinv(jacobian[good], rcond=rcond)
    step[good] = -(inverse @ residual[good, :, None])[..., 0]
    return step


def excess(q: Float[np.ndarray, "S d"], step: Float[np.ndarray, "S d"]) -> Float[np.ndarray, " S"]:
    """The largest part of each step relative to the tolerance of `solve`, all in sizes."""
    return np.max(np.abs(step) / (_ATOL + _RTOL * np.abs(q)), axis=1)


def root(
    map: ReturnMap, damped: bool, max_steps: int
) -> tuple[Float[Array, " d"], Turn, Int[Array, ""]]:
    """The state that the return map leaves where it is, the turn from there, and steps taken.

    Differentiable once and twice; only the state has derivatives.
    """
    return _root_on_host(map, max_steps) if on_host(map.expected) else _root(map, damped, max_steps)


def _root_on_host(map: ReturnMap, max_steps: int) -> tuple[np.ndarray, Turn, np.ndarray]:
    """Newton's method as that of optimistix."""
    sizes, x, steps = map.sizes, map.anchor.q[:, 0] / map.sizes, 0
    while True:
        turn = map.turn_with_jacobian(x * sizes)
        residual = turn.residual / sizes
        (step,) = newton_steps((turn.jacobian * sizes / sizes[:, None])[None], residual[None])
        x, steps = x + step, steps + 1
        done = excess(x[None], step[None])[0] < 1 and np.max(np.abs(residual)) < _ATOL
        if done or steps == max_steps or not np.isfinite(x).all():
            return x * sizes, turn, np.asarray(steps)


@eqx.filter_custom_jvp
def _root(map, damped, max_steps):
    import optimistix as optx  # (a fifth of a second, here as below)

    if damped:
        solver = optx.LevenbergMarquardt(rtol=_RTOL, atol=_ATOL)
    else:
        solver = optx.Newton(rtol=_RTOL, atol=_ATOL, linear_solver=_linear_solver())
    solution = optx.root_find(
        _residual, solver, map.anchor.q[:, 0] / map.sizes, map,
        has_aux=True, max_steps=max_steps, throw=False,
    )  # fmt: skip
    return solution.value * map.sizes, solution.aux, solution.stats["num_steps"]


@_root.def_jvp
def _root_jvp(primals, tangents):
    """Implicit: 0 = P(q, p) - q moves q by -(J - I)^-1 dP/dp. (optimistix's own derivative raises
    where it is taken twice, since JAX cannot vectorize the derivative of `flow_jacobian`.)"""
    import lineax as lx

    map, t_map, sizes = primals[0], tangents[0], primals[0].sizes
    q, turn, steps = root(*primals)
    fixed = jax.tree_util.tree_map(lambda _: None, map.settings)
    t_map = eqx.tree_at(lambda m: m.settings, t_map, fixed, is_leaf=lambda x: x is None)
    _, by_parameters = eqx.filter_jvp(lambda map: map.turn(q).residual, (map,), (t_map,))
    jacobian = map.turn_with_jacobian(q).jacobian * sizes / sizes[:, None]
    jacobian, by_parameters = lx.MatrixLinearOperator(jacobian), by_parameters / sizes
    found = lx.linear_solve(jacobian, by_parameters, _linear_solver(), throw=False)
    t_q = -found.value * sizes
    nothing = jax.tree_util.tree_map(lambda _: None, (turn, steps))
    return (q, turn, steps), (t_q, *nothing)


def _linear_solver():
    """Along a direction in which J - I is singular, neither Newton nor a derivative moves."""
    import lineax as lx

    return lx.SVD(rcond=SINGULAR)


def _residual(x, map: ReturnMap):
    """(P(q) - q) in sizes for q = x sizes, whose derivative is the Jacobian of the turn's pieces,
    and the `Turn`.

    The Jacobian comes with the value, so that the turn need not be traced again for it.
    """
    fixed = jax.lax.stop_gradient(x * map.sizes)
    turn = map.turn_with_jacobian(fixed)
    residual = turn.residual + turn.jacobian @ (x * map.sizes - fixed)
    return residual / map.sizes, turn
