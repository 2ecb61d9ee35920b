r"""The denominator $\chi$ that all transfer functions of a periodic system share.

$$\chi(q^{-N}) = 1 + c_1 q^{-N} + \ldots + c_d q^{-dN} = \prod_i (1 - \lambda_i q^{-N})$$

Its coefficients c are real, its roots are the d non-zero Floquet multipliers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from .covariance import Covariance


class Denominator(NamedTuple):
    """An estimate of the denominator."""

    coefficients: Float[np.ndarray, " d"]
    covariance: Covariance
    """Of the coefficients."""
    converged: bool

    @classmethod
    def of_unknown_accuracy(cls, coefficients: Float[np.ndarray, " d"]) -> "Denominator":
        d = len(coefficients)
        return cls(coefficients, Covariance.unknown(d), False)


def chi(
    period_delay: Complex[np.ndarray, " E"], c: Float[np.ndarray, " d"]
) -> Complex[np.ndarray, " E"]:
    r"""$1 + c_1 z^{-N} + \ldots + c_d z^{-dN}$ at values of $z^{-N}$, the delay by one period."""
    return np.polynomial.polynomial.polyval(period_delay, np.concatenate([[1.0], c]))


def multipliers_of(coefficients: Float[np.ndarray, " d"]) -> Complex[np.ndarray, " d"]:
    """The multipliers, by decreasing modulus, of a pair that with positive imaginary part first."""
    roots = np.roots([1.0, *coefficients]).astype(complex)
    if len(roots) < len(coefficients):  # numpy drops roots at zero
        roots = np.concatenate([roots, np.zeros(len(coefficients) - len(roots))])
    return roots[np.lexsort((-roots.imag, -np.abs(roots)))]
