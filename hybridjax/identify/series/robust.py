"""Losses in which outliers count less: weights of samples, and their price in accuracy."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..descent import Coefficients
from ..htf_errors import SMALLEST_ERROR
from .linearization import Linearization, SectionFit, each_fit, minimize
from .output_error import OutputErrorProblem, SectionRegression
from .records import CycleGrid


Loss = Literal["squares", "huber"]
Samples = list[Float[np.ndarray, "_ _ N ny"]]
"""A number for each sample of each grid."""

# Where Huber's loss becomes linear, in standard deviations: 95 % as efficient as squares for
# Gaussian errors. Larger: outliers count more; smaller: Gaussian errors are met less efficiently.
_HUBER = 1.345
# The median of the modulus of a standard normal variable.
_MEDIAN = 0.6745
# Outputs beyond so many standard deviations are left out of the start. Larger: outliers move the
# start; smaller: large responses are left out.
_FAR = 6.0
# Iterations of the weights at most, and the change of c, relative to 1 + |c|, of the last one.
_MAX_REWEIGHTINGS, _SETTLED = 50, 1e-6


def _root_weights(error: np.ndarray) -> np.ndarray:
    """Return the roots of the weights with which least squares minimize Huber's loss.

    **Arguments:** `error`: in standard deviations (Holland and Welsch 1977).
    """
    return np.sqrt(_HUBER / np.maximum(np.abs(error), _HUBER))


def without_outliers(problem: OutputErrorProblem) -> OutputErrorProblem:
    """Return the problem without the outputs that are far from all others."""
    parts = problem.parts()
    spread = _spread(problem, [part.y for part in parts])
    weights = [np.where(np.abs(part.y) > _FAR * spread, 0.0, part.weight) for part in parts]
    return problem.weighed(weights)


def minimize_robust(
    problem: OutputErrorProblem, start: Coefficients, max_steps: int
) -> tuple[OutputErrorProblem, Coefficients, Linearization, bool]:
    """Return the minimum of Huber's loss by iteratively reweighted least squares."""
    outputs = [part.y for part in problem.parts()]
    spread = np.maximum(_spread(problem, outputs), SMALLEST_ERROR)
    problem = _with_weights(problem, [y / spread for y in outputs])
    c, solution, converged = minimize(problem, start, max_steps)
    for _ in range(_MAX_REWEIGHTINGS):
        before, error = c, misfit(problem, solution)
        scale = np.maximum(_spread(problem, error), SMALLEST_ERROR)
        problem = _with_weights(problem.rescale(scale), [e / scale for e in error])
        c, solution, _ = minimize(problem, c, 1)
        converged = bool(np.abs(c - before).max() <= _SETTLED * (1 + np.abs(c).max()))
        if converged:
            break
    return problem, c, solution, converged


def _with_weights(problem: OutputErrorProblem, error: Samples) -> OutputErrorProblem:
    pairs = zip(problem.parts(), error, strict=True)
    return problem.weighed([_root_weights(e) * part.sampled for part, e in pairs])


def misfit(problem: OutputErrorProblem, solution: Linearization) -> Samples:
    """Return the residuals, unweighted and corrected for the share that the fit takes of them."""

    def section(_, part: CycleGrid, n: int, fit: SectionFit, regression: SectionRegression):
        x = part.y[:, :, n, fit.outputs]
        error = regression.residual(fit.coefficients[..., 0], x).reshape(x.shape)
        weight = part.weight[:, :, n, fit.outputs]
        remainder = np.maximum(1 - regression.leverage(fit.root), 0.5)
        left = weight * np.sqrt(remainder)[..., None]
        return n, fit.outputs, np.where(weight > 0, error / np.where(left > 0, left, 1.0), 0.0)

    errors = [np.zeros(part.y.shape) for part in problem.parts()]
    for whole, results in zip(errors, each_fit(problem, solution, section), strict=True):
        for n, outputs, error in results:
            whole[:, :, n, outputs] = error
    return errors


def rms_of(problem: OutputErrorProblem, x: Samples) -> Float[np.ndarray, " ny"]:
    """Return the root mean square of each output's x where the problem has samples."""
    pairs = [(part.sampled, a) for part, a in zip(problem.parts(), x, strict=True)]
    square = sum(((a**2) * sampled).sum(axis=(0, 1, 2)) for sampled, a in pairs)
    count = sum(sampled.sum(axis=(0, 1, 2)) for sampled, _ in pairs)
    return np.maximum(np.sqrt(square / count), SMALLEST_ERROR)


def _spread(problem: OutputErrorProblem, x: Samples) -> Float[np.ndarray, " ny"]:
    """Return the standard deviation of each output's x, from the median of its modulus."""
    pairs = [(np.abs(a), part.sampled) for a, part in zip(x, problem.parts(), strict=True)]
    each = [np.concatenate([a[..., i][s[..., i]] for a, s in pairs]) for i in range(x[0].shape[3])]
    return np.array([np.median(a) for a in each]) / _MEDIAN


class Efficiency(NamedTuple):
    """The effect of a loss on the accuracy of a fit, for each output (Huber, *Robust Statistics*,
    1981, sec. 7.6): 1 for squares, in units of the noise."""

    curvature: Float[np.ndarray, " ny"]
    """Mean second derivative of the loss, relative to the mean weight."""
    variance: Float[np.ndarray, " ny"]
    """Mean square of its derivative, relative to the mean weight."""

    @property
    def noise(self) -> Float[np.ndarray, " ny"]:
        """Standard deviation of Gaussian errors for which least squares are as accurate."""
        return np.sqrt(self.variance) / self.curvature


def efficiency(problem: OutputErrorProblem, solution: Linearization, loss: Loss) -> Efficiency:
    """Return the efficiency of the loss at its minimum."""
    ny = problem.shape[2]
    if loss == "squares":
        return Efficiency(np.ones(ny), np.ones(ny))
    total = slope = count = np.zeros(ny)
    for part, error in zip(problem.parts(), misfit(problem, solution), strict=True):
        total = total + (part.weight**2).sum(axis=(0, 1, 2))
        slope = slope + ((np.abs(error) < _HUBER) & part.sampled).sum(axis=(0, 1, 2))
        count = count + part.sampled.sum(axis=(0, 1, 2))
    # The unknowns take a share of the residuals' squares, as in least squares.
    kept = solution.freedom.sum(axis=0) / count
    return Efficiency(slope / total, solution.square.sum(axis=0) / kept / total)
