"""At which frequencies the inputs of a recording had power."""

import numpy as np
from jaxtyping import Float
from scipy import signal

from ..experiments.record import uninterrupted_records
from .data import SectionData


# An input tells nothing where its power is below this part of its largest. Doubled: bands end where
# more power is left.
_LEAST_POWER = 0.01
# Cycles in one window, at most. Doubled: twice the resolution in frequency, and noisier spectra.
_WINDOW = 16


def input_spectrum(
    data: SectionData,
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F nu"]]:
    """Frequencies in cycles per period, and power spectral densities there (Welch 1967)."""
    records, N = uninterrupted_records(data), data.n_sections
    length = N * max(1, min(_WINDOW, max(len(r.u) for r in records) // (2 * N)))
    total, weight = np.zeros((length // 2 + 1, len(data.inputs))), 0
    f = np.fft.rfftfreq(length, 1 / N)
    for r in records:
        if len(r.u) >= length:
            _, power = signal.welch(r.u, N, nperseg=length, axis=0)
            total, weight = total + len(r.u) * power, weight + len(r.u)
    return f, total / max(weight, 1)


def input_band(data: SectionData) -> list[float]:
    """For each input, the frequency (cycles per period) above which it has next to no power."""
    f, power = input_spectrum(data)
    strong = power > _LEAST_POWER * power.max(axis=0)
    return [float(f[np.flatnonzero(s)[-1]]) if s.any() else 0.0 for s in strong.T]
