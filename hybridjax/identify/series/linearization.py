"""What numerators and free starts leave of outputs at some c, and its derivative in c: sums over
all records."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..descent import Coefficients
from .cycle_filters import divide_by_chi
from .output_error import OutputErrorProblem, Part, in_passes
from .section_regression import SectionRegression, root_of


class SectionFit(NamedTuple):
    """What fits some outputs of a section, those with the same weights, best."""

    outputs: list[int]
    root: Float[np.ndarray, "r k"]
    """Of the inverse of the inputs' Gram matrix."""
    coefficients: Float[np.ndarray, "r m C"]
    """Of the inputs, for C columns of each of m outputs."""
    slopes: Float[np.ndarray, "r d m C"]
    """Their derivatives in c."""

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "SectionFit":
        """That of the problem with each output in units of its noise."""
        unit = noise[self.outputs, None]
        coefficients, slopes = self.coefficients / unit, self.slopes / unit
        return self._replace(coefficients=coefficients, slopes=slopes)

    @property
    def first(self) -> "SectionFit":
        """That of the first column."""
        return self._replace(coefficients=self.coefficients[..., :1], slopes=self.slopes[..., :1])

    def errors(
        self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]
    ) -> Float[np.ndarray, "rows m C"]:
        """Residuals, weighted."""
        return _left(self.coefficients, regression, x)

    def samples(
        self, c: Coefficients, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]
    ) -> tuple[Float[np.ndarray, "rows m C"], Float[np.ndarray, "rows d m C"]]:
        """Errors and their derivatives in c, which omit what vanishes with the
        residuals (Kaufman 1975): q^-jN / chi of what was fitted, less what fits that."""
        left = self.errors(regression, x)
        slopes = _reduced(regression, _fitted(self.coefficients, c, regression, x))
        slopes = slopes - np.tensordot(regression.remainder, self.slopes, 1)
        return left, slopes


class Linearization(NamedTuple):
    """Sums of weighted residuals and of their derivatives in c."""

    c: Coefficients
    square: Float[np.ndarray, "N ny"]
    """Sum of the squares of the residuals."""
    gradient: Float[np.ndarray, "ny d"]
    """Sum of the products of residuals and their derivatives, over all sections."""
    curvature: Float[np.ndarray, "ny d d"]
    """Sum of the products of derivatives."""
    freedom: Int[np.ndarray, "N ny"]
    """Samples less unknowns."""
    numerators: Float[np.ndarray, "N columns ny"]
    """Of the first column of outputs; rows are lags, then inputs."""
    slope: Float[np.ndarray, "d N columns ny"]
    """Their derivative with respect to c."""
    roots: list[list[Float[np.ndarray, "columns r"]]]
    """root @ root.T is the covariance of the numerators of a section and output, given c."""
    fits: list[list[SectionFit]]
    """Of each section."""

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "Linearization":
        """That of the problem with each output in units of its noise."""
        return self._replace(
            square=self.square / noise**2,
            gradient=self.gradient / noise[:, None] ** 2,
            curvature=self.curvature / noise[:, None, None] ** 2,
            numerators=self.numerators / noise,
            slope=self.slope / noise,
            fits=[[fit.rescale(noise) for fit in fits] for fits in self.fits],
        )

    def as_residuals(self) -> tuple[Float[np.ndarray, " d1"], Float[np.ndarray, "d1 d"]]:
        """d + 1 residuals with their Jacobian that have the same sums."""
        values, vectors = np.linalg.eigh(self.curvature.sum(axis=0))
        size = np.sqrt(np.maximum(values, 0))
        along = vectors.T @ self.gradient.sum(axis=0)
        along = np.where(size > 0, along / np.where(size > 0, size, 1), 0.0)
        rest = np.sqrt(max(self.square.sum() - along @ along, 0.0))
        jacobian = np.concatenate([size[:, None] * vectors.T, np.zeros((1, len(size)))])
        return np.append(along, rest), jacobian


def linearize(
    problem: OutputErrorProblem,
    c: Coefficients,
    outputs: Callable[[int, Part, int], Float[np.ndarray, "S T ny C"]] | None = None,
) -> Linearization:
    """All residuals and their derivatives in c, in three passes.

    **Arguments:** `outputs`: other ones than those measured, C of each, of the number and the data
    of a part and a section.
    """
    N, nu, ny = problem.shape
    d, columns = len(c), problem.lags * nu
    sums = [[_Sums(some, c) for some in alike] for alike in problem.alike]

    def of(work):
        def section(k, part, n, regressions):
            y = part.y[:, :, n, :, None] if outputs is None else outputs(k, part, n)
            for one, regression in zip(sums[n], regressions, strict=True):
                work(one, regression, y[:, :, one.outputs])

        return section

    passes = [of(work) for work in (_Sums.begin, _Sums.refine, _Sums.finish)]
    in_passes(problem, passes, *regressions_at(problem, c))
    found = Linearization(
        c=c,
        square=np.zeros((N, ny)),
        gradient=np.zeros((ny, d)),
        curvature=np.zeros((ny, d, d)),
        freedom=np.zeros((N, ny), int),
        numerators=np.zeros((N, columns, ny)),
        slope=np.zeros((d, N, columns, ny)),
        roots=[[np.zeros((0, 0))] * ny for _ in range(N)],
        fits=[[one.fit for one in some] for some in sums],
    )
    for n, (some, to_lags) in enumerate(zip(sums, problem.to_lags, strict=True)):
        for one in some:
            which, fit = one.outputs, one.fit
            found.square[n, which] = one.square
            found.gradient[which] += one.gradient
            found.curvature[which] += one.curvature
            found.freedom[n, which] = round(one.freedom) - fit.root.shape[1]
            found.numerators[n][:, which] = to_lags @ fit.coefficients[..., 0]
            slope = np.moveaxis(fit.slopes[..., 0], 1, 0)
            found.slope[:, n][..., which] = to_lags @ slope
            for i in which:
                found.roots[n][i] = to_lags @ fit.root
    return found


def regressions_at(problem: OutputErrorProblem, c: Coefficients):
    """What `in_passes` takes to make the regressions of each section at c."""

    def regress(part, v, n):
        return [problem.regression(part, v, c, n, some[0]) for some in problem.alike[n]]

    return regress, lambda part: divide_by_chi(c, part.u)


def each_part(
    problem: OutputErrorProblem,
    found: Linearization,
    work: Callable[[int, Part, int, SectionFit, SectionRegression], Any],
    collect: Callable[[int, list[list[Any]]], None],
) -> None:
    """One more pass, with what was found: `work` for each part (its number first), section and list
    of outputs, and `collect` for each part with its number and what came out."""

    def section(k, part, n, regressions):
        pairs = zip(found.fits[n], regressions, strict=True)
        return [work(k, part, n, fit, regression) for fit, regression in pairs]

    in_passes(problem, [section], *regressions_at(problem, found.c), collect)


class _Sums:
    """What the passes add up for some outputs of a section.

    Each pass solves with the sums of the one before, and the last corrects what rounding has left:
    so the result is as accurate as that of one array.
    """

    def __init__(self, outputs: list[int], c: Coefficients):
        self.outputs, self.c = outputs, c
        self.gram: Any = 0.0
        self.freedom = 0.0
        self._along: Any = 0.0
        self._along_left: Any = 0.0
        self._along_slopes: Any = 0.0
        self._along_last: Any = 0.0
        self._root: Any = None
        self._fit: SectionFit | None = None
        self.square: Any = 0.0
        self.gradient: Any = 0.0
        self._curvature: Any = 0.0

    def begin(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        self.gram = self.gram + regression.gram
        self.freedom += regression.freedom
        self._along = self._along + _along(regression, _reduced(regression, x))

    def refine(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        if self._root is None:
            self._root = root_of(self.gram)
            self._along = self._solved(self._along)
        self._along_left += _along(regression, _left(self._along, regression, x))
        fitted = _fitted(self._along, self.c, regression, x)
        self._along_slopes += _along(regression, _reduced(regression, fitted))

    def finish(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        left, slopes = self.fit.samples(self.c, regression, x)
        self._along_last += _along(regression, slopes)
        self.square += (left**2).sum(axis=(0, 2))
        self.gradient += np.einsum("rjmk,rmk->mj", slopes, left)
        self._curvature += np.einsum("rimk,rjmk->mij", slopes, slopes)

    @property
    def fit(self) -> SectionFit:
        """After the second pass."""
        if self._fit is None:
            a = self._along + self._solved(self._along_left)
            slopes = self._solved(self._along_slopes)
            self._fit = SectionFit(self.outputs, self._root, a, slopes)
        return self._fit

    @property
    def curvature(self) -> Float[np.ndarray, "m d d"]:
        """After the last one."""
        missed = self._solved(self._along_last)
        return self._curvature - np.einsum("rimk,rjmk->mij", self._along_last, missed)

    def _solved(self, along: np.ndarray) -> np.ndarray:
        return np.tensordot(self._root, np.tensordot(self._root.T, along, 1), 1)


def _left(a: np.ndarray, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]):
    return _reduced(regression, x) - np.tensordot(regression.remainder, a, 1)


def _reduced(regression: SectionRegression, x: np.ndarray) -> np.ndarray:
    """Columns (S, T, ...), by row."""
    flat = x.reshape(*x.shape[:2], -1)
    return regression.reduced(flat).reshape(-1, *x.shape[2:])


def _along(regression: SectionRegression, left: np.ndarray) -> np.ndarray:
    return np.tensordot(regression.remainder.T, left, 1)


def _fitted(
    a: Float[np.ndarray, "r m C"], c: Coefficients, regression: SectionRegression, x: np.ndarray
) -> Float[np.ndarray, "S T d m C"]:
    """What was fitted, later and filtered."""
    flat = x.reshape(*x.shape[:2], -1)
    fitted = regression.response(a.reshape(len(a), -1), flat).reshape(x.shape)
    return np.stack([divide_by_chi(c, fitted, j) for j in range(1, len(c) + 1)], axis=2)
