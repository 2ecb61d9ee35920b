"""From sums over experiments to harmonic transfer functions and their variances."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ...errors import DefinitionError
from ...linear.htf import Scatter
from .realizations import Realizations
from .spectral_sums import SpectralSums


# Part of the power of a line by which |sum of U^2| may fall short of the sum of |U|^2 where all
# phases are the same. Doubled: phases that differ by 0.08 degrees count as the same, not 0.06.
_SAME_PHASES = 1e-6


class NoiseVariance(NamedTuple):
    """What repeated windows tell; None where there was one window."""

    variance: Float[np.ndarray, "M F ny nu"] | None
    scatter: Scatter | None


class LineEstimates(NamedTuple):
    """H at F lines; the variances as in `HTF`."""

    H: Complex[np.ndarray, "M F ny nu"]
    variance: Float[np.ndarray, "M F ny nu"] | None
    noise_variance: Float[np.ndarray, "M F ny nu"] | None
    scatter: Scatter | None
    single: Realizations | None
    """What each experiment tells, where the variance is that of realizations."""
    noise: NoiseVariance
    realizations: Int[np.ndarray, " F"]
    """How many experiments there are beyond those that the unknowns need."""
    coherence: Float[np.ndarray, "M F ny"]
    """The part of the power at each output line that H explains; NaN without realizations."""
    why_not: str
    """Why realizations do not tell the distortion, or nothing."""

    def of_noise(self) -> "LineEstimates":
        """The same with the variance of noise alone."""
        variance, scatter = self.noise
        return self._replace(variance=variance, noise_variance=None, scatter=scatter, single=None)

    def require_total(self, f: Float[np.ndarray, " F"]) -> None:
        """**Raises:** `DefinitionError` if the scatter over realizations is not known."""
        if self.why_not:
            raise DefinitionError(self.why_not)
        few = self.realizations < 1
        if few.any():
            raise DefinitionError(
                f"f = {f[few][0]:.10g} was measured in one realization only, so the distortion is "
                "not seen: apply several (`Design.realizations`), or ask for variance='noise'."
            )


def solve_lines(sums: SpectralSums, rows: Int[np.ndarray, " F"]) -> LineEstimates:
    r"""Least squares at some lines: `Y = H U + G conj(U)`, G = 0 unless the line meets itself.

    With p unknowns and G experiments the residuals have G - p complex degrees of freedom, and the
    variance of H is theirs times the diagonal of the inverse of the normal matrix. The noise of
    each experiment, from repeated windows, goes the same way.
    """
    nu, shape = len(sums.setup.inputs), sums.direct.shape[2:]
    H = np.zeros((len(rows), nu, *shape), complex)
    spread = np.zeros((len(rows), nu))
    left = np.zeros((len(rows), *shape))
    unknowns = np.where(sums.mirrored[rows], 2 * nu, nu)
    for both in (False, True):
        here = np.flatnonzero(sums.mirrored[rows] == both)
        if len(here) == 0:
            continue
        some = rows[here]
        right = sums.direct[some]
        if both:
            right = np.concatenate([right, sums.mirror[some]], axis=1)
        inverse = np.linalg.inv(sums.gram(sums.ran, some, both))
        found = np.einsum("kij,kjml->kiml", inverse, right)
        H[here] = found[:, :nu]
        spread[here] = np.einsum("kii->ki", inverse).real[:, :nu]
        explained = np.einsum("kiml,kiml->kml", found.conj(), right).real
        left[here] = np.maximum(sums.energy[some] - explained, 0)

    H = H.transpose(2, 0, 3, 1)

    def variance(residual):
        out = residual[:, None] * spread[:, :, None, None]
        return out.transpose(2, 0, 3, 1)

    count = sums.count[rows]
    realizations = count - unknowns
    noise = NoiseVariance(None, None)
    repeated = sums.repeats > 1
    if repeated:
        mean = sums.noise[rows] / count[:, None, None]
        noise = NoiseVariance(variance(mean), Scatter(count * (sums.repeats - 1.0)))
    why_not = _why_not(sums, rows)
    total, of_noise, scatter, single = None, None, None, None
    if (realizations > 0).any() and not why_not:
        residual = left / np.maximum(realizations, 1)[:, None, None]
        residual[realizations < 1] = np.inf
        total, of_noise = variance(residual), noise.variance
        single = _single(sums, rows)
        roundness = None if single is None else single.roundness(H)
        scatter = Scatter(np.maximum(realizations, 1).astype(float), roundness)
    elif repeated:
        total, scatter = noise
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = left / np.maximum(realizations, 0)[:, None, None]
        coherence = 1 - lost / (sums.energy[rows] / count[:, None, None])
    coherence = np.where((realizations > 0)[:, None, None], np.maximum(coherence, 0), np.nan)
    coherence = coherence.transpose(1, 0, 2)
    return LineEstimates(
        H=H,
        variance=total,
        noise_variance=of_noise,
        scatter=scatter,
        single=single,
        noise=noise,
        realizations=realizations,
        coherence=coherence,
        why_not=why_not,
    )


def _single(sums: SpectralSums, rows: Int[np.ndarray, " F"]) -> Realizations | None:
    """None where unknowns share experiments, or there are too many of these."""
    power = sums.ran.power[rows]
    size = np.einsum("kii->ki", power).real
    shared = (power * ~np.eye(size.shape[1], dtype=bool)).any()
    if sums.single is None or shared or sums.mirrored[rows].any():
        return None
    parts = sums.single.direct[:, rows] / size[:, :, None, None]
    return Realizations(parts.transpose(0, 3, 1, 4, 2), sums.single.power[:, rows] / size)


def _why_not(sums: SpectralSums, rows: Int[np.ndarray, " F"]) -> str:
    """Why the scatter over experiments is not that over realizations of random phases."""
    power = np.einsum("kii->k", sums.ran.power[rows]).real
    alike = np.abs(np.einsum("kii->k", sums.ran.square[rows])) > (1 - _SAME_PHASES) * power
    several = sums.count[rows] > len(sums.setup.inputs)
    if several.any() and (alike & several).sum() > several.sum() / 2:
        return (
            "the experiments repeat the same phases, so that their scatter is noise alone and does "
            "not show the distortion: apply realizations with new random phases "
            "(`Design.realizations`)."
        )
    if not sums.crest_test.random:
        return (
            f"the phases are not random: {sums.crest_test.low} of {sums.crest_test.tested} signals "
            "have a crest factor below that of 200 random draws. The scatter of optimized phases "
            "does not show the distortion of a class of signals: ask for variance='noise', or use "
            "random phases."
        )
    return ""
