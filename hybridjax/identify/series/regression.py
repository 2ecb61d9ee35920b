r"""The output-error problem in time: numerators and unknown starts projected out.

With $\chi(q^{-N}) y = B_{n \bmod N}(q^{-1}) u$ and $v = \chi^{-1} u$, filtered from cycle to cycle,

$$y[n] = \sum_r b_{n \bmod N}[r]\, v[n-r] + (\chi^{-1} g)[n] + \varepsilon[n],$$

where g is free in the first cycles of each record: it stands for inputs and outputs before the
record. For given c every section is a linear regression of its own, in b and g.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import lfilter

from ..._core.threads import on_all_cores
from .layout import Layout


_RANK = 1e-10  # singular values below this part of the largest are dropped
_GRAM = 1e-12  # and eigenvalues of Gram matrices
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

    def independent(n: int):
        tells = good[:, :, n].any(axis=2) & (cycle >= first[:, n, None] + free)
        rows = lagged(layout.u, n, lags, layout.lead)[tells]
        _, s, vh = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=False)
        kept = s > _RANK * s.max(initial=0)
        return vh[kept].T / s[kept]

    scale = np.sqrt(np.nanmean(layout.y**2, axis=(0, 1, 2)))
    return Problem(
        layout.u,
        np.where(good, layout.y, 0.0) / scale,
        good,
        first,
        lags,
        layout.lead,
        free,
        on_all_cores(independent, range(N)),
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
    root: Float[np.ndarray, "r k"]
    """root @ root.T is the inverse of the Gram matrix of `rest`."""

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
        w, q = np.linalg.eigh(rest.T @ rest)
        kept = w > _GRAM * w.max(initial=0)
        return cls(V, E, good, left, to_free, rest, q[:, kept] / np.sqrt(w[kept]))

    @property
    def freedom(self) -> int:
        used = self.root.shape[1] + (self.left**2).sum()
        return int(self.good.sum()) - int(round(float(used)))

    @property
    def leverage(self) -> Float[np.ndarray, "S T"]:
        """The share of its own error that the fit takes from each sample."""
        own = ((self.rest @ self.root) ** 2).sum(axis=1)
        return (self.left**2).sum(axis=2) + own.reshape(self.left.shape[:2])

    def solve(self, x: Float[np.ndarray, "S T C"]):
        """Coefficients of V, and what is left at the rows sampled."""
        a, left = np.zeros((self.rest.shape[1], x.shape[2])), self.good * x
        for _ in range(2):  # the second time for accuracy
            left = left - self.left @ (self.left.swapaxes(1, 2) @ left)
            more = self.root @ (self.root.T @ (self.rest.T @ left.reshape(-1, x.shape[2])))
            left = left - (self.rest @ more).reshape(left.shape)
            a += more
        return a, left

    def response(self, a: Float[np.ndarray, "r C"], x: Float[np.ndarray, "S T C"]):
        """What inputs with these coefficients, and the starts that fit x best, make of all rows."""
        inputs = self.V @ a
        free = self.to_free @ (self.left.swapaxes(1, 2) @ (self.good * (x - inputs)))
        return inputs + self.E @ free


class Linearization(NamedTuple):
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

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "Linearization":
        """That of the problem with each output in units of its noise (`rescale`)."""
        return self._replace(
            residual=self.residual / noise[:, None],
            jacobian=self.jacobian / noise[:, None],
            numerators=self.numerators / noise,
            slope=self.slope / noise,
        )


def linearize(
    problem: Problem, c: Coefficients, y: Float[np.ndarray, "S T N ny C"] | None = None
) -> Linearization:
    """What the numerators and free starts leave of the outputs, and its derivative in c.

    The derivative omits what vanishes with the residual (Kaufman 1975). `y`: other outputs than
    those measured, C of each.
    """
    S, T, N, ny = problem.y.shape
    y = problem.y[..., None] if y is None else y
    d, columns = len(c), problem.lags * problem.u.shape[3]
    found = Linearization(
        np.zeros(y.shape),
        np.zeros((d, *y.shape)),
        np.zeros((N, ny), int),
        np.zeros((S, T, N, ny)),
        np.zeros((N, columns, ny)),
        np.zeros((d, N, columns, ny)),
        [[np.zeros((0, 0))] * ny for _ in range(N)],
    )
    v = along_cycles(c, problem.u)

    def section(n: int) -> None:
        V = lagged(v, n, problem.lags, problem.lead) @ problem.maps[n]
        E = responses_to_starts(c, problem.first[:, n], T, min(problem.free, T))
        for good, outputs in _sampled_alike(problem.good[:, :, n]):
            regression = Regression.make(V, E, problem.slow, good)
            x = y[:, :, n, outputs].reshape(S, T, -1)
            a, left = regression.solve(x)
            fitted = regression.response(a, x)
            fitted = np.concatenate([along_cycles(c, fitted, j + 1) for j in range(d)], axis=2)
            more, slopes = regression.solve(fitted)
            shape = (len(outputs), y.shape[4])
            found.residual[:, :, n, outputs] = left.reshape(S, T, *shape)
            slopes = np.moveaxis(slopes.reshape(S, T, d, *shape), 2, 0)
            found.jacobian[:, :, :, n, outputs] = slopes
            found.freedom[n, outputs] = regression.freedom
            found.leverage[:, :, n, outputs] = regression.leverage[..., None]
            to_lags = problem.maps[n]
            found.numerators[n][:, outputs] = to_lags @ a.reshape(-1, *shape)[..., 0]
            more = np.moveaxis(more.reshape(-1, d, *shape)[..., 0], 1, 0)
            found.slope[:, n][..., outputs] = to_lags @ more
            for i in outputs:
                found.roots[n][i] = to_lags @ regression.root

    on_all_cores(section, range(N))
    return found


def _sampled_alike(good: Bool[np.ndarray, "S T ny"]):
    """The rows in which outputs are sampled, and the outputs that are sampled in these."""
    left = list(range(good.shape[2]))
    while left:
        rows = good[..., left[0]]
        same = [i for i in left if np.array_equal(good[..., i], rows)]
        yield rows, same
        left = [i for i in left if i not in same]


def responses_to_starts(
    c: Coefficients, first: Int[np.ndarray, " S"], T: int, K: int
) -> Float[np.ndarray, "S T K"]:
    """The responses to g in each of the first K cycles, of T, in which a record meets a section."""
    place = first[:, None] + np.arange(K)
    impulses = (np.arange(T)[:, None] == place[:, None]).astype(float)
    return along_cycles(c, impulses)


class Delayed(NamedTuple):
    """What inputs leave of the outputs 0, 1, ..., d cycles earlier."""

    gram: Float[np.ndarray, "ny d1 d1"]
    freedom: int
    """The number of independent rows of all outputs: noise of variance 1 makes the sum of the Gram
    matrices that large."""

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "Delayed":
        """The same with each output in units of its noise, which was `noise` units before."""
        return self._replace(gram=self.gram / (noise**2)[:, None, None])


def delayed_outputs(problem: Problem, order: int) -> Delayed:
    """Only from rows whose lagged inputs and outputs are all known."""
    _, T, N, ny = problem.y.shape
    delays = range(order + 1)
    cycle = np.arange(T)[:, None]

    def section(n: int):
        gram, freedom = np.zeros((ny, order + 1, order + 1)), 0
        V = lagged(problem.u, n, problem.lags, problem.lead) @ problem.maps[n]
        known = (cycle >= problem.first[:, n] + problem.free).T[..., None]
        good, y = problem.good[:, :, n], problem.y[:, :, n]
        good = known & np.all([_later(good, j, not problem.free) for j in delays], axis=0)
        for rows, outputs in _sampled_alike(good):
            regression = Regression.make(V, problem.slow[:, :, :0], problem.slow, rows)
            past = np.concatenate([_later(y[..., outputs], j) for j in delays], axis=2)
            Z = regression.solve(past)[1].reshape(-1, order + 1, len(outputs))
            gram[outputs] = np.einsum("rji,rki->ijk", Z, Z)
            freedom += max(regression.freedom, 0) * len(outputs)
        return gram, freedom

    grams, freedoms = zip(*on_all_cores(section, range(N)), strict=True)
    return Delayed(sum(grams), sum(freedoms))


def initial(delayed: Delayed) -> Coefficients:
    """chi y = B u by total least squares, which white noise does not bias."""
    order = delayed.gram.shape[1] - 1
    null = np.linalg.eigh(delayed.gram.sum(axis=0))[1][:, 0]
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
