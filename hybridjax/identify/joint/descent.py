"""The damped descent of periodic models, in local coordinates that are chosen anew at each step."""

from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Inexact

from ..descent import FIRST_DAMPING, ROUNDING, Point, descend
from .model import LocalCoordinates, PeriodicModel, characteristic_slopes, local_coordinates


# Expected decrease of the cost at the minimum, for each unknown, in units of the errors' variance.
# Larger: rms errors grow, by 0.5 % for 2e-2; smaller: steps without effect.
_SETTLED_GAIN = 1e-2
# Expected squared change of the characteristic polynomial's coefficients there, in units of their
# variance. Larger: multipliers miss the minimum, at 1e-3 by 3 % of their standard errors.
_SETTLED_SHIFT = 1e-3
# If no step lowers the cost: the gain, relative to the cost, or the largest entry of the step, that
# rounding explains (slow states multiply it by up to 1e6). Larger: stalled descents count as
# converged; smaller: minima of exact data do not.
_STALLED_GAIN, _STALLED_STEP = 1e-10, 1e-8


class NormalEquations:
    """Linearized least squares for residuals r with the derivatives -J.

    **Arguments:** `gram` (P, P), $J^T J$. `gradient` (P,), $J^T r$.
    """

    def __init__(self, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"]):
        self.gradient = gradient
        size = np.sqrt(np.maximum(np.diag(gram), 0))
        self._size = np.where(size > 0, size, 1.0)
        self._values, self._vectors = np.linalg.eigh(gram / self._size / self._size[:, None])
        self._slope = self._vectors.T @ (gradient / self._size)
        self._shown = self._values > ROUNDING * self._values[-1]

    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        """Return a Levenberg-Marquardt step and the decrease of the cost expected from it.

        Without damping the step leaves undetermined combinations as they are.
        """
        values = np.maximum(self._values, 0) + damping
        if not damping:
            values = np.where(self._shown, values, np.inf)
        part = self._slope / values
        return self._vectors @ part / self._size, float(part @ self._slope)

    def spread(self, unit: float = 1.0) -> "Spread":
        """Return the uncertainty of the solution, for errors of this variance."""
        vectors, least = self._vectors / self._size[:, None], ROUNDING * self._values[-1]
        root = vectors * np.sqrt(unit / np.maximum(self._values, least))
        return Spread(root[:, self._shown], root[:, ~self._shown])


class Spread(NamedTuple):
    """The uncertainty of combinations of unknowns."""

    root: Float[np.ndarray, "P r"]
    """R with $R R^T = v (J^T J)^+$, without undetermined combinations."""
    hidden: Float[np.ndarray, "P h"]
    """The same for undetermined combinations, with the smallest eigenvalue above rounding: a lower
    bound."""

    def variance(self, slopes: Inexact[np.ndarray, "P *rest"]) -> Float[np.ndarray, "*rest"]:
        """Return the variance of numbers with these derivatives; infinite if undetermined."""
        shown, hidden = (
            (np.abs(np.tensordot(x.T, slopes, 1)) ** 2).sum(axis=0)
            for x in (self.root, self.hidden)
        )
        return np.where(hidden > shown, np.inf, shown)

    def covariance(self, slopes: Float[np.ndarray, "d P"]) -> Float[np.ndarray, "d d"]:
        """Return the covariance of numbers with these derivatives; all of it is infinite if one
        variance is."""
        if np.isinf(self.variance(slopes.T)).any():
            return np.full((len(slopes), len(slopes)), np.inf)
        half = slopes @ self.root
        return half @ half.T


@runtime_checkable
class Problem(Protocol):
    """A sum of squares of `residuals` numbers, as a function of a model."""

    @property
    def residuals(self) -> int: ...

    def cost(self, model: PeriodicModel) -> float:
        """Return the sum; infinite for a model whose outputs overflow."""
        ...

    def refined(self, model: PeriodicModel, direct: bool) -> PeriodicModel:
        """Return the model with the unknowns that can be eliminated at low cost."""
        ...

    def reweighted(self, model: PeriodicModel) -> "Problem":
        """Return the problem with the weights that the residuals of a model suggest."""
        ...

    def linearize(self, coordinates: LocalCoordinates) -> NormalEquations: ...


class ModelPoint(Point):
    """A model of a descent."""

    def __init__(self, problem: Problem, model: PeriodicModel, direct: bool):
        self.problem, self.direct = problem, direct
        self.model = problem.refined(model, direct)
        self.cost = problem.cost(self.model)

    @cached_property
    def coordinates(self) -> LocalCoordinates:
        return local_coordinates(self.model, self.direct)

    @cached_property
    def equations(self) -> NormalEquations:
        return self.problem.linearize(self.coordinates)

    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        return self.equations.step(damping)

    def moved(self, step: Float[np.ndarray, " P"]) -> "ModelPoint":
        return ModelPoint(self.problem, self.coordinates.moved(step), self.direct)

    def accepted(self) -> "ModelPoint":
        """Return the point with new weights.

        The log determinant of the errors' covariance is concave, so that a step that lowers the
        cost with the old weights raises the likelihood, where no sample is missing. With gaps the
        covariance is that of the pairs that are sampled, which is nearly the likelihood's.
        """
        problem = self.problem.reweighted(self.model)
        if problem is not self.problem:
            self.problem, self.cost = problem, problem.cost(self.model)
        return self

    def settled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        size = self.coordinates.size
        unit = min(1.0, self.cost / max(self.problem.residuals - size, 1))
        if gain > _SETTLED_GAIN * size * unit:
            return False
        _, slopes = characteristic_slopes(self.coordinates)
        change = np.linalg.lstsq(slopes @ self.equations.spread().root, slopes @ step)[0]
        return bool(change @ change <= _SETTLED_SHIFT * unit * len(slopes))

    def stalled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        return bool(gain <= _STALLED_GAIN * self.cost or np.abs(step).max() < _STALLED_STEP)


def minimize(
    problem: Problem, model: PeriodicModel, direct: bool, max_steps: int
) -> tuple[ModelPoint, bool]:
    """Return the minimum of the cost from a model on, and whether it was reached.

    **Arguments:** `direct`: whether D is free.
    """
    return descend(ModelPoint(problem, model, direct), max_steps, FIRST_DAMPING)
