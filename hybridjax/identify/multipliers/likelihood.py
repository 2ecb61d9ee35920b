"""Gauss and Newton's iteration for the denominator, where it starts, and what it is worth."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float, Inexact

from .projection import Group, delayed, evaluate


_STARTS = 6  # weighted solutions of the linearized problem, at most
_HALVINGS = 20
Coefficients = Float[np.ndarray, " d"]


def gauss_newton(
    linearize: Callable[[Coefficients], tuple[np.ndarray, np.ndarray]],
    start: Coefficients,
    max_steps: int,
) -> tuple[Coefficients, bool]:
    """Minimize a sum of squares, halving steps that do not lower it.

    **Arguments:** `linearize(c)` gives the residuals (n,) and their Jacobian (n, d).

    **Returns:** c, and whether the end was reached: a step that no longer matters.
    """
    c = start
    residual, jacobian = linearize(c)
    cost = residual @ residual
    for _ in range(max_steps):
        step = np.linalg.lstsq(jacobian, -residual)[0]
        gain = ((jacobian @ step) ** 2).sum()
        if gain <= 1e-14 * cost or np.linalg.norm(step) <= 1e-12 * (1 + np.linalg.norm(c)):
            return c, True
        for k in range(_HALVINGS):
            trial = c + step / 2**k
            with np.errstate(all="ignore"):
                new_residual, new_jacobian = linearize(trial)
                new_cost = new_residual @ new_residual
            if new_cost < cost:
                break
        else:
            return c, bool(gain <= 1e-6 * cost)
        c, residual, jacobian, cost = trial, new_residual, new_jacobian, new_cost
    return c, False


def maximum_likelihood(
    groups: list[Group], order: int, max_steps: int, start: Coefficients | None = None
) -> tuple[Coefficients, bool]:
    """The coefficients with the smallest misfit, and whether the iteration came to its end."""

    def linearize(c):
        parts = [evaluate(group, c) for group in groups]
        jacobian = np.concatenate([p.jacobian.reshape(order, -1) for p in parts], axis=1)
        return np.concatenate([p.residual.ravel() for p in parts]), jacobian.T

    return gauss_newton(linearize, linearized(groups, order) if start is None else start, max_steps)


def linearized(groups: list[Group], order: int) -> Coefficients:
    """chi H = B in the sense of total least squares, weighted by 1/|chi| of the last solution.

    The covariance of the errors is known up to a factor, so that the solution is consistent.
    """
    c = np.zeros(order)
    for _ in range(_STARTS):
        columns, noise = rank_matrix(groups, c)
        _, vectors = scipy.linalg.eigh(columns.T @ columns, noise)
        null = vectors[:, 0]
        if abs(null[0]) < 1e-8 * np.abs(null).max():
            break
        c, last = null[1:] / null[0], c
        if np.abs(c - last).max() < 1e-3 * (1 + np.abs(c).max()):
            break
    return c


def rank_matrix(
    groups: list[Group], c: Coefficients
) -> tuple[Float[np.ndarray, "n d1"], Float[np.ndarray, "d1 d1"]]:
    """What is left of z^-jN H, j = 0..d, and what its Gram matrix would be for errors alone."""
    parts = [delayed(group, c) for group in groups]
    return np.concatenate([p[0] for p in parts]), sum(p[1] for p in parts)


def noise_levels(groups: list[Group], c: Coefficients, outputs: int) -> Float[np.ndarray, " ny"]:
    """Root of the mean square of the misfit of each output, for the degrees of freedom left."""
    square, number = np.zeros(outputs), np.zeros(outputs)
    for group in groups:
        output = group.columns[:, 0]
        residual = evaluate(group, c).residual
        np.add.at(square, output, (residual**2).sum(axis=(0, 1)))
        np.add.at(number, output, group.freedom)
    return np.sqrt(square / number)


class Summary(NamedTuple):
    covariance: Float[np.ndarray, "d d"]
    covariance_freedom: float
    cost: float
    freedom: int


def summarize(
    groups: list[Group], c: Coefficients, errors: Literal["residuals", "variance"]
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
    noise, cost, left = np.zeros((d, d)), 0.0, 0
    for group in groups:
        found = evaluate(group, c, noise=True)
        noise += found.noise * group.data.shape[1]
        cost += float((found.residual**2).sum())
        left += group.freedom * group.data.shape[1]
        # A residual is smaller than the error, by the share of its equation in the numerators.
        error = found.residual / np.sqrt(1 - found.leverage)[..., None]
        np.add.at(score, group.line, np.einsum("jaek,aek->ej", found.jacobian, error))
        each = np.einsum("iaek,jaek->eij", found.jacobian, found.jacobian)
        np.add.at(shares, group.line, each)
    square = shares.sum(axis=0)
    if errors == "variance":
        found = sandwich(square - noise, square)
    else:
        found = sandwich(square - noise, score.T @ score, shares)
    return Summary(*found, cost, left)


def sandwich(
    curvature: Float[np.ndarray, "d d"],
    gradient: Float[np.ndarray, "d d"],
    shares: Float[np.ndarray, "parts d d"] | None = None,
) -> tuple[Float[np.ndarray, "d d"], float]:
    """Covariance of the coefficients, infinite if the curvature is not positive.

    **Arguments:** `gradient`: the covariance of the gradient; `shares`, where it was estimated
    from independent parts, what each is expected to add to it.

    **Returns:** the covariance and its degrees of freedom: the number of parts that contribute,
    one over the sum of the squares of their shares (Satterthwaite 1946).
    """
    values, vectors = np.linalg.eigh(curvature)
    if not values[0] > 1e-12 * values[-1]:
        return np.full(curvature.shape, np.inf), np.inf
    inverse = vectors / values @ vectors.T
    freedom = np.inf
    if shares is not None:
        half = np.linalg.inv(np.linalg.cholesky(shares.sum(axis=0)))
        share = np.einsum("ij,ejk,ik->ei", half, shares, half)
        freedom = float(1 / (share**2).sum(axis=0).mean())
    return inverse @ gradient @ inverse, freedom


def memory(multipliers: Inexact[np.ndarray, " d"], cycles: int) -> int:
    """Cycles after which a tenth is left of the slowest response; of a record at most a quarter."""
    slowest = np.clip(np.abs(multipliers).max(), 1e-3, 0.99)
    return int(min(np.ceil(np.log(0.1) / np.log(slowest)), cycles // 4))


def dependent(
    score: Float[np.ndarray, "S T d"], lags: int
) -> tuple[Float[np.ndarray, "d d"], float]:
    """The covariance of a gradient that is a sum over cycles, which depend on their neighbors.

    **Returns:** it, with the weights of Newey and West (1987), and how many terms stand for one
    that is independent.
    """
    gradient = np.einsum("sti,stj->ij", score, score)
    weights = 1 - np.arange(1, lags + 1) / (lags + 1)
    for k, w in enumerate(weights, 1):
        product = np.einsum("sti,stj->ij", score[:, k:], score[:, :-k])
        gradient += w * (product + product.T)
    return gradient, 1 + 2 * float((weights**2).sum())
