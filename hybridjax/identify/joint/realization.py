r"""State-space models from harmonic transfer functions at any frequencies.

The outputs at sections n, ..., n + p in response to $e^{i w n}$ are $O_n X_n(w)$ plus the response
to the inputs in these sections. The latter is projected out, and $O_n$ is the range of the
remainder (subspace identification from frequency responses, McKelvey, Akcay and Ljung 1996, at each
section; Uyanik et al. 2019 treat periodic systems by lifting). Given A and C, B and D are a linear
least-squares problem.

`fit_ldtp` calls `realized_htf` for its first model. If this has the wrong dimensions, look at the
level of noise there (`edge`); if A and C are wrong, at `_without_later_inputs`; if only B and D
are, at `PeriodicModel.refined`. The weight of a column must be the same in all of its rows.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from ...errors import DefinitionError
from ...linear.frequency_response import all_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..descent import ROUNDING, positive
from ..periodic import PeriodicModel
from ..realization import (
    Matrices,
    default_horizon,
    largest_of_noise,
    ranges,
    shifted,
)
from ..weights import SMALLEST_ERROR
from .frequency import FrequencyProblem


def realized_htf(
    htf: HTF, dims: Sequence[int] | None = None, *, order: int = 1
) -> LDTP:
    """Return a minimal model with these HTFs. Missing harmonics count as zero.

    **Arguments:**

    - `dims`: dimension of the state at each section. Default: the number of singular values above
      rounding errors or, if the HTFs have variances, above noise.
    - `order`: the number of multipliers expected, a lower bound of dimensions. Default: 1.

    **Raises:** `DefinitionError` for NaN, one frequency, or more dimensions than the frequencies
    support.
    """
    htf.require_sampled("a state-space model")
    f = np.asarray(htf.frequencies)
    N = htf.n_sections
    if not np.isfinite(htf.H).all():
        raise DefinitionError(
            "the HTFs hold NaN or infinity: leave these frequencies out."
        )
    F, ny, nu = htf.H.shape[1:]
    p = min(default_horizon(N), F - 1)
    if p < 1:
        raise DefinitionError("one frequency is too few: give HTFs at two or more.")
    harmonics = all_harmonics(N)
    H = np.zeros((N, F, ny, nu), complex)
    H[np.isin(harmonics, htf.harmonics)] = htf.H
    lags = np.outer(np.arange(N), harmonics)
    waves = np.exp(2j * np.pi * lags / N)
    responses = np.tensordot(waves, H, 1)
    if htf.variance is None:
        power = np.mean(np.abs(responses) ** 2, axis=(0, 1, 3))
        scale = positive(np.sqrt(power))
        weight = np.broadcast_to(1 / scale[:, None], (F, ny, nu))
        edge = 0.0
    else:
        # Real and imaginary part each have half of the variance.
        spread = np.sqrt(np.asarray(htf.variance).sum(axis=0) / 2)
        scale = positive(np.sqrt((spread**2).mean(axis=(0, 2))))
        smallest = SMALLEST_ERROR * np.abs(responses).max()
        weight = 1 / np.maximum(spread, smallest)
        edge = largest_of_noise((p + 1) * ny, 2 * F * nu)
    unit = scale[:, None]
    weight = weight * unit
    observed = _without_later_inputs(responses / unit, weight, f, p)
    A, C = shifted(ranges(observed, dims, order, edge, ny), ny)
    model = PeriodicModel(
        A=A,
        B=[np.zeros((len(a), nu)) for a in A],
        C=C,
        D=[np.zeros((ny, nu))] * N,
        K=[np.zeros((len(a), 0)) for a in A],
    )
    weights = np.broadcast_to(weight, H.shape)
    problem = FrequencyProblem(
        f=f,
        harmonics=harmonics,
        target=H / unit,
        weight=weights,
    )
    for _ in range(2):  # the second time removes rounding errors
        model = model.refined(True, problem.linearize)
    return model.to_ldtp(scale, htf.inputs, htf.outputs)


def _without_later_inputs(
    responses: Complex[np.ndarray, "N F ny nu"],
    weight: Float[np.ndarray, "F ny nu"],
    f: Float[np.ndarray, " F"],
    p: int,
) -> Matrices:
    """Return, for each section, the outputs at this section and the p sections after it, at all
    frequencies, without their responses to the inputs at these sections."""
    N, F, ny, nu = responses.shape
    # Each column has one weight (that of its noise), so that the rows of an input keep their form.
    column = np.sqrt(np.mean(weight**2, axis=1)).T.ravel()  # (nu F)
    delay = np.exp(2j * np.pi / N * f)
    powers = delay ** np.arange(p + 1)[:, None]
    inputs = _real(np.kron(np.eye(nu), powers) * column)
    _, size, directions = np.linalg.svd(inputs, full_matrices=False)
    taken = directions[size > ROUNDING * size[0]]
    out = []
    for n in range(N):
        later = [
            responses[(n + i) % N] * powers[i][:, None, None] for i in range(p + 1)
        ]
        rows = np.stack(later).transpose(0, 2, 3, 1)
        rows = rows.reshape((p + 1) * ny, nu * F)
        rows = _real(rows * column)
        for _ in range(2):  # the second time removes rounding errors
            rows = rows - (rows @ taken.T) @ taken
        # The triangular factor has the same range and singular values, and fewer columns.
        out.append(np.asarray(np.linalg.qr(rows.T, mode="r")).T)
    return out


def _real(x: Complex[np.ndarray, "a b"]) -> Float[np.ndarray, "a b2"]:
    return np.concatenate([np.real(x), np.imag(x)], axis=1)
