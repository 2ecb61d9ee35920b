"""Physical parameters from data, by Levenberg-Marquardt through the limit cycle."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Path, Positive, Seed, StepCount
from .._core.pieces.run import DaskClient
from .._core.progress import counted, working
from .._core.results import Result
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem
from .guesses import Guesses, Tried
from .model_fit import ModelFit, ParameterGuesses
from .observations import AbstractObservation
from .parameters import Free, Parameters, free_parameters
from .problem import MAX_STEPS, FitProblem, evaluate
from .sensitivity import Identifiability, diagnose


# Without standard deviations, no other guess is tried once the mean square of the residuals,
# relative to that of the data, is below this. Doubled, fits 1.4 times as far off count as perfect.
_PERFECT = 1e-12
# With them, none is tried once the cost, which has a chi square distribution, is above its mean by
# less than so many of its standard deviations. Doubled, worse local minima count as fits.
_LIKELY = 4.0


@checked
@working("fit_model")
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
    store: Path | None = None,
    client: DaskClient | None = None,
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
    - `store`, `client`: as of `sweep`; a guess is a piece. With one of them all guesses are tried.

    **Returns:** a `ModelFit`, the best of all guesses. Its `result` is a code of `Result`: nothing
    is raised where a fit does not converge.

    **Raises:** `DefinitionError` for parameters, bounds or data that do not fit the system;
    `ComputationError` if no guess has a limit cycle on which the data can be observed; and as
    `sweep` for a store or a client.

    The program is compiled at the first call for each class of systems and kind of data; other
    values of parameters and data use it again.
    """
    problem, near = _prepare(system, data, free, guess)
    p = problem.parameters
    x0 = np.asarray(p.encode(p.read(system)))
    around = spread * np.random.default_rng(seed).uniform(-1, 1, (guesses - 1, len(x0)))
    job = Guesses(problem, _several(data), system, near, np.stack([x0, *(x0 + around)]), max_steps)
    if store is None and client is None:
        tried = _until_good(job)
    else:
        tried = job.all(store, client)
    best = int(np.argmin(tried.cost))
    if tried.cost[best] == np.inf:
        raise ComputationError(
            f"none of {guesses} guesses has a limit cycle on which the data can be observed "
            f"({Result(int(tried.result[best])).message}): give another system, or more `guesses`."
        )
    return _summary(job, tried, best)


def _until_good(job: Guesses) -> Tried:
    """What becomes of the guesses up to the first that explains the data."""
    found: list[dict[str, np.ndarray]] = []
    S, p = job.x.shape
    for k in counted(range(S), "guesses", S):
        found.append(job.run(k, None))
        one = Tried(**found[-1])
        goal = _goal(job.problem, int(one.residuals[0]), p)
        if one.result[0] == Result.OK and one.cost[0] <= goal:
            break
    return Tried(*(np.concatenate([one[name] for one in found]) for name in Tried._fields))


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
    observations = _several(data)
    if not observations:
        raise DefinitionError("`data` holds no observation, but one or more are needed.")
    near = guess if isinstance(guess, LimitCycle) else find_limit_cycle(system, guess)
    near = _anchored(near)
    return FitProblem(parameters, tuple(one.prepare(near) for one in observations)), near


def _several(
    data: AbstractObservation | Sequence[AbstractObservation],
) -> tuple[AbstractObservation, ...]:
    return (data,) if isinstance(data, AbstractObservation) else tuple(data)


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


def _goal(problem: FitProblem, count: int, parameters: int) -> float:
    """The cost of a fit to so many numbers that needs no other guess."""
    if not problem.weighted:
        return _PERFECT * count
    freedom = max(count - parameters, 1)
    return freedom + _LIKELY * np.sqrt(2 * freedom)


def _summary(job: Guesses, tried: Tried, best: int) -> ModelFit:
    parameters, weighted = job.problem.parameters, job.problem.weighted
    decode = lambda x: np.asarray(parameters.decode(jnp.asarray(x)))  # noqa: E731
    guesses = ParameterGuesses(
        decode(job.x[: len(tried.cost)]), decode(tried.fitted), tried.cost, tried.steps,
        tried.result,
    )  # fmt: skip
    x = jnp.asarray(tried.fitted[best])
    # (By way of the guess: the first cycle may be too far away.)
    cycle = job.cycle(tried.fitted[best], job.cycle(job.x[best], job.near))
    there = evaluate(job.problem, x, cycle)
    residuals, values = np.asarray(there.residuals), decode(x)
    size = np.asarray(_sizes(values))
    sensitivity = _relative(parameters, x, there.jacobian)
    seen = diagnose(parameters.names, sensitivity)
    freedom, cost = len(residuals) - seen.rank, float(tried.cost[best])
    unit = 1.0 if weighted else max(cost / max(freedom, 1), np.finfo(float).tiny)
    left, singular, _ = np.linalg.svd(sensitivity.T, full_matrices=False)
    some = left[:, : seen.rank] / singular[: seen.rank] * size[:, None]
    return ModelFit(
        cycle.system, cycle, parameters.names, values, unit * some @ some.T,
        residuals, cost, freedom, seen, guesses, int(tried.result[best]), job.problem,
    )  # fmt: skip
