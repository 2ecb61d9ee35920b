"""The covariance of the gradient of an output-error problem, from blocks of cycles."""

import numpy as np
from jaxtyping import Float

from ..multipliers.covariance import Covariance
from .linearization import Linearization, each_part
from .output_error import OutputErrorProblem


# Smallest share of its errors that a fit to all leaves to a block, so that dividing by it stays
# finite. Doubled: blocks that the others hardly predict weigh half as much.
_SMALLEST_REMAINDER = 0.1
# Largest correction of a covariance for the freedom that the minimum takes: to 1 / 0.5. Doubled:
# none.
_SMALLEST_FREEDOM = 0.5


def gradient_covariance(
    problem: OutputErrorProblem, found: Linearization, cycles: int
) -> Covariance:
    """The covariance of the gradient at the minimum, from blocks of so many cycles or more.

    Errors of neighboring cycles may depend on each other and on the inputs, as those of distortion
    do. Numerators take what these cycles have in common, and no correction of single residuals puts
    that back. Each block's errors are those of a prediction by a fit to the others (the jackknife
    that deletes blocks: Künsch 1989; Bell and McCaffrey 2002), which are larger than the true ones.
    The sum of the squares is therefore taken relative to what it is on average for white noise. Its
    freedom is that by which the blocks scatter (Pan and Wall 2002), at most that of normal errors
    (Satterthwaite 1946).
    """
    d = len(found.c)
    scores: dict[int, Float[np.ndarray, "B d"]] = {}
    expectations: dict[int, Float[np.ndarray, "B d d"]] = {}

    def section(part, n, fit, regression):
        T = part.y.shape[1]
        count = max(1, T // cycles)
        length = -(-T // count)

        def blocks(x):  # (S, T, ...) -> (S count, length, ...)
            padding = [(0, 0), (0, count * length - T)] + [(0, 0)] * (x.ndim - 2)
            return np.pad(x, padding).reshape(len(x) * count, length, *x.shape[2:])

        inputs, starts = blocks(regression.input_basis(fit.root)), blocks(regression.basis)
        left, axes = np.linalg.eigh(np.eye(length) - inputs @ inputs.swapaxes(1, 2))
        left = np.maximum(left, _SMALLEST_REMAINDER)[:, None]
        error, slopes = fit.samples(found.c, regression, part.y[:, :, n, fit.outputs, None])
        rows = part.y.shape[:2]
        slopes = blocks(np.moveaxis(slopes[..., 0], 1, -1).reshape(*rows, -1, d))
        slopes = np.einsum("bkl,blid->bkid", axes / left @ axes.swapaxes(1, 2), slopes)
        score = np.einsum("bkid,bki->bd", slopes, blocks(error[..., 0].reshape(*rows, -1)))
        expected = np.einsum("bkid,bkie->bde", slopes, slopes)
        for basis in (inputs, starts):
            along = np.einsum("bkr,bkid->brid", basis, slopes)
            expected -= np.einsum("brid,brie->bde", along, along)
        return score, expected

    def collect(k, sections):
        for score, expected in (one for each in sections for one in each):
            scores[k] = scores.get(k, 0.0) + score
            expectations[k] = expectations.get(k, 0.0) + expected

    each_part(problem, found, section, collect)
    score = np.concatenate(list(scores.values()))
    expected = np.concatenate(list(expectations.values()))
    # In units in which white noise makes the sum one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected.sum(axis=0)))
    except np.linalg.LinAlgError:  # nothing is left of any block
        return Covariance.unknown(d)
    score, share = score @ half.T, half @ expected @ half.T
    sum_of_squares = score.T @ score
    # Scores add up to zero at the minimum, which takes this part of the sum away.
    taken = np.einsum("bij,bji->", share, share) / d
    white = np.linalg.cholesky(found.curvature.sum(axis=0))
    matrix = white @ sum_of_squares @ white.T / max(1 - taken, _SMALLEST_FREEDOM)
    part = np.einsum("bi,ij,bj->b", score, np.linalg.pinv(sum_of_squares), score) / d
    normal = np.trace(share, axis1=1, axis2=2) / d
    scatter = max(((part - normal) ** 2).sum() * d / 2, (normal**2).sum())
    return Covariance(matrix, float(1 / scatter))
