"""The linear regression of one section: inputs, unknown starts and drift, solved for together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Inexact


# Singular values of regressors below this part of the largest one are rounding errors. Doubled:
# combinations of starts and drift are dropped that are half as nearly dependent.
RANK = 1e-10
# The same of eigenvalues of a Gram matrix, which are squares. Doubled: of inputs, by 1.4 times.
_GRAM_RANK = 1e-12


class SectionRegression(NamedTuple):
    """Regressors of outputs that are sampled in the same rows (records and cycles), in one part of
    the data.

    Starts and drift are unknown in each record of its own, and are projected out here. The
    coefficients of inputs are common to all parts, whose sums of `gram` and `along` give them.
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
        kept = s > RANK * s.max(axis=1, initial=0, keepdims=True)
        basis = basis * kept[:, None]
        weights = np.where(kept, 1 / np.where(kept, s, 1), 0)[:, None]
        to_starts = (np.swapaxes(right, 1, 2) * weights)[:, : starts.shape[2]]
        remainder = rows * inputs
        remainder = remainder - basis @ (basis.swapaxes(1, 2) @ remainder)
        return cls(inputs, starts, rows, basis, to_starts, remainder.reshape(-1, inputs.shape[2]))

    @property
    def gram(self) -> Float[np.ndarray, "r r"]:
        """Products of the inputs with each other."""
        return self.remainder.T @ self.remainder

    @property
    def freedom(self) -> float:
        """Samples less unknown starts and drift."""
        return float((self.weight > 0).sum() - (self.basis**2).sum())

    def input_basis(self, root: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "S T k"]:
        """The rows of this part in an orthonormal basis of all rows of the inputs."""
        return (self.remainder @ root).reshape(*self.basis.shape[:2], -1)

    def leverage(self, root: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "S T"]:
        """The share of its own error that a fit takes from each sample."""
        return (self.basis**2).sum(axis=2) + (self.input_basis(root) ** 2).sum(axis=2)

    def reduced(self, x: Float[np.ndarray, "S T C"]) -> Float[np.ndarray, "rows C"]:
        """C outputs, weighted, less what starts and drift explain."""
        left = self.weight * x
        for _ in range(2):  # the second time for accuracy
            left = left - self.basis @ (self.basis.swapaxes(1, 2) @ left)
        return left.reshape(-1, x.shape[2])

    def along(self, left: Float[np.ndarray, "rows C"]) -> Float[np.ndarray, "r C"]:
        """Products of the inputs with what is left of outputs."""
        return self.remainder.T @ left

    def response(
        self, a: Float[np.ndarray, "r C"], x: Float[np.ndarray, "S T C"]
    ) -> Float[np.ndarray, "S T C"]:
        """What inputs with these coefficients, and the starts that fit x best, make of all rows."""
        forced = self.inputs @ a
        free = self.to_starts @ (self.basis.swapaxes(1, 2) @ (self.weight * (x - forced)))
        return forced + self.starts @ free


def root_of(gram: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "r k"]:
    """root @ root.T is the inverse of a Gram matrix, where it has one."""
    w, q = np.linalg.eigh(gram)
    kept = w > _GRAM_RANK * w.max(initial=0)
    return q[:, kept] / np.sqrt(w[kept])
