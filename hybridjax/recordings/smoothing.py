"""Splines through samples with a stated bandwidth, gaps between samples, and isolated spikes.

All files of `recordings` that evaluate a signal between its samples call `spline` (or `means`), and
ask `bridgeable` and `gaps` which gaps are too long. `spike_heights` finds isolated wrong samples.
Time series are arrays (n,), with NaN for missing samples. `gaps` must include what lies before and
after all samples: by it callers leave out what a spline would extrapolate.

The constants say what counts as a spike. If a good sample is left out or a spike stays in, look at
`spike_heights` (and `input_spikes` for inputs), which tests each condition in turn; if a signal is
too smooth, at `_smoothed` and the bandwidth.
"""

from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded
from scipy.sparse import diags_array

from .._core.boundary.values import Number
from ..errors import DefinitionError


Series = Float[np.ndarray, " n"]
"""Samples of one signal, or their times."""
Bandwidth = Annotated[float, Number("a positive number", above=0, infinite=True)]
"""In Hz; infinite: nothing is smoothed."""

# With a bandwidth below this, in cycles per sample, a spline is a straight line. Smaller: its
# weight overflows. Larger: slow changes of long recordings are removed.
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
# Least height of a spike: this many ranges of the closest half of its neighbors, and a number of
# standard deviations of the noise (or smallest steps of the signal). For an input, the range of its
# middle 98 % counts, too; for placeholders such as -9999, the range of all samples. Larger: spikes
# stay in. Smaller: steep parts, noise, rounding and the perturbation itself are left out.
RANGES = 3.0
_NOISES = 6.0
# A spike is isolated if within this many samples on either side there are no more wrong samples
# than two longest spikes have. Fewer: ringing after an impact is taken for spikes. More:
# independent spikes nearby stay in.
_NEAR = 10
# Spikes are alike if their phases differ by less than this part of a cycle, and their heights by
# less than the factor `RANGES`. If they occur in half of the cycles, they are part of the motion.
# Larger: spikes that are near each other by chance are kept. Smaller: impacts in a jittering rhythm
# are left out.
_SAME_PHASE = 0.01
# An input is smooth if the noise from sample to sample is below this part of its standard
# deviation. Larger: single samples of white inputs count as spikes. Smaller: spikes of noisy inputs
# are kept.
_SMOOTH_INPUT = 0.3


def spline(time: Series, values: Series, bandwidth: int | float) -> CubicSpline:
    r"""Return a natural cubic spline through samples; NaN are left out.

    A finite bandwidth b (Hz) makes it a smoothing spline (Reinsch 1967; Green and Silverman,
    *Nonparametric Regression and Generalized Linear Models*, 1994, sec. 2.3): it minimizes $\sum
    (y_i - s(t_i))^2 + \gamma \int s''^2$ over functions s. A sine of frequency $f$ passes with the
    gain $1 / (1 + \gamma h (2 \pi f)^4)$, where h is the time between samples, and $\gamma$ is
    chosen so that the gain is one half at b.
    """
    finite = np.isfinite(values)
    count = int(finite.sum())
    if count < FEWEST:
        raise DefinitionError(f"a spline needs {FEWEST} samples, not {count}.")
    time = time[finite]
    values = values[finite]
    step = np.median(np.diff(time))
    weight = (2 * np.pi * max(bandwidth * step, _STRAIGHT)) ** -4.0
    smooth = _smoothed(np.diff(time) / step, values, weight)
    return CubicSpline(time, smooth, bc_type="natural")


def _smoothed(h: Float[np.ndarray, " n1"], values: Series, weight: float) -> Series:
    r"""Return a smoothing spline at its samples.

    The samples f of a natural spline determine its second derivatives c: $R c = Q^T f$, where the
    columns of Q are second divided differences. The minimizer is $f = y - \gamma Q c$, with
    $(R + \gamma Q^T Q) c = Q^T y$.

    `make_smoothing_spline` of scipy takes ten times as long, and is off by several percent at the
    bandwidths of slow drift.

    **Arguments:** `h`: distances between the samples, in units of about 1. `weight`: $\gamma$.
    """
    before = h[:-1]
    after = h[1:]
    shape = (len(values), len(before))
    # (`Any`, since checkers of types infer one number from the default.)
    downwards: Any = [0, -1, -2]
    around: Any = [-1, 0, 1]
    middle = -1 / before - 1 / after
    differences = [1 / before, middle, 1 / after]
    Q = diags_array(differences, offsets=downwards, shape=shape)
    coupling = after[:-1] / 6
    R = diags_array([coupling, (before + after) / 3, coupling], offsets=around)
    matrix = R + weight * (Q.T @ Q)
    band = [np.pad(matrix.diagonal(k), (0, k)) for k in range(3)]
    curvature = solveh_banded(band, Q.T @ values, lower=True, check_finite=False)
    return values - weight * (Q @ curvature)


def require_passing(bandwidth: float, rate: float) -> None:
    """**Raises:** `DefinitionError` for a bandwidth that removes a rhythm of this rate (Hz)."""
    if bandwidth < rate:
        raise DefinitionError(
            f"`bandwidth` removes the rhythm of {rate:.3g} Hz: raise or omit it."
        )


def bridgeable(time: Series, longest: int | float = 0.0) -> float:
    """Return the longest gap that a spline bridges: `longest`, but not less than three samples."""
    step = float(np.median(np.diff(time)))
    return max(longest, 3.001 * step)


def gaps(time: Series, longest: int | float) -> Float[np.ndarray, "g 2"]:
    """Return the intervals without samples that are longer than `longest`, including the interval
    before all samples, which starts at -inf, and the one after all samples."""
    edges = np.concatenate([[-np.inf], time, [np.inf]])
    intervals = sliding_window_view(edges, 2)
    return intervals[np.diff(edges) > longest]


def inside(
    parts: Float[np.ndarray, "g 2"],
    start: Series,
    end: Series,
) -> Bool[np.ndarray, " n"]:
    """Return which intervals from start to end touch any of the given ones (disjoint, sorted)."""
    begun = np.searchsorted(parts[:, 0], end, side="left")
    over = np.searchsorted(parts[:, 1], start, side="right")
    return np.asarray(begun > over)


def means(
    time: Series,
    values: Series,
    edges: Float[np.ndarray, " m1"],
) -> Float[np.ndarray, " m"]:
    """Return means of a signal between successive edges; it is linear between its samples."""
    finite = np.isfinite(values)
    line = make_interp_spline(time[finite], values[finite], k=1)
    area = line.antiderivative()(edges)
    return np.diff(area) / np.diff(edges)


def without_spikes(values: Series) -> Series:
    """Return a signal in which the samples of isolated spikes are missing (NaN)."""
    return np.where(spike_heights(values) != 0, np.nan, values)


def spike_heights(values: Series) -> Series:
    r"""Return the signed height of each sample of an isolated spike, and zero elsewhere.

    Candidates are samples that an opening of the signal (or a closing) removes: the opening is the
    largest of the least values of four successive samples (top hat: Serra, *Image Analysis and
    Mathematical Morphology*, 1982). It removes spikes of up to three samples, but no steps, kinks
    or longer pulses. A candidate is a spike if its distance from the median of its neighbors
    (Hampel 1974) exceeds three times the range of the closest half of them, six standard deviations
    of the noise, and six of the smallest steps of the signal, and if few other candidates are
    nearby. (Many are nearby if a signal rings.)

    **Arguments:** `values`: the signal; NaN where a sample is missing.
    """
    heights = np.zeros(len(values))
    finite = np.isfinite(values)
    x = values[finite]
    if len(x) <= _NEIGHBORHOOD:
        return heights
    height = _candidates(x)
    steps = np.abs(np.diff(x))
    smallest_step = steps[steps > 0].min(initial=np.inf)
    least = _NOISES * max(noise_of(x), smallest_step)
    spikes = np.flatnonzero(np.abs(height) > least)
    usual = RANGES * _ranges_nearby(x, spikes)
    spikes = spikes[np.abs(height[spikes]) > usual]
    last_near = np.searchsorted(spikes, spikes + _NEAR + 1)
    first_near = np.searchsorted(spikes, spikes - _NEAR)
    spikes = spikes[last_near - first_near <= 2 * _LONGEST]
    heights[np.flatnonzero(finite)[spikes]] = height[spikes]
    return heights


def _candidates(x: Series) -> Series:
    """Return the signed height of each sample above or below its neighbors: the distance from their
    median, but not more than an opening or closing removes."""
    above = np.asarray(ndimage.white_tophat(x, _LONGEST + 1))
    below = np.asarray(ndimage.black_tophat(x, _LONGEST + 1))
    distance = x - ndimage.median_filter(x, _NEIGHBORHOOD)
    removed = np.where(distance > 0, above, below)
    return np.sign(distance) * np.minimum(np.abs(distance), removed)


def _ranges_nearby(
    x: Series,
    samples: Int[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Return for some samples the range of the closest half of their neighbors."""
    half = _NEIGHBORHOOD // 2
    first = np.clip(samples - half, 0, len(x) - _NEIGHBORHOOD)
    neighbors = np.sort(sliding_window_view(x, _NEIGHBORHOOD)[first], axis=1)
    later = neighbors[:, half:]
    ranges = later - neighbors[:, : half + 1]
    return ranges.min(axis=1)


def noise_of(x: Series) -> float:
    """Return the standard deviation of the noise from sample to sample; a few spikes have no
    effect.

    It follows from the median of fourth differences, which have the standard deviation sqrt(70) for
    noise of standard deviation 1, and are nearly zero for slower changes.
    """
    median_of_normal = 0.6745  # of the modulus of a standard normal variable
    differences = np.abs(np.diff(x, n=4))
    return float(np.median(differences)) / (median_of_normal * np.sqrt(70))


def recurring(
    heights: Float[np.ndarray, " k"],
    phase: Float[np.ndarray, " k"],
    cycles: int | float,
) -> Bool[np.ndarray, " k"]:
    """Return which spikes belong to the motion: similar spikes occur at the same phase of most
    cycles.

    **Arguments:** `phase` of each, in cycles, which increases from stretch to stretch. `cycles`:
    number of cycles.
    """
    recurs = np.zeros(len(heights), bool)
    for k in range(len(heights)):
        ratio = heights / heights[k]
        distance = phase - phase[k]
        to_whole_cycles = np.abs((distance + 0.5) % 1 - 0.5)
        alike = (ratio > 1 / RANGES) & (ratio < RANGES)
        alike &= to_whole_cycles < _SAME_PHASE
        in_cycles = np.unique(np.round(distance[alike]))
        recurs[k] = len(in_cycles) > 0.5 * cycles
    return recurs


def input_spikes(values: Series) -> Series:
    """Return `spike_heights` of an input, but only if the input is smooth otherwise, and only of
    spikes far beyond its usual range. (The perturbation itself must not be removed.)"""
    heights = spike_heights(values)
    if not heights.any():
        return heights
    usual = values[np.isfinite(values) & (heights == 0)]
    low, high = np.quantile(usual, [0.01, 0.99])
    is_noisy = noise_of(usual) > _SMOOTH_INPUT * usual.std()
    if high == low or is_noisy:
        return np.zeros(len(values))
    distance = np.abs(values - (low + high) / 2)
    return np.where(distance > RANGES * (high - low) / 2, heights, 0.0)
