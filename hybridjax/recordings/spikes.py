"""Isolated spikes: one to three samples that stick out of all that is around them."""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage


# A spike lasts for so many samples at most: where 1 % are struck, three in a row happen. Doubled:
# short pulses are taken for spikes.
_LONGEST = 3
# How far it sticks out, in ranges of the closest half of the samples around it, and how many of
# these are looked at. Either doubled: spikes where a signal is steep are missed.
_LEAST_RANGES, _NEIGHBORHOOD = 3.0, 9
# How far in standard deviations of the noise, and in the smallest steps that the signal makes.
# Either doubled: spikes half as large are left alone.
_LEAST_NOISES, _LEAST_STEPS = 6.0, 6.0
# Spikes so near to each other, in samples, are no longer isolated if there are more than so many.
# Doubled: what rings from sample to sample for twice as long is taken for spikes.
_NEAR, _MOST_NEAR = 10, 6
# Prediction of a sample by a cubic through two to either side, and the root of the sum of squares.
_PREDICTION = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6
_PREDICTION_NOISE = float(np.linalg.norm(_PREDICTION))
# The median of the modulus of a standard normal variable.
_MEDIAN = 0.6745
# The share of cycles with a transient at the same phase that make it part of the motion, and how
# near to each other they are, in cycles. Doubled: impacts that are not seen in every cycle are
# taken for spikes; spikes that are near each other by chance are left in.
_SHARE_OF_CYCLES, _SAME_PHASE = 0.5, 0.01
# Heights of one transient differ by less than this factor. Doubled: the same as for the phase.
_SAME_HEIGHT = 3.0
# How far beyond the middle 98 % of an input a spike of it lies, in half their range. Doubled:
# spikes of twice the size are left in.
_INPUT_TAIL, _BEYOND_INPUT = 0.01, 3.0
# Of its standard deviation, the part of an input that is noise from sample to sample, up to which
# it counts as smooth. Doubled: single samples of white inputs may be taken for spikes.
_SMOOTH_INPUT = 0.3


def without_spikes(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """A signal in which the samples of isolated spikes are missing, NaN."""
    return np.where(spike_heights(values) != 0, np.nan, values)


def spike_heights(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    r"""How far each sample of an isolated spike sticks out, with its sign; zero elsewhere.

    Spikes of up to three samples are what an opening (or closing) of a signal takes away: the
    largest of the least values of four successive samples (top hat: Serra, *Image Analysis and
    Mathematical Morphology*, 1982). Steps, kinks and pulses of four samples or more pass. What
    also differs from the median of what is around it (Hampel 1974) counts where it is larger than
    three times the range of the closest half of these, six times the noise (from what a cubic
    through their neighbors misses samples by), and six of the signal's smallest steps, and where it
    is not one of many nearby, which ring.

    **Arguments:** `values`; NaN where a sample is missing.
    """
    heights = np.zeros(len(values))
    seen = np.isfinite(values)
    x = values[seen]
    if len(x) <= _NEIGHBORHOOD:
        return heights
    top = x - ndimage.grey_opening(x, _LONGEST + 1)
    bottom = ndimage.grey_closing(x, _LONGEST + 1) - x
    off = x - ndimage.median_filter(x, _NEIGHBORHOOD)
    out = np.sign(off) * np.minimum(np.abs(off), np.where(off > 0, top, bottom))
    steps = np.abs(np.diff(x))
    least = steps[steps > 0].min(initial=np.inf)
    large = np.flatnonzero(np.abs(out) > max(_LEAST_NOISES * noise_of(x), _LEAST_STEPS * least))
    half = _NEIGHBORHOOD // 2
    first = np.clip(large - half, 0, len(x) - _NEIGHBORHOOD)
    around = np.sort(x[first[:, None] + np.arange(_NEIGHBORHOOD)], axis=1)
    shortest_half = (around[:, half:] - around[:, : half + 1]).min(axis=1)
    large = large[np.abs(out[large]) > _LEAST_RANGES * shortest_half]
    near = np.searchsorted(large, large + _NEAR + 1) - np.searchsorted(large, large - _NEAR)
    large = large[near <= _MOST_NEAR]
    heights[np.flatnonzero(seen)[large]] = out[large]
    return heights


def noise_of(x: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of what changes from sample to sample, few spikes apart."""
    missed = np.abs(np.convolve(x, _PREDICTION, "valid"))
    return float(np.median(missed)) / (_MEDIAN * _PREDICTION_NOISE)


def recurring(
    heights: Float[np.ndarray, " k"], phase: Float[np.ndarray, " k"], cycles: int | float
) -> Bool[np.ndarray, " k"]:
    """Which spikes are transients of the motion: alike ones stand at this phase of most cycles.

    **Arguments:** `phase` of each, in cycles, which go on from stretch to stretch. `cycles`: their
    number.
    """
    found = np.zeros(len(heights), bool)
    for k, (height, own) in enumerate(zip(heights, phase, strict=True)):
        ratio = heights / height
        alike = (ratio > 1 / _SAME_HEIGHT) & (ratio < _SAME_HEIGHT)
        alike &= np.abs((phase - own + 0.5) % 1 - 0.5) < _SAME_PHASE
        found[k] = len(np.unique(np.round(phase[alike] - own))) > _SHARE_OF_CYCLES * cycles
    return found


def input_spikes(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """As `spike_heights`, but only where the input is smooth otherwise and a spike lies far beyond
    all else that it does: what is left must not be the perturbation itself."""
    heights = spike_heights(values)
    if not heights.any():
        return heights
    rest = values[np.isfinite(values) & (heights == 0)]
    low, high = np.quantile(rest, [_INPUT_TAIL, 1 - _INPUT_TAIL])
    if high == low or noise_of(rest) > _SMOOTH_INPUT * rest.std():
        return np.zeros(len(values))
    beyond = np.abs(values - (low + high) / 2) > _BEYOND_INPUT * (high - low) / 2
    return np.where(beyond, heights, 0.0)
