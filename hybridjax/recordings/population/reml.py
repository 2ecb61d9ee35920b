r"""Means of estimates whose errors are known: restricted maximum likelihood, small samples.

The estimates of subject s, one for each of its conditions, are

$$y_s = X_s \beta + b_s + e_s, \quad b_s \sim N(0, \Psi), \quad e_s \sim N(0, \mathrm{diag}(v_s))$$

with known v_s (meta-analysis: Hardy and Thompson 1996; Jackson, Riley and White 2011).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize, special, stats


class Cells(NamedTuple):
    """Estimates of n subjects in q cells (conditions); where `present` is False there is none."""

    y: Float[np.ndarray, "n q"]
    v: Float[np.ndarray, "n q"]
    x: Float[np.ndarray, "n q p"]
    present: Bool[np.ndarray, "n q"]


class Mixed(NamedTuple):
    """Coefficients, their Kenward-Roger covariance, and what their degrees of freedom need."""

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    between: Float[np.ndarray, "q q"]
    plain: Float[np.ndarray, "p p"]
    slopes: Float[np.ndarray, "k p p"]
    uncertainty: Float[np.ndarray, "k k"]
    most: int

    def freedom(self, weights: Float[np.ndarray, " p"]) -> float:
        """Return the degrees of freedom of a contrast (for one contrast, those of Kenward and Roger
        are Satterthwaite's), at most those of subjects without a model of their spread."""
        gradient = -np.einsum("i,kij,j->k", weights, self.slopes, weights)
        spread = gradient @ self.uncertainty @ gradient
        square = (weights @ self.plain @ weights) ** 2
        return float(np.clip(2 * square / max(spread, 1e-300), 1.0, self.most))


def mixed(cells: Cells) -> Mixed:
    """Fit by restricted maximum likelihood, with covariances after Kenward and Roger (1997).

    Psi is free between cells that some subject shares, and zero between others (Welch's case).
    """
    present, q = cells.present, cells.y.shape[1]
    shared = np.einsum("ni,nj->ij", present, present.astype(int)) > 0
    scale = max(float(np.std(cells.y[present])), float(np.sqrt(np.mean(cells.v[present]))), 1e-300)
    y = np.where(present, cells.y, 0.0) / scale
    x = np.where(present[..., None], cells.x, 0.0)
    # Cells without an estimate have variance 1, zero regressors and a zero: they add constants.
    v = np.where(present, cells.v / scale**2, 1.0)
    pairs = present[:, :, None] & present[:, None, :]
    rows, columns = np.nonzero(np.tril(shared))

    def matrix(free: Float[np.ndarray, " k"]) -> Float[np.ndarray, "q q"]:
        lower = np.zeros((q, q))
        lower[rows, columns] = free
        return lower

    def fitted(between):
        total = np.where(pairs, between, 0.0)
        total[:, np.arange(q), np.arange(q)] += v
        w = np.linalg.inv(total)
        phi = np.linalg.inv(np.einsum("nip,nij,njq->pq", x, w, x))
        return total, w, phi, phi @ np.einsum("nip,nij,nj->p", x, w, y)

    def cost(free):
        lower = matrix(free)
        total, w, phi, beta = fitted(lower @ lower.T)
        wx, r = w @ x, np.einsum("nij,nj->ni", w, y - x @ beta)
        value = np.linalg.slogdet(total)[1].sum() - np.linalg.slogdet(phi)[1]
        value += np.sum(r * (y - x @ beta))
        slope = w - wx @ phi @ np.swapaxes(wx, 1, 2) - r[:, :, None] * r[:, None, :]
        slope = np.where(pairs, slope, 0.0).sum(axis=0)
        return value / 2, (slope @ lower)[rows, columns]

    start = np.where(rows == columns, 0.7, 0.0)
    free = optimize.minimize(cost, start, jac=True, method="L-BFGS-B").x
    between = matrix(free) @ matrix(free).T
    _, w, phi, beta = fitted(between)
    wx = w @ x
    # Derivatives by the free elements of Psi, (k, n, q, q).
    k = np.arange(len(rows))
    d = np.zeros((len(rows), 1, q, q))
    d[k, 0, rows, columns] = d[k, 0, columns, rows] = 1.0
    d = np.where(pairs, d, 0.0)
    dw = d @ w
    slopes = -np.einsum("nip,knij,njq->kpq", wx, d, wx)
    second = np.einsum("nip,knij,lnjm,nmq->klpq", wx, d, w @ d, wx)
    traces = np.einsum("knij,lnji->kl", dw, dw) - 2 * np.einsum("ij,klji->kl", phi, second)
    traces += np.einsum("kij,lji->kl", phi @ slopes, phi @ slopes)
    uncertainty = np.linalg.pinv(traces / 2, hermitian=True)
    extra = np.einsum("kl,klpq->pq", uncertainty, second)
    extra -= np.einsum("kl,kpi,ij,ljq->pq", uncertainty, slopes, phi, slopes)
    covariance = phi + 2 * phi @ extra @ phi
    scaled = phi @ slopes @ phi * scale**2
    # `slopes` are those of the inverse of phi: d phi = -phi slope phi.
    most = max(len(y) - np.linalg.matrix_rank(x.sum(axis=1)), 1)
    square = scale**2
    return Mixed(beta * scale, covariance * square, between * square, phi * square, scaled,
                 uncertainty, most)  # fmt: skip


class Meta(NamedTuple):
    """A regression of single estimates: covariance after Knapp and Hartung."""

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    freedom: int
    variance: float
    """Between subjects."""
    variance_error: float


def meta(
    y: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], x: Float[np.ndarray, "n p"]
) -> Meta:
    """Return the regression by restricted maximum likelihood, with the covariance of Hartung and
    Knapp (2001; Knapp and Hartung 2003), scaled by the weighted residuals."""
    variance = between_variance(y, v, x)
    beta, phi, square = weighted(y, v + variance, x)
    freedom = len(y) - x.shape[1]
    error = np.sqrt(2 / np.sum((v + variance) ** -2.0))
    return Meta(beta, phi * square / freedom, freedom, variance, float(error))


def between_variance(y, v, x) -> float:
    """Return the variance at which the derivative of the restricted likelihood is zero, or 0."""

    def score(variance):
        w = 1 / (v + variance)
        phi = np.linalg.inv((x * w[:, None]).T @ x)
        r = w * (y - x @ (phi @ (x.T @ (w * y))))
        return r @ r - w.sum() + np.einsum("ip,pq,iq,i->", x, phi, x, w**2)

    high = float(v.max() + y @ y) * 10
    return 0.0 if score(0.0) <= 0 else _root(score, 0.0, high)


def weighted(y, v, x) -> tuple[np.ndarray, np.ndarray, float]:
    """Return coefficients, their covariance and the sum of squares of the weighted residuals."""
    phi = np.linalg.inv((x / v[:, None]).T @ x)
    beta = phi @ (x / v[:, None]).T @ y
    return beta, phi, float(np.sum((y - x @ beta) ** 2 / v))


def spread_interval(y, v, x, level: float = 0.95) -> tuple[float, float]:
    """Return bounds of the standard deviation between subjects: those for which the sum of squares
    lies between quantiles of chi-squared (Q profile: Viechtbauer 2007)."""
    freedom = len(y) - x.shape[1]
    upper, lower = stats.chi2.isf([(1 - level) / 2, (1 + level) / 2], freedom)
    largest = 1e3 * (np.ptp(y) ** 2 + v.max())

    def bound(quantile):
        excess = lambda variance: weighted(y, v + variance, x)[2] - quantile  # noqa: E731
        return 0.0 if excess(0.0) < 0 else _root(excess, 0.0, largest)

    return np.sqrt(bound(upper)), np.sqrt(bound(lower))


def moderated(
    v: Float[np.ndarray, " n"], freedom: Float[np.ndarray, " n"], trend: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, " n"]:
    """Return variances with less scatter: means of each, weighted by its degrees of freedom, and of
    the common trend of their logarithms, weighted by the freedom that fits their scatter (empirical
    Bayes: Smyth 2004).

    Variances that are estimated from few blocks would otherwise give the largest weights to
    subjects whose errors happen to be underestimated.
    """
    half = np.minimum(freedom, 1e9) / 2
    if len(v) - trend.shape[1] < 3 or half.min() > 1e6:
        return v
    log = np.log(v) - special.digamma(half) + np.log(half)
    mean = trend @ np.linalg.lstsq(trend, log)[0]
    excess = np.sum((log - mean) ** 2) / (len(v) - trend.shape[1])
    excess -= float(np.mean(special.polygamma(1, half)))
    # The half of the prior freedom, at which a log chi-squared has the variance of the excess.
    prior = 1e9
    if excess > 1e-9:
        scatter = lambda x: float(special.polygamma(1, x)) - excess  # noqa: E731
        prior = _root(scatter, 1e-3, 1e9)
    common = np.exp(mean + special.digamma(prior) - np.log(prior))
    return (prior * common + half * v) / (prior + half)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    root: Any = optimize.brentq(function, low, high, xtol=1e-12 * high)
    return float(root)
