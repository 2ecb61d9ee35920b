"""Linearized least squares, summed up."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact


# Eigenvalues of the scaled matrix below this part of the largest one are rounding errors. Doubled:
# combinations that the data show 1.4 times better count as not shown.
_SINGULAR = 1e-13


class NormalEquations:
    """Of residuals r with the derivatives -J, in units of the lengths of the columns of J.

    **Arguments:** `gram` (P, P), $J^T J$. `gradient` (P,), $J^T r$.
    """

    def __init__(self, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"]):
        self.gradient = gradient
        size = np.sqrt(np.maximum(np.diag(gram), 0))
        self._size = np.where(size > 0, size, 1.0)
        self._values, self._vectors = np.linalg.eigh(gram / self._size / self._size[:, None])
        self._slope = self._vectors.T @ (gradient / self._size)
        self._shown = self._values > _SINGULAR * self._values[-1]

    def step(self, damping: float) -> tuple[Float[np.ndarray, " P"], float]:
        """A step of Levenberg and Marquardt, and the decrease of the cost expected from it."""
        part = self._slope / (np.maximum(self._values, 0) + damping)
        return self._vectors @ part / self._size, float(part @ self._slope)

    def solution(self) -> tuple[Float[np.ndarray, " P"], float]:
        """The step to the minimum, without what the data do not show, and the decrease of the
        cost expected from it."""
        part = self._slope[self._shown] / self._values[self._shown]
        step = self._vectors[:, self._shown] @ part / self._size
        return step, float(part @ self._slope[self._shown])

    def spread(self, unit: float = 1.0) -> "Spread":
        """Of the solution, for errors of this variance."""
        vectors, least = self._vectors / self._size[:, None], _SINGULAR * self._values[-1]
        error = np.sqrt(unit / np.maximum(self._values, least))
        return Spread(
            vectors[:, self._shown] * error[self._shown],
            vectors[:, ~self._shown] * error[~self._shown],
        )


class Spread(NamedTuple):
    """How uncertain combinations of unknowns are."""

    root: Float[np.ndarray, "P r"]
    """R with $R R^T = v (J^T J)^+$: combinations that the data do not show are left out."""
    hidden: Float[np.ndarray, "P h"]
    """The same of those, as if the data showed them as well as rounding can hide it: they are not
    known better than this."""

    def variance(self, slopes: Inexact[np.ndarray, "P *rest"]) -> Float[np.ndarray, "*rest"]:
        """Of numbers with these derivatives; infinite where most of it is hidden."""
        known, hidden = (
            (np.abs(np.tensordot(x.T, slopes, 1)) ** 2).sum(axis=0)
            for x in (self.root, self.hidden)
        )
        return np.where(hidden > known, np.inf, known)

    def covariance(self, slopes: Float[np.ndarray, "d P"]) -> Float[np.ndarray, "d d"]:
        """Of numbers with these derivatives; infinite, all of it, if one has no finite variance."""
        if np.isinf(self.variance(slopes.T)).any():
            return np.full((len(slopes), len(slopes)), np.inf)
        half = slopes @ self.root
        return half @ half.T
