"""`random_input`: noise with power up to a frequency, for any hardware that plays a file.

Users call it, and no other part of the package does. The filter must run forwards and backwards:
only so is half of the amplitude left at `bandwidth`. If the signal has a transient at its ends,
look at the samples that are cut off there (`transient`); if its rms value is wrong, at the last
line.
"""

import numpy as np
from jaxtyping import Float
from scipy import signal

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import NonNegative, Positive, Seed
from ..._core.limits import PERIODS
from ...errors import DefinitionError


@checked
def random_input(
    duration: Positive,
    rate: Positive,
    bandwidth: Positive,
    *,
    rms: NonNegative = 1.0,
    seed: Seed = 0,
) -> Float[np.ndarray, "n 1"]:
    """Return a random perturbation with power up to `bandwidth`: white noise, low-passed.

    The filter is a Butterworth filter of order 4, applied forwards and backwards. The perturbation
    is not aligned to any phase, so any hardware that plays a file can apply it.

    **Arguments:**

    - `duration`: in seconds.
    - `rate`: samples per second.
    - `bandwidth`: the frequency in Hz at which half of the amplitude is left.
    - `rms`: rms value, in the unit of the input. Default: 1.
    - `seed`: seed of the noise. Default: 0.

    **Returns:** the samples (n, 1), with n the duration times the rate.

    **Raises:** `DefinitionError` for a bandwidth of half the rate or more, a duration without a
    sample, and too many samples.

    **Example:**

    ```python
    force = hj.experiments.random_input(60, 50, bandwidth=8, rms=0.02)
    np.savetxt("force.txt", force)
    ```

    **After:** hardware that plays it, or `hj.testing.simulate_recording`.
    """
    if bandwidth >= rate / 2:
        raise DefinitionError(
            f"`bandwidth` must be less than half of `rate`, {rate / 2:g}, but is {bandwidth:g}."
        )
    # Samples that are cut off at either end, where the filter starts.
    transient = 4 * rate / bandwidth
    samples = duration * rate + 2 * transient
    if not samples <= PERIODS:
        raise DefinitionError(
            f"`duration`, `rate` and `bandwidth` need {samples:.3g} samples, more than {PERIODS}."
        )
    n = round(duration * rate)
    if n == 0:
        raise DefinitionError(
            f"`duration` = {duration:g} is shorter than half of the time between samples, "
            f"{1 / rate:g}."
        )
    pad = round(transient)
    sos = signal.butter(4, bandwidth, fs=rate, output="sos")
    white = np.random.default_rng(seed).normal(size=(n + 2 * pad, 1))
    force = signal.sosfiltfilt(sos, white, axis=0)[pad : pad + n]
    return rms * force / np.sqrt(np.mean(force**2, axis=0))
