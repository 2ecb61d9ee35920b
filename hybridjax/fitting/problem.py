"""Weighted residuals of data as a function of free parameters (`FitProblem`), and their
minimization (`descend`).

`fit.py` calls `free_parameters` and `descend`. Parameters are changed in coordinates x without
bounds (`Parameters.encode` and `decode`, which must stay inverse to each other). `evaluate` returns
residuals and their Jacobian at x; `TransientProblem` does the same for trajectories, without a
limit cycle. Residuals must be infinite where there is no cycle (`_joined`): `descend` then takes a
shorter step. A further kind of free parameter, as delays are one, needs a case in `_value`,
`of_system` and `Parameters.observed`.

An iteration that ends too early has its cause in `descend`. If a Jacobian is wrong, look at
`candidate_cycle`, and compare the two ways of `evaluate`; if a name or a bound is refused without
need, look at `free_parameters`.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import Numbers
from .._core.boundary.values import Reals
from .._core.compilation import kind, quick_jit
from .._core.executor import is_inside_program, on_the_cpu
from .._core.host_derivatives import NotOnHostError, only_on_host
from .._core.results import Result
from ..errors import DefinitionError
from ..identify.weights import estimated_noise
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import keep_turn, last_turn
from ..orbits.newton import MAX_STEPS as NEWTON_STEPS, root, solve
from ..orbits.return_map import Turn
from ..systems.system import HybridSystem, arrays_of
from ..systems.varied import parameter_of, with_parameters
from .observations import AbstractObservation, ObservedHTF
from .transients import ObservedTrajectory, residuals_of, start_value, with_start


# The iteration ends when a step changes neither the coordinates nor the residuals by more than
# this, absolutely and relatively (both have no unit). Larger: parameters are less accurate than the
# data allow. Smaller: steps that only change rounding errors.
_TOLERANCE = 1e-9
# Largest number of evaluations of the model from one guess. Fewer: distant guesses do not converge.
# More: hopeless guesses take longer.
MAX_STEPS = 64
# No step is taken along directions whose sensitivity is below this part of the largest one. If even
# the largest sensitivity is below this number, no step can improve the fit. Larger: badly
# identified parameters keep their initial values. Smaller: unidentifiable parameters drift away.
_RCOND = 1e-8
# A step is accepted if the cost falls by the part `_ACCEPTED` of the predicted reduction. If it
# falls by the part `_GOOD`, the damping is reduced, otherwise increased. Lower: steps without gain
# are accepted, or steps oscillate about the minimum. Higher: good steps are repeated, or made too
# short.
_ACCEPTED, _GOOD = 0.01, 0.5
# The first damping, and the factor by which it changes. Higher: more steps until the damping is
# right. Lower: first steps are too long, or more steps until the damping is right.
_DAMPING, _FACTOR = 3e-3, 4.0

# Names of the entries of `ObservedHTF.delay` among the free parameters.
DELAYS = "input_delay", "output_delay"
# Probability that the residuals of a right model are called a misfit (up to five times that, where
# variances were estimated from few realizations). Larger: right models are doubted. Smaller: wrong
# models whose parameters are a few standard errors off pass.
FALSE_ALARMS = 1e-3
# Text between the name of a state and the number of a trajectory, in names of unknown initial
# states.
AT_START = " at start "

Observations = Sequence[AbstractObservation]
Bounds = Annotated[Numbers, Reals("2", infinite=True)]
Free = str | Sequence[str] | Mapping[str, Bounds | None]


class Parameters(eqx.Module):
    r"""The free parameters of a system, and coordinates x for them that have no bounds.

    With a bound on one side $v = l + e^x$ or $v = h - e^x$; with two $v = l + (h - l)/(1 +
    e^{-x})$; without any $v = s x$, with the size s of the first guess (1 if that is zero: then
    the parameter's unit matters, unless it has bounds). A parameter that only keeps its sign is
    therefore changed by factors.

    **Fields:** `names`; `low`, `high` (p,), infinite where there is no bound; `size` (p,).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    size: Float[Array, " p"]

    def read(
        self, system: HybridSystem, observations: Observations
    ) -> Float[Array, " p"]:
        """Return the values of a system, and the delays of its observations."""
        return jnp.stack([_value(system, observations, name) for name in self.names])

    @eqx.filter_jit
    def insert(self, system: HybridSystem, values: Float[Array, " p"]) -> HybridSystem:
        """Return the system with other values."""
        named = zip(self.names, values, strict=True)
        return with_parameters(
            system, {name: x for name, x in named if of_system(name)}
        )

    def observed(
        self, observations: Observations, values: Float[Array, " p"]
    ) -> list[AbstractObservation]:
        """Return the observations with other delays."""
        named = {name: values[k] for k, name in enumerate(self.names) if name in DELAYS}

        def changed(o):
            if not named or getattr(o, "delay", None) is None:
                return o
            both = dict(zip(DELAYS, o.delay, strict=True)) | named
            return eqx.tree_at(lambda o: o.delay, o, jnp.stack([*both.values()]))

        return [changed(o) for o in observations]

    @eqx.filter_jit
    def encode(self, values: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """Return the coordinates of parameter values; NaN for a value outside of its bounds."""
        low, high, cases = self._bounds()
        up = values - low
        down = high - values
        logarithms = [jnp.log(up / down), jnp.log(up), jnp.log(down)]
        return jnp.select(cases, logarithms, values / self.size)

    @eqx.filter_jit
    def decode(self, x: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """Return values at coordinates x."""
        low, high, cases = self._bounds()
        inside = low + (high - low) * jax.nn.sigmoid(x)
        return jnp.select(
            cases, [inside, low + jnp.exp(x), high - jnp.exp(x)], x * self.size
        )

    def _bounds(self) -> tuple[Array, Array, list[Array]]:
        """Return the bounds with zero in place of infinity; and masks of parameters with both
        bounds, a lower bound, and an upper bound."""
        has_low = jnp.isfinite(self.low)
        has_high = jnp.isfinite(self.high)
        low = jnp.where(has_low, self.low, 0.0)
        high = jnp.where(has_high, self.high, 0.0)
        return low, high, [has_low & has_high, has_low, has_high]


def of_system(name: str) -> bool:
    """Test whether a free parameter is one of the system."""
    return name not in DELAYS and AT_START not in name


def _value(system: HybridSystem, observations: Observations, name: str) -> Array:
    """The value of a free parameter: of the system, a delay of observations, or a state at the
    start of a trajectory.

    **Raises:** `DefinitionError` for a delay that no observation has.
    """
    if AT_START in name:
        state, _, number = name.partition(AT_START)
        trajectory = observations[int(number) - 1]
        assert isinstance(trajectory, ObservedTrajectory)
        return start_value(trajectory, system, state)
    if name not in DELAYS:
        return parameter_of(system, name)
    delays = [
        o.delay
        for o in observations
        if isinstance(o, ObservedHTF) and o.delay is not None
    ]
    if not delays:
        raise DefinitionError(
            f"'{name}' is free, but no data have a delay: pass `ObservedHTF(..., delay=)`."
        )
    return delays[0][DELAYS.index(name)]


def free_parameters(
    system: HybridSystem, free: Free, observations: Observations = ()
) -> Parameters:
    """Return the free parameters of a system, given as in `fit_model`.

    **Raises:** `DefinitionError` for names that are no numbers of the system, or bounds that do not
    enclose the values that it has.
    """
    names = (free,) if isinstance(free, str) else tuple(free)
    if not names or len(set(names)) < len(names):
        raise DefinitionError(
            f"`free` must name one parameter or more, each once, not {names}."
        )
    names += tuple(
        f"{state}{AT_START}{k}"
        for k, observation in enumerate(observations, 1)
        if isinstance(observation, ObservedTrajectory)
        for state in observation.unknown_states
    )
    rows = []
    for name in names:
        value = float(_value(system, observations, name))
        bounds = free.get(name) if isinstance(free, Mapping) else None
        if AT_START in name:
            bounds = -jnp.inf, jnp.inf
        if bounds is None:  # it keeps its sign
            lowest = 0.0 if value > 0 else -jnp.inf
            highest = 0.0 if value < 0 else jnp.inf
            bounds = (lowest, highest)
        if not bounds[0] < value < bounds[1]:
            raise DefinitionError(
                f"the bounds of '{name}', {bounds[0]:g} and {bounds[1]:g}, must enclose the value "
                f"at which the fit starts, {value:g}."
            )
        rows.append((*bounds, abs(value) or 1.0))
    return Parameters(names, *map(jnp.asarray, np.transpose(rows)))


def candidate_cycle(
    system: HybridSystem, guess: LimitCycle
) -> tuple[LimitCycle, Turn | None]:
    """Return the cycle of a system near the `guess`, as `find_limit_cycle`, under a transformation;
    and its last turn outside of programs.

    `factors` and `pieces` are NaN: derivatives of a cycle's factors are second derivatives of the
    flow, and take two thirds of the time of compilation.
    """
    map = guess.return_map.at_phase_of(system)
    last = None
    if is_inside_program():
        q, turn, steps = root(map, NEWTON_STEPS)
        period = map.turn(q, turn.record).period
        anchor = map.departure(q)
    else:
        anchor, turn, steps, _ = solve(map, True, False, last_turn(guess))
        period = turn.period
        last = turn
    period = map.expected if map.base is None else period
    code = jnp.where(turn.closed, Result.OK, Result.NOT_CONVERGED)
    cycle = dataclasses.replace(
        guess,
        system=system,
        numbers=arrays_of(system),
        period=period,
        anchor=anchor,
        pieces=guess.pieces._replace(q=jnp.full_like(guess.pieces.q, jnp.nan)),
        factors=jnp.full_like(guess.factors, jnp.nan),
        residual=turn.distance,
        iterations=steps,
        result=jnp.where(turn.result == Result.OK, code, turn.result),
    )
    if last is not None:
        keep_turn(cycle, last)
    return cycle, last


def tail_of(
    cost: Float[np.ndarray, "*n"] | float, dof: float, most: float
) -> Float[np.ndarray, "*n"]:
    """Return the probability that a right model has a cost as large.

    The squares of errors in units of estimated variances have Fisher's distribution. Their sum is
    taken as chi-squared with the same mean and variance (Satterthwaite 1946).

    **Arguments:** `most`: largest mean square that estimated variances explain; 1 for known ones.
    """
    from scipy import special  # (a fifth of a second)

    level, deviation = estimated_noise(most, most)
    if not np.isfinite(deviation):
        return np.ones_like(cost)
    times_fewer = deviation**2
    return special.chdtrc(dof / times_fewer, cost / level / times_fewer)


class FitProblem(eqx.Module):
    """Weighted residuals as a function of the coordinates x of the free parameters."""

    parameters: Parameters
    observations: tuple[AbstractObservation, ...]

    @property
    def weighted(self) -> bool:
        """True if all data have standard deviations."""
        return all(bool(observation.weighted) for observation in self.observations)

    def unit(self, cost: float, dof: float) -> float:
        """Return the factor of covariances of a fit, from its cost relative to the expected value.
        With estimated variances, it corrects for their scatter; without variances, it is this ratio
        itself (NaN if there are no degrees of freedom)."""
        misfit = cost / max(dof, 1)
        if not self.weighted:
            return max(misfit, np.finfo(float).tiny) if dof else np.nan
        _, deviation = estimated_noise(self.most, misfit)
        return deviation**2

    @property
    def most(self) -> float:
        """Largest mean square of the residuals that estimated variances explain."""
        htfs = [x for x in self.observations if isinstance(x, ObservedHTF)]
        return max((float(x.most) for x in htfs), default=1.0)

    def evaluated(
        self, x: Float[Array | np.ndarray, " p"], guess: LimitCycle | None
    ) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"], Any]:
        """Return residuals and Jacobian at x, and a guess for parameters near x."""
        assert guess is not None
        return evaluate(self, x, guess)

    def residuals(
        self, x: Float[Array, " p"], guess: LimitCycle
    ) -> tuple[Array, tuple]:
        """Return the residuals (r,), infinite where there is no limit cycle, or no observation on
        it; and the anchor, the period and the last turn of the cycle."""
        values = self.parameters.decode(x)
        cycle, turn = candidate_cycle(
            self.parameters.insert(guess.system, values), guess
        )
        observations = self.parameters.observed(self.observations, values)
        parts = [observation.residuals(cycle) for observation in observations]
        return _joined(parts, cycle.result), (cycle.anchor, cycle.period, turn)


class TransientProblem(FitProblem):
    """Weighted residuals of trajectories, which need no limit cycle."""

    system: HybridSystem

    def of_values(self, x: Float[Array, " p"]) -> Float[Array, " r"]:
        """Return the residuals (r,), infinite where a flow lacks a measurement."""
        values = self.parameters.decode(x)
        system = self.parameters.insert(self.system, values)
        named = dict(zip(self.parameters.names, values, strict=True))
        parts = []
        for k, observation in enumerate(self.observations, 1):
            assert isinstance(observation, ObservedTrajectory)
            start = {
                state: named[f"{state}{AT_START}{k}"]
                for state in observation.unknown_states
            }
            moved = with_start(observation, system, start)
            parts.append(residuals_of(moved, system))
        return _joined(parts, Result.OK)

    def evaluated(
        self, x: Float[Array | np.ndarray, " p"], guess: LimitCycle | None
    ) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"], Any]:
        r, J = jax.device_get(_transient(self, jnp.asarray(x)))
        return r, J, None


@quick_jit
def _transient(problem: TransientProblem, x: Float[Array, " p"]) -> tuple[Array, Array]:
    """Residuals and their Jacobian, all columns in one pass."""

    def push(direction):
        return jax.jvp(problem.of_values, (x,), (direction,))

    return jax.vmap(push, out_axes=(None, -1))(np.eye(len(x)))


@jax.jit
def _joined(parts, result):
    """Residuals of all observations, one after the other; infinite if one of them is not finite, or
    if there is no cycle."""
    r = jnp.concatenate(parts)
    is_finite = jnp.isfinite(r).all()
    return jnp.where((result == Result.OK) & is_finite, r, jnp.inf)


def _with_jacobian(problem: FitProblem, x, guess):
    """Return residuals (r,), their Jacobian (r, p) with all columns in one pass, in forward mode,
    and the anchor, the period and the last turn."""

    def at(x):
        return problem.residuals(x, guess)

    def push(direction):
        return jax.jvp(at, (x,), (direction,), has_aux=True)

    along = jax.vmap(push, out_axes=(None, -1, None))
    return along(np.eye(x.shape[0]))


_compiled = quick_jit(_with_jacobian)
_not_on_host: set[tuple] = set()


def evaluate(
    problem: FitProblem, x: Float[Array | np.ndarray, " p"], guess: LimitCycle
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"], LimitCycle]:
    """Return residuals and Jacobian at x, computed on the host if the derivatives are available
    there; and a guess for parameters near x."""
    arguments = problem, jnp.asarray(x), guess
    with on_the_cpu():
        key = kind(arguments)
        values = None
        if key not in _not_on_host:
            try:
                with only_on_host():
                    values = _with_jacobian(*arguments)
            except NotOnHostError:
                _not_on_host.add(key)
        r, J, (anchor, period, turn) = values or _compiled(*arguments)
    near = dataclasses.replace(guess, anchor=anchor, period=period)
    if turn is not None:
        keep_turn(near, turn)
    return *jax.device_get((r, J)), near


def descend(
    problem: FitProblem,
    x: Float[np.ndarray, " p"],
    guess: LimitCycle | None,
    evaluate: Callable = evaluate,
) -> tuple[
    Any, Float[np.ndarray, " r"], Float[np.ndarray, "r p"], LimitCycle | None, int, bool
]:
    """Return the end of the Levenberg-Marquardt iteration from x: coordinates, residuals and their
    Jacobian, a guess for their cycle, number of evaluations, and whether it has converged.
    `evaluate`: another function in place of `evaluate` of this file.

    The damping is relative to the largest sensitivity, so that units of the residuals have no
    effect. (If the data identify only the product of two parameters, `scipy.optimize.least_squares`
    takes 27 evaluations instead of 8, and moves the two to 1e17 and 1e-17.) The iteration runs on
    the host, so that only the model is compiled.
    """
    damping = _DAMPING
    steps = 1
    r, J, near = evaluate(problem, x, guess)

    def step(damping):
        largest = np.linalg.norm(J, 2)
        size = largest if largest > _RCOND else 1.0  # (rounding is no sensitivity)
        penalty = np.sqrt(damping) * size * np.eye(len(x))
        damped = np.concatenate([J, penalty])
        goal = np.append(r, np.zeros(len(x)))
        return np.linalg.lstsq(damped, goal, rcond=_RCOND)[0]

    while steps < MAX_STEPS and np.isfinite(r).all() and np.isfinite(J).all():
        trial = x - step(damping)
        steps += 1
        change = trial - x
        r_new, J_new, nearer = evaluate(problem, trial, near)
        predicted = (J @ change) @ (J @ change + 2 * r)
        gain = (r_new - r) @ (r_new + r)
        is_better = gain <= _ACCEPTED * predicted
        # (For a step as small as this, rounding decides whether it is accepted.)
        done = _small(change, trial) and (_small(r_new - r, r_new) or not is_better)
        if is_better:
            x, r, J, near = trial, r_new, J_new, nearer
        damping *= 1 / _FACTOR if gain < _GOOD * predicted else _FACTOR
        if done:
            # (Steps also become short where no step helps: near parameters without a cycle.)
            gain = r @ J @ step(_RCOND**2)
            converged = bool(gain <= _TOLERANCE * (1 + r @ r))
            return x, r, J, near, steps, converged
    return x, r, J, near, steps, False


def _small(change: Float[np.ndarray, " n"], x: Float[np.ndarray, " n"]) -> bool:
    """Test whether each entry of x has changed by less than the tolerance."""
    allowed = _TOLERANCE * (1 + np.abs(x))
    return bool(np.all(np.abs(change) < allowed))
