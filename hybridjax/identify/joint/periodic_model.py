"""Matrices of a periodic model without padding, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...linear.ldtp import LDTP


Blocks = list[Float[np.ndarray, "rows columns"]]
"""One matrix for each section."""


class PeriodicModel(NamedTuple):
    """$x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n]$, $y[n] = C[n] x[n] + D[n] u[n] + e[n]$."""

    A: Blocks
    """(d[n+1], d[n]) at section n,"""
    B: Blocks
    """(d[n+1], nu),"""
    C: Blocks
    """(ny, d[n]),"""
    D: Blocks
    """(ny, nu),"""
    K: Blocks
    """(d[n+1], ny), or without columns: then noise does not reach the state."""

    @classmethod
    def of(cls, model: LDTP, scale: Float[np.ndarray, " ny"]) -> "PeriodicModel":
        """With outputs in units of `scale`, and noise that does not reach the state."""
        dims = [int(d) for d in np.asarray(model.dims)]
        after = [*dims[1:], dims[0]]
        A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
        return cls(
            [a[:j, :i] for a, i, j in zip(A, dims, after, strict=True)],
            [b[:j] for b, j in zip(B, after, strict=True)],
            [c[:, :i] / scale[:, None] for c, i in zip(C, dims, strict=True)],
            [d / scale[:, None] for d in D],
            [np.zeros((j, 0)) for j in after],
        )

    @property
    def dims(self) -> list[int]:
        return [a.shape[1] for a in self.A]

    @property
    def n_sections(self) -> int:
        return len(self.A)

    def monodromy(self, first: int = 0) -> Float[np.ndarray, "d d"]:
        """The product of A over one period from section `first` on."""
        product = np.eye(self.A[first].shape[1])
        for k in range(self.n_sections):
            product = self.A[(first + k) % self.n_sections] @ product
        return product

    def error_model(self) -> "PeriodicModel":
        """With the A - K C that carries errors of predictions on, in place of A."""
        return self._replace(A=[A - K @ C for A, K, C in zip(self.A, self.K, self.C, strict=True)])

    def to_ldtp(
        self, scale: Float[np.ndarray, " ny"], inputs: tuple[str, ...], outputs: tuple[str, ...]
    ) -> LDTP:
        """Back, with outputs in their own units."""
        C, D = ([scale[:, None] * x for x in blocks] for blocks in (self.C, self.D))
        return LDTP.from_blocks(self.A, self.B, C, D, inputs, outputs)
