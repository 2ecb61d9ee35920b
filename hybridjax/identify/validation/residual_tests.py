"""Tests of what a model leaves of records, as sums over these."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from ...experiments.record import Record


# Samples of a section, below which a correlation says nothing. Doubled: more records are refused.
FEWEST_SAMPLES = 8
# Singular values of lagged inputs below this part of the largest one are rounding errors. Doubled:
# none but rounding.
_RANK = 1e-9


class Whiteness:
    """Correlations of residuals with earlier ones, section by section."""

    def __init__(self, N: int, lags: int, ny: int):
        self.N, self.lags = N, lags
        self.products, self.counts = np.zeros((N, lags, ny)), np.zeros((N, lags, ny), int)

    def add(self, records: Sequence[Record], e: Sequence[np.ndarray]) -> None:
        """**Arguments:** `e`: what is left of each record's outputs."""
        section, now = sections_of(records), np.concatenate(e)
        for lag in range(1, self.lags + 1):
            product = now * np.concatenate([_earlier(x, lag) for x in e])
            for n in range(self.N):
                values = product[section == n]
                self.products[n, lag - 1] += np.nansum(values, axis=0)
                self.counts[n, lag - 1] += np.isfinite(values).sum(axis=0)

    def result(
        self, size: Float[np.ndarray, "N ny"]
    ) -> tuple[Float[np.ndarray, "N lags ny"], Float[np.ndarray, " ny"]]:
        """The correlations and the p-values; `size`: rms of the residuals at each section."""
        scale = np.where(size > 0, size, 1.0)
        N, lags = self.N, self.lags
        before = (np.arange(N)[:, None] - np.arange(1, lags + 1)) % N
        count = self.counts
        z = self.products / scale[:, None] / scale[before] / np.sqrt(np.maximum(count, 1))
        # The mean over the sections of each lag, and what the sections differ from it: independent.
        total = count >= FEWEST_SAMPLES
        z = z * total
        count = total.sum(axis=0)
        pooled = z.sum(axis=0) ** 2 / np.maximum(count, 1)
        rest = (z**2).sum(axis=(0, 1)) - pooled.sum(axis=0)
        few = (count > 0).sum(axis=0)
        p = stats.chi2.sf(pooled.sum(axis=0), few)
        if N > 1:
            p = np.minimum(p, stats.chi2.sf(rest, count.sum(axis=0) - few))
            p = -np.expm1(2 * np.log1p(-p))
        return z, p


class Independence:
    """What inputs of now and earlier explain of residuals, section by section.

    The rows of lagged inputs, with the residuals as one more column, are kept as the triangle of
    their QR decomposition.
    """

    def __init__(self, N: int, lags: int, ny: int, nu: int):
        self.N, self.lags, self.ny, self.nu = N, lags, ny, nu
        self.triangles = {k: np.zeros((0, lags * nu + 1)) for k in np.ndindex(N, ny)}
        self.counts = np.zeros((N, ny), int)

    def add(self, records: Sequence[Record], e: Sequence[np.ndarray]) -> None:
        """**Arguments:** `e`: what is left of each record's outputs."""
        section, now = sections_of(records), np.concatenate(e)
        past = [np.concatenate([_earlier(r.u, lag) for r in records]) for lag in range(self.lags)]
        past = np.stack(past, axis=1).reshape(len(now), -1)
        known = np.isfinite(past).all(axis=1)
        for n, i in np.ndindex(self.N, self.ny):
            rows = (section == n) & known & np.isfinite(now[:, i])
            more = np.concatenate([past[rows], now[rows, i, None]], axis=1)
            self.counts[n, i] += len(more)
            stacked = np.concatenate([self.triangles[n, i], more])
            self.triangles[n, i] = np.linalg.qr(stacked, mode="r")

    def result(
        self,
    ) -> tuple[
        Float[np.ndarray, "N lags ny nu"], Float[np.ndarray, " ny"], list[list[tuple[int, int]]]
    ]:
        """Correlations with the inputs, the p-values, and the degrees of freedom of the F ratios of
        each output."""
        z = np.zeros((self.N, self.lags, self.ny, self.nu))
        square = np.zeros(self.ny)
        ratios: list[list[tuple[int, int]]] = [[] for _ in range(self.ny)]
        for (n, i), triangle in self.triangles.items():
            U, r, rows = triangle[:, :-1], triangle[:, -1], int(self.counts[n, i])
            if rows < FEWEST_SAMPLES or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * (r @ r) / rows)
            z[n, :, i] = (U.T @ r / np.where(size > 0, size, 1.0)).reshape(self.lags, self.nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > _RANK * s[0]][:, : rows // 2]
            # Explained against unexplained part: an F ratio, as its normal deviate squared.
            a, b = left.shape[1], rows - left.shape[1]
            inside = ((left.T @ r) ** 2).sum()
            ratio = (inside / a) / ((r @ r - inside) / b)
            square[i] += stats.norm.isf(np.clip(stats.f.sf(ratio, a, b), 1e-300, 1 - 1e-16))
            ratios[i].append((a, b))
        count = np.array([len(r) for r in ratios])
        return z, stats.norm.sf(square / np.sqrt(np.maximum(count, 1))), ratios


def sections_of(records: Sequence[Record]) -> Int[np.ndarray, " n"]:
    """Of all samples."""
    return np.concatenate([(r.first_section + np.arange(len(r.u))) % r.n_sections for r in records])


def _earlier(x: np.ndarray, lag: int) -> np.ndarray:
    """x, `lag` samples earlier; NaN before its start."""
    out = np.full_like(x, np.nan)
    out[lag:] = x[: max(len(x) - lag, 0)]
    return out
