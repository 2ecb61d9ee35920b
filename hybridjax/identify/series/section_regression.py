"""The linear regression of one section: inputs, unknown starts and drift, solved for together."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Inexact


# Singular values of regressors below this part of the largest one are rounding errors. Doubled:
# combinations of starts and drift are dropped that are half as nearly dependent.
RANK = 1e-10
# The same of eigenvalues of a Gram matrix, which are squares. Doubled: of inputs, by 1.4 times.
_GRAM_RANK = 1e-12


class SectionRegression(NamedTuple):
    """Regressors of outputs that are sampled in the same rows (records and cycles).

    Starts and drift are unknown in each record of its own; the coefficients of inputs are common.
    """

    inputs: Float[np.ndarray, "S T r"]
    starts: Float[np.ndarray, "S T K"]
    """Responses to unknown starts."""
    weight: Inexact[np.ndarray, "S T 1"] | Bool[np.ndarray, "S T 1"]
    """What rows are multiplied by: roots of their weights, zero where there is no sample."""
    basis: Float[np.ndarray, "S T k"]
    """Orthonormal basis of the weighted rows of starts and drift, record by record."""
    to_starts: Float[np.ndarray, "S k K"]
    """Takes coefficients of the basis to those of the starts."""
    remainder: Float[np.ndarray, "rows r"]
    """The weighted rows of the inputs, less what starts and drift explain."""
    root: Float[np.ndarray, "r k"]
    """root @ root.T is the inverse of the Gram matrix of `remainder`."""

    @classmethod
    def make(
        cls,
        inputs: Float[np.ndarray, "S T r"],
        starts: Float[np.ndarray, "S T K"],
        drift: Float[np.ndarray, "S T k"],
        weight: Inexact[np.ndarray, "S T"] | Bool[np.ndarray, "S T"],
    ) -> "SectionRegression":
        rows = weight[:, :, None]
        each = rows * np.concatenate([starts, drift], axis=2)
        basis, s, right = np.linalg.svd(each, full_matrices=False)
        kept = s > RANK * s.max(initial=0)
        basis = basis * kept[:, None]
        weights = np.where(kept, 1 / np.where(kept, s, 1), 0)[:, None]
        to_starts = (np.swapaxes(right, 1, 2) * weights)[:, : starts.shape[2]]
        remainder = rows * inputs
        remainder = remainder - basis @ (basis.swapaxes(1, 2) @ remainder)
        remainder = remainder.reshape(-1, inputs.shape[2])
        w, q = np.linalg.eigh(remainder.T @ remainder)
        kept = w > _GRAM_RANK * w.max(initial=0)
        root = q[:, kept] / np.sqrt(w[kept])
        return cls(inputs, starts, rows, basis, to_starts, remainder, root)

    @property
    def freedom(self) -> int:
        """Samples less unknowns."""
        used = self.root.shape[1] + (self.basis**2).sum()
        return int((self.weight > 0).sum()) - int(round(float(used)))

    @property
    def input_basis(self) -> Float[np.ndarray, "S T k"]:
        """Orthonormal basis of `remainder`, in the same rows."""
        return (self.remainder @ self.root).reshape(*self.basis.shape[:2], -1)

    @property
    def leverage(self) -> Float[np.ndarray, "S T"]:
        """The share of its own error that the fit takes from each sample."""
        return (self.basis**2).sum(axis=2) + (self.input_basis**2).sum(axis=2)

    def solve(
        self, x: Float[np.ndarray, "S T C"]
    ) -> tuple[Float[np.ndarray, "r C"], Float[np.ndarray, "S T C"]]:
        """Coefficients of the inputs for C outputs, and what is left of these, weighted."""
        a, left = np.zeros((self.remainder.shape[1], x.shape[2])), self.weight * x
        for _ in range(2):  # the second time for accuracy
            left = left - self.basis @ (self.basis.swapaxes(1, 2) @ left)
            more = self.root @ (self.root.T @ (self.remainder.T @ left.reshape(-1, x.shape[2])))
            left = left - (self.remainder @ more).reshape(left.shape)
            a += more
        return a, left

    def response(
        self, a: Float[np.ndarray, "r C"], x: Float[np.ndarray, "S T C"]
    ) -> Float[np.ndarray, "S T C"]:
        """What inputs with these coefficients, and the starts that fit x best, make of all rows."""
        forced = self.inputs @ a
        free = self.to_starts @ (self.basis.swapaxes(1, 2) @ (self.weight * (x - forced)))
        return forced + self.starts @ free


def weighted_alike(weight: np.ndarray) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Of weights (S, T, ny), those (S, T) that differ, and the outputs that have them."""
    left = list(range(weight.shape[2]))
    while left:
        rows = weight[..., left[0]]
        same = [i for i in left if np.array_equal(weight[..., i], rows)]
        yield rows, same
        left = [i for i in left if i not in same]
