"""Residuals of data as a function of parameters, and the iteration that makes them small."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._core.compilation import quick_jit
from .._core.results import Result
from ..orbits.cycle import LimitCycle
from .candidate import candidate_cycle
from .observations import AbstractObservation
from .parameters import Parameters


# The iteration ends when a step changes no coordinate by more than this, in sum and relative to it
# (coordinates have no unit), and the cost by no more than this part and as much. Doubled, a fit
# sometimes ends one step earlier.
_TOLERANCE = 1e-9
# Evaluations of the model from one guess. Doubled, fits that do not converge take twice as long.
MAX_STEPS = 64
# No step is taken along directions whose sensitivity is below this part of the largest one.
# Doubled, directions that the data see twice as well are left alone.
_RCOND = 1e-8


class FitProblem(eqx.Module):
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
        with_factors = any(one.uses_factors for one in self.observations)
        cycle = candidate_cycle(system, guess, with_factors)
        r = jnp.concatenate([one.residuals(cycle) for one in self.observations])
        return jnp.where((cycle.result == Result.OK) & jnp.isfinite(r).all(), r, jnp.inf)


class Evaluation(NamedTuple):
    """Where an iteration ended."""

    x: Float[Array, " p"]
    """Coordinates of the parameters."""
    residuals: Float[Array, " r"]
    """There; infinite where there is no limit cycle, or nothing to be observed on it."""
    jacobian: Float[Array, "r p"]
    """Derivatives of the residuals by the coordinates."""
    steps: Int[Array, ""]
    """Evaluations of the model with its derivatives."""
    converged: Bool[Array, ""]


@quick_jit
def _with_jacobian(problem: FitProblem, x, guess):
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
def _iterate(problem: FitProblem, x, guess, free, max_steps: int) -> Evaluation:
    solution = optx.least_squares(
        lambda x, args: _residuals(x, *args),
        optx.LevenbergMarquardt(_TOLERANCE, _TOLERANCE, linear_solver=lx.SVD(rcond=_RCOND)),
        x,
        (problem, guess, free),
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    done = solution.result == optx.RESULTS.successful
    return Evaluation(solution.value, *solution.aux, solution.stats["num_steps"], done)


def levenberg_marquardt(
    problem: FitProblem, x: Float[Array, " p"], guess: LimitCycle, max_steps: int
) -> Evaluation:
    """Parameters that make the residuals small, from one guess of theirs."""
    return _iterate(problem, x, guess, jnp.asarray(1.0), max_steps)


def evaluate(problem: FitProblem, x: Float[Array, " p"], guess: LimitCycle) -> Evaluation:
    """Residuals and Jacobian at x. By the program of the iteration, since another would compile for
    as long: a derivative that is zero moves nothing."""
    return _iterate(problem, x, guess, jnp.asarray(0.0), MAX_STEPS)
