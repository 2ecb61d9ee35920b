"""Residuals of data as a function of parameters, and the iteration that makes them small."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._core.compile import quick_jit
from .._core.results import Result
from ..orbits.cycle import LimitCycle
from .candidate import candidate_cycle
from .observations import AbstractObservation
from .parameters import Parameters


# Evaluations of the model for one start.
MAX_STEPS = 64
# Along directions whose sensitivity is below this part of the largest one no step is taken.
_RCOND = 1e-8


class Problem(eqx.Module):
    """Weighted residuals as a function of the coordinates x of the free parameters."""

    parameters: Parameters
    observations: tuple[AbstractObservation, ...]

    @property
    def weighted(self) -> bool:
        """Whether all data came with their standard deviations."""
        return all(bool(one.weighted) for one in self.observations)

    def residuals(self, x: Float[Array, " p"], guess: LimitCycle) -> Float[Array, " r"]:
        """Infinite where there is no limit cycle, or nothing to be observed on it."""
        system = self.parameters.insert(guess.system, self.parameters.decode(x))
        cycle = candidate_cycle(system, guess)
        r = jnp.concatenate([one.residuals(cycle) for one in self.observations])
        return jnp.where((cycle.result == Result.OK) & jnp.isfinite(r).all(), r, jnp.inf)


@quick_jit
def _with_jacobian(problem: Problem, x, guess):
    """Residuals (r,) and Jacobian (r, p): all columns in one pass, forwards."""
    push = jax.vmap(
        lambda t: jax.jvp(lambda x: problem.residuals(x, guess), (x,), (t,)), out_axes=(None, -1)
    )
    return push(jnp.eye(x.shape[0]))


@eqx.filter_custom_jvp
def _residuals(x, problem, guess):
    return _with_jacobian(problem, x, guess)[0]


@_residuals.def_jvp
def _residuals_jvp(primals, tangents):
    """optimistix linearises at every trial point, so that this is one evaluation for each."""
    x, problem, guess = primals
    r, J = _with_jacobian(problem, x, guess)
    return r, J @ tangents[0]


@quick_jit
def levenberg_marquardt(problem: Problem, x, guess, tolerance, max_steps: int):
    """From one start: coordinates, residuals and Jacobian there, steps, whether it converged. With
    an infinite tolerance, those of the start."""
    solution = optx.least_squares(
        lambda x, args: _residuals(x, *args),
        optx.LevenbergMarquardt(tolerance, tolerance, linear_solver=lx.SVD(rcond=_RCOND)),
        x,
        (problem, guess),
        max_steps=max_steps,
        throw=False,
    )
    last = solution.state.f_info  # what was computed at the coordinates that it gives back
    done = solution.result == optx.RESULTS.successful
    return solution.value, last.residual, last.jac.as_matrix(), solution.stats["num_steps"], done


def evaluate(problem: Problem, x: Float[Array, " p"], guess: LimitCycle):
    """Residuals (r,) and Jacobian (r, p) at x, by the program of the iteration."""
    nowhere = jnp.asarray(jnp.inf)
    _, r, J, _, _ = levenberg_marquardt(problem, x, guess, nowhere, MAX_STEPS)
    return np.asarray(r), J
