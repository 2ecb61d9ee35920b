"""Physical parameters from data, by Levenberg-Marquardt through the limit cycle."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Positive, Seed, StepCount
from .._core.results import Result
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem
from .model_fit import ModelFit, ParameterGuesses
from .observations import AbstractObservation
from .parameters import Free, Parameters, free_parameters
from .problem import MAX_STEPS, FitProblem, evaluate, levenberg_marquardt
from .sensitivity import Identifiability, diagnose


# Without standard deviations, no other guess is tried once the mean square of the residuals,
# relative to that of the data, is below this. Doubled, fits 1.4 times as far off count as perfect.
_PERFECT = 1e-12
# With them, none is tried once the cost, which has a chi square distribution, is above its mean by
# less than so many of its standard deviations. Doubled, worse local minima count as fits.
_LIKELY = 4.0


@checked
def fit_model(
    system: HybridSystem,
    data: AbstractObservation | Sequence[AbstractObservation],
    free: Free,
    *,
    guess: Guess | LimitCycle | None = None,
    guesses: Count = 1,
    spread: Positive = 0.2,
    seed: Seed = 0,
    max_steps: StepCount = MAX_STEPS,
    progress: bool = False,
) -> ModelFit:
    r"""Fit parameters of a system to data by nonlinear least squares.

    Each kind of data turns a limit cycle into weighted residuals; Levenberg and Marquardt's
    iteration (`optimistix.LevenbergMarquardt`) drives the parameters, with the exact Jacobian
    through the cycle, its events and its sections. Along combinations of parameters that the data
    do not see nothing moves, and the result names them.

    ```python
    fit = hj.fit_model(hopper, hj.ObservedHTF(estimate, sections), ("M", "k", "b"), guesses=4)
    ```

    **Arguments:**

    - `system`: whose parameters are the first guess.
    - `data`: an `ObservedHTF`, `ObservedSeries` or `ObservedCycle`, or several of them; or a
        subclass of `AbstractObservation` for data of another kind.
    - `free`: names of parameters, which keep their signs, or `{name: (low, high)}` with bounds
        (infinite where there are none, `None` for the sign of the value). Names may have dots.
    - `guess`: of the limit cycle of `system`, or the cycle of a similar system; see
        `find_limit_cycle`.
    - `guesses`: how many guesses of the parameters to try at most: those of `system`, then others
        around them. Once one has converged to a cost that the data explain (as large as their
        standard deviations make it, or without these 1e-12 of the data's squares), the rest is not
        tried.
    - `spread`: the other guesses have coordinates uniformly drawn within this distance: 0.2 means
        factors between exp(-0.2) and exp(0.2). `seed` of the draw.
    - `max_steps`: evaluations of the model from each guess.
    - `progress`: show a bar over the guesses.

    **Returns:** a `ModelFit`, the best of all guesses. Its `result` is a code of `Result`: nothing
    is raised where a fit does not converge.

    **Raises:** `DefinitionError` for parameters, bounds or data that do not fit the system;
    `ComputationError` if no guess has a limit cycle on which the data can be observed.

    The program is compiled at the first call for each class of systems and kind of data; other
    values of parameters and data use it again.
    """
    problem, near = _prepare(system, data, free, guess)
    parameters, weighted = problem.parameters, problem.weighted
    x0 = np.asarray(parameters.encode(parameters.read(system)))
    around = spread * np.random.default_rng(seed).uniform(-1, 1, (guesses - 1, len(x0)))
    tried, best = [], None
    for x in tqdm([x0, *(x0 + around)], "guesses", disable=not progress):
        found = _from(problem, jnp.asarray(x), system, near, max_steps)
        tried.append(found)
        best = found if best is None or found.cost < best.cost else best
        if best.result == Result.OK and best.cost <= _goal(len(best.residuals), len(x0), weighted):
            break
    if best.cost == np.inf:
        raise ComputationError(
            f"none of {guesses} guesses has a limit cycle on which the data can be observed "
            f"({best.result.message}): give another system, or more `guesses`."
        )
    return _summary(problem, tried, best)


@checked
def identifiability(
    system: HybridSystem,
    data: AbstractObservation | Sequence[AbstractObservation],
    free: Free,
    *,
    guess: Guess | LimitCycle | None = None,
) -> Identifiability:
    """Which combinations of parameters some data see, without a fit: before an experiment, say.

    **Arguments:** as for `fit_model`. The values of the data do not matter, their kind and their
    standard deviations do.

    **Returns:** an `Identifiability`, at the parameters of `system`.

    **Raises:** as `fit_model`; `ComputationError` if `system` cannot give such data.
    """
    problem, near = _prepare(system, data, free, guess)
    parameters, cycle = problem.parameters, find_limit_cycle(system, near)
    x = parameters.encode(parameters.read(system))
    there = evaluate(problem, x, cycle)
    if not np.isfinite(there.residuals).all():
        raise ComputationError("the system has a limit cycle, but the data cannot be had from it.")
    return diagnose(parameters.names, _relative(parameters, x, there.jacobian))


def _prepare(
    system: HybridSystem,
    data: AbstractObservation | Sequence[AbstractObservation],
    free: Free,
    guess: Guess | LimitCycle | None,
) -> tuple[FitProblem, LimitCycle]:
    """The problem, and a limit cycle near which to look for others."""
    parameters = free_parameters(system, free)
    observations = (data,) if isinstance(data, AbstractObservation) else tuple(data)
    if not observations:
        raise DefinitionError("`data` holds no observation, but one or more are needed.")
    near = guess if isinstance(guess, LimitCycle) else find_limit_cycle(system, guess)
    near = _anchored(near)
    return FitProblem(parameters, tuple(one.prepare(near) for one in observations)), near


def _anchored(cycle: LimitCycle) -> LimitCycle:
    """The same cycle, begun as far as can be from any change of charts: there the cycles of other
    systems are most likely to be in the same chart at the same phase of the clock."""
    charts = np.asarray(cycle.legs.chart)
    apart = np.subtract.outer(np.arange(len(charts)), np.arange(len(charts))) % len(charts)
    apart = np.minimum(apart, apart.T)
    room = np.where(charts != charts[:, None], apart, len(charts)).min(axis=1)
    if not cycle.clocked or room[0] == room.max():
        return cycle
    k, s = int(np.argmax(room)), Structure(cycle.system)
    a, q = int(charts[k]), cycle.legs.q[:, k]
    return find_limit_cycle(
        cycle.system, Guess(s.names[a], q[: s.dims[a]], cycle.legs.t[k]),
        multiplicity=cycle.multiplicity, conserved=cycle.conserved, settings=cycle.settings,
    )  # fmt: skip


def _relative(
    parameters: Parameters, x: Float[Array, " p"], jacobian: Float[Array | np.ndarray, "r p"]
) -> Float[np.ndarray, "r p"]:
    """From derivatives by coordinates to derivatives by relative changes of the values."""
    values, slopes = jax.jvp(parameters.decode, (x,), (jnp.ones_like(x),))
    return np.asarray(jacobian * _sizes(values) / slopes)


def _sizes(values):
    return jnp.where(values == 0, 1.0, jnp.abs(values))


class _Found(eqx.Module):
    """Where one guess led."""

    guess: Float[Array, " p"]
    x: Float[Array, " p"]
    cost: float
    steps: int
    result: Result
    cycle: LimitCycle
    residuals: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r p"]


def _from(problem: FitProblem, x, system: HybridSystem, near: LimitCycle, max_steps) -> _Found:
    p = problem.parameters
    cycle = find_limit_cycle(p.insert(system, p.decode(x)), near, throw=False)
    nothing = np.zeros(0), np.zeros((0, len(x)))
    if int(cycle.result) != Result.OK:
        return _Found(x, x, np.inf, 0, Result(int(cycle.result)), cycle, *nothing)
    end = levenberg_marquardt(problem, x, cycle, max_steps)
    r, J, steps = np.asarray(end.residuals), np.asarray(end.jacobian), int(end.steps)
    if not np.isfinite(r).all():  # there is a cycle, but not what was observed on it
        return _Found(x, x, np.inf, steps, Result.NOT_CONVERGED, cycle, *nothing)
    cycle = find_limit_cycle(p.insert(system, p.decode(end.x)), cycle, throw=False)
    result = Result.OK if end.converged else Result.NOT_CONVERGED
    return _Found(x, end.x, float(r @ r), steps, result, cycle, r, J)


def _goal(count: int, parameters: int, weighted: bool) -> float:
    """The cost of a fit that needs no other guess."""
    if not weighted:
        return _PERFECT * count
    freedom = max(count - parameters, 1)
    return freedom + _LIKELY * np.sqrt(2 * freedom)


def _summary(problem: FitProblem, tried: list[_Found], best: _Found) -> ModelFit:
    parameters, weighted = problem.parameters, problem.weighted
    decode = lambda x: np.asarray(parameters.decode(x))  # noqa: E731
    guesses = ParameterGuesses(
        np.stack([decode(one.guess) for one in tried]),
        np.stack([decode(one.x) for one in tried]),
        np.array([one.cost for one in tried]),
        np.array([one.steps for one in tried]),
        np.array([int(one.result) for one in tried]),
    )
    values = decode(best.x)
    size = np.asarray(_sizes(values))
    sensitivity = _relative(parameters, best.x, best.jacobian)
    seen = diagnose(parameters.names, sensitivity)
    freedom = len(best.residuals) - seen.rank
    unit = 1.0 if weighted else max(best.cost / max(freedom, 1), np.finfo(float).tiny)
    left, singular, _ = np.linalg.svd(sensitivity.T, full_matrices=False)
    some = left[:, : seen.rank] / singular[: seen.rank] * size[:, None]
    return ModelFit(
        best.cycle.system, best.cycle, parameters.names, values, unit * some @ some.T,
        best.residuals, best.cost, freedom, seen, guesses, int(best.result), problem,
    )  # fmt: skip
