"""Physical parameters from data, by Levenberg-Marquardt through the limit cycle."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from tqdm import tqdm

from .._core.compile import quick_jit
from .._core.errors import DefinitionError
from .._core.results import Result
from ..orbits.cycle import LimitCycle, find_limit_cycle
from ..systems.system import Guess, HybridSystem
from .candidate import candidate_cycle
from .identifiability import diagnose
from .model_fit import ModelFit, Starts
from .observations import AbstractObservation
from .parameters import Free, Parameters, free_parameters


# The iteration ends when neither coordinates nor residuals move by more than this part.
_RTOL = 1e-9
# Along directions whose sensitivity is below this part of the largest one no step is taken.
_RCOND = 1e-8
# Without variances, a fit that explains all but this part of the data (mean square) is perfect.
_PERFECT = 1e-12


class _Problem(eqx.Module):
    """Weighted residuals as a function of the coordinates x of the free parameters."""

    parameters: Parameters
    observations: tuple[AbstractObservation, ...]

    def residuals(self, x: Float[Array, " p"], guess: LimitCycle) -> Float[Array, " r"]:
        """Infinite where there is no limit cycle, or nothing to be observed on it."""
        system = self.parameters.insert(guess.system, self.parameters.decode(x))
        cycle = candidate_cycle(system, guess)
        r = jnp.concatenate([one.residuals(cycle) for one in self.observations])
        return jnp.where((cycle.result == Result.OK) & jnp.isfinite(r).all(), r, jnp.inf)


@quick_jit
def _with_jacobian(problem: _Problem, x, guess):
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
def _levenberg_marquardt(problem: _Problem, x, guess, tolerance, max_steps: int):
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


def fit_model(
    system: HybridSystem,
    data: AbstractObservation | Sequence[AbstractObservation],
    free: Free,
    *,
    guess: Guess | LimitCycle | None = None,
    starts: int = 1,
    spread: float = 0.2,
    seed: int = 0,
    max_steps: int = 64,
    progress: bool = False,
) -> ModelFit:
    r"""Fit parameters of a system to data by nonlinear least squares.

    Each kind of data turns a limit cycle into weighted residuals; Levenberg and Marquardt's
    iteration (`optimistix.LevenbergMarquardt`) drives the parameters, with the exact Jacobian
    through the cycle, its events and its sections. Along combinations of parameters that the data
    do not see nothing moves, and the result names them.

    ```python
    fit = hj.fit_model(hopper, hj.ObservedHTF(estimate, sections), ("M", "k", "b"), starts=4)
    ```

    **Arguments:**

    - `system`: where the fit starts. It has a limit cycle.
    - `data`: an `ObservedHTF`, `ObservedSeries` or `ObservedCycle`, or several of them.
    - `free`: names of parameters, which keep their signs, or `{name: (low, high)}` with bounds
        (infinite where there are none, `None` for the sign of the value). Names may have dots.
    - `guess`: of the limit cycle of `system`, see `find_limit_cycle`.
    - `starts`: how many starts to try at most: `system` itself, then others around it. Once one
        has converged to a cost that the data explain (as large as their standard deviations make
        it, or without these 1e-12 of the data's squares), the rest is not tried.
    - `spread`: the other starts have coordinates uniformly drawn within this distance: 0.2 means
        factors between exp(-0.2) and exp(0.2). `seed` of the draw.
    - `max_steps`: evaluations of the model for each start.
    - `progress`: show a bar over the starts.

    **Returns:** a `ModelFit`, the best of all starts. Its `result` is a code of `Result`: nothing
    is raised where a fit does not converge.

    **Raises:** `DefinitionError` for parameters, bounds or data that do not fit the system;
    `ComputationError` if `system` has no limit cycle.

    The program is compiled at the first call for each class of systems and kind of data; other
    values of parameters and data use it again.
    """
    parameters = free_parameters(system, free)
    observations = (data,) if isinstance(data, AbstractObservation) else tuple(data)
    if not observations or not all(isinstance(one, AbstractObservation) for one in observations):
        raise DefinitionError(
            "data are ObservedHTF, ObservedSeries or ObservedCycle objects, one or more."
        )
    if starts < 1 or max_steps < 1 or not spread > 0:
        raise DefinitionError(
            f"starts and max_steps must be at least 1 and spread positive, not {starts}, "
            f"{max_steps} and {spread}."
        )
    first = find_limit_cycle(system, guess)
    problem = _Problem(parameters, tuple(one.prepare(first) for one in observations))
    weighted = all(one.weighted for one in observations)
    x0 = np.asarray(parameters.encode(parameters.read(system)))
    around = spread * np.random.default_rng(seed).uniform(-1, 1, (starts - 1, len(x0)))
    tried, best = [], None
    for x in tqdm([x0, *(x0 + around)], "starts", disable=not progress):
        found = _from(problem, jnp.asarray(x), first, max_steps)
        tried.append(found)
        best = found if best is None or found.cost < best.cost else best
        if best.result == Result.OK and best.cost <= _goal(len(best.residuals), len(x0), weighted):
            break
    return _summary(parameters, tried, best, weighted)


class _Found(eqx.Module):
    """Where one start led."""

    start: Float[Array, " p"]
    x: Float[Array, " p"]
    cost: float
    steps: int
    result: Result
    cycle: LimitCycle
    residuals: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r p"]


def _from(problem: _Problem, x: Float[Array, " p"], first: LimitCycle, max_steps: int) -> _Found:
    p = problem.parameters
    cycle = find_limit_cycle(p.insert(first.system, p.decode(x)), first, throw=False)
    if int(cycle.result) != Result.OK:
        nothing = np.zeros(0), np.zeros((0, len(x)))
        return _Found(x, x, np.inf, 0, Result(int(cycle.result)), cycle, *nothing)
    end, r, J, steps, done = _levenberg_marquardt(problem, x, cycle, jnp.asarray(_RTOL), max_steps)
    cycle = find_limit_cycle(p.insert(first.system, p.decode(end)), cycle, throw=False)
    result = Result.OK if done else Result.NOT_CONVERGED
    r = np.asarray(r)
    return _Found(x, end, float(r @ r), int(steps), result, cycle, r, np.asarray(J))


def _goal(count: int, parameters: int, weighted: bool) -> float:
    """The cost of a fit that needs no other start."""
    if not weighted:
        return _PERFECT * count
    freedom = max(count - parameters, 1)
    return freedom + 4 * np.sqrt(2 * freedom)


def _summary(parameters: Parameters, tried: list[_Found], best: _Found, weighted) -> ModelFit:
    decode = lambda x: np.asarray(parameters.decode(x))  # noqa: E731
    starts = Starts(
        np.stack([decode(one.start) for one in tried]),
        np.stack([decode(one.x) for one in tried]),
        np.array([one.cost for one in tried]),
        np.array([one.steps for one in tried]),
        np.array([int(one.result) for one in tried]),
    )
    values = decode(best.x)
    slopes = jax.jvp(parameters.decode, (best.x,), (jnp.ones_like(best.x),))[1]
    size = np.where(values == 0, 1.0, np.abs(values))
    sensitivity = best.jacobian / np.asarray(slopes) * size
    seen = diagnose(parameters.names, sensitivity)
    freedom = len(best.residuals) - seen.rank
    unit = 1.0 if weighted else best.cost / max(freedom, 1)
    information = sensitivity.T @ sensitivity / (unit * np.outer(size, size))
    left, singular, _ = np.linalg.svd(sensitivity.T, full_matrices=False)
    some = left[:, : seen.rank] / singular[: seen.rank] * size[:, None]
    return ModelFit(
        best.cycle.system, best.cycle, parameters.names, values, unit * some @ some.T, information,
        best.residuals, best.cost, freedom, weighted, seen, starts, int(best.result),
    )  # fmt: skip
