"""Losses that outliers do not decide: weights for samples, and what these cost in accuracy."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from .output_error import Linearization, OutputErrorProblem


Loss = Literal["squares", "huber", "student"]

# Where Huber's loss becomes linear, in standard deviations: 95 % as efficient as squares for normal
# errors. Doubled: outliers count twice as much.
_HUBER = 1.345
# Degrees of freedom of Student's distribution (Lange, Little and Taylor 1989). Doubled: outliers
# count twice as much.
_STUDENT = 4.0
# The median of the modulus of a standard normal variable.
_MEDIAN = 0.6745
# Outputs beyond so many standard deviations are left out of what a fit starts from. Doubled: larger
# outliers move the start.
_FAR = 6.0
# The share of its own error that a fit leaves to a sample, at least, as far as its weight is
# concerned. Doubled: outliers that the fit nearly passes through count more.
_SMALLEST_REMAINDER = 0.5
# Smallest noise of an output in the units of the moment: rounding. Doubled: outputs without noise
# count half as much beside noisy ones.
_ROUNDING = 1e-15


def root_weights(loss: Loss, error: np.ndarray) -> np.ndarray:
    """Roots of the weights of errors, in standard deviations, by which least squares minimize the
    loss (iteratively reweighted: Holland and Welsch 1977)."""
    if loss == "huber":
        return np.sqrt(_HUBER / np.maximum(np.abs(error), _HUBER))
    if loss == "student":
        return np.sqrt((_STUDENT + 1) / (_STUDENT + error**2))
    return np.ones_like(error)


def _slope(loss: Loss, error: np.ndarray) -> np.ndarray:
    """The second derivative of the loss."""
    if loss == "huber":
        return (np.abs(error) < _HUBER).astype(float)
    return (_STUDENT + 1) * (_STUDENT - error**2) / (_STUDENT + error**2) ** 2


def weigh_outputs(problem: OutputErrorProblem) -> OutputErrorProblem:
    """With weights that take the outputs themselves for errors, to start from."""
    weight = root_weights("huber", problem.y / np.maximum(_spread(problem, problem.y), _ROUNDING))
    return problem._replace(weight=problem.weight * weight)


def without_outliers(problem: OutputErrorProblem) -> OutputErrorProblem:
    """Without the outputs that are far from all others."""
    far = np.abs(problem.y) > _FAR * _spread(problem, problem.y)
    return problem._replace(weight=np.where(far, 0.0, problem.weight))


def reweight(problem: OutputErrorProblem, found: Linearization, loss: Loss) -> OutputErrorProblem:
    """In units of the noise, with the weights that a fit suggests."""
    error = misfit(problem, found)
    scale = np.maximum(_spread(problem, error), _ROUNDING)
    weight = root_weights(loss, error / scale)
    return problem.rescale(scale)._replace(weight=np.where(problem.sampled, weight, 0.0))


def misfit(problem: OutputErrorProblem, found: Linearization) -> Float[np.ndarray, "S T N ny"]:
    """Unweighted, and without the share that the fit takes of it."""
    left = problem.weight * np.sqrt(np.maximum(1 - found.leverage, _SMALLEST_REMAINDER))
    return np.where(problem.sampled, found.residual[..., 0] / np.where(left > 0, left, 1.0), 0.0)


def rms_of(
    problem: OutputErrorProblem, x: Float[np.ndarray, "S T N ny"]
) -> Float[np.ndarray, " ny"]:
    """Root mean square of each output's x where the problem has samples."""
    square = (np.where(problem.sampled, x, 0.0) ** 2).sum(axis=(0, 1, 2))
    return np.maximum(np.sqrt(square / problem.sampled.sum(axis=(0, 1, 2))), _ROUNDING)


def _spread(
    problem: OutputErrorProblem, x: Float[np.ndarray, "S T N ny"]
) -> Float[np.ndarray, " ny"]:
    """Standard deviation of each output's x, by the median of its modulus."""
    each = np.moveaxis(np.abs(x), -1, 0), np.moveaxis(problem.sampled, -1, 0)
    return np.array([np.median(a[s]) for a, s in zip(*each, strict=True)]) / _MEDIAN


class Efficiency(NamedTuple):
    """What a loss changes of the accuracy of a fit, for each output (Huber, *Robust Statistics*,
    1981, sec. 7.6): 1 for squares, in units of the noise."""

    curvature: Float[np.ndarray, " ny"]
    """Mean second derivative of the loss, relative to the mean weight."""
    variance: Float[np.ndarray, " ny"]
    """Mean square of its derivative, relative to the mean weight."""

    @property
    def noise(self) -> Float[np.ndarray, " ny"]:
        """Standard deviation of normal errors that would leave least squares as uncertain."""
        return np.sqrt(self.variance) / self.curvature


def efficiency(problem: OutputErrorProblem, found: Linearization, loss: Loss) -> Efficiency:
    ny = problem.y.shape[-1]
    if loss == "squares":
        return Efficiency(np.ones(ny), np.ones(ny))
    total = (problem.weight**2).sum(axis=(0, 1, 2))
    slope = _slope(loss, misfit(problem, found)) * problem.sampled
    # Of the residuals' squares a share is missing, as of those of least squares.
    square = (found.residual**2).sum(axis=(0, 1, 2, 4))
    kept = found.freedom.sum(axis=0) / problem.sampled.sum(axis=(0, 1, 2))
    return Efficiency(slope.sum(axis=(0, 1, 2)) / total, square / kept / total)
