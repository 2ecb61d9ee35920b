"""`fit_model`: physical parameters from data, by Levenberg-Marquardt iterations through the limit
cycle.

It takes the stages in order: the problem with its free parameters (`_prepare`, `problem.py`),
guesses (`_starts_around`), an iteration from each guess (`_descend`), and the best end as a
`ModelFit` (`_of_end`). Data convert limit cycles to residuals (`observations.py`); residuals are
evaluated in `beside.py` or `problem.py`. `identifiability` evaluates the Jacobian once, without a
fit.

If a fit ends at a wrong minimum, look at `_starts_around` and `_descend`; if residuals are wrong,
at `observations.py` or `transients.py`; if standard errors are, at `_of_end`; if data or bounds are
refused, at `_prepare` and `_transients`; if a guess has no cycle, at `_cycle_at`. Two things must
stay: the first guess is `system` itself, and the cycle of the result comes from
`find_limit_cycle` (`_summary`), since cycles of the iteration have fewer checks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import searching
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Seed
from .._core.findings import listed, warn_of
from .._core.memo import Recent
from .._core.progress import counted, working
from .._core.results import Result
from ..errors import ComputationError, DefinitionError
from ..orbits.curve import away_from_events
from ..orbits.cycle import LimitCycle, what_changed
from ..orbits.find import find_limit_cycle
from ..orbits.guess import require_similar
from ..systems.check import check_system
from ..systems.quotient import check_symmetry
from ..systems.start import StateLike
from ..systems.system import Guess, HybridSystem
from .beside import Model
from .model_fit import Identifiability, ModelFit, ParameterGuess, diagnose
from .observations import AbstractObservation
from .problem import (
    DELAYS,
    FALSE_ALARMS,
    FitProblem,
    Free,
    Parameters,
    TransientProblem,
    descend,
    free_parameters,
    tail_of,
)
from .transients import ObservedTrajectory, lack_of, require_names


Data = AbstractObservation | Sequence[AbstractObservation]

# Distance of the other guesses from the first one, in coordinates: factors between exp(-0.2) and
# exp(0.2). Larger: most of them have no limit cycle. Smaller: all end in the same minimum.
_SPREAD = 0.2
# If the data have no standard deviations, no further guess is tried once the mean square of the
# residuals, relative to that of the data, is below this. Larger: fits with errors count as perfect.
# Smaller: perfect fits with rounding errors do not.
_PERFECT = 1e-12

# Cycles at the end of a fit are the same if their periods differ by less than this part. Larger:
# another cycle is returned with the fit. Smaller: the search is repeated for rounding errors.
_SAME_PERIOD = 1e-6

_starts = Recent(8)
"""The limit cycles from which fits of systems without a guess have begun."""


@checked
@working("fit_model")
def fit_model(
    system: HybridSystem,
    data: Data,
    free: Free,
    *,
    guess: Guess | LimitCycle | StateLike | None = None,
    guesses: Count = 1,
    seed: Seed = 0,
) -> ModelFit:
    r"""Fit parameters of a system to data by nonlinear least squares.

    Weighted residuals are computed from a limit cycle, in the way of each type of data. The
    Levenberg-Marquardt iteration changes the parameters, with the exact Jacobian through the cycle,
    its events and its sections. Parameters do not move along combinations that the data do not
    identify, and the result lists these.

    **Arguments:**

    - `system`: its parameters are the first guess.
    - `data`: an `ObservedHTF`, `ObservedSeries` or `ObservedCycle`, or several of them; or a
        subclass of `AbstractObservation` for data of another type. One or several
        `ObservedTrajectory` need no limit cycle.
    - `free`: names of the parameters to fit, which keep their signs; or `{name: (low, high)}` with
        bounds. A bound may be infinite, and `{name: None}` keeps the sign. The name of a parameter
        of a part has dots, as in "system.k". The names "input_delay" and "output_delay" stand for
        the delays of all `ObservedHTF` that have a `delay`.
    - `guess`: guess of the limit cycle of `system`, or the cycle of a similar system; see
        `find_limit_cycle`.
    - `guesses`: largest number of guesses of the parameters: those of `system`, then random ones
        with factors between exp(-0.2) and exp(0.2). The search stops at the first guess with a cost
        that is not too large for the standard deviations of the data (without these, below 1e-12 of
        the squared data). Default: 1. `seed`: seed of the random guesses. Default: 0.

    **Returns:** a `ModelFit`, the best of all guesses. Its `result` is a code of `Result`: no error
    is raised where a fit does not converge.

    **Raises:** `DefinitionError` for parameters, bounds or data that do not fit the system;
    `ComputationError` if no guess has a limit cycle on which the data can be observed.

    The function is compiled at the first call for each class of systems and type of data; calls
    with other values of parameters and data reuse it.

    **Example:**

    ```python
    observed = hj.fitting.ObservedHTF(htf, sections)
    found = hj.fit_model(hj.models.VerticalHopper(k=10.2), observed, ("k", "b"))
    print(found.values, found.standard_errors)
    ```

    **Before:** `hj.estimate_htf`, with `hj.fitting.ObservedHTF`; `hj.fitting.identifiability`.
    **After:** `hj.validate`, `hj.linearize`, `hj.save`.
    """
    transient = _transients(system, data, free)
    if transient is not None:
        fit = _fit_transients(transient, guesses, seed)
    else:
        problem, near = _prepare(system, data, free, guess)
        fit = _fit_cycles(problem, system, near, guesses, seed)
    warn_of([x for x in fit.findings if x.cause == "misfit"])
    return fit


def _fit_cycles(
    problem: FitProblem,
    system: HybridSystem,
    near: LimitCycle,
    guesses: int,
    seed: int,
) -> ModelFit:
    """Fit parameters to data of limit cycles, which are searched for near one.

    **Raises:** `ComputationError` if no guess has a limit cycle on which the data can be observed.
    """
    parameters = problem.parameters
    x0 = np.asarray(parameters.encode(parameters.read(system, problem.observations)))
    starts = _starts_around(x0, guesses, seed)
    model = Model(problem, system, near)
    ends: list[End] = []
    for start in counted(starts, "guesses", guesses):
        at_guess = not ends and near.system is system
        cycle = near
        if not at_guess and not model.is_beside(start, near):
            cycle = _cycle_at(problem, system, start, near)
        ends.append(_descend(problem, start, cycle, model))
        if ends[-1].explains(problem):
            break
    best = min(ends, key=lambda end: (end.cost, -len(end.residuals)))
    if best.cost == np.inf:
        why = Result(best.result).message
        if len(best.residuals):
            why = "its residuals are not finite"
        raise ComputationError(
            f"none of {guesses} guesses has a limit cycle on which the data can be observed "
            f"({why}): give another system, or more `guesses`."
        )
    return _summary(problem, system, ends, best, model.known or best.cycle)


def _starts_around(
    x0: Float[np.ndarray, " p"], guesses: int, seed: int
) -> Float[np.ndarray, "guesses p"]:
    """Coordinates from which fits begin: the first ones, and random ones around them."""
    rng = np.random.default_rng(seed)
    draws = rng.uniform(-1, 1, (guesses - 1, len(x0)))
    around = _SPREAD * draws
    return np.concatenate([x0[None], x0 + around])


def _fit_transients(problem: TransientProblem, guesses: int, seed: int) -> ModelFit:
    """Fit parameters to trajectories.

    **Raises:** `ComputationError` if no guess has flows with all measurements.
    """
    parameters = problem.parameters
    values = parameters.read(problem.system, problem.observations)
    x0 = np.asarray(parameters.encode(values))

    def model(problem, x, guess):
        return problem.evaluated(x, guess)

    ends: list[End] = []
    for start in counted(_starts_around(x0, guesses, seed), "guesses", guesses):
        x, r, J, _, steps, converged = descend(problem, start, None, model)
        result = Result.OK if converged else Result.NOT_CONVERGED
        cost = float(r @ r) if np.isfinite(J).all() else np.inf
        ends.append(End(start, x, cost, r, J, None, steps, int(result)))
        if ends[-1].explains(problem):
            break
    best = min(ends, key=lambda end: end.cost)
    if not np.isfinite(best.cost):
        lacks = [
            lack_of(x, problem.system)
            for x in problem.observations
            if isinstance(x, ObservedTrajectory)
        ]
        causes = [f"trajectory {k}: {x}" for k, x in enumerate(lacks, 1) if x]
        causes = causes or ["derivatives are not finite"]
        raise ComputationError(
            f"none of {guesses} guesses has trajectories with all measurements. With the "
            f"parameters of `system`: {listed(causes)}. Compare `hj.flow` from the start of each "
            "with its data, and begin with other parameters."
        )
    return _of_end(problem, ends, best, None)


@checked
def identifiability(
    system: HybridSystem,
    data: Data,
    free: Free,
    *,
    guess: Guess | LimitCycle | StateLike | None = None,
) -> Identifiability:
    """Find the combinations of parameters that data identify, without a fit.

    **Arguments:** `system`, `data`, `free` and `guess`: as in `fit_model`. The values of the data
    have no effect, but their type and their standard deviations have.

    **Returns:** an `Identifiability`, at the parameters of `system`.

    **Raises:** as `fit_model`; `ComputationError` if `system` cannot produce such data.

    **Example:**

    ```python
    events = [hj.AtEvent("liftoff"), hj.AtEvent("touchdown")]
    observed = hj.fitting.ObservedCycle(events, times=(0.5163, 1.3510), times_std=0.001)
    print(hj.fitting.identifiability(hopper, observed, ("M", "k", "b")))
    ```

    **Before:** `hj.fitting.ObservedHTF`, `hj.fitting.ObservedSeries` or `hj.fitting.ObservedCycle`.
    **After:** `hj.fit_model`.
    """
    cycle = None
    problem: FitProblem | None = _transients(system, data, free)
    if problem is None:
        problem, near = _prepare(system, data, free, guess)
        with searching("as `guess`"):
            cycle = find_limit_cycle(system, near)
    parameters = problem.parameters
    x = parameters.encode(parameters.read(system, problem.observations))
    residuals, jacobian, _ = problem.evaluated(x, cycle)
    if not np.isfinite(residuals).all():
        raise ComputationError(
            "the system predicts NaN or infinity for these data: change its parameters."
        )
    return diagnose(parameters.names, _relative(parameters, x, jacobian))


def _prepare(
    system: HybridSystem,
    data: Data,
    free: Free,
    guess: Guess | LimitCycle | StateLike | None,
) -> tuple[FitProblem, LimitCycle]:
    """Return the problem, and a limit cycle near which to search for others."""
    observations = [data] if isinstance(data, AbstractObservation) else data
    if not observations:
        raise DefinitionError(
            "`data` must be one observation or more, not an empty list."
        )
    parameters = free_parameters(system, free, observations)
    near = _known_cycle(system, guess)
    for name in {*parameters.names} - {*DELAYS}:
        check_symmetry(near.system, near.structure.sizes(near.settings.scale), name)
    prepared = tuple(observation.prepare(near) for observation in observations)
    _require_same_weighting(prepared)
    return FitProblem(parameters, prepared), near


def _transients(
    system: HybridSystem, data: Data, free: Free
) -> TransientProblem | None:
    """Return the problem of a fit to trajectories; None if the data are of limit cycles."""
    observations = [data] if isinstance(data, AbstractObservation) else [*data]
    of_trajectories = [x for x in observations if isinstance(x, ObservedTrajectory)]
    if not of_trajectories:
        return None
    if len(of_trajectories) < len(observations):
        raise DefinitionError(
            "trajectories and limit cycles cannot be fitted together: fit each alone, and compare "
            "both by `fit.compare(other)`."
        )
    check_system(system)
    for observation in of_trajectories:
        require_names(observation, system)
    _require_same_weighting(observations)
    parameters = free_parameters(system, free, observations)
    return TransientProblem(parameters, tuple(observations), system)


def _require_same_weighting(observations: Sequence[AbstractObservation]) -> None:
    """**Raises:** `DefinitionError` if only some of the data have standard deviations."""
    if len({bool(observation.weighted) for observation in observations}) > 1:
        raise DefinitionError("give standard deviations of all data, or of none.")


def _known_cycle(
    system: HybridSystem, guess: Guess | LimitCycle | StateLike | None
) -> LimitCycle:
    """The cycle near which others are searched for. Fits of the same system from no guess, as of
    many draws of data, share it, and what is recorded of it."""
    if guess is None:
        known: LimitCycle | None = _starts.get(system)
        if known is not None and not what_changed(known.system, known.numbers):
            return known
    with searching("as `guess`"):
        near = (
            guess if isinstance(guess, LimitCycle) else find_limit_cycle(system, guess)
        )
    require_similar(near.return_map, system)
    moved = away_from_events(near)
    if moved is not near:
        near = find_limit_cycle(near.system, moved, settings=near.settings)
    return _starts.keep(near, system) if guess is None else near


def _relative(
    parameters: Parameters,
    x: Float[Array, " p"],
    jacobian: Float[Array | np.ndarray, "r p"],
) -> Float[np.ndarray, "r p"]:
    """Return derivatives by relative changes of the values from those by coordinates."""
    values, slopes = jax.jvp(parameters.decode, (x,), (jnp.ones_like(x),))
    return np.asarray(jacobian * _sizes(values) / slopes)


def _sizes(values: Array) -> Array:
    """The magnitudes of values, to which their changes are relative; 1 for zero."""
    return jnp.where(values == 0, 1.0, jnp.abs(values))


class End(NamedTuple):
    """The result of one guess."""

    start: Float[np.ndarray, " p"]
    """Coordinates of the guess."""
    x: Float[np.ndarray, " p"]
    """Coordinates of the fit."""
    cost: float
    """Infinite where there is no limit cycle, or no observation on it."""
    residuals: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r p"]
    """Derivatives of the residuals by the coordinates."""
    cycle: LimitCycle | None
    """A guess for the cycle of the fit; None for trajectories."""
    steps: int
    result: int

    def explains(self, problem: FitProblem) -> bool:
        """Test whether the fit has converged to a cost that the data explain."""
        if self.result != Result.OK:
            return False
        if not problem.weighted:
            return self.cost <= _PERFECT * len(self.residuals)
        dof = max(len(self.residuals) - len(self.x), 1)
        return float(tail_of(self.cost, dof, problem.most)) >= FALSE_ALARMS


def _cycle_at(
    problem: FitProblem,
    system: HybridSystem,
    x: Float[np.ndarray, " p"],
    near: LimitCycle,
) -> LimitCycle:
    """Return the cycle with the parameters at x, converged or not."""
    p = problem.parameters
    return find_limit_cycle(
        p.insert(system, p.decode(jnp.asarray(x))), near, throw=False
    )


def _descend(
    problem: FitProblem,
    start: Float[np.ndarray, " p"],
    cycle: LimitCycle,
    model: Model,
) -> End:
    """The end of the iteration from one guess. `cycle`: the cycle there; if it was not found, the
    guess is also the end, and its cost is infinite."""
    if int(cycle.result) != Result.OK:
        none = np.zeros(0), np.zeros((0, len(start)))
        return End(start, start, np.inf, *none, cycle, 0, int(cycle.result))
    x, r, J, near, steps, converged = descend(problem, start, cycle, model)
    result = Result.OK if converged else Result.NOT_CONVERGED
    cost = float(r @ r)
    return End(start, x, cost, r, J, near, steps, int(result))


def _summary(
    problem: FitProblem,
    system: HybridSystem,
    ends: list[End],
    best: End,
    near: LimitCycle | None,
) -> ModelFit:
    """The fit with the best of all ends, and its cycle: from a search that begins at `near`, or if
    that leads elsewhere, at the last cycle of the iteration."""
    assert best.cycle is not None and near is not None
    cycle = _cycle_at(problem, system, best.x, near)
    # (A search from a distant cycle may find another one.)
    period = float(best.cycle.period)
    is_same = abs(float(cycle.period) - period) <= _SAME_PERIOD * period
    if int(cycle.result) != Result.OK or not is_same:
        cycle = _cycle_at(problem, system, best.x, best.cycle)
    return _of_end(problem, ends, best, cycle)


def _of_end(
    problem: FitProblem, ends: list[End], best: End, cycle: LimitCycle | None
) -> ModelFit:
    """The fit with the best of all ends; `cycle`: None for trajectories."""
    parameters = problem.parameters

    def decode(x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        return np.asarray(parameters.decode(jnp.asarray(x)))

    guesses = tuple(
        ParameterGuess(
            decode(end.start), decode(end.x), end.cost, end.steps, end.result
        )
        for end in ends
    )
    values = decode(best.x)
    result = best.result
    if cycle is not None:
        fitted = cycle.system
        if result == Result.OK:
            # (During the iteration, cycles have fewer checks, so that the last one may be wrong.)
            result = int(cycle.result)
    else:
        assert isinstance(problem, TransientProblem)
        fitted = parameters.insert(problem.system, jnp.asarray(values))
    size = np.asarray(_sizes(jnp.asarray(values)))
    sensitivity = _relative(parameters, jnp.asarray(best.x), best.jacobian)
    identified = diagnose(parameters.names, sensitivity)
    rank = identified.rank
    dof = len(best.residuals) - rank
    left, singular, _ = np.linalg.svd(sensitivity.T, full_matrices=False)
    scaled = left[:, :rank] / singular[:rank]
    root = scaled * size[:, None]
    return ModelFit(
        system=fitted,
        cycle=cycle,
        names=parameters.names,
        values=values,
        covariance=problem.unit(best.cost, dof) * root @ root.T,
        residuals=best.residuals,
        cost=best.cost,
        dof=float(dof),
        identifiability=identified,
        guesses=guesses,
        result=result,
        problem=problem,
    )
