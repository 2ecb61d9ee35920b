"""Whether the phases of multisines may have been drawn at random, by their crest factors.

The crest factor of a signal is its largest value relative to its rms. Random phases give Gaussian
signals with crest factors of 3 or so; phases that were optimized give lower ones.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


# Experiments that are looked at, at most. Doubled: twice the time, no other verdict but by chance.
_TESTED_EXPERIMENTS = 12
# Redraws of the phases of each signal. Doubled: half the chance that random phases count as low.
_REDRAWS = 200
# Lines of a signal, below which chance can do as well as any choice of phases. Doubled: optimized
# signals of 8 to 15 lines are taken for random ones.
_FEWEST_LINES = 8
# Part of the largest line below which a line is not excited. Doubled: none but rounding.
_SILENT_LINE = 1e-6


class CrestTest(NamedTuple):
    """How many signals were tested, and how many of them had a crest factor below all redraws."""

    tested: int
    low: int

    @property
    def random(self) -> bool:
        """False where so many low crest factors come by chance once in 10 000 times or less."""
        return self.low < max(2, self.tested / 2)

    def merge(self, other: "CrestTest") -> "CrestTest":
        """The test of both sets of signals."""
        return CrestTest(self.tested + other.tested, self.low + other.low)


def compare_crest_factors(u: Float[np.ndarray, "S n nu"]) -> CrestTest:
    """Compare crest factors with those of 200 redraws of the phases, for some of the signals.

    The realizations of a random-phase multisine show the distortion that its class of signals
    causes; signals with phases chosen for a low crest factor (or any other purpose) do not.
    """
    some = np.unique(np.linspace(0, len(u) - 1, _TESTED_EXPERIMENTS).round().astype(int))
    rng = np.random.default_rng(0)
    tested = low = 0
    for signal in u[some].transpose(0, 2, 1).reshape(-1, u.shape[1]):
        size = np.abs(np.fft.rfft(signal))
        lines = np.flatnonzero(size > _SILENT_LINE * size.max())
        if not np.isfinite(signal).all() or not _FEWEST_LINES <= len(lines) <= len(signal) // 4:
            continue
        spectra = np.zeros((_REDRAWS, len(size)), complex)
        turns = rng.uniform(0, 2 * np.pi, (_REDRAWS, len(lines)))
        spectra[:, lines] = size[lines] * np.exp(1j * turns)
        draws = np.abs(np.fft.irfft(spectra, len(signal), axis=1)).max(axis=1)
        tested += 1
        low += bool(np.abs(signal).max() < draws.min())
    return CrestTest(tested, low)
