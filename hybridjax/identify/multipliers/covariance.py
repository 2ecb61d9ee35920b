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
# Smallest share of its errors that a fit to all leaves to a block, so that dividing by it stays
# finite. Doubled: blocks that the others hardly predict weigh half as much.
_SMALLEST_REMAINDER = 0.1


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


def fading(c: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
    """Coefficients of chi, with responses that fade where those of c do not."""
    slowest = np.abs(np.roots([1.0, *c])).max(initial=_FASTEST)
    return c * min(1.0, _SLOWEST / slowest) ** np.arange(1, len(c) + 1)


def in_blocks(x: Float[np.ndarray, "S T *rest"], count: int) -> Float[np.ndarray, "B length *rest"]:
    """The T cycles of each record in so many blocks, the last one filled up with zeros."""
    S, T, *rest = x.shape
    length = -(-T // count)
    padding = [(0, 0), (0, count * length - T)] + [(0, 0)] * len(rest)
    return np.pad(x, padding).reshape(S * count, length, *rest)


def inverse_of_remainder(taken: Float[np.ndarray, "B k k"]) -> Float[np.ndarray, "B k k"]:
    """That of 1 less the share of a block's errors that a fit to all takes."""
    values, vectors = np.linalg.eigh(np.eye(taken.shape[1]) - taken)
    return vectors / np.maximum(values, _SMALLEST_REMAINDER)[:, None] @ vectors.swapaxes(1, 2)


def block_freedom(
    score: Float[np.ndarray, "blocks d"], share: Float[np.ndarray, "blocks d d"]
) -> float:
    """Degrees of freedom of the covariance that the scores of independent blocks add up to.

    By how they scatter (Pan and Wall 2002), at most those of normal errors (Satterthwaite 1946).

    **Arguments:** `share`: what each is expected to add, in units in which they add up to one.
    """
    d = score.shape[1]
    part = np.einsum("bi,ij,bj->b", score, np.linalg.pinv(score.T @ score), score) / d
    normal = np.trace(share, axis1=1, axis2=2) / d
    scatter = max(((part - normal) ** 2).sum() * d / 2, (normal**2).sum())
    return float(1 / scatter)
