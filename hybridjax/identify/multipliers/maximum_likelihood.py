"""The denominator that fits harmonic transfer functions best, where to start, how sure it is."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..descent import Coefficients, Minimum, least_squares
from .covariance import Covariance, sandwich
from .variable_projection import HTFGroup, delayed_responses, misfit_of


# Weighted solutions of the linearized problem, at most. Doubled: a better start, as a rule in vain.
_MAX_REWEIGHTINGS = 6
# Change of c, relative to 1 + |c|, that ends them. Doubled: one solution fewer at times.
_SETTLED_START = 1e-3
# The leading coefficient relative to the largest one, below which its solution is no start (c would
# be infinite) and the last one is kept. Doubled: nothing changes but in such degenerate cases.
_NO_LEADING_COEFFICIENT = 1e-8
# Smallest share of its errors that a fit leaves to a line, so that dividing by it stays finite.
# Doubled: lines that alone decide c count at most 0.7 times as much.
_SMALLEST_REMAINDER = 0.1


def maximum_likelihood(
    groups: list[HTFGroup], order: int, max_steps: int, start: Coefficients | None = None
) -> Minimum:
    """The coefficients with the smallest misfit, from `start` or the linearized problem on."""

    def linearize(c):
        parts = [misfit_of(group, c) for group in groups]
        jacobian = np.concatenate([p.jacobian.reshape(order, -1) for p in parts], axis=1)
        return np.concatenate([p.residual.ravel() for p in parts]), jacobian.T

    start = total_least_squares(groups, order) if start is None else start
    return least_squares(linearize, start, max_steps)


def total_least_squares(groups: list[HTFGroup], order: int) -> Coefficients:
    """chi H = B in the sense of total least squares, weighted by 1/|chi| of the last solution.

    The covariance of the errors is known up to a factor, so that the solution is consistent.
    """
    c = np.zeros(order)
    for _ in range(_MAX_REWEIGHTINGS):
        responses = delayed_responses(groups, c)
        vectors, _, _ = np.linalg.svd(responses.whitened())
        null = np.linalg.solve(responses.noise_root().T, vectors[:, -1])
        if abs(null[0]) < _NO_LEADING_COEFFICIENT * np.abs(null).max():
            break
        c, last = null[1:] / null[0], c
        if np.abs(c - last).max() < _SETTLED_START * (1 + np.abs(c).max()):
            break
    return c


def noise_levels(groups: list[HTFGroup], c: Coefficients, outputs: int) -> Float[np.ndarray, " ny"]:
    """Root of the mean square of the misfit of each output, for the degrees of freedom left."""
    square, number = np.zeros(outputs), np.zeros(outputs)
    for group in groups:
        output = group.channel[:, 0]
        residual = misfit_of(group, c).residual
        np.add.at(square, output, (residual**2).sum(axis=(0, 1)))
        np.add.at(number, output, group.freedom)
    return np.sqrt(square / number)


class Summary(NamedTuple):
    """What the misfit at the minimum says."""

    covariance: Covariance
    """Of the coefficients."""
    cost: float
    """Sum of squares of the misfit, in units of the errors supposed."""
    freedom: int
    """The real equations that the numerators leave: what the cost is expected to be."""


def summarize(
    groups: list[HTFGroup], c: Coefficients, errors: Literal["residuals", "variance"]
) -> Summary:
    r"""Covariance of the coefficients, and how large the misfit is.

    With the residuals r, their Jacobian J and its part Q that errors make,
    $\mathrm{Cov}(c) = (J^T J - Q)^{-1} M (J^T J - Q)^{-1}$, where M is the covariance of the
    gradient $J^T r$: $J^T J$ for errors of the variances supposed, or the sum over frequencies of
    the squares of their parts of the gradient.
    """
    d = len(c)
    lines = 1 + max(int(group.line.max()) for group in groups)
    score, shares = np.zeros((lines, d)), np.zeros((lines, d, d))
    noise, cost, freedom = np.zeros((d, d)), 0.0, 0
    for group in groups:
        found = misfit_of(group, c, noise=True)
        noise += found.noise * group.size
        cost += float((found.residual**2).sum())
        freedom += group.freedom * group.size
        # A residual is smaller than the error, by the share of its equation in the numerators.
        error = found.residual / np.sqrt(1 - found.leverage)[..., None]
        np.add.at(score, group.line, np.einsum("jaek,aek->ej", found.jacobian, error))
        each = np.einsum("iaek,jaek->eij", found.jacobian, found.jacobian)
        np.add.at(shares, group.line, each)
    square = shares.sum(axis=0)
    if errors == "variance":
        covariance = sandwich(square - noise, square)
    else:
        score = _without_own_share(score, shares)
        covariance = sandwich(square - noise, score.T @ score, shares)
    return Summary(covariance, cost, freedom)


def _without_own_share(
    score: Float[np.ndarray, "lines d"], shares: Float[np.ndarray, "lines d d"]
) -> Float[np.ndarray, "lines d"]:
    """Each line's part of the gradient as large as it is on average before c takes its share of it
    (Bell and McCaffrey 2002)."""
    try:
        root = np.linalg.cholesky(shares.sum(axis=0))
    except np.linalg.LinAlgError:  # nothing is known of some direction
        return score
    half = np.linalg.inv(root)
    taken, axes = np.linalg.eigh(half @ shares @ half.T)
    left = np.maximum(1 - taken, _SMALLEST_REMAINDER)
    along = np.einsum("lij,li->lj", axes, score @ half.T) / np.sqrt(left)
    return np.einsum("lij,lj->li", axes, along) @ root.T
