"""Covariances of estimated coefficients that hold whatever the errors are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact


# Smallest eigenvalue of the curvature relative to its largest: below it, rounding may have made it.
# Doubled: a coefficient known 1.4 times better relative to the best known is said to be unknown.
_SINGULAR = 1e-12
# Part of a response that is left when it counts as forgotten (the number of cycles whose scores
# are correlated). Doubled: fewer lags, and covariances that scatter less but miss more.
_FORGOTTEN = 0.1
# Largest modulus of a multiplier assumed here: 0.99 takes 230 cycles. Closer to 1: more lags.
_SLOWEST = 0.99
# Smallest modulus, to keep the logarithm finite; one lag either way.
_FASTEST = 1e-3
# Share of a record that lags may take. Doubled: sums over fewer pairs, which scatter more.
_LARGEST_SHARE = 0.25


class Covariance(NamedTuple):
    """A covariance matrix and how well it is known."""

    matrix: Float[np.ndarray, "d d"]
    """Infinite where nothing is known."""
    freedom: float
    """Degrees of freedom that it was estimated with; infinite where it is exact."""

    @classmethod
    def unknown(cls, size: int) -> "Covariance":
        return cls(np.full((size, size), np.inf), np.inf)


def sandwich(
    curvature: Float[np.ndarray, "d d"],
    gradient: Float[np.ndarray, "d d"],
    shares: Float[np.ndarray, "parts d d"] | None = None,
) -> Covariance:
    r"""Covariance of a minimum: $K^{-1} M K^{-1}$ (White 1980); unknown unless K is positive.

    **Arguments:** `curvature`: K. `gradient`: M, the covariance of the gradient; `shares`, where it
    was estimated from independent parts, what each is expected to add to it.

    Its degrees of freedom are the number of parts that contribute: one over the sum of the squares
    of their shares (Satterthwaite 1946).
    """
    values, vectors = np.linalg.eigh(curvature)
    if not values[0] > _SINGULAR * values[-1]:
        return Covariance.unknown(len(curvature))
    inverse = vectors / values @ vectors.T
    freedom = np.inf
    if shares is not None:
        half = np.linalg.inv(np.linalg.cholesky(shares.sum(axis=0)))
        share = np.einsum("ij,ejk,ik->ei", half, shares, half)
        freedom = float(1 / (share**2).sum(axis=0).mean())
    return Covariance(inverse @ gradient @ inverse, freedom)


def correlated_cycles(multipliers: Inexact[np.ndarray, " d"], cycles: int) -> int:
    """Cycles after which a tenth is left of the slowest response; at most a quarter of a record."""
    slowest = np.clip(np.abs(multipliers).max(), _FASTEST, _SLOWEST)
    needed = np.ceil(np.log(_FORGOTTEN) / np.log(slowest))
    return int(min(needed, int(cycles * _LARGEST_SHARE)))


class GradientCovariance(NamedTuple):
    """The covariance of a gradient whose parts depend on their neighbors."""

    matrix: Float[np.ndarray, "d d"]
    weights: Float[np.ndarray, " lags"]
    """Of products of parts that are 1, 2, ... cycles apart."""

    def freedom(self, shares: Float[np.ndarray, "S T d"]) -> float:
        """The degrees of freedom it was estimated with, from what each part is expected to add to
        it (Satterthwaite 1946): products of different parts are independent terms, too."""
        total = (shares**2).sum(axis=(0, 1))
        for k, w in enumerate(self.weights, 1):
            total += 2 * w**2 * (shares[:, k:] * shares[:, :-k]).sum(axis=(0, 1))
        return float(1 / total.mean())


def serial_covariance(score: Float[np.ndarray, "S T d"], lags: int) -> GradientCovariance:
    """The covariance of a sum over cycles (T, in S records) that depend on so many neighbors.

    With Parzen's weights (Gallant, *Nonlinear Statistical Models*, 1987), which leave the first
    half of the lags nearly as they are, and never make a variance negative.
    """
    gradient = np.einsum("sti,stj->ij", score, score)
    lag = np.arange(1, 2 * lags + 2) / (2 * lags + 2)
    weights = np.where(lag < 0.5, 1 - 6 * lag**2 + 6 * lag**3, 2 * (1 - lag) ** 3)
    weights = weights[: score.shape[1] - 1]
    for k, w in enumerate(weights, 1):
        product = np.einsum("sti,stj->ij", score[:, k:], score[:, :-k])
        gradient += w * (product + product.T)
    return GradientCovariance(gradient, weights)
