"""Splines through samples, smoothing ones with a stated bandwidth, and gaps between samples."""

from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solveh_banded

from .._core.boundary.values import Number
from ..errors import DefinitionError


Bandwidth = Annotated[float, Number("a positive number", above=0, infinite=True)]
"""In Hz; infinite: nothing is smoothed."""

# Samples that a spline is drawn through, at least. Doubled: shorter stretches are left out.
FEWEST = 5
# Times between samples that are no gap yet: three, and rounding. Doubled: splines bridge gaps that
# are twice as long where samples are scarce.
_GAP_SAMPLES = 3.001


class Spline(eqx.Module):
    """A natural cubic spline: its values and second derivatives at the knots."""

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    curvature: Float[np.ndarray, " n"]

    def __call__(self, t: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        k = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2)
        h = self.time[k + 1] - self.time[k]
        before, after = t - self.time[k], self.time[k + 1] - t
        line = (after * self.values[k] + before * self.values[k + 1]) / h
        bend = (1 + before / h) * self.curvature[k + 1] + (1 + after / h) * self.curvature[k]
        return line - before * after * bend / 6


def spline(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], bandwidth: int | float
) -> Spline:
    r"""A natural cubic spline through samples; NaN are left out.

    A finite bandwidth b (Hz) makes it a smoothing spline (Reinsch 1967; Green and Silverman,
    *Nonparametric Regression and Generalized Linear Models*, 1994, sec. 2.3): the minimizer of
    $\sum (y_i - f(t_i))^2 + \gamma \int f''^2$ passes a sine of frequency $f$ with the gain
    $1 / (1 + \gamma h (2 \pi f)^4)$, h the time between samples, and $\gamma$ is chosen so that
    this is one half at b.
    """
    seen = np.isfinite(values)
    if seen.sum() < FEWEST:
        raise DefinitionError(f"{int(seen.sum())} samples are too few for a spline.")
    time, values = time[seen], values[seen]
    step = float(np.median(np.diff(time)))
    h = np.diff(time) / step
    weight = (2 * np.pi * bandwidth * step) ** -4.0
    # (R + weight Q'Q) curvature = Q' y; the columns of Q are second divided differences.
    q = np.stack([1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]])
    band = np.zeros((3, len(h) - 1))
    band[0] = (h[:-1] + h[1:]) / 3 + weight * (q**2).sum(axis=0)
    band[1, :-1] = h[1:-1] / 6 + weight * (q[1, :-1] * q[0, 1:] + q[2, :-1] * q[1, 1:])
    band[2, :-2] = weight * q[2, :-2] * q[0, 2:]
    right = q[0] * values[:-2] + q[1] * values[1:-1] + q[2] * values[2:]
    curvature = solveh_banded(band, right, lower=True, overwrite_ab=True, check_finite=False)
    smooth = values.copy()
    for k in range(3):
        smooth[k : len(values) - 2 + k] -= weight * q[k] * curvature
    return Spline(time, smooth, np.pad(curvature, 1) / step**2)


def bridgeable(
    time: Float[np.ndarray, " n"], seen: Bool[np.ndarray, " n"], longest: int | float = 0.0
) -> float:
    """The longest time without a sample that a spline bridges: `longest`, but not less than three
    samples."""
    return max(longest, _GAP_SAMPLES * float(np.median(np.diff(time[seen]))))


def gaps(
    time: Float[np.ndarray, " n"], seen: Bool[np.ndarray, " n"], longest: int | float
) -> Float[np.ndarray, "g 2"]:
    """First and last times of the stretches without a sample that are longer than `longest`: first
    the time before all samples, which begins at -inf, last that after them."""
    there = np.concatenate([[-np.inf], time[seen], [np.inf]])
    wide = np.flatnonzero(np.diff(there) > longest)
    return np.stack([there[wide], there[wide + 1]], axis=1)


def inside(
    intervals: Float[np.ndarray, "g 2"],
    start: Float[np.ndarray, " n"],
    end: Float[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Which of the intervals from start to end touch any of the (disjoint, sorted) ones given."""
    before: Int[np.ndarray, " n"] = np.searchsorted(intervals[:, 0], end, side="left")
    over: Int[np.ndarray, " n"] = np.searchsorted(intervals[:, 1], start, side="right")
    return before > over


def means(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], edges: Float[np.ndarray, " m1"]
) -> Float[np.ndarray, " m"]:
    """Means of a signal between successive edges; it is linear between its samples."""
    seen = np.isfinite(values)
    time, values = time[seen], values[seen]
    area = np.concatenate([[0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2)])
    at = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, len(time) - 2)
    since = edges - time[at]
    slope = (values[at + 1] - values[at]) / (time[at + 1] - time[at])
    whole = area[at] + since * (values[at] + slope * since / 2)
    return np.diff(whole) / np.diff(edges)


def nearest(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], t: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " m"]:
    """The samples next to some times."""
    seen = np.isfinite(values)
    time, values = time[seen], values[seen]
    return values[np.searchsorted((time[:-1] + time[1:]) / 2, t)]
