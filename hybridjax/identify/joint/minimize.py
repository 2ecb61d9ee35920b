"""Levenberg and Marquardt's iteration in local coordinates that are chosen anew for each step."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .characteristic import characteristic_slopes
from .coordinates import LocalCoordinates, local_coordinates
from .frequency import FrequencyProblem
from .normal_equations import NormalEquations
from .periodic_model import PeriodicModel
from .prediction.problem import SeriesProblem


# Damping of the first step, relative to the squared length of each column. Doubled: first steps are
# shorter by up to a half, in directions that the data show badly.
_FIRST_DAMPING = 1e-4
# Damping falls by this factor at most after a step that lowers the cost as expected, and stays
# where half of the gain comes (Nielsen 1999). Doubled: fewer steps fail, more are short.
_LESS = 0.1
# Factor by which damping rises after a step that does not lower the cost. Doubled: fewer attempts,
# shorter steps.
_MORE = 4.0
# Largest damping. Doubled: one attempt more before an iteration stalls.
_MOST_DAMPING = 1e8
# The minimum is expected to lie lower than the last cost by less than this for each unknown, in
# units of the errors' variance: there the errors of all unknowns add up to 1 for each. Doubled: rms
# errors grow by another 0.5 %.
_SETTLED_GAIN = 1e-2
# And the characteristic polynomial's coefficients there to differ by less than this part of their
# variance. Doubled: multipliers miss the minimum by 4.5 instead of 3.2 % of their standard errors.
_SETTLED_SHIFT = 1e-3
# If no step lowers the cost: the gain that the minimum promises, relative to the cost, or the
# largest entry of the step there, that rounding explains: that of numbers, made 1e6 times as large
# by slow states. Doubled: iterations that stall count as converged more often.
_STALLED_GAIN, _STALLED_STEP = 1e-10, 1e-8


class Minimum(NamedTuple):
    coordinates: LocalCoordinates
    equations: NormalEquations
    cost: float
    converged: bool
    problem: FrequencyProblem | SeriesProblem
    """With the last weights."""


def minimize(
    problem: FrequencyProblem | SeriesProblem,
    model: PeriodicModel,
    direct: bool,
    max_steps: int,
    settled_gain: float = _SETTLED_GAIN,
) -> Minimum:
    """The model that makes the cost smallest, from this one on.

    After each step the problem takes the weights that its errors suggest, where these are unknown.
    The log determinant of their covariance is concave, so that a step that lowers the cost with the
    weights of before raises the likelihood, where no sample is missing. With gaps the covariance is
    that of the pairs that are seen, which is nearly the likelihood's.

    **Arguments:** `direct`: whether D is free. `settled_gain`: what the minimum may promise, of the
    cost, for each unknown.
    """
    model = problem.refined(model, direct)
    cost, damping = problem.cost(model), _FIRST_DAMPING
    coordinates = local_coordinates(model, direct)
    equations = problem.linearize(coordinates)
    for _ in range(max_steps):
        # (A damped step is small also where the minimum is far.)
        whole, most = equations.solution()
        unit = min(1.0, cost / max(problem.residuals - coordinates.size, 1))
        enough = settled_gain * coordinates.size * unit
        if most <= enough and _shift(coordinates, equations, whole) <= _SETTLED_SHIFT * unit:
            return Minimum(coordinates, equations, cost, True, problem)
        step, gain = equations.step(damping)
        model, more = problem.refined(coordinates.moved(step), direct), _MORE
        while (lower := problem.cost(model)) >= cost:
            if damping > _MOST_DAMPING:
                small = most <= _STALLED_GAIN * cost or np.abs(whole).max() < _STALLED_STEP
                return Minimum(coordinates, equations, cost, bool(small), problem)
            damping, more = damping * more, 2 * more
            step, gain = equations.step(damping)
            model = problem.refined(coordinates.moved(step), direct)
        damping *= max(_LESS, 1 - (2 * min((cost - lower) / gain, 1.0) - 1) ** 3)
        again = problem.reweighted(model)
        cost = lower if again is problem else again.cost(model)
        problem = again
        coordinates = local_coordinates(model, direct)
        equations = problem.linearize(coordinates)
    return Minimum(coordinates, equations, cost, False, problem)


def _shift(
    coordinates: LocalCoordinates, equations: NormalEquations, step: Float[np.ndarray, " P"]
) -> float:
    """The squared change of the characteristic polynomial's coefficients, in units of their
    covariance, for each of them."""
    _, slopes = characteristic_slopes(coordinates)
    change = np.linalg.lstsq(slopes @ equations.spread().root, slopes @ step)[0]
    return float(change @ change) / len(slopes)
