"""Phases of multisines that give low crest factors (largest value over rms value).

`Design.optimize_phases` calls `low_peak_phases`, which minimizes p-norms of each signal over its
phases, for growing p. Phases that other rules need are no unknowns (`free`): those of lines that
several experiments share, and those at 0 and N/2. The signal is made as in `Design.signals`: the
two must agree.

If crest factors are not low, look at the constants; if the minimization fails, at the derivatives
in `norm`; if a design is refused afterwards, at `free`.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from .partition import is_real


# Powers p of the norms, which approach the peak. For 2048 samples the last norm is within 6 % of
# the peak (the bound is 2048^(1/128)). A larger first power leads to poorer minima.
_POWERS = (4, 8, 16, 32, 64, 128)
# Steps of the minimization at each power. Fewer: higher crest factors. Twice as many: hardly lower
# ones, in twice the time.
_STEPS = 100


def low_peak_phases(design: Any, seed: int) -> Float[np.ndarray, " K"]:
    """Return the phases of `Design.optimize_phases`."""
    nu = len(design.inputs)
    length = design.n_sections * design.periods
    _, pair, count = np.unique(
        design.line * nu + design.channel, return_inverse=True, return_counts=True
    )
    real = is_real(design.line, design.periods, design.n_sections)
    free = (count[pair] == 1) & ~real
    if not free.any():
        raise DefinitionError(
            "no phase of this design is free: each is shared or has a fixed sign."
        )
    where = design.experiment * nu + design.channel
    size = np.where(real, 2.0, 1.0) * 0.5 * length * np.asarray(design.amplitude)
    rng = np.random.default_rng(seed)
    phase = np.where(free, rng.uniform(0, 2 * np.pi, len(free)), design.phase)
    for signal in np.unique(where):
        k = np.flatnonzero(where == signal)
        if free[k].any():
            phase[k[free[k]]] = _lower(
                phase[k], free[k], design.line[k], size[k], length
            )
    return phase % (2 * np.pi)


def _lower(phase, free, line, size, length: int):
    """Return the free phases of one signal that minimize its peak.

    **Arguments:** one entry for each cosine of the signal: `phase`, whether it is `free`, its
    `line`, and its `size` in the spectrum. `length`: number of samples.
    """
    from scipy.optimize import minimize  # (a third of a second, needed by few designs)

    spectrum = np.zeros(length // 2 + 1, complex)
    best = phase[free]
    least = np.inf

    def signal(x):
        value = size * np.exp(1j * np.where(free, 0.0, phase))
        value[free] = size[free] * np.exp(1j * x)
        spectrum[line] = value
        return np.fft.irfft(spectrum, length)

    def norm(x, p):
        """Return the logarithm of the p-norm and its derivatives."""
        u = signal(x)
        peak = np.abs(u).max()
        v = np.abs(u) / peak
        total = np.sum(v**p)
        slope = np.fft.rfft(v ** (p - 1) * np.sign(u) / (peak * total))[line[free]]
        turn = np.real(1j * size[free] * np.exp(1j * x) * slope.conj())
        return np.log(peak) + np.log(total) / p, 2 / length * turn

    x = phase[free]
    for p in _POWERS:
        x = minimize(norm, x, p, "L-BFGS-B", jac=True, options={"maxiter": _STEPS}).x
        peak = np.abs(signal(x)).max()
        if peak < least:
            best = x
            least = peak
    return best
