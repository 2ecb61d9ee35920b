"""The damped descent of all fits: Gauss-Newton steps, shortened as Levenberg and Marquardt do."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Inexact


Coefficients = Float[np.ndarray, " d"]
P = TypeVar("P", bound="Point")

# Singular values, steps and numbers, relative to the largest of their kind, that are rounding.
# Smaller: rounding counts as information; larger: information of exact data is lost.
ROUNDING = 1e-12
# Leading coefficient of a null vector, relative to its largest one, below which c would overflow:
# the solution of the linearized problem is not used.
NO_LEADING_COEFFICIENT = 1e-8
# Damping after the first failed step, relative to the squared length of each column. Larger: short
# steps; smaller: several attempts until a step lowers the cost.
FIRST_DAMPING = 1e-4
# Factors of the damping: the smallest after a step that lowers the cost (Nielsen 1999), and the
# first after a step that fails. Closer to 1: more attempts; farther: steps too long or short.
_LESS, _MORE = 0.1, 4.0
# Largest damping: steps are then below 1e-8 of the full one. Larger: attempts below rounding;
# smaller: descents stop in narrow valleys.
_MOST_DAMPING = 1e8
# Expected decrease of the cost, relative to it, at the minimum: coefficients are off by 1e-7 of
# their standard errors, times the root of the residuals' number. Smaller: steps lost in rounding.
_SETTLED_GAIN = 1e-14
# If no step lowers the cost: the gain, relative to the cost, that rounding explains. Smaller:
# minima of exact data count as not converged; larger: stalled descents count as converged.
_STALLED_GAIN = 1e-6
# Options of a rough fit: steps, and the decrease of the cost, in units of the noise, that is not
# worth one. More, and smaller: steps that follow noise; fewer, and larger: fits that hardly move.
ROUGH: dict[str, Any] = {"max_steps": 4, "settled_gain": 5.0}


class Point(ABC):
    """A point of a descent, with the local least-squares problem there."""

    cost: float
    """The sum of squares; infinite or NaN where it cannot be computed."""

    @abstractmethod
    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        """Return a step, and the decrease of the cost that the local problem expects of it.

        The squared length of each column of the Jacobian counts 1 + `damping` times.
        """

    @abstractmethod
    def moved(self: P, step: Float[np.ndarray, " P"]) -> P:
        """Return the point after a step; only its `cost` is needed at once."""

    def accepted(self: P) -> P:
        """Return the point from which the descent goes on, e.g. with new weights."""
        return self

    @abstractmethod
    def settled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        """Test whether the undamped step and its expected decrease are too small to matter."""

    @abstractmethod
    def stalled(self, step: Float[np.ndarray, " P"], gain: float) -> bool:
        """Test whether rounding explains that no part of the undamped step lowers the cost."""


def descend(point: P, damping: float = 0.0, max_steps: int = 50) -> tuple[P, bool]:
    """Descend from a point to a minimum; return the last point and whether it is a minimum.

    **Arguments:** `damping`: of the first step. Default: 0, a full Gauss-Newton step; damping then
    begins when a step fails. `max_steps`: default 50.
    """
    for _ in range(max_steps):
        whole = point.step(0.0)
        if point.settled(*whole):
            return point, True
        step, gain = point.step(damping) if damping else whole
        trial, factor = point.moved(step), _MORE
        while not trial.cost < point.cost:
            if damping > _MOST_DAMPING:
                return point, point.stalled(*whole)
            damping, factor = max(damping, FIRST_DAMPING) * factor, 2 * factor
            step, gain = point.step(damping)
            trial = point.moved(step)
        damping *= max(
            _LESS, 1 - (2 * min((point.cost - trial.cost) / gain, 1.0) - 1) ** 3
        )
        point = trial.accepted()
    return point, False


def least_squares(
    linearize: Callable[[Coefficients], tuple[np.ndarray, np.ndarray]],
    start: Coefficients,
    max_steps: int = 50,
    settled_gain: float = 0.0,
) -> tuple[Coefficients, bool]:
    """Minimize a sum of squares whose linear unknowns are eliminated.

    **Arguments:** `linearize(c)` returns the residuals (n,) and their Jacobian (n, d).
    `max_steps`: default 50. `settled_gain`: a decrease of the sum that does not matter.

    **Returns:** the last coefficients, and whether they are a minimum.
    """
    point, converged = descend(_Squares(linearize, start, settled_gain), 0.0, max_steps)
    return point.c, converged


class _Squares(Point):
    """A point of `least_squares`."""

    def __init__(self, linearize: Callable, c: Coefficients, settled_gain: float):
        self.c, self._linearize, self._settled_gain = c, linearize, settled_gain
        with np.errstate(all="ignore"):
            self.residual, self.jacobian = linearize(c)
            self.cost = float(self.residual @ self.residual)

    def step(self, damping: float) -> tuple[Coefficients, float]:
        jacobian, residual = self.jacobian, self.residual
        if damping:
            size = np.sqrt(damping) * np.linalg.norm(jacobian, axis=0)
            jacobian = np.concatenate([jacobian, np.diag(size)])
            residual = np.concatenate([residual, np.zeros(len(size))])
        step = np.linalg.lstsq(jacobian, -residual)[0]
        return step, float(((jacobian @ step) ** 2).sum())

    def moved(self, step: Coefficients) -> "_Squares":
        return _Squares(self._linearize, self.c + step, self._settled_gain)

    def settled(self, step: Coefficients, gain: float) -> bool:
        small = np.linalg.norm(step) <= ROUNDING * (1 + np.linalg.norm(self.c))
        return bool(gain <= max(_SETTLED_GAIN * self.cost, self._settled_gain) or small)

    def stalled(self, step: Coefficients, gain: float) -> bool:
        return bool(gain <= _STALLED_GAIN * self.cost)


class NormalEquations:
    """Linearized least squares for residuals r with the derivatives -J.

    **Arguments:** `gram` (P, P), $J^T J$. `gradient` (P,), $J^T r$.
    """

    def __init__(
        self, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"]
    ):
        self.gradient = gradient
        size = np.sqrt(np.maximum(np.diag(gram), 0))
        self._size = np.where(size > 0, size, 1.0)
        self._values, self._vectors = np.linalg.eigh(
            gram / self._size / self._size[:, None]
        )
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
        vectors, least = (
            self._vectors / self._size[:, None],
            ROUNDING * self._values[-1],
        )
        root = vectors * np.sqrt(unit / np.maximum(self._values, least))
        return Spread(root[:, self._shown], root[:, ~self._shown])


class Spread(NamedTuple):
    """The uncertainty of combinations of unknowns."""

    root: Float[np.ndarray, "P r"]
    """R with $R R^T = v (J^T J)^+$, without undetermined combinations."""
    hidden: Float[np.ndarray, "P h"]
    """The same for undetermined combinations, with the smallest eigenvalue above rounding: a lower
    bound."""

    def variance(
        self, slopes: Inexact[np.ndarray, "P *rest"]
    ) -> Float[np.ndarray, "*rest"]:
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
