r"""Periodic noise: what a linear periodic model makes of white inputs."""

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Scalar, Vector
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.ldtp import LDTP
from .frequency import adjoints
from .periodic_model import PeriodicModel


@checked
def noise_spectrum(
    noise: LDTP, f: Scalar | Vector, harmonics: Harmonics | None = None
) -> Float[np.ndarray, "M F ny"]:
    r"""The spectrum of periodic noise where the harmonics of lines lie.

    Noise v of the outputs that a periodic model makes of independent inputs w of variance one,

    $$s[n+1] = A[n] s[n] + B[n] w[n], \qquad v[n] = C[n] s[n] + D[n] w[n],$$

    has, over long windows of L samples,

    $$S(\varphi) = \lim \frac{1}{L}\, E\,\Big|\sum_n v[n]\, e^{-2 \pi i \varphi n / N}\Big|^2
    = \frac{1}{N} \sum_n \big| D[n] + z^{-1} \mu[n+1] B[n] \big|^2, \qquad
    z = e^{2 \pi i \varphi / N},$$

    with the adjoint $\mu[n] = C[n] + z^{-1} \mu[n+1] A[n]$ (the cyclic spectrum at cycle frequency
    zero: Gardner, Napolitano and Paura 2006). $H_m$ at the line f is disturbed by what lies at
    f + m.

    White noise with the standard deviation sigma gives sigma^2 for all f and m. The variance of
    an H_m that was measured with a cosine of amplitude a in P periods is
    $4 S(f + m) / (N P a^2)$: that of `Design.expected_variance(noise=1)` times this.

    **Arguments:**

    - `noise`: stable, its inputs white with variance one: as many as it has outputs, more, or less.
    - `f` (F,): lines, cycles per period. `harmonics`: which ones; None means all N.

    **Returns:** (M, F, ny), the squared unit of each output.

    **Raises:** `DefinitionError` for a model with a multiplier of modulus one or more, whose noise
    grows without end.
    """
    f = np.atleast_1d(np.asarray(f, float))
    N = noise.n_sections
    harmonics = check_harmonics(harmonics, N)
    if len(noise.multipliers) and np.abs(noise.multipliers[0]) >= 1:
        raise DefinitionError(
            f"the noise grows without end: its model has a multiplier of modulus "
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
    """The noise of a model in innovation form, of inputs with variance one.

    **Arguments:** `S`: covariances of the innovations, in units of `scale`, as the model's outputs.
    """
    ny = len(outputs)
    L = np.linalg.cholesky(S)
    names = tuple(f"noise of {name}" for name in outputs)
    D = [scale[:, None] * root for root in L]
    if not model.K[0].shape[1]:
        zero = np.zeros((len(S), 1, 1))
        return LDTP(zero, zero * np.ones(ny), np.zeros((len(S), ny, 1)), D, None, names, outputs)
    B = [K @ root for K, root in zip(model.K, L, strict=True)]
    C = [scale[:, None] * C for C in model.C]
    return LDTP.from_blocks(model.A, B, C, D, names, outputs)
