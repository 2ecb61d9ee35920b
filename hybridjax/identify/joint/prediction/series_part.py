"""Records as the likelihood of series sees them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...series.records import CycleGrid


# Singular values below this part of the largest one are rounding errors. Doubled: combinations of
# starts or drifts that the data show half as well are left out.
_RANK = 1e-10


class SeriesPart(NamedTuple):
    """R records of T cycles."""

    u: Float[np.ndarray, "N R T nu"]
    y: Float[np.ndarray, "N R T ny"]
    """In units of a scale; zero where there is no sample."""
    seen: Bool[np.ndarray, "N R T ny"]
    lost: Bool[np.ndarray, "N R T ny"]
    """Inside of a record, but not seen."""
    first: Int[np.ndarray, " R"]
    """The section at which each record starts."""
    drift: Float[np.ndarray, "N R T ny K"]
    """An orthonormal basis of what an unknown drift adds to the samples of each output that are
    seen, with zeros beyond its rank."""

    @classmethod
    def of(cls, grid: CycleGrid, scale: Float[np.ndarray, " ny"]) -> "SeriesPart":
        seen = grid.sampled
        lost = grid.inside[..., None] & ~seen
        waves = grid.drift[:, None, :, None, :] * np.moveaxis(seen, 2, 1)[..., None]
        basis, s, _ = np.linalg.svd(np.moveaxis(waves, 2, 3), full_matrices=False)  # (R N ny T K)
        kept = s > _RANK * np.maximum(s.max(axis=-1, keepdims=True, initial=0), _RANK)
        basis = basis * kept[..., None, :]
        return cls(
            u=np.moveaxis(grid.u, 2, 0),
            y=np.moveaxis(grid.y / scale, 2, 0),
            seen=np.moveaxis(seen, 2, 0),
            lost=np.moveaxis(lost, 2, 0),
            first=np.argmax(grid.inside[:, 0], axis=1),
            drift=np.transpose(basis, (1, 0, 3, 2, 4)),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """R, T."""
        return self.u.shape[1], self.u.shape[2]

    def without_drift(
        self, n: int, x: Float[np.ndarray, "R T ny columns"]
    ) -> Float[np.ndarray, "R T ny columns"]:
        """What is left of columns at section n where samples are seen."""
        x = x * self.seen[n][..., None]
        if not self.drift.shape[-1]:
            return x
        basis = self.drift[n]
        return x - np.einsum("rtik,rsik,rsic->rtic", basis, basis, x, optimize=True)


def solve_starts(
    gram: Float[np.ndarray, "R s s"], along: Float[np.ndarray, "R s columns"]
) -> Float[np.ndarray, "R s columns"]:
    """The pseudoinverse of each Gram matrix times columns."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > _RANK * np.maximum(values.max(axis=-1, keepdims=True, initial=0), 1e-300)
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    return vectors @ (inverse[..., None] * (vectors.swapaxes(1, 2) @ along))
