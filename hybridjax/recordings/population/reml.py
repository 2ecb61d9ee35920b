r"""Means over subjects of estimates with known errors: restricted maximum likelihood, for small
samples.

The estimate of subject s in cell c (its group and condition) is

$$y_{sc} = x_{sc} \beta + b_{sc} + e_{sc}, \quad b_s \sim N(0, \Psi), \quad e_{sc} \sim
N(0, v_{sc})$$

with known $v_{sc}$ (meta-analysis: Hardy and Thompson 1996; Jackson, Riley and White 2011). Mixed
models of other libraries estimate one variance of all errors instead.

`population.py` calls `mixed` (several groups or conditions) or `meta` (one estimate for each
subject), and gets a `Mixed`, whose `contrast` gives differences. `moderated` first reduces the
scatter of variances from few blocks. In all functions, `v` are variances, not standard errors;
`mixed` takes cells numbered from 0 on, in the order of the rows of Psi.

If a mean or the spread between subjects is wrong, look at `mixed`. If only the error of a mean is,
look at the covariance there, or at that of `meta`; if its degrees of freedom are, at
`Mixed.contrast`; if the interval of the spread is, at `spread_interval`.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, special, stats


Reals = Float[np.ndarray, " N"]
Design = Float[np.ndarray, "N p"]
Labels = Int[np.ndarray, " N"]

# From this number on, degrees of freedom count as infinite. More: roots of digamma functions
# overflow. Fewer: exact variances are moderated.
_EXACT = 1e9


class Mixed(NamedTuple):
    """A fitted mean of subjects."""

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    """Covariance of the coefficients, corrected for small samples."""
    between: Float[np.ndarray, "q q"]
    """Psi, the covariance between subjects."""
    plain: Float[np.ndarray, "p p"]
    """The covariance if Psi were known."""
    slopes: Float[np.ndarray, "k p p"]
    """Derivatives of the plain covariance with respect to the elements of Psi."""
    uncertainty: Float[np.ndarray, "k k"]
    """Covariance of the elements of Psi."""
    most: int
    """Degrees of freedom of a t test: number of subjects less number of coefficients."""

    def contrast(self, w: Float[np.ndarray, " p"]) -> tuple[float, float, float]:
        """Return value, standard error and degrees of freedom of a contrast. (For a single
        contrast, Kenward and Roger's degrees of freedom are Satterthwaite's.) They are at most
        those of a t test."""
        value = float(w @ self.coefficients)
        error = float(np.sqrt(w @ self.covariance @ w))
        slope = np.einsum("i,kij,j->k", w, self.slopes, w)
        square = w @ self.plain @ w
        scatter = max(slope @ self.uncertainty @ slope, 1e-300)
        dof = 2 * square**2 / scatter
        return value, error, float(np.clip(dof, 1, self.most))


def mixed(
    y: Reals,
    v: Reals,
    x: Design,
    subjects: Labels,
    cells: Labels,
) -> Mixed:
    """Fit by restricted maximum likelihood, with covariances after Kenward and Roger (1997).

    Psi is free between cells that some subject shares, and zero between others (Welch's case).
    """
    # Matrices: whether two estimates belong to one subject, (N, N); and to which cell each estimate
    # belongs, (N, q).
    same = subjects[:, None] == subjects
    cell = np.eye(cells.max() + 1)[cells]
    # The elements of a lower triangular factor of Psi that are not zero.
    row, column = np.nonzero(np.tril(cell.T @ same @ cell))
    spread = float(np.std(y))
    error = float(np.sqrt(v.mean()))
    scale = max(spread, error, 1e-300)
    square = scale**2
    y = y / scale
    v = v / square

    def squares(free):
        """Return a factor of Psi; and for generalized least squares, the covariance of the
        estimates, the covariance of the coefficients, the weights of the estimates, and the
        projection to residuals."""
        lower = np.zeros((cell.shape[1], cell.shape[1]))
        lower[row, column] = free
        between = cell @ lower @ lower.T @ cell.T
        total = np.diag(v) + same * between
        w = np.linalg.inv(total)
        plain = np.linalg.inv(x.T @ w @ x)
        weights = w @ x @ plain
        projection = w - weights @ x.T @ w
        return lower, total, plain, weights, projection

    def cost(free):
        """Return minus the logarithm of the restricted likelihood, and its derivatives."""
        lower, total, plain, _, projection = squares(free)
        residual = projection @ y
        _, volume = np.linalg.slogdet(total)
        _, volume_of_means = np.linalg.slogdet(plain)
        by_total = same * (projection - np.outer(residual, residual))
        by_factor = cell.T @ by_total @ cell @ lower
        value = (volume - volume_of_means + y @ residual) / 2
        return value, by_factor[row, column]

    start = np.where(row == column, 0.7, 0.0)
    best = optimize.minimize(
        cost,
        start,
        jac=True,
        method="L-BFGS-B",
        options={"ftol": 1e-13},
    )
    # A spread below 1e-5 of the scale is zero, up to the accuracy of the optimizer.
    free = np.where(np.abs(best.x) < 1e-5, 0.0, best.x)
    lower, _, plain, weights, projection = squares(free)
    # Derivatives of the covariance of all estimates by the elements of Psi, (k, N, N).
    both = np.einsum("nk,mk->knm", cell[:, row], cell[:, column])
    change = same * np.maximum(both, both.mT)
    moved = projection @ change
    information = np.einsum("kij,lji->kl", moved, moved) / 2
    uncertainty = np.linalg.pinv(information, hermitian=True)
    effect = change @ weights
    correction = np.einsum(
        "kl,kip,ij,ljq->pq",
        uncertainty,
        effect,
        projection,
        effect,
        optimize=True,
    )
    each = np.unique(same, axis=0)
    sums = np.array([x[rows].sum(axis=0) for rows in each])
    dof = len(sums) - np.linalg.matrix_rank(sums)
    return Mixed(
        coefficients=weights.T @ y * scale,
        covariance=(plain + 2 * correction) * square,
        between=lower @ lower.T * square,
        plain=plain * square,
        slopes=weights.T @ effect,
        uncertainty=uncertainty * square**2,
        most=max(dof, 1),
    )


def meta(y: Reals, v: Reals, x: Design) -> Mixed:
    """Return the fit of single estimates of subjects, with the covariance of Hartung and Knapp
    (2001; Knapp and Hartung 2003), scaled by the weighted residuals. The factor is at least one:
    otherwise estimates that happen to scatter less than their errors would have errors that are too
    small."""
    each = np.arange(len(y))
    fit = mixed(y, v, x, each, np.zeros(len(y), int))
    variance = v + fit.between[0, 0]
    square = weighted_squares(y, variance, x) / fit.most
    covariance = fit.plain * max(square, 1.0)
    return fit._replace(covariance=covariance, slopes=np.zeros_like(fit.slopes))


def weighted_squares(y: Reals, v: Reals, x: Design) -> float:
    """Return the sum of squares of the weighted residuals."""
    weight = 1 / np.sqrt(v)
    regressors = x * weight[:, None]
    target = y * weight
    solution = np.linalg.lstsq(regressors, target)[0]
    residual = target - regressors @ solution
    return float(residual @ residual)


def spread_interval(y: Reals, v: Reals, x: Design) -> tuple[float, float]:
    """Return bounds of the standard deviation between subjects: those for which the sum of squares
    lies between quantiles of chi-squared (Q profile: Viechtbauer 2007)."""
    largest = 1e3 * (np.ptp(y) ** 2 + v.max())

    def bound(tail):
        quantile = stats.chi2.isf(tail, len(y) - x.shape[1])

        def excess(variance):
            return weighted_squares(y, v + variance, x) - quantile

        if excess(0.0) < 0:
            return 0.0
        return float(np.sqrt(_root(excess, 0.0, largest)))

    return bound(0.025), bound(0.975)


def moderated(v: Reals, dof: Reals, trend: Design) -> Reals:
    """Return variances with less scatter (empirical Bayes: Smyth 2004). Each is a weighted mean of
    the variance itself and of the common trend of all variances. The weight of the former is its
    degrees of freedom; the weight of the latter follows from the scatter of the variances.

    Variances that are estimated from few blocks would otherwise give the largest weights to
    subjects whose errors happen to be underestimated.
    """
    half = np.minimum(dof, _EXACT) / 2
    surplus = len(v) - trend.shape[1]
    if surplus < 3 or half.min() > 1e6:
        return v
    bias = special.digamma(half) - np.log(half)
    log = np.log(v) - bias
    mean = trend @ np.linalg.lstsq(trend, log)[0]
    scatter = np.sum((log - mean) ** 2) / surplus
    excess = scatter - special.polygamma(1, half).mean()
    # Half of the prior degrees of freedom, with which a log chi-squared variable has the excess
    # variance.
    prior = _EXACT
    if excess > 1 / _EXACT:
        prior = _root(lambda half: special.polygamma(1, half) - excess, 1e-3, _EXACT)
    common = np.exp(mean + special.digamma(prior) - np.log(prior))
    weighted = prior * common + half * v
    return weighted / (prior + half)


def _root(function: Any, low: float, high: float) -> Any:
    return optimize.brentq(function, low, high, xtol=1e-12 * high)
