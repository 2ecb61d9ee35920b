"""State-space models from measured responses, and first models of time series."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy import special

from ..._core.arguments import Numbers, require_axes
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Order
from ..._core.boundary.values import Integers, Reals
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.frequency_response import all_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from ..denominator import SLOWEST
from ..descent import ROUNDING
from ..series.fit import SeriesFit
from ..series.records import PreparedRecords
from ..series.residuals import ANSWER
from ..weights import SMALLEST_ERROR
from .frequency import FrequencyProblem
from .model import PeriodicModel


# Factor by which a singular value must exceed the largest that noise alone makes, on average.
# Larger: weak states are missed; smaller: noise makes states.
_NOISE_MARGIN = 1.1
# Sections in which a state is observed, at least, by default. Smaller: less averaging.
_SHORTEST_HORIZON = 8


@checked
def realize(
    source: HTF | SeriesFit | Annotated[Numbers, Reals("sections lags outputs inputs")],
    dims: Order | Annotated[Numbers, Integers("sections", sign="positive")] | None = None,
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
    spread = inputs = outputs = None
    if isinstance(source, SeriesFit):
        N, R = source.numerators.shape[:2]
        inputs, outputs = source.inputs, source.outputs
        p = default_horizon(N)
        markov = source.impulse_response(2 * p + 1)
        spread = np.sqrt((source.roots**2).sum(axis=4).mean(axis=(0, 2, 3))) * source.noise
    else:
        markov = np.asarray(source)
        N, lags = markov.shape[:2]
        p = min(default_horizon(N), (lags - 1) // 2)
        if p < 1:
            raise DefinitionError(f"{lags} lags are too few: 3 or more are needed.")
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


def default_horizon(N: int) -> int:
    """Return the number of sections in which a state is observed; twice as many lags are needed."""
    return max(_SHORTEST_HORIZON, 2 * N)


def _scale(scale: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
    return np.where(scale > 0, scale, 1.0)


def given_dims(dims: Any, N: int, name: str = "dims") -> list[int] | None:
    """Return one dimension for each section; None if none are given.

    **Raises:** `DefinitionError` for another number of dimensions.
    """
    if dims is None:
        return None
    chosen = np.broadcast_to(np.asarray(dims), N) if np.ndim(dims) == 0 else np.asarray(dims)
    require_axes(f"`{name}`", chosen, {"sections": N})
    return [int(d) for d in chosen]


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


def _shifted(bases: list[np.ndarray], ny: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return A and C from O_n: its first rows are C[n], the others O_{n+1} A[n]."""
    after = [*bases[1:], bases[0]]
    A = [np.linalg.lstsq(O[:-ny], now[ny:])[0] for O, now in zip(after, bases, strict=True)]
    return A, [O[:ny] for O in bases]


def _from_htf(htf: HTF, dims: Any, order: int) -> LDTP:
    f, N = np.asarray(htf.f), htf.n_sections
    if not np.isfinite(htf.H).all():
        raise DefinitionError("the HTFs hold NaN or infinity: leave these frequencies out.")
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
    column = np.sqrt(np.mean(weight**2 * scale[:, None] ** 2, axis=1)).T.ravel()  # (nu F)
    powers = np.exp(2j * np.pi / N * f) ** np.arange(p + 1)[:, None]
    _, s, vh = np.linalg.svd(_real(np.kron(np.eye(nu), powers) * column), full_matrices=False)
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
    unit = scale[:, None]
    problem = FrequencyProblem(
        f, tuple(m.tolist()), H / unit, np.broadcast_to(weight * unit, H.shape)
    )
    for _ in range(2):  # the second time removes rounding errors
        model = problem.refined(model, True)
    return model.to_ldtp(scale, htf.inputs, htf.outputs)


def _real(x: Complex[np.ndarray, "a b"]) -> Float[np.ndarray, "a b2"]:
    return np.concatenate([np.real(x), np.imag(x)], axis=1)


# Samples of a section for each coefficient of the regression on its past. Larger: a short past,
# which states outlast; smaller: noise.
_ROWS = 3
# Part by which the squared length of every regressor is enlarged. Larger: bias; smaller: noise in
# combinations that are hardly excited.
_SHRINKAGE = 1e-6


def subspace_model(
    records: PreparedRecords, dims: Sequence[int], innovations: bool, direct: bool = True
) -> PeriodicModel:
    """Return a model with these dimensions, with or without K and D.

    Each output is regressed on its past and that of the inputs, section by section. The effect of
    the past of a section on the outputs from there on is a matrix whose rank is the dimension of
    the state (Chiuso 2007, "PBSID", for each section of the period). Samples before a record count
    as zero: many short records that begin anywhere give a worse model.

    **Raises:** `DefinitionError` for too few cycles for a past as long as the states need.
    """
    grid, N, ny, most = records.whole(), len(dims), len(records.outputs), int(max(dims))
    z = np.concatenate([grid.u, grid.y / records.scale], axis=3)
    sampled, columns = np.asarray(grid.sampled.all(axis=3)), z.shape[3]
    sections = [_Section(z, sampled, n, ny) for n in range(N)]
    samples = min(len(section.y) for section in sections)
    past = min(samples // (_ROWS * columns), default_horizon(N))
    needed = -(-most // columns) + 1
    if past < needed:
        raise DefinitionError(
            f"{samples} cycles are too few to begin with {most} dimensions of the state: "
            f"about {_ROWS * columns * needed} are needed. Give a model as `guess`, as of "
            "`hj.identify.realize(hj.fit_series(...))`."
        )
    rules = [section.regression(past, direct) for section in sections]
    horizon = max(-(-most // ny) + 1, min(past, N, default_horizon(0)))
    to_state = []
    for n, section in enumerate(sections):
        # The effect of rows that are older by i samples.
        ahead = np.zeros((past * columns, horizon, ny))
        for i in range(min(horizon, past)):
            ahead[: (past - i) * columns, i] = rules[(n + i) % N][i * columns :]
        ahead = ahead.reshape(len(ahead), -1)
        root = np.linalg.qr(section.past(past), mode="r")
        _, s, vh = np.linalg.svd(root @ ahead, full_matrices=False)
        if dims[n] > len(s):
            text = f"the data show {len(s)} dimensions of section {n}, not {dims[n]}"
            raise DefinitionError(f"{text}: lower `guess`.")
        kept = np.maximum(s[: dims[n]], _SHRINKAGE * s[0])
        to_state.append(ahead @ (vh[: dims[n]].T / kept * np.sqrt(len(section.y))))
    return _from_states(sections, to_state, past, innovations, direct)


def answers_at_once(records: PreparedRecords, drive: PreparedRecords) -> bool:
    """Test whether the outputs answer the inputs of a loop at their own section.

    If so, they answer a reference at once, given the past of all signals: the likelihood-ratio
    test, section by section (Anderson, *Multivariate Statistical Analysis*, 2003, section 8.4),
    which holds for any controller. Inputs that answer outputs at once look the same in the inputs.

    **Raises:** `DefinitionError` if both answer each other at once: no model of the noise tells
    them apart.
    """
    grid, ny = records.whole(), len(records.outputs)
    nr = len(drive.inputs)
    z = np.concatenate([drive.whole().u, grid.u, grid.y / records.scale], axis=3)
    sampled = np.asarray(grid.sampled.all(axis=3))
    statistic, freedom, left, whole = 0.0, 0, 0.0, 0.0
    for n in range(records.n_sections):
        section = _Section(z, sampled, n, ny)
        count = len(section.y)
        length = max(min(count // (_ROWS * z.shape[3]), default_horizon(len(z[0, 0]))), 1)
        past = section.past(length)
        r, u = section.u[:, :nr], section.u[:, nr:]
        rows = np.concatenate([past, r], axis=1)
        errors = [section.y - x @ _regress(x, section.y) for x in (past, rows)]
        floor = _SHRINKAGE * section.y.T @ section.y  # errors of the regressions, without noise
        sizes = [np.linalg.slogdet(e.T @ e + floor)[1] for e in errors]
        statistic += max(count - rows.shape[1] - (ny - nr + 1) / 2, 0.0) * (sizes[0] - sizes[1])
        freedom += ny * nr
        left += float(((u - rows @ _regress(rows, u)) ** 2).sum())
        whole += float((u**2).sum())
    if special.gammaincc(freedom / 2, statistic / 2) > ANSWER:
        return False
    if left > _SHRINKAGE * whole:
        raise DefinitionError(
            "outputs answer inputs at the same section, where the inputs have a part that neither "
            "the reference nor the past explains: no model of the noise tells the two directions "
            "apart. Pass a model with D = 0 as `guess` if outputs do not respond at once."
        )
    return True


class _Section:
    """The samples of a section of all records, where all outputs were sampled."""

    def __init__(
        self,
        z: Float[np.ndarray, "R T N columns"],
        sampled: Bool[np.ndarray, "R T N"],
        section: int,
        ny: int,
    ):
        self.record, cycle = np.nonzero(sampled[:, :, section])
        self.time = cycle * z.shape[2] + section
        self._z = z.reshape(len(z), -1, z.shape[3])
        self.u, self.y = np.split(self._z[self.record, self.time], [-ny], axis=1)

    def past(self, length: int, later: int = 0) -> Float[np.ndarray, "samples columns"]:
        """Return the `length` samples before, `later` samples later: newest first, zero before a
        record."""
        back = self.time[:, None] + later - 1 - np.arange(length)
        rows = self._z[self.record[:, None], np.maximum(back, 0)]
        return np.where((back >= 0)[..., None], rows, 0.0).reshape(len(back), -1)

    def regression(self, length: int, direct: bool) -> Float[np.ndarray, "columns ny"]:
        """Return the effect of the past on the output."""
        rows = np.concatenate([self.u * direct, self.past(length)], axis=1)
        return _regress(rows, self.y)[self.u.shape[1] :]


def _regress(rows: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return a least-squares solution, shrunk slightly: regressors without power get zero."""
    size = np.sqrt(np.square(rows).sum(axis=0))
    rows = rows / np.where(size > 0, size, 1.0)
    x = np.linalg.solve(rows.T @ rows + _SHRINKAGE * np.eye(len(size)), rows.T @ target)
    return x / np.where(size > 0, size, 1.0)[:, None]


def _from_states(
    sections: list[_Section], to_state: list[np.ndarray], past: int, innovations: bool, direct: bool
) -> PeriodicModel:
    N, nu = len(sections), sections[0].u.shape[1]
    C, D, A, B, K = [], [], [], [], []
    for n, section in enumerate(sections):
        x = section.past(past) @ to_state[n]
        rows = np.concatenate([x, section.u], axis=1)
        output = _regress(np.concatenate([x, section.u * direct], axis=1), section.y)
        rows = np.concatenate([rows, section.y - rows @ output], axis=1)
        later = _regress(rows, section.past(past, 1) @ to_state[(n + 1) % N])
        d = x.shape[1]
        C.append(output[:d].T)
        D.append(output[d:].T)
        A.append(later[:d].T)
        B.append(later[d : d + nu].T)
        K.append(later[d + nu :].T if innovations else np.zeros((later.shape[1], 0)))
    model = PeriodicModel(A, B, C, D, K)
    size = np.abs(np.linalg.eigvals(model.monodromy())).max()
    shrunk = (SLOWEST / max(size, SLOWEST)) ** (1 / N)
    model = model._replace(A=[a * shrunk for a in A])
    while innovations and _slowest_error(model) > SLOWEST:
        model = model._replace(K=[k / 2 for k in model.K])
    return model


def _slowest_error(model: PeriodicModel) -> float:
    """Return the largest modulus of a multiplier of A - K C, for errors of predictions."""
    A = [A - K @ C for A, K, C in zip(model.A, model.K, model.C, strict=True)]
    return float(np.abs(np.linalg.eigvals(model._replace(A=A).monodromy())).max())
