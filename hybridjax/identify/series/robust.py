"""Losses that outliers do not decide: weights for samples, and what these cost in accuracy."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from .linearization import Linearization, SectionFit, each_part
from .output_error import OutputErrorProblem, Part
from .section_regression import SectionRegression


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


Samples = list[Float[np.ndarray, "S T N ny"]]
"""One number for each sample of each part."""


def weigh_outputs(problem: OutputErrorProblem) -> OutputErrorProblem:
    """With weights that take the outputs themselves for errors, to start from."""
    parts = list(problem.parts())
    spread = np.maximum(_spread(problem, [part.y for part in parts]), _ROUNDING)
    weights = [part.weight * root_weights("huber", part.y / spread) for part in parts]
    return problem.weighed(weights)


def without_outliers(problem: OutputErrorProblem) -> OutputErrorProblem:
    """Without the outputs that are far from all others."""
    parts = list(problem.parts())
    spread = _spread(problem, [part.y for part in parts])
    weights = [np.where(np.abs(part.y) > _FAR * spread, 0.0, part.weight) for part in parts]
    return problem.weighed(weights)


def reweight(problem: OutputErrorProblem, found: Linearization, loss: Loss) -> OutputErrorProblem:
    """In units of the noise, with the weights that a fit suggests."""
    error = misfit(problem, found)
    scale = np.maximum(_spread(problem, error), _ROUNDING)
    weights = [
        np.where(part.weight > 0, root_weights(loss, e / scale), 0.0)
        for part, e in zip(problem.parts(), error, strict=True)
    ]
    return problem.rescale(scale).weighed(weights)


def misfit(problem: OutputErrorProblem, found: Linearization) -> Samples:
    """Unweighted, and without the share that the fit takes of it."""
    errors = [np.zeros(part.y.shape) for part in problem.parts()]

    def section(_, part: Part, n: int, fit: SectionFit, regression: SectionRegression):
        x = part.y[:, :, n, fit.outputs, None]
        error, _ = fit.samples(found.c, regression, x)
        error = error.reshape(x.shape[:3])
        weight = part.weight[:, :, n, fit.outputs]
        remainder = np.maximum(1 - regression.leverage(fit.root), _SMALLEST_REMAINDER)
        left = weight * np.sqrt(remainder)[..., None]
        return n, fit.outputs, np.where(weight > 0, error / np.where(left > 0, left, 1.0), 0.0)

    def collect(k, sections):
        for n, outputs, error in (one for each in sections for one in each):
            errors[k][:, :, n, outputs] = error

    each_part(problem, found, section, collect)
    return errors


def rms_of(problem: OutputErrorProblem, x: Samples) -> Float[np.ndarray, " ny"]:
    """Root mean square of each output's x where the problem has samples."""
    square, count = 0.0, 0
    for part, values in zip(problem.parts(), x, strict=True):
        sampled = part.weight > 0
        square = square + (np.where(sampled, values, 0.0) ** 2).sum(axis=(0, 1, 2))
        count = count + sampled.sum(axis=(0, 1, 2))
    return np.maximum(np.sqrt(square / count), _ROUNDING)


def _spread(problem: OutputErrorProblem, x: Samples) -> Float[np.ndarray, " ny"]:
    """Standard deviation of each output's x, by the median of its modulus."""
    pairs = [(np.abs(a), part.weight > 0) for a, part in zip(x, problem.parts(), strict=True)]
    each = [np.concatenate([a[..., i][s[..., i]] for a, s in pairs]) for i in range(x[0].shape[3])]
    return np.array([np.median(a) for a in each]) / _MEDIAN


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
    ny = problem.shape[2]
    if loss == "squares":
        return Efficiency(np.ones(ny), np.ones(ny))
    total = slope = count = np.zeros(ny)
    for part, error in zip(problem.parts(), misfit(problem, found), strict=True):
        sampled = part.weight > 0
        total = total + (part.weight**2).sum(axis=(0, 1, 2))
        slope = slope + (_slope(loss, error) * sampled).sum(axis=(0, 1, 2))
        count = count + sampled.sum(axis=(0, 1, 2))
    # Of the residuals' squares a share is missing, as of those of least squares.
    kept = found.freedom.sum(axis=0) / count
    return Efficiency(slope / total, found.square.sum(axis=0) / kept / total)
