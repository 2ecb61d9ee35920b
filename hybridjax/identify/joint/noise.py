"""Periodic noise: spectra, models of noise, and predictors one step ahead."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Scalar, Vector
from ...errors import DefinitionError
from ...experiments.record import Record
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.ldtp import LDTP
from ..series.records import CycleGrid
from .frequency import adjoints
from .model import PeriodicModel
from .prediction import SeriesPart, SeriesProblem


@checked
def noise_spectrum(
    noise: LDTP, f: Scalar | Vector, harmonics: Harmonics | None = None
) -> Float[np.ndarray, "M F ny"]:
    r"""Return the spectrum of periodic noise at the harmonics of excited frequencies.

    The noise v of the outputs is the response of a periodic model to independent inputs w of
    variance one,

    $$s[n+1] = A[n] s[n] + B[n] w[n], \qquad v[n] = C[n] s[n] + D[n] w[n],$$

    Over long windows of L samples its spectrum is

    $$S(\varphi) = \lim \frac{1}{L}\, E\,\Big|\sum_n v[n]\, e^{-2 \pi i \varphi n / N}\Big|^2
    = \frac{1}{N} \sum_n \big| D[n] + z^{-1} \mu[n+1] B[n] \big|^2, \qquad
    z = e^{2 \pi i \varphi / N},$$

    with the adjoint $\mu[n] = C[n] + z^{-1} \mu[n+1] A[n]$ (the cyclic spectrum at cycle frequency
    zero: Gardner, Napolitano and Paura 2006). The noise of $H_m$ at f is that at f + m.

    White noise with the standard deviation sigma has the spectrum sigma^2 for all f and m. The
    variance of an H_m that is measured with a cosine of amplitude a in P periods is
    $4 S(f + m) / (N P a^2)$: that of `Design.expected_variance(noise=1)` times the spectrum.

    **Arguments:**

    - `noise`: a stable model with any number of white inputs of variance one.
    - `f` (F,): frequencies, in cycles per period. `harmonics`: Default: all N.

    **Returns:** (M, F, ny), the squared unit of each output.

    **Raises:** `DefinitionError` for a model with a multiplier of modulus one or more, whose noise
    is not stationary.
    """
    f = np.atleast_1d(np.asarray(f, float))
    N = noise.n_sections
    harmonics = check_harmonics(harmonics, N)
    if len(noise.multipliers) and np.abs(noise.multipliers[0]) >= 1:
        raise DefinitionError(
            f"the noise grows without bound: its model has a multiplier of modulus "
            f"{np.abs(noise.multipliers[0]):.4g}, which must be below 1."
        )
    model = PeriodicModel.of(noise, np.ones(len(noise.outputs)))
    z = np.exp(2j * np.pi / N * np.add.outer(harmonics, f).ravel())
    mu = adjoints(model, z)
    total = np.zeros((len(z), len(noise.outputs)))
    for n in range(N):
        after = np.tensordot(model.B[n].T, mu[(n + 1) % N], 1) / z[:, None]  # (inputs, F, ny)
        total += (np.abs(model.D[n].T[:, None] + after) ** 2).sum(axis=0)
    return total.reshape(len(harmonics), len(f), len(noise.outputs)) / N


def noise_model(
    model: PeriodicModel,
    S: Float[np.ndarray, "N ny ny"],
    scale: Float[np.ndarray, " ny"],
    outputs: tuple[str, ...],
) -> LDTP:
    """Return the noise of a model in innovation form, with inputs of variance one.

    **Arguments:** `S`: covariances of the innovations, in units of `scale`, as the model's outputs.
    """
    L = np.linalg.cholesky(S)
    names = tuple(f"noise of {name}" for name in outputs)
    D = [scale[:, None] * root for root in L]
    if not model.K[0].shape[1]:
        zero = np.zeros((len(S), 1, 1))
        B, C = zero * np.ones(len(outputs)), np.zeros((len(S), len(outputs), 1))
        return LDTP(zero, B, C, D, None, names, outputs)
    B = [K @ root for K, root in zip(model.K, L, strict=True)]
    return LDTP.from_blocks(model.A, B, [scale[:, None] * C for C in model.C], D, names, outputs)


class Predictor(NamedTuple):
    """A model in innovation form, in the units of the outputs."""

    model: PeriodicModel
    S: Float[np.ndarray, "N ny ny"]
    """Covariances of the innovations."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def n_sections(self) -> int:
        return self.model.n_sections

    @property
    def dims(self) -> list[int]:
        return self.model.dims

    def predict(self, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
        """Return the outputs expected at each sample, given the samples before it."""
        part = SeriesPart.of(CycleGrid.from_records([record]), np.ones(len(self.outputs)))
        path = SeriesProblem([part], self.S, True, free_start, 0).path(self.model, part)
        expected = [
            x @ C.T + u @ D.T
            for x, C, u, D in zip(path.x, self.model.C, part.u, self.model.D, strict=True)
        ]
        expected = np.where(part.sampled, part.y - np.stack(path.error), np.stack(expected))
        rows = slice(record.first_section, record.first_section + len(record.u))
        return np.moveaxis(expected[:, 0], 0, 1).reshape(-1, len(self.outputs))[rows]
