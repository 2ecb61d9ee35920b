"""Physical parameters from data, by Levenberg-Marquardt through the limit cycle."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Path, Seed
from .._core.pieces.description import array_digest, digest_of, versions
from .._core.pieces.run import DaskClient, fill
from .._core.pieces.store import Blocks, Layout, Variable
from .._core.progress import counted, working
from .._core.results import Result
from ..engine.describe import describe
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle, rough
from ..orbits.find import find_limit_cycle
from ..systems.system import Guess, HybridSystem
from .model_fit import Identifiability, ModelFit, ParameterGuesses, diagnose
from .observations import AbstractObservation
from .problem import (
    MAX_STEPS,
    FitProblem,
    Free,
    Parameters,
    evaluate,
    free_parameters,
    levenberg_marquardt,
)


Data = AbstractObservation | Sequence[AbstractObservation]

# Distance of the other guesses from the first one, in coordinates: factors between exp(-0.2) and
# exp(0.2). Larger: most of them have no limit cycle. Smaller: all end in the same minimum.
_SPREAD = 0.2
# Without standard deviations, no other guess is tried once the mean square of the residuals,
# relative to that of the data, is below this. Larger: fits with errors count as perfect. Smaller:
# perfect fits, with errors of rounding, do not.
_PERFECT = 1e-12
# With them, none is tried once the cost, which has a chi square distribution, is above its mean by
# less than so many of its standard deviations. Larger: local minima are accepted. Smaller: global
# ones are not, and all guesses are tried.
_LIKELY = 4.0


@checked
@working("fit_model")
def fit_model(
    system: HybridSystem,
    data: Data,
    free: Free,
    *,
    guess: Guess | LimitCycle | None = None,
    guesses: Count = 1,
    seed: Seed = 0,
    store: Path | None = None,
    client: DaskClient | None = None,
) -> ModelFit:
    r"""Fit parameters of a system to data by nonlinear least squares.

    Each type of data converts a limit cycle to weighted residuals; the Levenberg-Marquardt
    iteration (`optimistix.LevenbergMarquardt`) changes the parameters, with the exact Jacobian
    through the cycle, its events and its sections. Parameters do not move along combinations that
    the data do not identify, and the result lists these.

    ```python
    fit = hj.fit_model(hopper, hj.ObservedHTF(estimate, sections), ("M", "k", "b"), guesses=4)
    ```

    **Arguments:**

    - `system`: its parameters are the first guess.
    - `data`: an `ObservedHTF`, `ObservedSeries` or `ObservedCycle`, or several of them; or a
        subclass of `AbstractObservation` for data of another type.
    - `free`: names of parameters, which keep their signs, or `{name: (low, high)}` with bounds
        (infinite where there are none, `None` for the sign of the value). Names may have dots.
    - `guess`: of the limit cycle of `system`, or the cycle of a similar system; see
        `find_limit_cycle`.
    - `guesses`: largest number of guesses of the parameters: those of `system`, then random ones
        with factors between exp(-0.2) and exp(0.2). Once one has converged to a cost that the data
        explain (as expected from their standard deviations, or without these 1e-12 of the squared
        data), no more are tried. Default: 1. `seed` of these. Default: 0.
    - `store`, `client`: as in `sweep`; a guess is a piece. With one of them all guesses are tried.

    **Returns:** a `ModelFit`, the best of all guesses. Its `result` is a code of `Result`: no error
    is raised where a fit does not converge.

    **Raises:** `DefinitionError` for parameters, bounds or data that do not fit the system;
    `ComputationError` if no guess has a limit cycle on which the data can be observed; and as
    `sweep` for a store or a client.

    The function is compiled at the first call for each class of systems and type of data; calls
    with other values of parameters and data reuse it.
    """
    problem, near = _prepare(system, data, free, guess)
    p = problem.parameters
    x0 = np.asarray(p.encode(p.read(system)))
    around = _SPREAD * np.random.default_rng(seed).uniform(-1, 1, (guesses - 1, len(x0)))
    job = Guesses(problem, _several(data), system, near, np.stack([x0, *(x0 + around)]))
    tried = job.until_good() if store is None and client is None else job.all(store, client)
    best = int(np.argmin(tried.cost))
    if tried.cost[best] == np.inf:
        raise ComputationError(
            f"none of {guesses} guesses has a limit cycle on which the data can be observed "
            f"({Result(int(tried.result[best])).message}): give another system, or more `guesses`."
        )
    return _summary(job, tried, best)


@checked
def identifiability(
    system: HybridSystem, data: Data, free: Free, *, guess: Guess | LimitCycle | None = None
) -> Identifiability:
    """Find the combinations of parameters that data identify, without a fit.

    **Arguments:** as in `fit_model`. The values of the data have no effect, but their type and
    their standard deviations have.

    **Returns:** an `Identifiability`, at the parameters of `system`.

    **Raises:** as `fit_model`; `ComputationError` if `system` cannot produce such data.
    """
    problem, near = _prepare(system, data, free, guess)
    parameters, cycle = problem.parameters, find_limit_cycle(system, near)
    x = parameters.encode(parameters.read(system))
    end = evaluate(problem, x, cycle)
    if not np.isfinite(end.residuals).all():
        raise ComputationError("the system has a limit cycle, but cannot produce such data.")
    return diagnose(parameters.names, _relative(parameters, x, end.jacobian))


def _prepare(
    system: HybridSystem, data: Data, free: Free, guess: Guess | LimitCycle | None
) -> tuple[FitProblem, LimitCycle]:
    """Return the problem, and a limit cycle near which to search for others."""
    parameters = free_parameters(system, free)
    observations = _several(data)
    if not observations:
        raise DefinitionError("`data` holds no observation, but one or more are needed.")
    near = guess if isinstance(guess, LimitCycle) else find_limit_cycle(system, guess)
    near = _anchored(near)
    prepared = tuple(observation.prepare(near) for observation in observations)
    return FitProblem(parameters, prepared), near


def _several(data: Data) -> tuple[AbstractObservation, ...]:
    return (data,) if isinstance(data, AbstractObservation) else tuple(data)


def _anchored(cycle: LimitCycle) -> LimitCycle:
    """Return the same cycle, begun as far as possible from any change of charts: there the cycles
    of other systems are most likely to be in the same chart at the same phase of the clock."""
    charts = np.asarray(cycle.legs.chart)
    apart = np.subtract.outer(np.arange(len(charts)), np.arange(len(charts))) % len(charts)
    apart = np.minimum(apart, apart.T)
    room = np.where(charts != charts[:, None], apart, len(charts)).min(axis=1)
    if not cycle.clocked or room[0] == room.max():
        return cycle
    k, s = int(np.argmax(room)), cycle.structure
    a, q = int(charts[k]), cycle.legs.q[:, k]
    return find_limit_cycle(
        cycle.system, Guess(s.names[a], q[: s.dims[a]], cycle.legs.t[k]),
        multiplicity=cycle.multiplicity, conserved=cycle.conserved, settings=cycle.settings,
    )  # fmt: skip


def _relative(
    parameters: Parameters, x: Float[Array, " p"], jacobian: Float[Array | np.ndarray, "r p"]
) -> Float[np.ndarray, "r p"]:
    """Return derivatives by relative changes of the values from those by coordinates."""
    values, slopes = jax.jvp(parameters.decode, (x,), (jnp.ones_like(x),))
    return np.asarray(jacobian * _sizes(values) / slopes)


def _sizes(values: Array) -> Array:
    return jnp.where(values == 0, 1.0, jnp.abs(values))


class Tried(NamedTuple):
    """The results of S guesses."""

    fitted: Float[np.ndarray, "S p"]
    """Fitted coordinates."""
    cost: Float[np.ndarray, " S"]
    """Infinite where there is no limit cycle, or no observation on it."""
    residuals: Int[np.ndarray, " S"]
    """Number of residuals."""
    steps: Int[np.ndarray, " S"]
    result: Int[np.ndarray, " S"]


@dataclasses.dataclass(frozen=True)
class Guesses:
    """Fits from several guesses, one after the other or as pieces of work.

    **Fields:** `problem`; `given`, its observations before preparation; `system`, whose parameters
    are replaced; `near`, a limit cycle to search around; coordinates `x` of each guess.
    """

    problem: FitProblem
    given: tuple[AbstractObservation, ...]
    system: HybridSystem
    near: LimitCycle
    x: Float[np.ndarray, "S p"]

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Return the fit from guess k."""
        x = self.x[k]
        cycle = self.cycle(x, self.near)
        cost, count, steps, result = np.inf, 0, 0, int(cycle.result)
        if result == Result.OK:
            end = levenberg_marquardt(self.problem, jnp.asarray(x), cycle)
            r, steps = np.asarray(end.residuals), int(end.steps)
            count = len(r)
            result = int(Result.NOT_CONVERGED)
            if np.isfinite(r).all():  # (else there is a cycle, but no observation on it)
                x, cost = np.asarray(end.x), float(r @ r)
                result = int(Result.OK) if end.converged else result
        values = zip(Tried._fields, (x, cost, count, steps, result), strict=True)
        return {name: np.asarray(value)[None] for name, value in values}

    def cycle(self, x: Float[np.ndarray, " p"], near: LimitCycle) -> LimitCycle:
        """Return the cycle with the parameters at x, converged or not."""
        p = self.problem.parameters
        system = p.insert(self.system, p.decode(jnp.asarray(x)))
        return find_limit_cycle(system, near, throw=False)

    def until_good(self) -> Tried:
        """Return the results of the guesses up to the first that explains the data."""
        results: list[dict[str, np.ndarray]] = []
        S, p = self.x.shape
        for k in counted(range(S), "guesses", S):
            results.append(self.run(k, None))
            last = Tried(**results[-1])
            goal = _PERFECT * last.residuals[0]
            if self.problem.weighted:
                freedom = max(last.residuals[0] - p, 1)
                goal = freedom + _LIKELY * np.sqrt(2 * freedom)
            if last.result[0] == Result.OK and last.cost[0] <= goal:
                break
        return Tried(*(np.concatenate([x[name] for x in results]) for name in Tried._fields))

    def all(self, store: Any, client: Any) -> Tried:
        """Return the results of all guesses, by workers or in a store; see `fit_model`."""
        data = fill(self, store, client).dataset()
        return Tried(*(data[name].values for name in Tried._fields))

    def begin(self, client: DaskClient | None) -> tuple["Guesses", Layout]:
        """Return the job, and the form of its results."""
        S, p = self.x.shape
        variables = {
            "fitted": Variable("<f8", ("parameter",), (p,)),
            "cost": Variable("<f8"),
            **dict.fromkeys(("residuals", "steps", "result"), Variable("<i8")),
        }
        constants = {"parameter": (("parameter",), np.array(self.problem.parameters.names), {})}
        blocks, about = Blocks((S,), (1,)), self.description
        return self, Layout(("guess",), blocks, variables, constants, ("parameter",), about)

    def arrays(self) -> list[np.ndarray]:
        """Return the arrays that were computed before the first guess."""
        return [np.asarray(x) for x in jax.tree_util.tree_leaves(self._computed()[0])]

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "Guesses":
        """Return the job with these arrays of another call."""
        computed, static = self._computed()
        tree = jax.tree_util.tree_structure(computed)
        restored = jax.tree_util.tree_unflatten(tree, [jnp.asarray(x) for x in arrays])
        problem, near = eqx.combine(restored, static)
        return dataclasses.replace(self, problem=problem, near=near)

    def _computed(self) -> Any:
        return eqx.partition((self.problem, self.near), eqx.is_array)

    @property
    def description(self) -> dict[str, Any]:
        """JSON from which these fits can be told from others."""
        parameters = self.problem.parameters
        return {
            "kind": "guesses",
            "versions": versions(),
            "model": describe(self.system),
            "guess": rough(self.near),
            "free": list(parameters.names),
            "bounds": [array_digest(parameters.low), array_digest(parameters.high)],
            "data": [_digest(x) for x in self.given],
            "guesses": array_digest(self.x),
            "max_steps": MAX_STEPS,
        }


def _digest(data: AbstractObservation) -> str:
    leaves = jax.tree_util.tree_leaves(eqx.filter(data, eqx.is_array))
    return digest_of(type(data).__qualname__, *map(array_digest, leaves))


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
    end = evaluate(job.problem, x, cycle)
    residuals, values = np.asarray(end.residuals), decode(x)
    size = np.asarray(_sizes(jnp.asarray(values)))
    sensitivity = _relative(parameters, x, end.jacobian)
    identified = diagnose(parameters.names, sensitivity)
    rank, cost = identified.rank, float(tried.cost[best])
    freedom = len(residuals) - rank
    unit = 1.0 if weighted else max(cost / max(freedom, 1), np.finfo(float).tiny)
    left, singular, _ = np.linalg.svd(sensitivity.T, full_matrices=False)
    root = left[:, :rank] / singular[:rank] * size[:, None]
    return ModelFit(
        cycle.system, cycle, parameters.names, values, unit * root @ root.T,
        residuals, cost, freedom, identified, guesses, int(tried.result[best]), job.problem,
    )  # fmt: skip
