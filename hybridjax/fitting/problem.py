"""Residuals of data as a function of parameters, and the iteration that makes them small."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._core.compilation.compile import quick_jit
from .._core.results import Result
from ..orbits.cycle import LimitCycle
from .candidate import candidate_cycle
from .observations import AbstractObservation
from .parameters import Parameters


# The iteration ends when neither coordinates nor residuals move by more than this part.
_RTOL = 1e-9
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
def _residuals(x, problem, guess, free):
    r, J = _with_jacobian(problem, x, guess)
    return r, (r, J)


@_residuals.def_jvp
def _residuals_jvp(primals, tangents):
    """optimistix linearizes at every trial point, so that this is one evaluation for each."""
    x, problem, guess, free = primals
    r, J = _with_jacobian(problem, x, guess)
    return (r, (r, J)), (free * (J @ tangents[0]), (None, None))


@quick_jit
def _iterate(problem: Problem, x, guess, free, max_steps: int):
    solution = optx.least_squares(
        lambda x, args: _residuals(x, *args),
        optx.LevenbergMarquardt(_RTOL, _RTOL, linear_solver=lx.SVD(rcond=_RCOND)),
        x,
        (problem, guess, free),
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    done = solution.result == optx.RESULTS.successful
    return solution.value, *solution.aux, solution.stats["num_steps"], done


def levenberg_marquardt(problem: Problem, x: Float[Array, " p"], guess: LimitCycle, max_steps: int):
    """From one start: coordinates, residuals and Jacobian there, steps, whether it converged."""
    return _iterate(problem, x, guess, jnp.asarray(1.0), max_steps)


def evaluate(problem: Problem, x: Float[Array, " p"], guess: LimitCycle):
    """Residuals (r,) and Jacobian (r, p) at x. By the program of the iteration, since another would
    compile for as long: a derivative that is zero moves nothing."""
    _, r, J, _, _ = _iterate(problem, x, guess, jnp.asarray(0.0), MAX_STEPS)
    return np.asarray(r), J
