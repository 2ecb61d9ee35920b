"""Tests of the residuals of records for whiteness and independence, as sums over records."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, stats

from ..experiments.record import Record


# Samples of a section, below which its correlations are not tested. Fewer: their distribution is
# not normal; more: short records cannot be validated.
FEWEST_SAMPLES = 8
# Singular values of lagged inputs relative to the largest one that are rounding errors.
_RANK = 1e-9
# Probability with which a misfit that counts as visible is detected, and the draws over which
# Gaussian deviates are averaged. Fewer draws: the second digit of `visible` is wrong.
_POWER, _DRAWS = 0.8, 1000
# Largest misfit looked for, in standard deviations of the noise; beyond it nothing is visible.
_LARGEST = 1e3


class Whiteness:
    """Correlations of residuals with earlier ones, section by section."""

    def __init__(self, N: int, lags: int, ny: int):
        self.products, self.counts = np.zeros((N, lags, ny)), np.zeros((N, lags, ny), int)

    def add(self, records: Sequence[Record], residuals: Sequence[np.ndarray]) -> None:
        section, now = sections_of(records), np.concatenate(residuals)
        for lag in range(1, self.counts.shape[1] + 1):
            product = now * np.concatenate([_earlier(x, lag) for x in residuals])
            for n in range(len(self.counts)):
                values = product[section == n]
                self.products[n, lag - 1] += np.nansum(values, axis=0)
                self.counts[n, lag - 1] += np.isfinite(values).sum(axis=0)

    def result(
        self, size: Float[np.ndarray, "N ny"]
    ) -> tuple[Float[np.ndarray, "N lags ny"], Float[np.ndarray, " ny"]]:
        """Return correlations and p-values; `size`: rms of the residuals at each section."""
        scale = np.where(size > 0, size, 1.0)
        N, lags = self.counts.shape[:2]
        before = (np.arange(N)[:, None] - np.arange(1, lags + 1)) % N
        z = self.products / scale[:, None] / scale[before] / np.sqrt(np.maximum(self.counts, 1))
        # The mean over the sections of each lag, and the deviations from it: independent.
        tested = self.counts >= FEWEST_SAMPLES
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


class Independence:
    """The part of residuals that present and past inputs explain, section by section.

    The rows of lagged inputs, with the residuals as one more column, are kept as the triangle of
    their QR decomposition.
    """

    def __init__(self, N: int, lags: int, ny: int, nu: int):
        self.shape = N, lags, ny, nu
        self.triangles = {k: np.zeros((0, lags * nu + 1)) for k in np.ndindex(N, ny)}
        self.counts = np.zeros((N, ny), int)

    def add(self, records: Sequence[Record], residuals: Sequence[np.ndarray]) -> None:
        section, now = sections_of(records), np.concatenate(residuals)
        lags = range(self.shape[1])
        past = [np.concatenate([_earlier(r.u, lag) for r in records]) for lag in lags]
        past = np.stack(past, axis=1).reshape(len(now), -1)
        complete = np.isfinite(past).all(axis=1)
        for (n, i), triangle in self.triangles.items():
            rows = (section == n) & complete & np.isfinite(now[:, i])
            more = np.concatenate([past[rows], now[rows, i, None]], axis=1)
            self.counts[n, i] += len(more)
            self.triangles[n, i] = _triangle(np.concatenate([triangle, more]))

    def result(
        self, level: float
    ) -> tuple[
        Float[np.ndarray, "N lags ny nu"], Float[np.ndarray, " ny"], Float[np.ndarray, " ny"]
    ]:
        """Return the correlations with the inputs, the p-values, and the smallest visible misfits.

        The latter in standard deviations of the noise, for tests of this level.
        """
        N, lags, ny, nu = self.shape
        z, deviates = np.zeros(self.shape), np.zeros(ny)
        ratios: list[list[tuple[int, int]]] = [[] for _ in range(ny)]
        for (n, i), triangle in self.triangles.items():
            U, r, rows = triangle[:, :-1], triangle[:, -1], int(self.counts[n, i])
            if rows < FEWEST_SAMPLES or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * (r @ r) / rows)
            z[n, :, i] = (U.T @ r / np.where(size > 0, size, 1.0)).reshape(lags, nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > _RANK * s[0]][:, : rows // 2]
            # Explained against unexplained part: an F ratio, as its Gaussian deviate.
            a, b = left.shape[1], rows - left.shape[1]
            inside = ((left.T @ r) ** 2).sum()
            deviates[i] += _deviate((inside / a) / ((r @ r - inside) / b), a, b)
            ratios[i].append((a, b))
        count = np.array([len(x) for x in ratios])
        p = stats.norm.sf(deviates / np.sqrt(np.maximum(count, 1)))
        return z, p, np.array([_smallest_visible(x, level) for x in ratios])


def _triangle(rows: np.ndarray) -> np.ndarray:
    return np.linalg.qr(rows)[1]


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


def sections_of(records: Sequence[Record]) -> Int[np.ndarray, " n"]:
    """Return the section of each sample of all records."""
    return np.concatenate([(r.first_section + np.arange(len(r.u))) % r.n_sections for r in records])


def _earlier(x: np.ndarray, lag: int) -> np.ndarray:
    """Return x, `lag` samples earlier; NaN before its start."""
    out = np.full_like(x, np.nan)
    out[lag:] = x[: max(len(x) - lag, 0)]
    return out
