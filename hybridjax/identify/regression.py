r"""The output-error problem in time: numerators and unknown starts projected out.

With $\chi(q^{-N}) y = B_{n \bmod N}(q^{-1}) u$ and $v = \chi^{-1} u$, filtered from cycle to cycle,

$$y[n] = \sum_r b_{n \bmod N}[r]\, v[n-r] + (\chi^{-1} g)[n] + \varepsilon[n],$$

where g is free in the first cycles of each record: it stands for inputs and outputs before the
record. For given c every section is a linear regression of its own, in b and g.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from scipy.signal import lfilter

from .records import Layout


_RANK = 1e-10  # singular values below this part of the largest are dropped
Coefficients = Float[np.ndarray, " d"]


class Problem(NamedTuple):
    """What does not depend on c."""

    u: Float[np.ndarray, "S T N nu"]
    y: Float[np.ndarray, "S T N ny"]
    """In units of `scale`; zero where there is no sample."""
    good: Bool[np.ndarray, "S T N ny"]
    """Where there is one."""
    first: Int[np.ndarray, "S N"]
    """The cycle in which a record first meets a section."""
    lags: int
    """R: numerators have the lags -lead..R-1-lead."""
    lead: int
    free: int
    """K: the cycles at the start of each record in which g is free."""
    maps: list[Float[np.ndarray, "columns r"]]
    """For each section: the combinations of lagged inputs that are linearly independent."""
    slow: Float[np.ndarray, "S T K"]
    """What an unknown drift of the outputs is composed of."""
    scale: Float[np.ndarray, " ny"]


def set_up(layout: Layout, order: int, overhang: int, rest: bool) -> Problem:
    N = layout.y.shape[2]
    lags = layout.lead + order * N + overhang + 1
    free = 0 if rest else order + -(-overhang // N)
    good, first = np.isfinite(layout.y), np.argmax(layout.inside, axis=1)
    cycle = np.arange(layout.y.shape[1])
    maps = []
    for n in range(N):
        tells = good[:, :, n].any(axis=2) & (cycle >= first[:, n, None] + free)
        rows = lagged(layout.u, n, lags, layout.lead)[tells]
        _, s, vh = np.linalg.svd(rows, full_matrices=False)
        kept = s > _RANK * s.max(initial=0)
        maps.append(vh[kept].T / s[kept])
    scale = np.sqrt(np.nanmean(layout.y**2, axis=(0, 1, 2)))
    return Problem(
        layout.u,
        np.where(good, layout.y, 0.0) / scale,
        good,
        first,
        lags,
        layout.lead,
        free,
        maps,
        layout.slow,
        scale,
    )


def rescale(problem: Problem, noise: Float[np.ndarray, " ny"]) -> Problem:
    """The same with each output in units of its noise, which was `noise` units before."""
    return problem._replace(y=problem.y / noise, scale=problem.scale * noise)


def lagged(
    u: Float[np.ndarray, "S T N nu"], n: int, lags: int, lead: int
) -> Float[np.ndarray, "S T columns"]:
    """u[pN + n - r] for all cycles p and lags r = -lead, ..., which vary slowest; zero outside."""
    S, T, N, nu = u.shape
    before, after = np.zeros((S, lags - 1 - lead, nu)), np.zeros((S, lead, nu))
    row = np.concatenate([before, u.reshape(S, T * N, nu), after], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(row, lags, axis=1)[:, n::N]
    return windows[..., ::-1].swapaxes(2, 3).reshape(S, T, lags * nu)


def along_cycles(c: Coefficients, x: np.ndarray, delay: int = 0) -> np.ndarray:
    """x / chi along axis 1, the cycles, `delay` cycles later."""
    if delay >= x.shape[1]:
        return np.zeros_like(x)
    out = lfilter([1.0], np.concatenate([[1.0], c]), x, axis=1)
    return np.concatenate([np.zeros_like(out[:, :delay]), out[:, : x.shape[1] - delay]], axis=1)


class Regression(NamedTuple):
    """Inputs, unknown starts and drift of one section, for outputs sampled in the same rows."""

    V: Float[np.ndarray, "S T r"]
    E: Float[np.ndarray, "S T K"]
    """Responses to unknown starts; these and the slow changes are unknown in each record."""
    good: Bool[np.ndarray, "S T 1"]
    left: Float[np.ndarray, "S T K"]
    """Orthonormal basis of the sampled rows of both, and what takes its coefficients to g."""
    to_free: Float[np.ndarray, "S K K"]
    rest: Float[np.ndarray, "rows r"]
    """Sampled rows of V without what these explain."""
    inverse: Float[np.ndarray, "r r"]
    """Of the Gram matrix of `rest`."""

    @classmethod
    def make(cls, V, E, slow, good):
        good = good[:, :, None]
        both = good * np.concatenate([E, slow], axis=2)
        left, s, right = np.linalg.svd(both, full_matrices=False)
        kept = s > _RANK * s.max(initial=0)
        left = left * kept[:, None]
        to_free = np.swapaxes(right, 1, 2) * np.where(kept, 1 / np.where(kept, s, 1), 0)[:, None]
        to_free = to_free[:, : E.shape[2]]
        rest = good * V
        rest = (rest - left @ (left.swapaxes(1, 2) @ rest)).reshape(-1, V.shape[2])
        inverse = scipy.linalg.pinvh(rest.T @ rest, rtol=1e-12)
        return cls(V, E, good, left, to_free, rest, inverse)

    @property
    def freedom(self) -> int:
        used = np.linalg.matrix_rank(self.inverse, hermitian=True) + (self.left**2).sum()
        return int(self.good.sum()) - int(round(float(used)))

    @property
    def leverage(self) -> Float[np.ndarray, "S T"]:
        """The share of its own error that the fit takes from each sample."""
        own = np.einsum("ij,jk,ik->i", self.rest, self.inverse, self.rest)
        return (self.left**2).sum(axis=2) + own.reshape(self.left.shape[:2])

    def solve(self, x: Float[np.ndarray, "S T C"]):
        """Coefficients of V, the response at all rows, and what is left at those sampled."""
        a, left = np.zeros((self.rest.shape[1], x.shape[2])), self.good * x
        for _ in range(2):  # the second time for accuracy
            left = left - self.left @ (self.left.swapaxes(1, 2) @ left)
            more = self.inverse @ (self.rest.T @ left.reshape(-1, x.shape[2]))
            left = left - (self.rest @ more).reshape(left.shape)
            a += more
        inputs = self.V @ a
        free = self.to_free @ (self.left.swapaxes(1, 2) @ (self.good * (x - inputs)))
        return a, inputs + self.E @ free, left


class Linearisation(NamedTuple):
    residual: Float[np.ndarray, "S T N ny C"]
    jacobian: Float[np.ndarray, "d S T N ny C"]
    freedom: Int[np.ndarray, "N ny"]
    leverage: Float[np.ndarray, "S T N ny"]
    numerators: Float[np.ndarray, "N columns ny"]
    """Of the first column of outputs."""
    slope: Float[np.ndarray, "d N columns ny"]
    """Their derivative with respect to c."""
    roots: list[list[Float[np.ndarray, "columns r"]]]
    """root @ root.T is the covariance of the numerators of a section and output, given c."""


def linearise(
    problem: Problem, c: Coefficients, y: Float[np.ndarray, "S T N ny C"] | None = None
) -> Linearisation:
    """What the numerators and free starts leave of the outputs, and its derivative in c.

    The derivative omits what vanishes with the residual (Kaufman 1975). `y`: other outputs than
    those measured, C of each.
    """
    S, T, N, ny = problem.y.shape
    y = problem.y[..., None] if y is None else y
    d, columns = len(c), problem.lags * problem.u.shape[3]
    residual, jacobian = np.zeros(y.shape), np.zeros((d, *y.shape))
    freedom, leverage, roots = np.zeros((N, ny), int), np.zeros((S, T, N, ny)), []
    b, slope = np.zeros((N, columns, ny)), np.zeros((d, N, columns, ny))
    v = along_cycles(c, problem.u)
    for n in range(N):
        V = lagged(v, n, problem.lags, problem.lead) @ problem.maps[n]
        E = responses_to_starts(c, problem.first[:, n], T, min(problem.free, T))
        regression = None
        for i in range(ny):
            good = problem.good[:, :, n, i]
            if regression is None or not np.array_equal(good, regression.good[..., 0]):
                regression = Regression.make(V, E, problem.slow, good)
                left, share = regression.freedom, regression.leverage
                w, q = np.linalg.eigh(regression.inverse)
                root = problem.maps[n] @ (q * np.sqrt(np.maximum(w, 0)))
            a, fitted, residual[:, :, n, i] = regression.solve(y[:, :, n, i])
            b[n, :, i] = problem.maps[n] @ a[:, 0]
            for j in range(d):
                more, _, jacobian[j, :, :, n, i] = regression.solve(along_cycles(c, fitted, j + 1))
                slope[j, n, :, i] = problem.maps[n] @ more[:, 0]
            freedom[n, i], leverage[:, :, n, i] = left, share
            roots.append(root)
    roots = [roots[n * ny : (n + 1) * ny] for n in range(N)]
    return Linearisation(residual, jacobian, freedom, leverage, b, slope, roots)


def responses_to_starts(
    c: Coefficients, first: Int[np.ndarray, " S"], T: int, K: int
) -> Float[np.ndarray, "S T K"]:
    """The responses to g in each of the first K cycles, of T, in which a record meets a section."""
    place = first[:, None] + np.arange(K)
    impulses = (np.arange(T)[:, None] == place[:, None]).astype(float)
    return along_cycles(c, impulses)


class Delayed(NamedTuple):
    """What inputs leave of the outputs 0, 1, ..., d cycles earlier."""

    gram: Float[np.ndarray, "d1 d1"]
    freedom: int
    """The number of independent rows; noise of variance 1 makes the Gram matrix that large."""


def delayed_outputs(problem: Problem, order: int) -> Delayed:
    """Only from rows whose lagged inputs and outputs are all known."""
    _, T, N, ny = problem.y.shape
    gram, freedom = np.zeros((order + 1, order + 1)), 0
    cycle = np.arange(T)[:, None]
    for n in range(N):
        V = lagged(problem.u, n, problem.lags, problem.lead) @ problem.maps[n]
        known = (cycle >= problem.first[:, n] + problem.free).T
        for i in range(ny):
            good, y = problem.good[:, :, n, i], problem.y[:, :, n, i]
            past = np.stack([_later(y, j) for j in range(order + 1)], axis=2)
            rows = known & np.all([_later(good, j, not problem.free) for j in range(order + 1)], 0)
            regression = Regression.make(V, problem.slow[:, :, :0], problem.slow, rows)
            Z = regression.solve(past)[2].reshape(-1, order + 1)
            gram += Z.T @ Z
            freedom += max(regression.freedom, 0)
    return Delayed(gram, freedom)


def initial(problem: Problem, order: int) -> Coefficients:
    """chi y = B u by total least squares, which white noise does not bias."""
    null = np.linalg.eigh(delayed_outputs(problem, order).gram)[1][:, 0]
    if abs(null[0]) < 1e-8 * np.abs(null).max():
        return np.zeros(order)
    roots = np.roots(null / null[0])
    size = np.maximum(np.abs(roots) / 0.99, 1.0)
    return np.pad(np.poly(roots / size).real[1:], (0, order - len(roots)))


def _later(x: np.ndarray, cycles: int, fill: float | bool = 0) -> np.ndarray:
    """x delayed along axis 1."""
    T = x.shape[1]
    cycles = min(cycles, T)
    return np.concatenate([np.full_like(x[:, :cycles], fill), x[:, : T - cycles]], axis=1)
