"""Tests of the residuals of records for whiteness and independence."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special, stats

from ..experiments.record import Record
from .series.output_error import RANK


# Samples of a section, below which its correlations are not tested. Fewer: their distribution is
# not normal; more: short records cannot be validated.
FEWEST_SAMPLES = 8
# Probability with which a misfit that counts as visible is detected. Larger: models are called
# better tested than they are; smaller: misfits that are detected as a rule count as invisible.
_POWER = 0.8


class Samples(NamedTuple):
    """The samples of S records, one after the other."""

    n_sections: int
    section: Int[np.ndarray, " n"]
    before: Int[np.ndarray, " n"]
    """The number of earlier samples in the same record."""
    u: Float[np.ndarray, "n nu"]

    @classmethod
    def of(cls, records: Sequence[Record]) -> "Samples":
        N, before = records[0].n_sections, [np.arange(len(r.u)) for r in records]
        section = [(r.first_section + k) % N for r, k in zip(records, before, strict=True)]
        u = np.concatenate([r.u for r in records])
        return cls(N, np.concatenate(section), np.concatenate(before), u)

    def at(self, lags: int) -> list[Int[np.ndarray, " k"]]:
        """Return the samples at each section with so many samples before them."""
        late = self.before >= lags
        return [np.flatnonzero(late & (self.section == n)) for n in range(self.n_sections)]

    def count(  # type: ignore[override]  # (of tuples)
        self, present: Bool[np.ndarray, "n ny"], lags: int
    ) -> Int[np.ndarray, "N ny"]:
        """Return how often each section was sampled with so many samples before it."""
        return np.stack([present[rows].sum(axis=0) for rows in self.at(lags)])


def whiteness_test(
    samples: Samples,
    error: Float[np.ndarray, "n ny"],
    size: Float[np.ndarray, "N ny"],
    lags: int,
) -> tuple[Float[np.ndarray, "N lags ny"], Float[np.ndarray, " ny"]]:
    """Return correlations of residuals with earlier ones, section by section, and p-values.

    **Arguments:** `size`: rms of the residuals at each section.
    """
    scale, N = np.where(size > 0, size, 1.0), samples.n_sections
    z, tested = np.zeros((N, lags, size.shape[1])), np.zeros((N, lags, size.shape[1]), bool)
    for k in range(lags):
        for n, rows in enumerate(samples.at(k + 1)):
            product = error[rows] * error[rows - k - 1] / scale[n] / scale[(n - k - 1) % N]
            count = np.isfinite(product).sum(axis=0)
            z[n, k] = np.nansum(product, axis=0) / np.sqrt(np.maximum(count, 1))
            tested[n, k] = count >= FEWEST_SAMPLES
    # The mean over the sections of each lag, and the deviations from it: independent.
    z = z * tested
    count = tested.sum(axis=0)
    pooled = z.sum(axis=0) ** 2 / np.maximum(count, 1)
    deviations = (z**2).sum(axis=(0, 1)) - pooled.sum(axis=0)
    degrees = (count > 0).sum(axis=0)
    p = stats.chi2.sf(pooled.sum(axis=0), degrees)
    if N > 1:
        p = np.minimum(p, stats.chi2.sf(deviations, count.sum(axis=0) - degrees))
        p = -np.expm1(2 * np.log1p(-p))
    return z, p


def independence_test(
    samples: Samples, error: Float[np.ndarray, "n ny"], lags: int, level: float
) -> tuple[Float[np.ndarray, "N lags ny nu"], Float[np.ndarray, " ny"], Float[np.ndarray, " ny"]]:
    """Test the part of residuals that present and past inputs explain, section by section.

    **Returns:** the correlations with the inputs, the p-values, and the smallest visible misfits,
    in standard deviations of the noise, for tests of this level. A misfit of rms r times the noise
    makes F ratios of n samples noncentral, by $n r^2$. The power is that of one F ratio with the
    degrees of freedom of all sections, which is 1 to 4 % too optimistic.
    """
    N, ny, nu = samples.n_sections, error.shape[1], samples.u.shape[1]
    z, deviates, tested = np.zeros((N, lags, ny, nu)), np.zeros(ny), np.zeros(ny)
    degrees = np.zeros((2, ny))
    for n, rows in enumerate(samples.at(lags - 1)):
        past = samples.u[rows[:, None] - np.arange(lags)].reshape(len(rows), -1)
        for i in range(ny):
            present = np.isfinite(error[rows, i])
            U, r, count = past[present], error[rows, i][present], int(present.sum())
            if count < FEWEST_SAMPLES or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * (r @ r) / count)
            z[n, :, i] = (U.T @ r / np.where(size > 0, size, 1.0)).reshape(lags, nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > RANK * s[0]][:, : count // 2]
            # Explained against unexplained part: an F ratio, as its Gaussian deviate.
            a, b = left.shape[1], count - left.shape[1]
            inside = ((left.T @ r) ** 2).sum()
            p = stats.f.sf((inside / a) / ((r @ r - inside) / b), a, b)
            deviates[i] += stats.norm.isf(np.clip(p, 1e-300, 1 - 1e-16))
            degrees[:, i] += a, b
            tested[i] += 1
    p = stats.norm.sf(deviates / np.sqrt(np.maximum(tested, 1)))
    shift = special.ncfdtrinc(*degrees, 1 - _POWER, special.fdtri(*degrees, 1 - level))
    return z, p, np.sqrt(shift / np.maximum(degrees.sum(axis=0), 1))
