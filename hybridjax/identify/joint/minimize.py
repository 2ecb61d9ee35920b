"""Levenberg and Marquardt's iteration in local coordinates that are chosen anew for each step."""

from typing import NamedTuple

import numpy as np

from .coordinates import LocalCoordinates, local_coordinates
from .frequency import FrequencyProblem
from .normal_equations import NormalEquations
from .periodic_model import PeriodicModel
from .series import SeriesProblem


# Damping of the first step, relative to the squared length of each column. Doubled: first steps are
# shorter by up to a half, in directions that the data show badly.
_FIRST_DAMPING = 1e-4
# Factors by which damping falls after a step that lowers the cost, and rises after one that does
# not. Doubled: fewer attempts in all, of which more fail.
_LESS, _MORE = 0.1, 4.0
# Largest damping. Doubled: one attempt more before an iteration stalls.
_MOST_DAMPING = 1e8
# Decrease of the cost, expected or found, in units of variances or relative to a cost below 1, that
# is the last. Doubled: the minimum is missed by 0.14 instead of 0.1 standard errors of one
# combination; more where steps are short, since the data show some combinations badly.
_SETTLED_GAIN = 1e-2
# If no step lowers the cost: the gain, relative to the cost, or the largest entry of the step, that
# rounding explains. Doubled: iterations that stall count as converged more often.
_STALLED_GAIN, _STALLED_STEP = 1e-6, 1e-8


class Minimum(NamedTuple):
    coordinates: LocalCoordinates
    equations: NormalEquations
    cost: float
    converged: bool
    problem: FrequencyProblem | SeriesProblem
    """With the last weights."""


def minimize(
    problem: FrequencyProblem | SeriesProblem, model: PeriodicModel, direct: bool, max_steps: int
) -> Minimum:
    """The model that makes the cost smallest, from this one on.

    After each step the problem takes the weights that its errors suggest, where these are unknown.
    The cost is concave in the covariance of the errors up to terms without the model, so that a
    step that lowers it with the weights of before raises the likelihood.

    **Arguments:** `direct`: whether D is free.
    """
    cost, damping = problem.cost(model), _FIRST_DAMPING
    coordinates = local_coordinates(model, direct)
    equations = problem.linearize(coordinates)
    for _ in range(max_steps):
        step, gain = equations.step(damping)
        if gain <= _SETTLED_GAIN * min(1.0, cost):
            return Minimum(coordinates, equations, cost, True, problem)
        model = coordinates.moved(step)
        while (lower := problem.cost(model)) >= cost:
            if damping > _MOST_DAMPING:
                small = gain <= _STALLED_GAIN * cost or np.abs(step).max() < _STALLED_STEP
                return Minimum(coordinates, equations, cost, bool(small), problem)
            damping *= _MORE
            model = coordinates.moved(equations.step(damping)[0])
        settled = cost - lower <= _SETTLED_GAIN * min(1.0, cost)
        again = problem.reweighted(model)
        cost = lower if again is problem else again.cost(model)
        problem, damping = again, damping * _LESS
        coordinates = local_coordinates(model, direct)
        equations = problem.linearize(coordinates)
        if settled:
            return Minimum(coordinates, equations, cost, True, problem)
    return Minimum(coordinates, equations, cost, False, problem)
