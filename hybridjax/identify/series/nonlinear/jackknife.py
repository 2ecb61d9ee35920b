"""The covariance of what is fitted, from fits that leave out blocks of cycles."""

import numpy as np
from jaxtyping import Float

from ...denominator import (
    Covariance,
    block_freedom,
    correlated_cycles,
    in_blocks,
    inverse_of_remainder,
)
from .channels import Columns, channel_misfits
from .shared_state import SharedStateModel, SharedStateProblem


# Blocks that all cycles are divided into, unless these were shorter than errors depend on each
# other. Doubled: more is missed of what distant cycles have in common, and the covariance scatters
# 0.7 times as much.
_BLOCKS = 10


def jackknife(
    problem: SharedStateProblem,
    model: SharedStateModel,
    root: Float[np.ndarray, "P P"],
    to_c: Float[np.ndarray, "d P"],
) -> Covariance:
    r"""The jackknife that deletes blocks of cycles (Künsch 1989), of the linearized problem.

    A fit to all but a block b differs by $(J^T J)^{-1} J_b^T (1 - H_b)^{-1} e_b$, with J the
    derivatives, e the errors, and $H_b$ the part of the block in the hat matrix, by which the fit
    takes a share of its errors. The sum of the squares of these differences is on average no less
    than the variance (Efron and Stein 1981). That of white noise it makes too large, where unknowns
    are many; but where products are taken, errors are distortion: they depend on the inputs, and
    fits to all data take most of what a block's errors have in common.

    **Arguments:** `root`: root @ root.T is the inverse of the Hessian. `to_c` takes entries of A
    and B, in its columns, to coefficients.
    """
    S, T = problem.y.shape[:2]
    lags = correlated_cycles(np.linalg.eigvals(model.A), T)
    count = max(1, T // max(lags + 1, S * T // _BLOCKS))
    columns, P = Columns.of(problem, model), root.shape[1]
    own, along = np.zeros((S * count, P, P)), np.zeros((S * count, P, 1))
    for n, i, rows, e, found, _ in channel_misfits(problem, model):
        error, slopes = np.zeros((S, T, 1)), np.zeros((S, T, P))
        error[rows, 0], slopes[rows] = e, found.dense(columns, rows) @ root
        basis = np.concatenate([found.basis, problem.direct[n][i].drift], axis=2)
        error, slopes, basis = (in_blocks(x, count) for x in (error, slopes, basis))
        across = basis.swapaxes(1, 2)
        inverse = inverse_of_remainder(across @ basis)
        # (1 - Q Q')^-1 = 1 + Q (1 - Q' Q)^-1 Q' for the basis Q of what is linear in this output.
        outer = slopes.swapaxes(1, 2) @ basis @ inverse
        own += slopes.swapaxes(1, 2) @ slopes + outer @ (across @ slopes)
        along += slopes.swapaxes(1, 2) @ error + outer @ (across @ error)
    inverse = inverse_of_remainder(own)
    half = np.linalg.cholesky(to_c @ to_c.T)
    to_c = np.linalg.solve(half, to_c)  # in units in which white noise makes the covariance one
    score = (to_c @ inverse @ along)[..., 0]
    share = to_c @ inverse @ own @ to_c.T
    unit = np.linalg.inv(np.linalg.cholesky(share.sum(axis=0)))
    freedom = block_freedom(score @ unit.T, unit @ share @ unit.T)
    return Covariance(half @ score.T @ score @ half.T, freedom)
