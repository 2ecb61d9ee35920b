"""The covariance of the denominator's coefficients, from blocks of cycles."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from ..denominator import (
    Covariance,
    block_freedom,
    correlated_cycles,
    fading,
    in_blocks,
    inverse_of_remainder,
    multipliers_of,
    sandwich,
)
from ..htf_errors import amounts
from .linearization import Linearization, each_fit, linearize, measured_outputs
from .output_error import OutputErrorProblem
from .records import CycleGrid, divide_by_chi


# Draws of pure noise from which the noise in the Jacobian is estimated, and draws of noise filtered
# by the system. Fewer: standard errors scatter with the draws, by 3 % for 16; more: time.
_WHITE_DRAWS, _FILTERED_DRAWS = 4, 16


def coefficient_covariance(
    problem: OutputErrorProblem,
    solution: Linearization,
    errors: Literal["residuals", "white"],
) -> Covariance:
    """Return the covariance of c; with "residuals" errors may depend on each other and on u."""

    def draws(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny C"]:
        sampled = part.sampled[:, :, n, :, None]
        white = np.random.default_rng((k, n)).standard_normal((*sampled.shape[:3], _WHITE_DRAWS))
        return white * sampled

    noise = linearize(problem, solution.c, draws).curvature / _WHITE_DRAWS
    curvature, whole = (solution.curvature - noise).sum(axis=0), solution.curvature.sum(axis=0)
    if errors == "white" or not np.linalg.eigvalsh(whole)[0] > 0:
        return sandwich(curvature, whole)
    lags = correlated_cycles(multipliers_of(solution.c), problem.records.cycles)
    gradient = gradient_covariance(problem, solution, lags + 1)
    return sandwich(curvature, gradient.matrix)._replace(freedom=gradient.freedom)


def gradient_covariance(
    problem: OutputErrorProblem, solution: Linearization, cycles: int
) -> Covariance:
    """Return the covariance of the gradient at the minimum, from blocks of at least so many cycles.

    Errors of neighboring cycles may depend on each other and on the inputs. Numerators take the
    common part of these errors, and no correction of single residuals restores it. The errors of a
    block are therefore those of a prediction by a fit to the other blocks (delete-block jackknife:
    Künsch 1989; Bell and McCaffrey 2002), which are larger than the true ones. The sum of their
    squares is divided by its expectation for noise like that of the data, which has two parts:
    white noise, and noise filtered by 1 / chi, as process noise is. The amounts of both follow from
    two sums of squares of the residuals (variance components: Rao 1971).
    """
    d = len(solution.c)
    memory = fading(solution.c)

    def outputs(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny C"]:
        """Return the outputs, and noise filtered by the system."""
        y = measured_outputs(k, part, n)
        draws = np.random.default_rng((k, n)).standard_normal((*y.shape[:3], _FILTERED_DRAWS))
        return np.concatenate([y, divide_by_chi(memory, draws)], axis=-1)

    def section(k, part, n, fit, regression):
        count = max(1, part.y.shape[1] // cycles)
        sampled = part.sampled[:, :, n, fit.outputs, None]

        def backward(x):  # its product with white noise is that of x with filtered noise
            return divide_by_chi(memory, (sampled * x)[:, ::-1])

        bases = regression.input_basis(fit.root), regression.basis
        inputs, starts = (in_blocks(basis, count) for basis in bases)
        weights = inverse_of_remainder(inputs @ inputs.swapaxes(1, 2))
        x = outputs(k, part, n)[:, :, fit.outputs]
        error = regression.residual(fit.coefficients, x).reshape(x.shape)
        _, slopes = fit.first.samples(solution.c, regression, x[..., :1])
        slopes = np.moveaxis(slopes[..., 0], 1, -1).reshape(*error.shape[:3], d)
        square = [(x**2).sum(axis=(0, 1, 2)) for x in (error, backward(error))]
        late = backward(slopes)
        slopes = np.einsum("bkl,blid->bkid", weights, in_blocks(slopes, count))
        score = np.einsum("bkid,bkic->bcd", slopes, in_blocks(error, count))
        expected = np.einsum("bkid,bkie->bde", slopes, slopes)
        for basis in (inputs, starts):
            along = np.einsum("bkr,bkid->brid", basis, slopes)
            expected -= np.einsum("brid,brie->bde", along, along)
        return score, expected, square, np.einsum("stid,stie->de", late, late)

    fits = linearize(problem, solution.c, outputs).fits
    results = each_fit(problem, solution._replace(fits=fits), section)
    score, by_white = (
        np.concatenate([sum(result[i] for result in grid) for grid in results]) for i in (0, 1)
    )
    squares = np.sum([result[2] for grid in results for result in grid], axis=0)
    filtered = sum(result[3] for grid in results for result in grid)
    # Filtered noise adds to the first sum of squares as much as white noise adds to the second.
    first, second = squares[:, 1:].mean(axis=1)
    white = np.array([[solution.freedom.sum(), first], [first, second]])
    of_white, of_filtered = amounts(white, squares[:, 0])
    by_filtered = np.einsum("bcd,bce->de", score[:, 1:], score[:, 1:]) / _FILTERED_DRAWS
    expected = of_white * by_white.sum(axis=0) + of_filtered * by_filtered
    true = of_white * solution.curvature.sum(axis=0) + of_filtered * filtered
    # In units in which noise like that of the data makes the sum one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected))
        true = np.linalg.cholesky(true)
        share = np.linalg.inv(np.linalg.cholesky(by_white.sum(axis=0)))
    except np.linalg.LinAlgError:  # nothing is left of any block
        return Covariance.unknown(d)
    scaled, share = score[:, 0] @ half.T, share @ by_white @ share.T
    # Scores add up to zero at the minimum, which takes this part of the sum away.
    taken = np.einsum("bij,bji->", share, share) / d
    matrix = true @ scaled.T @ scaled @ true.T / max(1 - taken, 0.5)
    return Covariance(matrix, block_freedom(scaled, share))
