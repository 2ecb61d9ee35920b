"""Splines through samples with a stated bandwidth, gaps between samples, and isolated spikes."""

from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded

from .._core.boundary.values import Number
from ..errors import DefinitionError


Series = Float[np.ndarray, " n"]
"""Samples of one signal, or their times."""
Bandwidth = Annotated[float, Number("a positive number", above=0, infinite=True)]
"""In Hz; infinite: nothing is smoothed."""

# Bandwidth, in cycles per sample, at which a spline is a straight line. Smaller: its weight
# overflows. Larger: slow changes of long recordings are not passed.
_STRAIGHT = 1e-12
# Fewest samples of a spline. More: short stretches are left out. Fewer than 3: the band matrix is
# empty.
FEWEST = 5
# Longest spike in samples. Longer: short pulses are taken for spikes. Shorter: neighbors that are
# hit together (where 1 % of the samples are hit) stay in.
_LONGEST = 3
# Number of neighboring samples with which a spike is compared. More: spikes where a signal is steep
# are missed. Fewer: their median is a spike itself.
_NEIGHBORHOOD = 3 * _LONGEST
# Least height of a spike in ranges of the closest half of its neighbors (for an input also of its
# middle 98 %; for a number that stands for no value, of all samples), and in standard deviations of
# the noise (or smallest steps of the signal). Larger: spikes stay in. Smaller: steep parts, noise,
# rounding and the perturbation itself are left out.
RANGES, _NOISES = 3.0, 6.0
# Spikes are isolated if within so many samples on either side there are no more of them than two
# longest spikes have. Fewer: ringing after an impact is taken for spikes. More: independent spikes
# nearby stay in.
_NEAR = 10
# Cubic prediction of a sample from two neighbors on either side.
_PREDICTION = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6
# Transients within this many cycles, with heights within a factor of `RANGES`, are alike, and part
# of the motion if they occur in half of the cycles. Larger: spikes that are near each other by
# chance stay in. Smaller: impacts in a jittering rhythm are left out.
_SAME_PHASE = 0.01
# Fraction of an input's standard deviation that is noise from sample to sample, up to which it
# counts as smooth. Larger: single samples of white inputs are taken for spikes. Smaller: spikes of
# noisy inputs stay in.
_SMOOTH_INPUT = 0.3


def spline(time: Series, values: Series, bandwidth: int | float) -> CubicSpline:
    r"""Return a natural cubic spline through samples; NaN are left out.

    A finite bandwidth b (Hz) makes it a smoothing spline (Reinsch 1967; Green and Silverman,
    *Nonparametric Regression and Generalized Linear Models*, 1994, sec. 2.3): the minimizer of
    $\sum (y_i - f(t_i))^2 + \gamma \int f''^2$ passes a sine of frequency $f$ with the gain
    $1 / (1 + \gamma h (2 \pi f)^4)$, h the time between samples, and $\gamma$ is chosen so that
    this is one half at b.
    """
    finite = np.isfinite(values)
    if finite.sum() < FEWEST:
        raise DefinitionError(
            f"a spline needs {FEWEST} samples, not {int(finite.sum())}."
        )
    time, values = time[finite], values[finite]
    step = float(np.median(np.diff(time)))
    h = np.diff(time) / step
    weight = (2 * np.pi * max(bandwidth * step, _STRAIGHT)) ** -4.0
    # (R + weight Q'Q) curvature = Q' y; the columns of Q are second divided differences.
    q = np.stack([1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]])
    band = np.zeros((3, len(h) - 1))
    band[0] = (h[:-1] + h[1:]) / 3 + weight * (q**2).sum(axis=0)
    band[1, :-1] = h[1:-1] / 6 + weight * (q[1, :-1] * q[0, 1:] + q[2, :-1] * q[1, 1:])
    band[2, :-2] = weight * q[2, :-2] * q[0, 2:]
    right = q[0] * values[:-2] + q[1] * values[1:-1] + q[2] * values[2:]
    curvature = solveh_banded(
        band, right, lower=True, overwrite_ab=True, check_finite=False
    )
    smooth = values.copy()
    for k in range(3):
        smooth[k : len(values) - 2 + k] -= weight * q[k] * curvature
    return CubicSpline(time, smooth, bc_type="natural")


def require_passing(bandwidth: float, rate: float) -> None:
    """**Raises:** `DefinitionError` for a bandwidth that removes a rhythm of this rate (Hz)."""
    if bandwidth < rate:
        raise DefinitionError(
            f"`bandwidth` removes the rhythm of {rate:.3g} Hz: raise or omit it."
        )


def bridgeable(time: Series, longest: int | float = 0.0) -> float:
    """Return the longest gap that a spline bridges: `longest`, but not less than three samples."""
    return max(longest, 3.001 * float(np.median(np.diff(time))))


def gaps(time: Series, longest: int | float) -> Float[np.ndarray, "g 2"]:
    """Return the intervals without samples that are longer than `longest`, from the one before all
    samples, which starts at -inf, to the one after them."""
    edges = np.concatenate([[-np.inf], time, [np.inf]])
    wide = np.flatnonzero(np.diff(edges) > longest)
    return np.stack([edges[wide], edges[wide + 1]], axis=1)


def inside(
    parts: Float[np.ndarray, "g 2"], start: Series, end: Series
) -> Bool[np.ndarray, " n"]:
    """Return which intervals from start to end touch any of the given ones (disjoint, sorted)."""
    before: Int[np.ndarray, " n"] = np.searchsorted(parts[:, 0], end, side="left")
    over: Int[np.ndarray, " n"] = np.searchsorted(parts[:, 1], start, side="right")
    return before > over


def means(
    time: Series, values: Series, edges: Float[np.ndarray, " m1"]
) -> Float[np.ndarray, " m"]:
    """Return means of a signal between successive edges; it is linear between its samples."""
    finite = np.isfinite(values)
    area = make_interp_spline(time[finite], values[finite], k=1).antiderivative()
    return np.diff(area(edges)) / np.diff(edges)


def without_spikes(values: Series) -> Series:
    """Return a signal in which the samples of isolated spikes are missing (NaN)."""
    return np.where(spike_heights(values) != 0, np.nan, values)


def spike_heights(values: Series) -> Series:
    r"""Return the signed height of each sample of an isolated spike, and zero elsewhere.

    Spikes of up to three samples are what an opening (or closing) of a signal removes: the largest
    of the least values of four successive samples (top hat: Serra, *Image Analysis and Mathematical
    Morphology*, 1982). Steps, kinks and pulses of four samples or more pass. A candidate is a spike
    if its distance from the median of its neighbors (Hampel 1974) exceeds three times the range of
    the closest half of them, six standard deviations of the noise, and six of the smallest steps of
    the signal, and if few others are nearby, as they are where a signal rings.

    **Arguments:** `values`: the signal; NaN where a sample is missing.
    """
    heights, finite = np.zeros(len(values)), np.isfinite(values)
    x = values[finite]
    if len(x) <= _NEIGHBORHOOD:
        return heights
    top = x - ndimage.grey_opening(x, _LONGEST + 1)
    bottom = ndimage.grey_closing(x, _LONGEST + 1) - x
    off = x - ndimage.median_filter(x, _NEIGHBORHOOD)
    out = np.sign(off) * np.minimum(np.abs(off), np.where(off > 0, top, bottom))
    steps = np.abs(np.diff(x))
    least = steps[steps > 0].min(initial=np.inf)
    large = np.flatnonzero(np.abs(out) > _NOISES * max(noise_of(x), least))
    half = _NEIGHBORHOOD // 2
    first = np.clip(large - half, 0, len(x) - _NEIGHBORHOOD)
    around = np.sort(x[first[:, None] + np.arange(_NEIGHBORHOOD)], axis=1)
    closest_half = (around[:, half:] - around[:, : half + 1]).min(axis=1)
    large = large[np.abs(out[large]) > RANGES * closest_half]
    near = np.searchsorted(large, large + _NEAR + 1) - np.searchsorted(
        large, large - _NEAR
    )
    large = large[near <= 2 * _LONGEST]
    heights[np.flatnonzero(finite)[large]] = out[large]
    return heights


def noise_of(x: Series) -> float:
    """Return the standard deviation of what changes from sample to sample, without few spikes."""
    missed = np.abs(np.convolve(x, _PREDICTION, "valid"))
    normal = 0.6745  # median of the modulus of a standard normal variable
    return float(np.median(missed)) / (normal * float(np.linalg.norm(_PREDICTION)))


def recurring(
    heights: Float[np.ndarray, " k"],
    phase: Float[np.ndarray, " k"],
    cycles: int | float,
) -> Bool[np.ndarray, " k"]:
    """Return which spikes are transients of the motion: similar ones at this phase of most cycles.

    **Arguments:** `phase` of each, in cycles, which increases from stretch to stretch. `cycles`:
    number of cycles.
    """
    recurs = np.zeros(len(heights), bool)
    for k in range(len(heights)):
        ratio, away = heights / heights[k], phase - phase[k]
        alike = (ratio > 1 / RANGES) & (ratio < RANGES)
        alike &= np.abs((away + 0.5) % 1 - 0.5) < _SAME_PHASE
        recurs[k] = len(np.unique(np.round(away[alike]))) > 0.5 * cycles
    return recurs


def input_spikes(values: Series) -> Series:
    """Return `spike_heights` of an input, only where it is smooth otherwise and a spike lies far
    beyond its usual range: the perturbation itself must stay."""
    heights = spike_heights(values)
    if not heights.any():
        return heights
    usual = values[np.isfinite(values) & (heights == 0)]
    low, high = np.quantile(usual, [0.01, 0.99])
    if high == low or noise_of(usual) > _SMOOTH_INPUT * usual.std():
        return np.zeros(len(values))
    beyond = np.abs(values - (low + high) / 2) > RANGES * (high - low) / 2
    return np.where(beyond, heights, 0.0)
