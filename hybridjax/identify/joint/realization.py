"""State-space models from measured responses: minimal, with dimensions that vary."""

from typing import Annotated

import numpy as np
from jaxtyping import Complex, Float

from ..._core.arguments import Numbers, names
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Order, SignalNames
from ..._core.boundary.values import Integers, Reals
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.frequency_response import all_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..series.fit import SeriesFit


# Singular values below this part of the largest one are rounding errors. Doubled: states that are
# seen twice as little are left out of exact models.
_ROUNDING = 1e-12
# Factor by which a singular value must exceed the largest that noise alone makes, on average.
# Doubled: states must be twice as strong to be found.
_NOISE_MARGIN = 1.1
# Sections that a state is seen through at least, by default. Doubled: more averaging, more lags.
_SHORTEST_HORIZON = 8
# Smallest standard deviation of an HTF, relative to the largest HTF: rounding. Doubled: outputs
# without noise count half as much beside noisy ones.
_SMALLEST_ERROR = 1e-15


@checked
def realize(
    source: HTF | SeriesFit | Annotated[Numbers, Reals("N lags ny nu")],
    dims: Order | Annotated[Numbers, Integers("N", sign="positive")] | None = None,
    *,
    order: Order = 1,
    horizon: Count | None = None,
    outputs: SignalNames | None = None,
    inputs: SignalNames | None = None,
) -> LDTP:
    r"""A minimal periodic state-space model with the responses given.

    The state at a section is what the outputs from there on remember of the inputs before it, so
    that its dimension is a rank at each section on its own.

    - *From Markov parameters* (an array (N, lags, ny, nu) as `LDTP.impulse_response` gives it, or a
      `SeriesFit`):
      the rank of the Hankel matrix at section n of the responses, `[i, j]`, at section n + i to
      an input at n - 1 - j (Ho and Kalman 1966, for each section of the period).
    - *From HTFs* on any frequencies: the outputs at sections n, ..., n + p in response to
      $e^{i w n}$ are $O_n X_n(w)$ plus what the inputs in this stretch add; the latter is
      projected out, and $O_n$ is the range of the rest (subspace identification from frequency
      responses, McKelvey, Akcay and Ljung 1996, at each section; Uyanik et al. 2019 treat
      periodic systems by lifting). Given A and C, B and D are a linear least-squares problem.

    A[n] takes $O_{n}$, shifted by one section, to $O_{n+1}$.

    **Arguments:**

    - `source`: exact or estimated. HTFs: harmonics that are not there count as zero.
    - `dims`: dimension of the state at all sections, or at each; None finds it by the singular
      values: those above rounding errors, or, where the source has variances, above what noise
      alone would make. States that are drowned in noise are left out.
    - `order`: no dimension found is smaller; the number of multipliers expected.
    - `horizon`: p, the sections that a state is seen through; default two periods, at least 8,
      where the source is that long. Long ones average more noise.
    - `outputs`, `inputs`: names, for an array.

    **Raises:** `DefinitionError` for too few lags or frequencies for the horizon, or more
    dimensions than the horizon can show.
    """
    require_x64()
    if isinstance(source, HTF):
        return _from_htf(source, dims, order, horizon)
    spread = None
    if isinstance(source, SeriesFit):
        N, R = source.numerators.shape[:2]
        outputs, inputs = source.outputs, source.inputs
        p = _horizon(horizon, N)
        markov = source.impulse_response(2 * p + 1)
        spread = np.sqrt((source.roots**2).sum(axis=4).mean(axis=(0, 2, 3))) * source.noise
    else:
        markov = np.asarray(source)
        N, lags = markov.shape[:2]
        p = _horizon(horizon, N) if horizon is not None else min(_horizon(None, N), (lags - 1) // 2)
        if p < 1 or lags < 2 * p + 1:
            raise DefinitionError(
                f"{lags} lags are too few for a horizon of {p} sections: {2 * p + 1} are needed."
            )
        outputs = names("outputs", outputs, markov.shape[2])
        inputs = names("inputs", inputs, markov.shape[3])
    ny, nu = markov.shape[2:]
    scale = _scale(np.sqrt(np.mean(markov**2, axis=(0, 1, 3))) if spread is None else spread)
    markov = markov / scale[:, None]
    edge = 0.0 if spread is None else _NOISE_MARGIN * (np.sqrt((p + 1) * ny) + np.sqrt(p * nu))

    hankels = [
        np.block([[markov[(n + i) % N, i + j + 1] for j in range(p)] for i in range(p + 1)])
        for n in range(N)
    ]
    bases = _bases(hankels, given_dims(dims, N), order, edge, ny)
    A, C = _shifted(bases, ny)
    after = [(n + 1) % N for n in range(N)]
    B = [bases[n].T @ hankels[n][:, :nu] for n in after]
    C, D = [scale[:, None] * c for c in C], list(scale[:, None] * markov[:, 0])
    return LDTP.from_blocks(A, B, C, D, inputs, outputs)


def _horizon(horizon: int | None, N: int) -> int:
    return max(_SHORTEST_HORIZON, 2 * N) if horizon is None else horizon


def _scale(scale: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
    return np.where(scale > 0, scale, 1.0)


def given_dims(dims, N: int, name: str = "dims") -> list[int] | None:
    """One for each section; None where none are given.

    **Raises:** `DefinitionError` for another number of them.
    """
    if dims is None:
        return None
    chosen = np.broadcast_to(np.asarray(dims), N) if np.ndim(dims) == 0 else np.asarray(dims)
    if chosen.shape != (N,):
        raise DefinitionError(f"`{name}` must be one for each of {N} sections, not {len(chosen)}.")
    return [int(d) for d in chosen]


def _bases(matrices, dims: list[int] | None, order: int, edge: float, ny: int):
    """O_n: orthonormal bases of the ranges of each section's matrix."""
    bases = []
    most = min(matrices[0].shape[0] - ny, matrices[0].shape[1])
    for n, matrix in enumerate(matrices):
        left, s, _ = np.linalg.svd(matrix, full_matrices=False)
        found = int((s > max(edge, _ROUNDING * s[0])).sum())
        d = max(order, found, 1) if dims is None else dims[n]
        if d > most:
            raise DefinitionError(
                f"section {n} would have {d} dimensions, but the horizon and the data show {most} "
                "at most: take a longer horizon, or give `dims`."
            )
        bases.append(left[:, :d])
    return bases


def _shifted(bases: list[np.ndarray], ny: int):
    """A and C from O_n: its first rows are C[n], the others O_{n+1} A[n]."""
    after = [*bases[1:], bases[0]]
    A = [np.linalg.lstsq(O[:-ny], now[ny:])[0] for O, now in zip(after, bases, strict=True)]
    return A, [O[:ny] for O in bases]


def _from_htf(htf: HTF, dims, order: int, horizon: int | None) -> LDTP:
    f, H, N = np.asarray(htf.f), np.asarray(htf.H), htf.n_sections
    if not np.isfinite(H).all():
        raise DefinitionError("the HTFs hold NaN or infinity.")
    ny, nu = H.shape[2:]
    p = min(_horizon(horizon, N), len(f) - 1) if horizon is None else _horizon(horizon, N)
    if 2 * len(f) <= p + 1:
        raise DefinitionError(
            f"{len(f)} frequencies are too few for a horizon of {p} sections: more than "
            f"{(p + 1) // 2} are needed."
        )
    m = np.array(all_harmonics(N))[np.isin(all_harmonics(N), htf.harmonics)]
    G = np.einsum("nm,mfij->nfij", np.exp(2j * np.pi * np.outer(np.arange(N), m) / N), H)
    if htf.variance is None:
        scale, edge = _scale(np.sqrt(np.mean(np.abs(G) ** 2, axis=(0, 1, 3)))), 0.0
        weight = np.broadcast_to(1 / scale[:, None], G.shape[1:])
    else:
        # Real and imaginary part have half of the variance each.
        spread = np.sqrt(np.asarray(htf.variance).sum(axis=0) / 2)
        scale = _scale(np.sqrt((spread**2).mean(axis=(0, 2))))
        weight = 1 / np.maximum(spread, _SMALLEST_ERROR * np.abs(G).max())
        edge = _NOISE_MARGIN * (np.sqrt((p + 1) * ny) + np.sqrt(2 * len(f) * nu))
    z = np.exp(2j * np.pi / N * f)

    # One weight for each column, that of its noise: the rows of an input stay what they were.
    column = np.sqrt(np.mean(weight**2 * scale[:, None] ** 2, axis=1)).T.ravel()  # (nu F)
    powers = z ** np.arange(p + 1)[:, None]
    inputs = np.kron(np.eye(nu), powers) * column
    _, s, vh = np.linalg.svd(_real(inputs), full_matrices=False)
    Q = vh[s > _ROUNDING * s[0]]
    matrices = []
    for n in range(N):
        Y = np.stack([G[(n + i) % N] * powers[i][:, None, None] for i in range(p + 1)])
        Y = Y.transpose(0, 2, 3, 1).reshape((p + 1) * ny, -1) * column
        Y = _real(Y / np.tile(scale, p + 1)[:, None])
        for _ in range(2):  # the second time for accuracy
            Y = Y - (Y @ Q.T) @ Q
        matrices.append(Y)
    bases = _bases(matrices, given_dims(dims, N), order, edge, ny)
    A, C = _shifted(bases, ny)
    C = [scale[:, None] * c for c in C]
    B, D = _inputs(A, C, G, z, weight)
    return LDTP.from_blocks(A, B, C, D, htf.inputs, htf.outputs)


def _real(x: Complex[np.ndarray, "a b"]) -> Float[np.ndarray, "a b2"]:
    return np.concatenate([x.real, x.imag], axis=1)


def _inputs(A, C, G, z, weight):
    """B and D by least squares: given A and C, the responses G are linear in them."""
    N, F, ny, nu = G.shape
    after = [A[n].shape[0] for n in range(N)]
    place = np.concatenate([[0], np.cumsum(after)])
    columns = place[-1] + N * ny
    triangles = [np.zeros((0, columns + 1)) for _ in range(nu)]
    for n in range(N):
        # C (I - Phi z^-N)^-1 A[n-1] ... A[n-r+1] z^-r multiplies B[n-r].
        Phi = np.eye(A[n].shape[1])
        for i in range(N):
            Phi = A[(n + i) % N] @ Phi
        resolvent = np.linalg.inv(np.eye(len(Phi)) - Phi * z[:, None, None] ** -N)
        row = C[n] @ resolvent
        block = np.zeros((F, ny, columns), complex)
        for r in range(1, N + 1):
            k = (n - r) % N
            block[:, :, place[k] : place[k + 1]] += row * z[:, None, None] ** -r
            row = row @ A[k]
        block[:, range(ny), place[-1] + n * ny + np.arange(ny)] = 1.0
        for j in range(nu):
            rows = np.concatenate([block, G[n, :, :, j, None]], axis=2) * weight[:, :, j, None]
            rows = rows.reshape(F * ny, -1)
            stacked = np.concatenate([triangles[j], rows.real, rows.imag])
            triangles[j] = np.linalg.qr(stacked, mode="r")
    x = np.stack([np.linalg.lstsq(t[:, :-1], t[:, -1])[0] for t in triangles], axis=1)
    B = [x[place[n] : place[n + 1]] for n in range(N)]
    D = [x[place[-1] + n * ny : place[-1] + (n + 1) * ny] for n in range(N)]
    return B, D
