r"""The denominator $\chi$ that all transfer functions of a periodic system share.

$$\chi(q^{-N}) = 1 + c_1 q^{-N} + \ldots + c_d q^{-dN} = \prod_i (1 - \lambda_i q^{-N})$$

Its coefficients c are real, and its roots are the d non-zero Floquet multipliers. All fits with
this denominator call this file: `multipliers_of` and `coefficients_of` convert, `sandwich` and
`block_freedom` give the covariance of estimated coefficients and its degrees of freedom, whatever
the distribution of the errors is. A wrong error bar has its cause in `sandwich`, or in the scores
that it gets; an infinite one, in a curvature that is not positive there. Two conventions must stay:
arrays of coefficients are c_1 to c_d without the leading 1, and multipliers have the order of
`multipliers_of`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact

from ..linear.multipliers import largest_first
from .descent import ROUNDING, Coefficients


# A response counts as forgotten when this part of it is left. (Scores of cycles are correlated
# until then.) Smaller: more lags, so that covariances scatter more. Larger: a part of each
# covariance is missed.
_FORGOTTEN = 0.1
# Largest modulus of a multiplier at the start of a fit (with 0.99, a tenth is left after 230
# cycles). Larger: simulations overflow. Smaller: slow modes start far from their minimum.
SLOWEST = 0.99
# A fit reduces the residuals of a block or line, and a correction divides by the share that is
# left. At least this share is assumed. Smaller: blocks that alone determine a coefficient dominate
# the covariance. Larger: covariances are too small.
_SMALLEST_REMAINDER = 0.1


def chi(
    period_delay: Complex[np.ndarray, " E"], c: Coefficients
) -> Complex[np.ndarray, " E"]:
    r"""Return $1 + c_1 z^{-N} + \ldots + c_d z^{-dN}$ at values of $z^{-N}$, the period's delay."""
    return np.polyval([*c[::-1], 1.0], period_delay)


def divided_by_chi(
    numerators: Inexact[np.ndarray, "*d M R ny nu"],
    c: Coefficients,
    f: Float[np.ndarray, " F"],
    N: int,
    lead: int = 0,
) -> Complex[np.ndarray, "*d M F ny nu"]:
    r"""Return $\sum_r b_m[r] z^{-r} / \chi(z^{-N})$ at frequencies f, with r from -lead on."""
    delay = np.exp(-2j * np.pi / N * f)
    exponents = np.arange(numerators.shape[-3]) - lead
    powers = delay[:, None] ** exponents
    values = np.einsum("fr,...mrij->...mfij", powers, numerators)
    return values / chi(delay**N, c)[:, None, None]


def coefficients_of(multipliers: Complex[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
    """Return the coefficients of the polynomial with these roots, without the leading 1."""
    return np.atleast_1d(np.poly(multipliers)).real[1:]


def multipliers_of(coefficients: Coefficients) -> Complex[np.ndarray, " d"]:
    """Return the multipliers by decreasing modulus, of each conjugate pair the upper one first."""
    roots = np.roots([1.0, *coefficients]).astype(complex)
    at_zero = len(coefficients) - len(roots)  # numpy drops these
    roots = np.pad(roots, (0, at_zero))
    return roots[largest_first(roots)]


class Covariance(NamedTuple):
    """A covariance matrix, which is infinite where nothing is known, and its degrees of freedom."""

    matrix: Float[np.ndarray, "d d"]
    dof: float
    """Degrees of freedom that it was estimated with; infinite where it is exact."""

    @classmethod
    def unknown(cls, size: int) -> "Covariance":
        return cls(np.full((size, size), np.inf), np.inf)


def sandwich(
    curvature: Float[np.ndarray, "d d"],
    gradient: Float[np.ndarray, "d d"],
    shares: Float[np.ndarray, "parts d d"] | None = None,
) -> Covariance:
    r"""Return the covariance of a minimum, $K^{-1} M K^{-1}$ (White 1980); unknown unless K > 0.

    **Arguments:** `curvature`: K. `gradient`: M, the covariance of the gradient. `shares`: the
    expected contributions of independent parts, if M was estimated from these. The degrees of
    freedom are then one over the sum of the squared shares (Satterthwaite 1946). Default: M is
    exact.
    """
    values, vectors = np.linalg.eigh(curvature)
    if not values[0] > ROUNDING * values[-1]:
        return Covariance.unknown(len(curvature))
    inverse = vectors / values @ vectors.T
    dof = np.inf
    if shares is not None:
        half = np.linalg.inv(np.linalg.cholesky(shares.sum(axis=0)))
        share = np.einsum("ij,ejk,ik->ei", half, shares, half)
        dof = float(1 / (share**2).sum(axis=0).mean())
    return Covariance(inverse @ gradient @ inverse, dof)


def correlated_cycles(multipliers: Inexact[np.ndarray, " d"], cycles: int) -> int:
    """Return the cycles after which a tenth of the slowest response is left.

    The result is at most a quarter of `cycles`.
    """
    slowest = np.clip(np.abs(multipliers).max(), _FORGOTTEN, SLOWEST)
    # (Sums over fewer pairs scatter more.)
    forgotten = np.ceil(np.log(_FORGOTTEN) / np.log(slowest))
    return int(min(forgotten, cycles // 4))


def fading(c: Coefficients) -> Coefficients:
    """Return the coefficients of chi, with multipliers moved to a modulus of at most 0.99."""
    slowest = np.abs(np.roots([1.0, *c])).max(initial=SLOWEST)
    powers = np.arange(1, len(c) + 1)
    return c * (SLOWEST / slowest) ** powers


def in_blocks(
    x: Float[np.ndarray, "S T *rest"], count: int
) -> Float[np.ndarray, "B length *rest"]:
    """Divide the T cycles of each record into blocks, the last one filled up with zeros."""
    S, T, *shape = x.shape
    length = -(-T // count)
    filled = np.zeros((S, count * length, *shape))
    filled[:, :T] = x
    return filled.reshape(S * count, length, *shape)


def inverse_of_remainder(
    taken: Float[np.ndarray, "B k k"], power: float = 1.0
) -> Float[np.ndarray, "B k k"]:
    """Return (1 - taken)^-power, where `taken` is the share by which a fit reduces the errors of a
    block."""
    remainder = np.eye(taken.shape[1]) - taken
    values, vectors = np.linalg.eigh(remainder)
    values = np.maximum(values, _SMALLEST_REMAINDER)
    return vectors / values[:, None] ** power @ vectors.mT


def block_freedom(
    score: Float[np.ndarray, "blocks d"], share: Float[np.ndarray, "blocks d d"]
) -> float:
    """Return the degrees of freedom of a covariance from the scores of independent blocks.

    They follow from the dispersion of the scores (Pan and Wall 2002), and are at most those for
    Gaussian errors (Satterthwaite 1946).

    **Arguments:** `share`: the expected contribution of each block; contributions add up to one.
    """
    d = score.shape[1]
    inverse = np.linalg.pinv(score.T @ score)
    part = np.einsum("bi,ij,bj->b", score, inverse, score) / d
    normal = np.linalg.trace(share) / d
    by_dispersion = ((part - normal) ** 2).sum() * d / 2
    of_gaussian = (normal**2).sum()
    return float(1 / max(by_dispersion, of_gaussian))
