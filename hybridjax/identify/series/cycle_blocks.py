"""How the gradient of an output-error fit scatters, by blocks of successive cycles.

Errors of neighboring cycles may depend on each other and on the inputs, as those of distortion do.
Numerators, many for the cycles there are, then take what these cycles have in common; no
correction of single residuals puts that back.
"""

import numpy as np
from jaxtyping import Float

from ..multipliers.covariance import Covariance
from ..multipliers.gauss_newton import Coefficients
from .cycle_filters import divide_by_chi
from .output_error import Linearization, OutputErrorProblem, section_regressions


# Smallest share of its errors that a fit to all leaves to a block, so that dividing by it stays
# finite. Doubled: blocks that the others hardly predict weigh half as much.
_SMALLEST_REMAINDER = 0.1
# Largest correction of a covariance for the freedom that the minimum takes: to 1 / 0.5. Doubled:
# none.
_SMALLEST_FREEDOM = 0.5


def gradient_covariance(
    problem: OutputErrorProblem, c: Coefficients, found: Linearization, cycles: int
) -> Covariance:
    """The covariance of the gradient at the minimum, from blocks of so many cycles or more.

    Each block's errors are those of a prediction by a fit to the others (the jackknife that deletes
    blocks: Künsch 1989; Bell and McCaffrey 2002), which are larger than the true ones. The sum of
    the squares is therefore taken relative to what it is on average for white noise. Its freedom is
    that by which the blocks scatter (Pan and Wall 2002), at most that of normal errors
    (Satterthwaite 1946).
    """
    T, N, d = *problem.y.shape[1:3], len(c)
    count = max(1, T // cycles)
    length = -(-T // count)
    v = divide_by_chi(c, problem.u)

    def blocks(x):  # (S, T, ...) -> (S count, length, ...)
        padding = [(0, 0), (0, count * length - T)] + [(0, 0)] * (x.ndim - 2)
        return np.pad(x, padding).reshape(-1, length, *x.shape[2:])

    score: Float[np.ndarray, "B d"] = np.zeros((len(problem.y) * count, d))
    expected: Float[np.ndarray, "B d d"] = np.zeros((len(score), d, d))
    for n in range(N):
        for outputs, regression in section_regressions(problem, c, v, n):
            inputs, starts = blocks(regression.input_basis), blocks(regression.basis)
            left, axes = np.linalg.eigh(np.eye(length) - inputs @ inputs.swapaxes(1, 2))
            left = np.maximum(left, _SMALLEST_REMAINDER)[:, None]
            slopes = blocks(np.moveaxis(found.jacobian[:, :, :, n, outputs, 0], 0, -1))
            slopes = np.einsum("bkl,blid->bkid", axes / left @ axes.swapaxes(1, 2), slopes)
            error = blocks(found.residual[:, :, n, outputs, 0])
            score += np.einsum("bkid,bki->bd", slopes, error)
            expected += np.einsum("bkid,bkie->bde", slopes, slopes)
            for basis in (inputs, starts):
                along = np.einsum("bkr,bkid->brid", basis, slopes)
                expected -= np.einsum("brid,brie->bde", along, along)
    # In units in which white noise makes the sum one.
    try:
        half = np.linalg.inv(np.linalg.cholesky(expected.sum(axis=0)))
    except np.linalg.LinAlgError:  # nothing is left of any block
        return Covariance.unknown(d)
    score, share = score @ half.T, half @ expected @ half.T
    sum_of_squares = score.T @ score
    # Scores add up to zero at the minimum, which takes this part of the sum away.
    taken = np.einsum("bij,bji->", share, share) / d
    white = np.linalg.cholesky(np.einsum("istnac,jstnac->ij", found.jacobian, found.jacobian))
    matrix = white @ sum_of_squares @ white.T / max(1 - taken, _SMALLEST_FREEDOM)
    part = np.einsum("bi,ij,bj->b", score, np.linalg.pinv(sum_of_squares), score) / d
    normal = np.trace(share, axis1=1, axis2=2) / d
    scatter = max(((part - normal) ** 2).sum() * d / 2, (normal**2).sum())
    return Covariance(matrix, float(1 / scatter))
