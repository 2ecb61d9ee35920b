r"""Means of estimates whose errors are known: restricted maximum likelihood, small samples.

The estimate of subject s in cell c (its group and condition) is

$$y_{sc} = x_{sc} \beta + b_{sc} + e_{sc}, \quad b_s \sim N(0, \Psi), \quad e_{sc} \sim
N(0, v_{sc})$$

with known $v_{sc}$ (meta-analysis: Hardy and Thompson 1996; Jackson, Riley and White 2011). Mixed
models of other libraries estimate one variance of all errors instead.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, special, stats


Reals = Float[np.ndarray, " N"]
Design = Float[np.ndarray, "N p"]


class Mixed(NamedTuple):
    """Coefficients and their small-sample covariance; Psi (`between`), that of its elements
    (`uncertainty`), and the derivatives (`slopes`) of the `plain` covariance by these."""

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    between: Float[np.ndarray, "q q"]
    plain: Float[np.ndarray, "p p"]
    slopes: Float[np.ndarray, "k p p"]
    uncertainty: Float[np.ndarray, "k k"]
    most: int

    def contrast(self, w: Float[np.ndarray, " p"]) -> tuple[float, float, float]:
        """Return value, standard error and degrees of freedom of a contrast (of a single one, those
        of Kenward and Roger are Satterthwaite's), at most those of a t test."""
        slope = np.einsum("i,kij,j->k", w, self.slopes, w)
        square = (
            2
            * (w @ self.plain @ w) ** 2
            / max(slope @ self.uncertainty @ slope, 1e-300)
        )
        error = float(np.sqrt(w @ self.covariance @ w))
        return float(w @ self.coefficients), error, float(np.clip(square, 1, self.most))


def mixed(
    y: Reals,
    v: Reals,
    x: Design,
    subjects: Int[np.ndarray, " N"],
    cells: Int[np.ndarray, " N"],
) -> Mixed:
    """Fit by restricted maximum likelihood, with covariances after Kenward and Roger (1997).

    Psi is free between cells that some subject shares, and zero between others (Welch's case).
    """
    same, cell = subjects[:, None] == subjects, np.eye(cells.max() + 1)[cells]
    i, j = np.nonzero(np.tril(cell.T @ same @ cell))
    scale = max(float(np.std(y)), float(np.sqrt(v.mean())), 1e-300)
    y, v = y / scale, v / scale**2

    def fitted(free):
        lower = np.zeros((cell.shape[1],) * 2)
        lower[i, j] = free
        total = np.diag(v) + same * (cell @ lower @ lower.T @ cell.T)
        w = np.linalg.inv(total)
        phi = np.linalg.inv(x.T @ w @ x)
        wx = w @ x @ phi
        return lower, total, phi, wx, w - wx @ x.T @ w

    def cost(free):
        lower, total, phi, _, projection = fitted(free)
        r = projection @ y
        slope = cell.T @ (same * (projection - np.outer(r, r))) @ cell
        value = np.linalg.slogdet(total)[1] - np.linalg.slogdet(phi)[1] + y @ r
        return value / 2, (slope @ lower)[i, j]

    start = np.where(i == j, 0.7, 0.0)
    best = optimize.minimize(
        cost, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-13}
    )
    # A spread below 1e-5 of the scale is zero, up to the accuracy of the optimizer.
    lower, _, phi, wx, projection = fitted(np.where(np.abs(best.x) < 1e-5, 0.0, best.x))
    # Derivatives of the covariance of all estimates by the elements of Psi, (k, N, N).
    both = np.einsum("nk,mk->knm", cell[:, i], cell[:, j])
    change = same * np.maximum(both, np.swapaxes(both, 1, 2))
    moved, effect = projection @ change, change @ wx
    uncertainty = np.linalg.pinv(
        np.einsum("kij,lji->kl", moved, moved) / 2, hermitian=True
    )
    extra = np.einsum(
        "kl,kip,ij,ljq->pq", uncertainty, effect, projection, effect, optimize=True
    )
    sums = np.array([x[row].sum(axis=0) for row in np.unique(same, axis=0)])
    square = scale**2
    return Mixed(
        wx.T @ y * scale,
        (phi + 2 * extra) * square,
        lower @ lower.T * square,
        phi * square,
        wx.T @ effect,
        uncertainty * square**2,
        max(len(sums) - np.linalg.matrix_rank(sums), 1),
    )


def meta(y: Reals, v: Reals, x: Design) -> Mixed:
    """Return the fit of single estimates of subjects, with the covariance of Hartung and Knapp
    (2001; Knapp and Hartung 2003), scaled by the weighted residuals, but not below one: estimates
    that scatter less than their errors would have none."""
    fit = mixed(y, v, x, np.arange(len(y)), np.zeros(len(y), int))
    square = weighted_squares(y, v + fit.between[0, 0], x) / fit.most
    return fit._replace(covariance=fit.plain * max(square, 1.0), slopes=0 * fit.slopes)


def weighted_squares(y: Reals, v: Reals, x: Design) -> float:
    """Return the sum of squares of the weighted residuals."""
    x, y = x / np.sqrt(v)[:, None], y / np.sqrt(v)
    return float(np.sum((y - x @ np.linalg.lstsq(x, y)[0]) ** 2))


def spread_interval(y: Reals, v: Reals, x: Design) -> tuple[float, float]:
    """Return bounds of the standard deviation between subjects: those for which the sum of squares
    lies between quantiles of chi-squared (Q profile: Viechtbauer 2007)."""
    largest = 1e3 * (np.ptp(y) ** 2 + v.max())

    def bound(tail):
        quantile = stats.chi2.isf(tail, len(y) - x.shape[1])
        if weighted_squares(y, v, x) < quantile:
            return 0.0
        excess = lambda variance: weighted_squares(y, v + variance, x) - quantile  # noqa: E731
        return float(np.sqrt(_root(excess, 0.0, largest)))

    return bound(0.025), bound(0.975)


def moderated(v: Reals, freedom: Reals, trend: Float[np.ndarray, "N k"]) -> Reals:
    """Return variances with less scatter: means of each, weighted by its degrees of freedom, and of
    the common trend of their logarithms, weighted by the freedom that fits their scatter (empirical
    Bayes: Smyth 2004).

    Variances that are estimated from few blocks would otherwise give the largest weights to
    subjects whose errors happen to be underestimated.
    """
    half, surplus = np.minimum(freedom, 1e9) / 2, len(v) - trend.shape[1]
    if surplus < 3 or half.min() > 1e6:
        return v
    log = np.log(v) - special.digamma(half) + np.log(half)
    mean = trend @ np.linalg.lstsq(trend, log)[0]
    excess = np.sum((log - mean) ** 2) / surplus - special.polygamma(1, half).mean()
    # The half of the prior freedom, at which a log chi-squared has the variance of the excess.
    prior = 1e9
    if excess > 1e-9:
        prior = _root(lambda z: special.polygamma(1, z) - excess, 1e-3, 1e9)
    common = np.exp(mean + special.digamma(prior) - np.log(prior))
    return (prior * common + half * v) / (prior + half)


def _root(function: Any, low: float, high: float) -> Any:
    return optimize.brentq(function, low, high, xtol=1e-12 * high)
