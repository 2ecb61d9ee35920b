"""What single experiments tell of harmonic transfer functions, and tests that need no more."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


# Rotations that errors are compared with: multiples of roots of primes, which fill all turns evenly
# (Weyl 1916). Doubled: p-values change by less than 0.001.
_ROTATIONS = 1000
_PRIMES = np.array([2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47])
# Numbers that are held at once. Doubled: twice the memory.
_AT_ONCE = 2_000_000


class Realizations(NamedTuple):
    """What each of R experiments, 16 at most, adds to the estimates at F frequencies.

    Zero where an experiment does not measure a frequency.
    """

    parts: Complex[np.ndarray, "R M F ny nu"]
    """Their sum over experiments is H."""
    shares: Float[np.ndarray, "R F nu"]
    """The weights of the experiments, whose sum is one."""

    def roundness(self, H: Complex[np.ndarray, "M F ny nu"]) -> Float[np.ndarray, "M F ny nu"]:
        r"""That of `Scatter`, of the residuals of estimates; 1 where two realizations or fewer are.

        Of n normal errors $1 - |\sum_j d_j^2|^2 / (\sum_j |d_j|^2)^2$ is $(n - 2) / n$ in the mean:
        it is Mauchly's criterion of their covariance in the plane, squared (Annals of Mathematical
        Statistics 1940).
        """
        shares = self.shares[:, None, :, None]
        scale = np.divide(1, np.sqrt(shares), out=np.zeros_like(shares), where=shares > 0)
        residuals = scale * (self.parts - shares * H)
        power = np.sum(np.abs(residuals) ** 2, axis=0)
        along = np.abs(np.sum(residuals**2, axis=0))
        count = np.sum(shares > 0, axis=0)
        known = (count > 2) & (power > 0)
        part = np.divide(along, power, out=np.zeros_like(power), where=known)
        mean = np.where(count > 2, 1 - 2 / np.maximum(count, 1), 1)
        return np.where(known, (1 - np.minimum(part, 1) ** 2) / mean, 1.0)

    def p_values(self, true: Complex[np.ndarray, "M F ny nu"]) -> Float[np.ndarray, "M F ny nu"]:
        r"""How likely errors are that add up to as much, if these are the true values.

        Of independent errors whose phases have no preference the sizes say nothing about the
        phases, so that under random rotations their sum takes all values that it might have had.
        The share of larger ones gives tests that keep their level for errors of any distribution
        and for any number of them (Lehmann and Romano, *Testing Statistical Hypotheses*, 2005,
        ch. 15; with signs in place of rotations: Csáji, Campi and Weyer, IEEE Trans. Signal
        Processing 2015). The largest error turns through all angles.
        """
        errors = np.asarray(self.parts) - np.asarray(self.shares)[:, None, :, None] * true
        size = np.sort(np.abs(errors).reshape(len(errors), -1), axis=0)
        found = np.abs(errors.sum(axis=0)).ravel() ** 2
        roots = np.sqrt(_PRIMES[: len(size) - 1])
        turns = 2 * np.pi * (np.arange(_ROTATIONS)[:, None] * roots % 1)
        larger = np.zeros(len(found))
        for some in np.array_split(turns, 1 + _ROTATIONS * len(found) // _AT_ONCE):
            others = np.hypot(np.cos(some) @ size[:-1], np.sin(some) @ size[:-1])
            needed, widest = found - others**2 - size[-1] ** 2, 2 * others * size[-1]
            cosine = np.divide(needed, widest, out=-np.ones_like(needed), where=widest > 0)
            larger += (np.arccos(np.clip(cosine, -1, 1)) / np.pi).sum(axis=0)
        return (larger / _ROTATIONS).reshape(true.shape)
