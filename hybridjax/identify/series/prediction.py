r"""Errors of predictions one step ahead by a periodic state-space model, and their derivatives.

$$e[n] = y[n] - C[n] x[n] - D[n] u[n], \qquad x[n+1] = A[n] x[n] + B[n] u[n] + K[n] e[n]$$

With K = 0 these are the errors of a simulation (output error). A change of the matrices at section
n changes the predictions by $\delta C\,x + \delta D\,u$ there, and the next state by $\delta A\,x +
\delta B\,u + \delta K\,e - K (\delta C\,x + \delta D\,u)$, which decays with $F = A - K C$. The
error of a missing output is replaced by its conditional mean, given the errors of the other outputs
of the same sample.

`fit_ldtp` calls `SeriesProblem` (cost, linearized equations, weights), and `hj.validate` calls
`Predictor`. `SeriesProblem.path` computes states and errors, and `slopes_of` the derivatives of
predictions: compare these two if a fit does not converge. Derivatives must stay those of
predictions, not of errors (see `NormalEquations`). If gaps in the records spoil a fit, look at
`SeriesProblem._weights`; if a spectrum of noise is wrong, at `noise_spectrum`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics, check_harmonics, harmonic_transfer
from ...linear.ldtp import LDTP
from ..descent import NormalEquations
from ..periodic import LocalCoordinates, PeriodicModel
from ..weights import SMALLEST_ERROR
from .output_error import RANK
from .records import CycleGrid


Columns = Float[np.ndarray, "_ _ _ _"]
"""(R, T, d, columns): states of R records in T cycles, one for each column."""


class SeriesPart(NamedTuple):
    """R records of T cycles, by section."""

    u: Float[np.ndarray, "N R T nu"]
    y: Float[np.ndarray, "N R T ny"]
    """Outputs in units of a scale; zero where there is no sample."""
    sampled: Bool[np.ndarray, "N R T ny"]
    lost: Bool[np.ndarray, "N R T ny"]
    """Whether a sample lies inside of its record, but is missing."""
    first: Int[np.ndarray, " R"]
    """The section at which each record starts."""
    drift: Float[np.ndarray, "N R T ny K"]
    """An orthonormal basis of the drift of each output at its samples; columns beyond its rank are
    zero."""

    @classmethod
    def of(cls, grid: CycleGrid, scale: Float[np.ndarray, " ny"]) -> "SeriesPart":
        sampled = np.moveaxis(grid.sampled, 2, 0)
        inside = np.moveaxis(grid.inside, 2, 0)[..., None]
        by_output = np.moveaxis(sampled, 3, 2)[..., None]
        waves = grid.drift[None, :, None] * by_output  # (N R ny T K)
        basis, size, _ = np.linalg.svd(waves, full_matrices=False)
        largest = size.max(axis=-1, keepdims=True, initial=0)
        kept = size > RANK * np.maximum(largest, RANK)
        basis = basis * kept[..., None, :]
        u = np.moveaxis(grid.u, 2, 0)
        y = np.moveaxis(grid.y / scale, 2, 0)
        return cls(
            u=np.ascontiguousarray(u),
            y=np.ascontiguousarray(y),
            sampled=sampled,
            lost=inside & ~sampled,
            first=np.argmax(grid.inside[:, 0], axis=1),
            drift=np.moveaxis(basis, 2, 3),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """R, T."""
        return self.u.shape[1], self.u.shape[2]

    def without_drift(self, n: int, x: Columns) -> Columns:
        """Return columns at the samples of section n without the part that a drift explains."""
        x = x * self.sampled[n][..., None]
        if not self.drift.shape[-1]:
            return x
        basis = self.drift[n]
        return x - np.einsum("rtik,rsik,rsic->rtic", basis, basis, x, optimize=True)


class Path(NamedTuple):
    """States and errors of a model, section by section."""

    F: list[Float[np.ndarray, "R1 T1 after d"]]
    gain: list[Float[np.ndarray, "R1 T1 after ny"]]
    """K as a factor of the errors of sampled outputs."""
    whiten: list[Float[np.ndarray, "R1 T1 ny ny"]]
    """Factors that make these errors independent with variance one."""
    x: list[Float[np.ndarray, "R T d"]]
    entering: list[Float[np.ndarray, "R T ny"]]
    """Errors that K multiplies, with their means for missing outputs."""
    error: list[Float[np.ndarray, "R T ny"]]
    """Errors, with drift removed; zero where an output is missing."""
    starts: list[Float[np.ndarray, "R rows s"]]
    """Responses of the predictions to the initial states, whitened."""
    start_gram: Float[np.ndarray, "R s s"]


class SeriesProblem(NamedTuple):
    """Records of outputs that a model predicts."""

    parts: Iterable[SeriesPart]
    S: Float[np.ndarray, "N ny ny"]
    """Covariance of the errors at each section, whose inverse weights them."""
    by_section: bool
    """Whether each section has its own covariance."""
    free_start: bool
    residuals: int
    """The number of samples."""

    def cost(self, model: PeriodicModel) -> float:
        """Return the weighted sum of squares; infinite or NaN if predictions overflow."""
        cost = 0.0
        with np.errstate(all="ignore"):
            for part in self.parts:
                try:
                    path = self.path(model, part)
                except np.linalg.LinAlgError:
                    return np.inf
                pairs = zip(path.whiten, path.error, strict=True)
                for w, e in pairs:
                    cost += float((np.matvec(w, e) ** 2).sum())
        return cost

    def reweighted(self, model: PeriodicModel) -> "SeriesProblem":
        """Return the problem with the covariance of the errors of a model."""
        square = np.zeros(self.S.shape)
        count = np.zeros(self.S.shape)
        for part in self.parts:
            path = self.path(model, part)
            for n, error in enumerate(path.error):
                sampled = part.sampled[n].astype(float)
                square[n] += np.einsum("rti,rtj->ij", error, error)
                count[n] += np.einsum("rti,rtj->ij", sampled, sampled)
        if not self.by_section:
            square[:] = square.sum(axis=0)
            count[:] = count.sum(axis=0)
        covariance = square / np.maximum(count, 1)
        variances, vectors = np.linalg.eigh(covariance)
        largest = variances[:, -1:]
        floor = np.maximum(SMALLEST_ERROR**2, SMALLEST_ERROR * largest)
        variances = np.maximum(variances, floor)[:, None]
        return self._replace(S=vectors * variances @ vectors.mT)

    def linearize(self, coordinates: LocalCoordinates) -> NormalEquations:
        """Return the least-squares problem of the P coordinates around their model, with the
        initial states eliminated."""
        P = coordinates.size
        gram = np.zeros((P, P))
        gradient = np.zeros(P)
        for part in self.parts:
            path = self.path(coordinates.model, part)
            R, _ = part.shape
            along = np.zeros((R, path.start_gram.shape[1], P))
            for n, slopes in enumerate(slopes_of(coordinates, part, path)):
                whiten = path.whiten[n]
                J = whiten @ part.without_drift(n, slopes)
                flat = J.reshape(-1, P)
                white = np.matvec(whiten, path.error[n])
                gram += flat.T @ flat
                gradient += white.ravel() @ flat
                by_record = J.reshape(R, -1, P)
                along += path.starts[n].mT @ by_record
            # (Less the part that the initial states explain.)
            taken = _solve_starts(path.start_gram, along)
            explained = np.tensordot(along, taken, ((0, 1), (0, 1)))
            gram -= explained
        return NormalEquations(gram, gradient)

    def path(self, model: PeriodicModel, part: SeriesPart) -> Path:
        """Return states and errors for the initial states that fit best."""
        R, T = part.shape
        N = len(self.S)
        given = []
        whiten = []
        gain = []
        F = []
        y = []
        for n in range(N):
            mean, root = self._weights(part, n)
            G = _gain(model.K[n], mean)
            given.append(mean)
            whiten.append(root)
            gain.append(G)
            corrected = G @ model.C[n]
            F.append(model.A[n] - corrected)
            at_once = part.u[n] @ model.D[n].T
            y.append(part.y[n] - at_once)

        starts = 0
        if self.free_start:
            starts = max(model.dims[n] for n in part.first)

        def enter(n: int, x: Columns) -> None:
            begins = part.first == n
            if starts and begins.any():
                d = x.shape[2]
                x[begins, 0, :, 1 : 1 + d] = np.eye(d)

        def drive(n: int, later: Columns) -> None:
            forced = part.u[n] @ model.B[n].T
            later[..., 0] += forced
            sampled = y[n] * part.sampled[n]
            later[..., 0] += np.matvec(gain[n], sampled)

        # The first column is the response to the inputs. Each other column is the response to one
        # coordinate of the initial state.
        filled = [1 + starts] * N
        shape = (R, T, 1 + starts)
        states = []
        errors = []
        responses = []
        gram = np.zeros((R, starts, starts))
        along = np.zeros((R, starts, 1))
        for n, x in enumerate(recursion(F, shape, enter, drive, filled)):
            error = model.C[n] @ x
            error[..., 0] = y[n] - error[..., 0]
            error = part.without_drift(n, error)
            white = whiten[n] @ error
            samples = white.shape[1] * white.shape[2]
            driven = white[..., :1].reshape(R, samples, 1)
            rows = white[..., 1:].reshape(R, samples, starts)
            gram += rows.mT @ rows
            along += rows.mT @ driven
            states.append(x)
            errors.append(error)
            responses.append(rows)

        x0 = _solve_starts(gram, along)[:, None]

        def from_starts(columns: Columns) -> np.ndarray:
            return (columns[..., 1:] @ x0)[..., 0]

        states = [x[..., 0] + from_starts(x) for x in states]
        errors = [e[..., 0] - from_starts(e) for e in errors]
        entering = []
        for n, x in enumerate(states):
            predicted = x @ model.C[n].T
            innovation = y[n] - predicted
            known = innovation * part.sampled[n]
            entering.append(np.matvec(given[n], known))
        return Path(
            F=F,
            gain=gain,
            whiten=whiten,
            x=states,
            entering=entering,
            error=errors,
            starts=responses,
            start_gram=gram,
        )

    def _weights(self, part: SeriesPart, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return two matrices: from the sampled errors to the conditional mean of all errors, and
        from the sampled errors to independent ones of variance one."""
        S = self.S[n]
        identity = np.eye(len(S))
        lost = part.lost[n]
        if not lost.any():
            return identity[None, None], _whitening(S)[None, None]
        kept = 1.0 - lost
        with_kept = S * kept[..., None, :]
        among_kept = kept[..., :, None] * with_kept
        among_lost = identity * lost[..., None]
        both = among_kept + among_lost
        return with_kept @ np.linalg.inv(both), _whitening(both)


def _whitening(covariance: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _gain(K: Float[np.ndarray, "after k"], mean: np.ndarray) -> np.ndarray:
    """Return K as a factor of the errors of sampled outputs; zero where K has no columns."""
    if K.shape[1]:
        return K @ mean
    return np.zeros((1, 1, len(K), mean.shape[-1]))


def recursion(
    F: Sequence[Float[np.ndarray, "_ _ _ _"]],
    shape: tuple[int, int, int],
    enter: Callable[[int, Columns], None],
    drive: Callable[[int, Columns], None],
    filled: Sequence[int],
) -> Iterator[Columns]:
    """Iterate over x at each section, where $x[n+1] = F[n] x[n] + \\ldots$ begins at zero.

    All cycles are computed in parallel, in two runs. The first run begins each cycle at zero, which
    gives the states at the starts of all cycles; the second run begins at these.

    **Arguments:**

    - `F`: (R, T, after, d) for each section; the first axes may have the length 1.
    - `shape`: R, T and the number of columns.
    - `enter`: adds terms to x at a section; `drive`: adds terms to the x after it.
    - `filled`: number of columns that are not zero in the first cycle after each section.
    """
    R, T, columns = shape
    d = F[0].shape[-1]
    x = np.zeros((R, T, d, columns))
    phi = np.eye(d)[None, None]
    for n, step in enumerate(F):
        enter(n, x)
        later = np.zeros((R, T, step.shape[-2], columns))
        columns_so_far = slice(filled[n])
        later[..., columns_so_far] = step @ x[..., columns_so_far]
        drive(n, later)
        x = later
        phi = step @ phi
    starts = np.zeros_like(x)
    for k in range(T - 1):
        place = min(k, phi.shape[1] - 1)
        period = phi[:, place]
        carried = period @ starts[:, k]
        starts[:, k + 1] = carried + x[:, k]
    x = starts
    for n, step in enumerate(F):
        enter(n, x)
        yield x
        x = step @ x
        drive(n, x)


def slopes_of(
    coordinates: LocalCoordinates, part: SeriesPart, path: Path
) -> Iterator[Columns]:
    """Iterate over the derivatives of the predictions at each section."""
    model = coordinates.model
    places = coordinates.places

    def enter(n: int, x: Columns) -> None:
        """No derivative enters at the start of a record."""

    def drive(n: int, later: Columns) -> None:
        place = places[n]
        gain = path.gain[n]
        x = path.x[n]
        u = part.u[n]
        unit = np.eye(later.shape[2])[None, None]
        by_Y = coordinates.to_A[n] - gain @ coordinates.to_C[n]
        later[..., place["Y"]] += _outer(by_Y, x)
        later[..., place["B"]] += _outer(unit, u)
        if model.K[n].shape[1]:
            by_input = u @ model.D[n].T
            predicted = x @ model.C[n].T + by_input
            error = predicted + path.entering[n]
            later[..., place["K"]] += _outer(unit, error)
        if coordinates.direct:
            by_direct = model.gain[n] - gain
            later[..., place["D"]] += _outer(by_direct, u)

    ends = [max(block.stop for block in place.values()) for place in places]
    shape = (*part.shape, coordinates.size)
    for n, states in enumerate(recursion(path.F, shape, enter, drive, ends)):
        place = places[n]
        slopes = model.C[n] @ states
        to_C = coordinates.to_C[n][None, None]
        slopes[..., place["Y"]] += _outer(to_C, path.x[n])
        if coordinates.direct:
            outputs = len(model.C[n])
            unit = np.eye(outputs)[None, None]
            slopes[..., place["D"]] += _outer(unit, part.u[n])
        yield slopes


def _outer(
    left: Float[np.ndarray, "R1 T1 a q"], right: Float[np.ndarray, "R T b"]
) -> np.ndarray:
    """Return (R, T, a, q b), the outer products of rows of the left matrix and right vectors."""
    product = left[..., None] * right[:, :, None, None, :]
    R, T, a, _, _ = product.shape
    return product.reshape(R, T, a, -1)


def _solve_starts(
    gram: Float[np.ndarray, "R s s"], along: Float[np.ndarray, "R s columns"]
) -> Float[np.ndarray, "R s columns"]:
    """Return the pseudoinverse of each Gram matrix times columns."""
    return np.linalg.pinv(gram, RANK, hermitian=True) @ along


def noise_spectrum(
    noise: LDTP, f: Float[np.ndarray, " F"], harmonics: Harmonics | None = None
) -> Float[np.ndarray, "M F ny"]:
    r"""Return the spectrum of periodic noise at the harmonics of excited frequencies.

    The noise v of the outputs is the response of a periodic model to independent inputs w of
    variance one,

    $$s[n+1] = A[n] s[n] + B[n] w[n], \qquad v[n] = C[n] s[n] + D[n] w[n],$$

    Over long windows of L samples its spectrum is

    $$S(\varphi) = \lim \frac{1}{L}\, E\,\Big|\sum_n v[n]\, e^{-2 \pi i \varphi n / N}\Big|^2
    = \sum_k \sum_j | H_{k,j}(\varphi - k) |^2$$

    with the harmonic transfer functions $H_k$ from all inputs j (the cyclic spectrum at cycle
    frequency zero: Gardner, Napolitano and Paura 2006). The noise of $H_m$ at f is that at f + m.

    **Arguments:**

    - `noise`: a stable model with any number of white inputs of variance one.
    - `f` (F,): frequencies, in cycles per period. `harmonics`: Default: all N.

    **Returns:** (M, F, ny), the squared unit of each output.

    **Raises:** `DefinitionError` for a model with a multiplier of modulus one or more, whose noise
    is not stationary.
    """
    N = noise.n_sections
    harmonics = check_harmonics(harmonics, N)
    if len(noise.multipliers) and np.abs(noise.multipliers[0]) >= 1:
        raise DefinitionError(
            f"noise with a multiplier of modulus {abs(noise.multipliers[0]):.4g} grows for ever."
        )
    k = np.arange(N)
    matrices = map(np.asarray, noise.matrices[:4])
    shifted = np.add.outer(k, f).ravel()
    H = harmonic_transfer(*matrices, shifted)
    power = (np.abs(H) ** 2).sum(axis=3)
    # (harmonic k, inputs at f + j, frequency, output)
    power = power.reshape(N, N, len(f), len(noise.outputs))
    spectra = []
    for m in harmonics:
        of_inputs = power[k, (m - k) % N]
        spectra.append(of_inputs.sum(axis=0))
    return np.stack(spectra)


def noise_model(
    model: PeriodicModel,
    S: Float[np.ndarray, "N ny ny"],
    scale: Float[np.ndarray, " ny"],
    outputs: tuple[str, ...],
) -> LDTP:
    """Return the noise of a model in innovation form, with inputs of variance one.

    **Arguments:** `S`: covariances of the innovations, in units of `scale`, as the model's outputs.
    """
    roots = np.linalg.cholesky(S)
    names = tuple(f"noise of {name}" for name in outputs)
    unit = scale[:, None]
    D = [unit * root for root in roots]
    has_states = model.K[0].shape[1] > 0
    if not has_states:
        N, ny, _ = S.shape
        A = np.zeros((N, 1, 1))
        B = np.zeros((N, 1, ny))
        C = np.zeros((N, ny, 1))
        return LDTP(A, B, C, D, None, names, outputs)
    B = [K @ root for K, root in zip(model.K, roots, strict=True)]
    C = [unit * C for C in model.C]
    return LDTP.from_blocks(model.A, B, C, D, names, outputs)


class Predictor(NamedTuple):
    """A model in innovation form, in the units of the outputs."""

    model: PeriodicModel
    S: Float[np.ndarray, "N ny ny"]
    """Covariances of the innovations."""

    @property
    def dims(self) -> list[int]:
        return self.model.dims

    def predicted(
        self, grid: CycleGrid, free_start: bool
    ) -> Float[np.ndarray, "R T N ny"]:
        """Return the expected outputs at each sample, given all earlier samples."""
        ones = np.ones(self.S.shape[1])
        part = SeriesPart.of(grid, ones)
        problem = SeriesProblem(
            parts=[part],
            S=self.S,
            by_section=True,
            free_start=free_start,
            residuals=0,
        )
        path = problem.path(self.model, part)
        out = np.zeros(grid.y.shape)
        for n, x in enumerate(path.x):
            by_state = x @ self.model.C[n].T
            by_input = part.u[n] @ self.model.D[n].T
            simulated = by_state + by_input
            predicted = part.y[n] - path.error[n]
            out[:, :, n] = np.where(part.sampled[n], predicted, simulated)
        return out

    def errors(
        self, grid: CycleGrid, free_start: bool
    ) -> Float[np.ndarray, "R T N ny"]:
        """Return the errors of `predicted`; NaN where an output was not sampled."""
        left = grid.y - self.predicted(grid, free_start)
        return np.where(grid.sampled, left, np.nan)
