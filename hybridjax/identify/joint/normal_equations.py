"""Linearized least squares, summed up."""

import numpy as np
from jaxtyping import Float


# Eigenvalues of the scaled matrix below this part of the largest one are rounding errors. Doubled:
# combinations that the data show 1.4 times better count as not shown.
_SINGULAR = 1e-13


class NormalEquations:
    """Of residuals r with the derivatives -J, in units of the lengths of the columns of J.

    **Arguments:** `gram` (P, P), $J^T J$. `gradient` (P,), $J^T r$.
    """

    def __init__(self, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"]):
        size = np.sqrt(np.diag(gram))
        self._size = np.where(size > 0, size, 1.0)
        self._values, self._vectors = np.linalg.eigh(gram / self._size / self._size[:, None])
        self._slope = self._vectors.T @ (gradient / self._size)

    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        """A step of Levenberg and Marquardt, and the decrease of the cost expected from it."""
        part = self._slope / (np.maximum(self._values, 0) + damping)
        return self._vectors @ part / self._size, float(part @ self._slope)

    def solution(self) -> Float[np.ndarray, " P"]:
        """The step to the minimum, without what the data do not show."""
        kept = self._values > _SINGULAR * self._values[-1]
        part = self._slope[kept] / self._values[kept]
        return self._vectors[:, kept] @ part / self._size

    def covariance_root(self) -> Float[np.ndarray, "P r"]:
        """R with $R R^T = (J^T J)^+$: combinations that the data do not show are left out."""
        kept = self._values > _SINGULAR * self._values[-1]
        return self._vectors[:, kept] / np.sqrt(self._values[kept]) / self._size[:, None]
