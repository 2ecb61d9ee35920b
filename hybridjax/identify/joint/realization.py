"""State-space models from measured responses."""

from typing import Annotated, Any

import numpy as np
from jaxtyping import Complex, Float

from ..._core.arguments import Numbers, require_axes
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Order
from ..._core.boundary.values import Integers, Reals
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.frequency_response import all_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..descent import ROUNDING
from ..periodic import PeriodicModel
from ..series.fit import SeriesFit
from ..series.subspace import default_horizon
from ..weights import SMALLEST_ERROR
from .frequency import FrequencyProblem


# Factor by which a singular value must exceed the largest that noise alone makes, on average.
# Larger: weak states are missed; smaller: noise makes states.
_NOISE_MARGIN = 1.1


@checked
def realize(
    source: HTF | SeriesFit | Annotated[Numbers, Reals("sections lags outputs inputs")],
    dims: Order
    | Annotated[Numbers, Integers("sections", sign="positive")]
    | None = None,
    *,
    order: Order = 1,
) -> LDTP:
    r"""Return a minimal periodic state-space model with given responses.

    The state at a section represents the effect of earlier inputs on the outputs from there on. Its
    dimension is a rank at each section.

    - *Markov parameters* (an array (N, lags, ny, nu) as of `LDTP.impulse_response`, or a
      `SeriesFit`): the dimension at section n is the rank of a Hankel matrix. Its block `[i, j]` is
      the response at section n + i to an input at section n - 1 - j (Ho and Kalman 1966, for each
      section of the period).
    - *HTFs* at any frequencies: the outputs at sections n, ..., n + p in response to
      $e^{i w n}$ are $O_n X_n(w)$ plus the response to the inputs in these sections. The latter is
      projected out, and $O_n$ is the range of the remainder (subspace identification from frequency
      responses, McKelvey, Akcay and Ljung 1996, at each section; Uyanik et al. 2019 treat
      periodic systems by lifting). Given A and C, B and D are a linear least-squares problem.

    A[n] takes $O_{n}$, shifted by one section, to $O_{n+1}$. The horizon p is two periods, but at
    least 8 sections; it is shorter if the source has too few lags or frequencies.

    **Arguments:**

    - `source`: exact or estimated responses. Missing harmonics of HTFs count as zero.
    - `dims`: dimension of the state at all sections, or at each. Default: the number of singular
      values above rounding errors or, if the source has variances, above noise.
    - `order`: the number of multipliers expected, a lower bound of dimensions. Default: 1.

    **Raises:** `DefinitionError` for too few lags or frequencies, or more dimensions than these
    support.
    """
    require_x64()
    if isinstance(source, HTF):
        source.require_sampled("`realize`")
        return _from_htf(source, dims, order)
    inputs = outputs = None
    if isinstance(source, SeriesFit):
        N, inputs, outputs = source.n_sections, source.inputs, source.outputs
        p = default_horizon(N)
        markov = source.impulse_response(2 * p + 1)
        spread = (source.roots**2).sum(axis=4).mean(axis=(0, 2)) * source.noise[
            :, None
        ] ** 2
    else:
        markov = np.asarray(source)
        N, lags = markov.shape[:2]
        p = min(default_horizon(N), (lags - 1) // 2)
        if p < 1:
            raise DefinitionError(f"{lags} lags are too few: 3 or more are needed.")
        spread = np.mean(markov**2, axis=(0, 1))
    ny, nu = markov.shape[2:]
    edge = (
        0.0
        if inputs is None
        else _NOISE_MARGIN * (np.sqrt((p + 1) * ny) + np.sqrt(p * nu))
    )
    # Outputs and inputs in units of their noise, or else of the responses.
    unit = _scale(np.sqrt(spread.mean(axis=0)))
    scale = _scale(np.sqrt((spread / unit**2).mean(axis=1)))
    markov = markov / scale[:, None] / unit

    hankels = [
        np.block(
            [[markov[(n + i) % N, i + j + 1] for j in range(p)] for i in range(p + 1)]
        )
        for n in range(N)
    ]
    bases = _bases(hankels, given_dims(dims, N), order, edge, ny)
    A, C = _shifted(bases, ny)
    B = [bases[(n + 1) % N].T @ hankels[(n + 1) % N][:, :nu] * unit for n in range(N)]
    C, D = [scale[:, None] * c for c in C], list(scale[:, None] * markov[:, 0] * unit)
    return LDTP.from_blocks(A, B, C, D, inputs, outputs)


def _scale(scale: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
    return np.where(scale > 0, scale, 1.0)


def given_dims(dims: Any, N: int, name: str = "dims") -> list[int] | None:
    """Return one dimension for each section; None if none are given.

    **Raises:** `DefinitionError` for another number of dimensions.
    """
    if dims is None:
        return None
    require_axes(f"`{name}`", dims, {}, {"sections": N})
    return np.broadcast_to(dims, N).tolist()


def _bases(
    matrices: list[np.ndarray], dims: list[int] | None, order: int, edge: float, ny: int
) -> list[np.ndarray]:
    """Return O_n, orthonormal bases of the ranges of each section's matrix."""
    bases = []
    most = min(matrices[0].shape[0] - ny, matrices[0].shape[1])
    for n, matrix in enumerate(matrices):
        left, s, _ = np.linalg.svd(matrix, full_matrices=False)
        rank = int((s > max(edge, ROUNDING * s[0])).sum())
        d = max(order, rank, 1) if dims is None else dims[n]
        if d > most:
            raise DefinitionError(
                f"section {n} would have {d} dimensions, but the data show {most} at most: give "
                "more lags or frequencies, or smaller `dims`."
            )
        bases.append(left[:, :d])
    return bases


def _shifted(
    bases: list[np.ndarray], ny: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return A and C from O_n: its first rows are C[n], the others O_{n+1} A[n]."""
    after = [*bases[1:], bases[0]]
    A = [
        np.linalg.lstsq(O[:-ny], now[ny:])[0]
        for O, now in zip(after, bases, strict=True)
    ]
    return A, [O[:ny] for O in bases]


def _from_htf(htf: HTF, dims: Any, order: int) -> LDTP:
    f, N = np.asarray(htf.f), htf.n_sections
    if not np.isfinite(htf.H).all():
        raise DefinitionError(
            "the HTFs hold NaN or infinity: leave these frequencies out."
        )
    F, ny, nu = htf.H.shape[1:]
    p = min(default_horizon(N), F - 1)
    if p < 1:
        raise DefinitionError("one frequency is too few: give HTFs at two or more.")
    m, H = np.array(all_harmonics(N)), np.zeros((N, F, ny, nu), complex)
    H[np.isin(m, htf.harmonics)] = htf.H
    G = np.tensordot(np.exp(2j * np.pi * np.outer(np.arange(N), m) / N), H, 1)
    if htf.variance is None:
        scale, edge = _scale(np.sqrt(np.mean(np.abs(G) ** 2, axis=(0, 1, 3)))), 0.0
        weight = np.broadcast_to(1 / scale[:, None], G.shape[1:])
    else:
        # Real and imaginary part have half of the variance each.
        spread = np.sqrt(np.asarray(htf.variance).sum(axis=0) / 2)
        scale = _scale(np.sqrt((spread**2).mean(axis=(0, 2))))
        weight = 1 / np.maximum(spread, SMALLEST_ERROR * np.abs(G).max())
        edge = _NOISE_MARGIN * (np.sqrt((p + 1) * ny) + np.sqrt(2 * F * nu))

    # One weight for each column, that of its noise, keeps the rows of an input as they are.
    column = np.sqrt(
        np.mean(weight**2 * scale[:, None] ** 2, axis=1)
    ).T.ravel()  # (nu F)
    powers = np.exp(2j * np.pi / N * f) ** np.arange(p + 1)[:, None]
    _, s, vh = np.linalg.svd(
        _real(np.kron(np.eye(nu), powers) * column), full_matrices=False
    )
    Q = vh[s > ROUNDING * s[0]]
    matrices = []
    for n in range(N):
        Y = np.stack([G[(n + i) % N] * powers[i][:, None, None] for i in range(p + 1)])
        Y = Y.transpose(0, 2, 3, 1).reshape((p + 1) * ny, -1) * column
        Y = _real(Y / np.tile(scale, p + 1)[:, None])
        for _ in range(2):  # the second time removes rounding errors
            Y = Y - (Y @ Q.T) @ Q
        # The triangular factor has the same range and singular values, and fewer columns.
        matrices.append(np.asarray(np.linalg.qr(Y.T, mode="r")).T)
    A, C = _shifted(_bases(matrices, given_dims(dims, N), order, edge, ny), ny)
    D = [np.zeros((ny, nu))] * N
    B, K = ([np.zeros((len(a), columns)) for a in A] for columns in (nu, 0))
    model = PeriodicModel(A, B, C, D, K)
    unit, harmonics = scale[:, None], tuple(m.tolist())
    problem = FrequencyProblem(
        f, harmonics, H / unit, np.broadcast_to(weight * unit, H.shape)
    )
    for _ in range(2):  # the second time removes rounding errors
        model = model.refined(True, problem.linearize)
    return model.to_ldtp(scale, htf.inputs, htf.outputs)


def _real(x: Complex[np.ndarray, "a b"]) -> Float[np.ndarray, "a b2"]:
    return np.concatenate([np.real(x), np.imag(x)], axis=1)
