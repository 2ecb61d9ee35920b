"""The covariance of the gradient of an output-error problem, from blocks of cycles."""

import numpy as np
from jaxtyping import Float

from ..denominator import Covariance, block_freedom, fading, in_blocks, inverse_of_remainder
from ..htf_errors import amounts
from .cycle_filters import divide_by_chi
from .linearization import Linearization, each_part, linearize
from .output_error import OutputErrorProblem, Part


# Largest correction of a covariance for the freedom that the minimum takes: to 1 / 0.5. Doubled:
# none.
_SMALLEST_FREEDOM = 0.5
# Draws of noise that passes the system, from which its share is estimated. Doubled: standard errors
# scatter by 2 instead of 3 % with the draws.
_PROBES = 16


def gradient_covariance(
    problem: OutputErrorProblem, found: Linearization, cycles: int
) -> Covariance:
    """The covariance of the gradient at the minimum, from blocks of so many cycles or more.

    Errors of neighboring cycles may depend on each other and on the inputs, as those of distortion
    do. Numerators take what these cycles have in common, and no correction of single residuals puts
    that back. Each block's errors are those of a prediction by a fit to the others (the jackknife
    that deletes blocks: Künsch 1989; Bell and McCaffrey 2002), which are larger than the true ones.
    The sum of the squares is therefore taken relative to what it is on average for noise like that
    of the data: part of it white, part of it filtered by 1 / chi, as is noise that drives the
    system. Numerators take more of the latter, and blocks depend on each other there. How much
    there is of both follows from two sums of squares of the residuals (Rao 1971).
    """
    d = len(found.c)
    memory = fading(found.c)
    scores: dict[int, Float[np.ndarray, "B C d"]] = {}
    expectations: dict[int, Float[np.ndarray, "B d d"]] = {}
    squares, passed = np.zeros((2, 1 + _PROBES)), np.zeros((d, d))

    def outputs(k: int, part: Part, n: int):
        """Those of the data, and noise that has passed the system."""
        y = part.y[:, :, n, :, None]
        draws = np.random.default_rng((k, n)).standard_normal((*y.shape[:3], _PROBES))
        return np.concatenate([y, divide_by_chi(memory, draws)], axis=-1)

    def section(k, part, n, fit, regression):
        count = max(1, part.y.shape[1] // cycles)
        weight = part.weight[:, :, n, fit.outputs, None]

        def through_system(x):  # the products with noise that has passed it, of those with white
            return divide_by_chi(memory, (weight * x)[:, ::-1])

        bases = regression.input_basis(fit.root), regression.basis
        inputs, starts = (in_blocks(basis, count) for basis in bases)
        weights = inverse_of_remainder(inputs @ inputs.swapaxes(1, 2))
        x = outputs(k, part, n)[:, :, fit.outputs]
        error = fit.errors(regression, x).reshape(x.shape)
        _, slopes = fit.first.samples(found.c, regression, x[..., :1])
        slopes = np.moveaxis(slopes[..., 0], 1, -1).reshape(*error.shape[:3], d)
        square = [(x**2).sum(axis=(0, 1, 2)) for x in (error, through_system(error))]
        filtered = through_system(slopes)
        filtered = np.einsum("stid,stie->de", filtered, filtered)
        slopes = np.einsum("bkl,blid->bkid", weights, in_blocks(slopes, count))
        score = np.einsum("bkid,bkic->bcd", slopes, in_blocks(error, count))
        expected = np.einsum("bkid,bkie->bde", slopes, slopes)
        for basis in (inputs, starts):
            along = np.einsum("bkr,bkid->brid", basis, slopes)
            expected -= np.einsum("brid,brie->bde", along, along)
        return score, expected, square, filtered

    def collect(k, sections):
        for score, expected, square, filtered in (one for each in sections for one in each):
            scores[k] = scores.get(k, 0.0) + score
            expectations[k] = expectations.get(k, 0.0) + expected
            squares[:] += square
            passed[:] += filtered

    fits = linearize(problem, found.c, outputs).fits
    each_part(problem, found._replace(fits=fits), section, collect)
    # Noise that has passed the system adds to the first sum what white noise adds to the second.
    first, second = squares[:, 1:].mean(axis=1)
    white = np.array([[found.freedom.sum(), first], [first, second]])
    share_white, share_passed = amounts(white, squares[:, 0])
    score = np.concatenate(list(scores.values()))
    by_white = np.concatenate(list(expectations.values()))
    by_passed = np.einsum("bcd,bce->de", score[:, 1:], score[:, 1:]) / _PROBES
    score = score[:, 0]
    expected = share_white * by_white.sum(axis=0) + share_passed * by_passed
    true = share_white * found.curvature.sum(axis=0) + share_passed * passed
    # In units in which noise like that of the data makes the sum one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected))
        true = np.linalg.cholesky(true)
        share = np.linalg.inv(np.linalg.cholesky(by_white.sum(axis=0)))
    except np.linalg.LinAlgError:  # nothing is left of any block
        return Covariance.unknown(d)
    score, share = score @ half.T, share @ by_white @ share.T
    sum_of_squares = score.T @ score
    # Scores add up to zero at the minimum, which takes this part of the sum away.
    taken = np.einsum("bij,bji->", share, share) / d
    matrix = true @ sum_of_squares @ true.T / max(1 - taken, _SMALLEST_FREEDOM)
    return Covariance(matrix, block_freedom(score, share))
