"""Tests of the residuals of records for whiteness and independence."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, stats

from ..experiments.record import Record
from .series.output_error import RANK


# Samples of a section, below which its correlations are not tested. Fewer: their distribution is
# not normal; more: short records cannot be validated.
FEWEST_SAMPLES = 8
# Probability with which a misfit that counts as visible is detected, and the draws over which
# Gaussian deviates are averaged. Fewer draws: the second digit of `visible` is wrong.
_POWER, _DRAWS = 0.8, 1000
# Largest misfit looked for, in standard deviations of the noise; beyond it nothing is visible.
_LARGEST = 1e3


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
    in standard deviations of the noise, for tests of this level.
    """
    N, ny, nu = samples.n_sections, error.shape[1], samples.u.shape[1]
    z, deviates = np.zeros((N, lags, ny, nu)), np.zeros(ny)
    ratios: list[list[tuple[int, int]]] = [[] for _ in range(ny)]
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
            deviates[i] += _deviate((inside / a) / ((r @ r - inside) / b), a, b)
            ratios[i].append((a, b))
    count = np.array([len(x) for x in ratios])
    p = stats.norm.sf(deviates / np.sqrt(np.maximum(count, 1)))
    return z, p, np.array([_smallest_visible(x, level) for x in ratios])


def _deviate(ratio, a: int, b: int):
    return stats.norm.isf(np.clip(stats.f.sf(ratio, a, b), 1e-300, 1 - 1e-16))


def _smallest_visible(ratios: Sequence[tuple[int, int]], level: float) -> float:
    """Return the rms of a misfit, in standard deviations of the noise, detected in 80 % of cases.

    Each F ratio with (a, b) degrees of freedom is one test of a of a + b samples, as a Gaussian
    deviate; the sum of all is compared with its quantile. A misfit of rms r times the noise
    makes each ratio noncentral, by (a + b) r^2 (the noncentral F distribution).
    """
    if not ratios:
        return np.nan
    rng = np.random.default_rng(0)
    normal = rng.normal(size=_DRAWS)
    draws = [
        (a, b, count, rng.chisquare(a - 1, _DRAWS) if a > 1 else 0.0, rng.chisquare(b, _DRAWS))
        for (a, b), count in Counter(ratios).items()
    ]

    def shortfall(log_misfit: float) -> float:
        mean = variance = 0.0
        for a, b, count, above, below in draws:
            above = above + (normal + np.sqrt(a + b) * np.exp(log_misfit)) ** 2
            deviate = _deviate((above / a) / (below / b), a, b)
            mean, variance = mean + count * deviate.mean(), variance + count * deviate.var()
        needed = stats.norm.isf(level) * np.sqrt(len(ratios))
        return (mean - needed) / np.sqrt(variance) - stats.norm.ppf(_POWER)

    limit = np.log(_LARGEST)
    if not shortfall(limit) > 0:
        return np.inf
    return float(np.exp(optimize.root_scalar(shortfall, bracket=(-limit, limit), xtol=1e-3).root))
