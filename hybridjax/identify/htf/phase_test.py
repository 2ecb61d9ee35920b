"""Whether the phases of multisines may be random draws, judged by their crest factors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


_TESTED, _DRAWS, _FEW = 12, 200, 8


class PhaseTest(NamedTuple):
    """How many signals were tested, and how many of them had a crest factor below all draws."""

    tested: int
    low: int

    @property
    def random(self) -> bool:
        """False where so many low crest factors come by chance once in 10 000 times or less."""
        return self.low < max(2, self.tested / 2)

    def __add__(self, other: "PhaseTest") -> "PhaseTest":
        return PhaseTest(self.tested + other.tested, self.low + other.low)


no_phases = PhaseTest(0, 0)


def examine_phases(u: Float[np.ndarray, "S n nu"]) -> PhaseTest:
    """Compare crest factors with those of 200 redraws of the phases, for some of the signals.

    The realizations of a random-phase multisine show the distortion that its class of signals
    causes; signals with phases chosen for a low crest factor (or any other purpose) do not.
    Signals with fewer than 8 lines are left out: chance can do as well as any choice there.
    """
    some = np.unique(np.linspace(0, len(u) - 1, _TESTED).round().astype(int))
    rng = np.random.default_rng(0)
    tested = low = 0
    for signal in u[some].transpose(0, 2, 1).reshape(-1, u.shape[1]):
        size = np.abs(np.fft.rfft(signal))
        lines = np.flatnonzero(size > 1e-6 * size.max())
        if not np.isfinite(signal).all() or not _FEW <= len(lines) <= len(signal) // 4:
            continue
        spectra = np.zeros((_DRAWS, len(size)), complex)
        turns = rng.uniform(0, 2 * np.pi, (_DRAWS, len(lines)))
        spectra[:, lines] = size[lines] * np.exp(1j * turns)
        draws = np.abs(np.fft.irfft(spectra, len(signal), axis=1)).max(axis=1)
        tested += 1
        low += bool(np.abs(signal).max() < draws.min())
    return PhaseTest(tested, low)
