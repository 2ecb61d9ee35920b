"""A perturbation that needs no phase."""

import numpy as np
from jaxtyping import Float
from scipy import signal

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, NonNegative, Positive, Seed
from .._core.limits import PERIODS
from ..errors import DefinitionError


# Periods of the bandwidth that are cut off at either end, where the filter begins. Doubled: nothing
# but rounding changes, and other random numbers are drawn.
_TRANSIENT = 4


@checked
def random_force(
    duration: Positive,
    rate: Positive,
    bandwidth: Positive,
    *,
    rms: NonNegative = 1.0,
    inputs: Count = 1,
    seed: Seed = 0,
) -> Float[np.ndarray, "n nu"]:
    """A random perturbation with power up to `bandwidth`: white noise, low-passed.

    The filter is Butterworth's of order 4, run forwards and backwards. It needs no phase, so that
    any hardware that plays a file can apply it.

    **Arguments:** `duration` in seconds, `rate` in samples per second, `bandwidth` in Hz (half of
    the amplitude), `rms`, number of `inputs`, `seed`.

    **Raises:** `DefinitionError` for a bandwidth of more than half the rate.
    """
    if bandwidth >= rate / 2:
        raise DefinitionError(
            f"`bandwidth` must be less than half of the {rate:g} samples per second, but is "
            f"{bandwidth:g}."
        )
    samples = (duration * rate + 2 * _TRANSIENT * rate / bandwidth) * inputs
    if not samples <= PERIODS:
        raise DefinitionError(
            f"`duration`, `rate` and `bandwidth` need {samples:.3g} samples of all inputs, more "
            f"than {PERIODS}."
        )
    n = round(duration * rate)
    sos = signal.butter(4, bandwidth, fs=rate, output="sos")
    pad = round(_TRANSIENT * rate / bandwidth)
    white = np.random.default_rng(seed).normal(size=(n + 2 * pad, inputs))
    force = signal.sosfiltfilt(sos, white, axis=0)[pad : pad + n]
    return rms * force / np.sqrt(np.mean(force**2, axis=0))
