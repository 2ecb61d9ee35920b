"""The descent of a periodic model to the nearest minimum: Gauss-Newton steps with
Levenberg-Marquardt damping.

`joint/fit.py` calls `descend` with a `ModelPoint` (a model and its least-squares problem), and gets
the last point and whether it is a minimum. The descent is not left to a library because each step
changes the problem: local coordinates are those of the last model, and the weights of time series
are those of its errors. A fit that ends too early has its cause in `settled` or `stalled`.
"""

from contextlib import suppress
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ..descent import NormalEquations
from ..periodic import (
    LocalCoordinates,
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from ..series.prediction import SeriesProblem
from .frequency import FrequencyProblem


Problem = FrequencyProblem | SeriesProblem

# The first damping, relative to the squared length of each column. Larger: short steps; smaller:
# several attempts until a step lowers the cost.
_FIRST_DAMPING = 1e-4
# Factors of the damping: `_LESS` is the smallest after a step that lowers the cost (Nielsen 1999),
# and the other one the first after a step that fails. Closer to 1: more attempts. Farther: steps
# are too long or too short.
_LESS = 0.1
_MORE = 4.0
# Largest damping, with which steps are below 1e-8 of the full step. Larger: steps are rounding
# errors. Smaller: descents stop in narrow valleys.
_MOST_DAMPING = 1e8
# A point is a minimum if the expected decrease of the cost, per unknown and in units of the errors'
# variance, is below this. Larger: rms errors grow (by 0.5 % for 2e-2). Smaller: steps without
# effect.
_SETTLED_GAIN = 1e-2
# In addition, the expected squared change of the coefficients of the characteristic polynomial, in
# units of their variance, must be below this. Larger: multipliers miss the minimum (at 1e-3, by 3 %
# of their standard errors).
_SETTLED_SHIFT = 1e-3
# If no step lowers the cost, the descent has converged up to rounding if the expected relative
# gain, or the largest entry of the step, is below these numbers. (Slow states amplify rounding by
# up to 1e6.) Larger: stalled descents count as converged. Smaller: minima of exact data do not.
_STALLED_GAIN = 1e-10
_STALLED_STEP = 1e-8


class ModelPoint:
    """A model, and the local least-squares problem there."""

    def __init__(self, problem: Problem, model: PeriodicModel, direct: bool):
        self.problem = problem
        self.direct = direct
        self.model = model
        # A resonant model is not refined. A model that overflows has no finite cost.
        with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):
            self.model = model.refined(direct, problem.linearize)
        self.cost = problem.cost(self.model)

    @cached_property
    def coordinates(self) -> LocalCoordinates:
        return local_coordinates(self.model, self.direct)

    @cached_property
    def equations(self) -> NormalEquations:
        return self.problem.linearize(self.coordinates)

    def moved(self, step: Float[np.ndarray, " P"]) -> "ModelPoint":
        return ModelPoint(self.problem, self.coordinates.moved(step), self.direct)

    def reweighted(self) -> "ModelPoint":
        """Return the point with new weights.

        The log determinant of the errors' covariance is concave. If no sample is missing, a step
        that lowers the cost with the old weights therefore raises the likelihood. With gaps, the
        covariance is computed from the pairs of outputs that are sampled together, which is nearly
        the same.
        """
        if isinstance(self.problem, SeriesProblem):
            self.problem = self.problem.reweighted(self.model)
            self.cost = self.problem.cost(self.model)
        return self

    def settled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        """Test whether the undamped step and its expected decrease are too small to matter."""
        size = self.coordinates.size
        degrees = max(self.problem.residuals - size, 1)
        unit = min(1.0, self.cost / degrees)
        if gain > _SETTLED_GAIN * size * unit:
            return False
        _, slopes = characteristic_slopes(self.coordinates)
        root = slopes @ self.equations.spread().root
        change = np.linalg.lstsq(root, slopes @ step)[0]
        return bool(change @ change <= _SETTLED_SHIFT * unit * len(slopes))

    def stalled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        """Test whether rounding explains that no part of the undamped step lowers the cost."""
        small = np.abs(step).max() < _STALLED_STEP
        return bool(gain <= _STALLED_GAIN * self.cost or small)


def descend(point: ModelPoint, max_steps: int = 50) -> tuple[ModelPoint, bool]:
    """Descend from a point to a minimum; return the last point and whether it is a minimum."""
    damping = _FIRST_DAMPING
    for _ in range(max_steps):
        whole = point.equations.step(0.0)
        if point.settled(*whole):
            return point, True
        step, gain = point.equations.step(damping)
        trial = point.moved(step)
        factor = _MORE
        while not trial.cost < point.cost:
            if damping > _MOST_DAMPING:
                return point, point.stalled(*whole)
            damping = max(damping, _FIRST_DAMPING) * factor
            factor = 2 * factor
            step, gain = point.equations.step(damping)
            trial = point.moved(step)
        kept = min((point.cost - trial.cost) / gain, 1.0)
        damping *= max(_LESS, 1 - (2 * kept - 1) ** 3)
        point = trial.reweighted()
    return point, False
