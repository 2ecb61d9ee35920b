"""The linearized output-error problem at some c: sums over all records, and its minimum in c."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..descent import Coefficients, least_squares
from .output_error import OutputErrorProblem, SectionRegression, in_passes, root_of
from .records import CycleGrid, divide_by_chi


Outputs = Callable[[int, CycleGrid, int], Float[np.ndarray, "S T ny C"]]
"""C columns for each output, as a function of the number of a grid, the grid and a section."""
Regress = Callable[[CycleGrid, Any, int], list[SectionRegression]]


class SectionFit(NamedTuple):
    """The best fit of some outputs of a section, with equal weights."""

    outputs: list[int]
    root: Float[np.ndarray, "r k"]
    """Root of the inverse of the inputs' Gram matrix."""
    coefficients: Float[np.ndarray, "r m C"]
    """Coefficients of the inputs, for C columns of each of m outputs."""
    slopes: Float[np.ndarray, "r d m C"]
    """Their derivatives with respect to c."""

    @property
    def first(self) -> "SectionFit":
        """The fit of the first column."""
        return self._replace(coefficients=self.coefficients[..., :1], slopes=self.slopes[..., :1])

    def samples(
        self, c: Coefficients, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]
    ) -> tuple[Float[np.ndarray, "rows m C"], Float[np.ndarray, "rows d m C"]]:
        """Return the weighted residuals and their derivatives with respect to c.

        The derivatives omit the term that vanishes with the residuals (Kaufman 1975).
        """
        fitted = filtered_response(self.coefficients, c, regression, x)
        left = regression.residual(self.coefficients, x)
        return left, regression.residual(self.slopes, fitted)


class SectionSums:
    """Sums over all records for some outputs of a section, in three passes.

    Each pass solves with the sums of the previous ones, and the last removes rounding errors: the
    result is as accurate as that of one QR decomposition.
    """

    def __init__(self, outputs: list[int], c: Coefficients):
        self.outputs, self._c = outputs, c
        self._gram: Any = 0.0
        self._along: Any = 0.0
        self._along_left: Any = 0.0
        self._along_slopes: Any = 0.0
        self._along_last: Any = 0.0
        self._curvature: Any = 0.0
        self.freedom = 0.0
        self.products: Any = 0.0
        """(m, C, C): products of the residuals of different columns."""
        self.gradient: Any = 0.0

    def begin(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        self._gram = self._gram + regression.along(regression.remainder)
        self._along = self._along + regression.along(regression.reduced(x))
        self.freedom += regression.freedom

    def refine(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        left = regression.residual(self._first, x)
        fitted = filtered_response(self._first, self._c, regression, x)
        self._along_left = self._along_left + regression.along(left)
        self._along_slopes = self._along_slopes + regression.along(regression.reduced(fitted))

    def finish(self, regression: SectionRegression, x: Float[np.ndarray, "S T m C"]) -> None:
        left, slopes = self.fit.samples(self._c, regression, x)
        self._along_last = self._along_last + regression.along(slopes)
        self.products = self.products + np.einsum("rmk,rml->mkl", left, left)
        self.gradient = self.gradient + np.einsum("rjmk,rmk->mj", slopes, left)
        self._curvature = self._curvature + np.einsum("rimk,rjmk->mij", slopes, slopes)

    @cached_property
    def _root(self) -> Float[np.ndarray, "r k"]:
        return root_of(self._gram)

    @cached_property
    def _first(self) -> Float[np.ndarray, "r m C"]:
        return self._solved(self._along)

    @cached_property
    def fit(self) -> SectionFit:
        """The fit, after the second pass."""
        a = self._first + self._solved(self._along_left)
        return SectionFit(self.outputs, self._root, a, self._solved(self._along_slopes))

    @property
    def curvature(self) -> Float[np.ndarray, "m d d"]:
        """The products of derivatives, after the last pass."""
        missed = self._solved(self._along_last)
        return self._curvature - np.einsum("rimk,rjmk->mij", self._along_last, missed)

    def _solved(self, along: np.ndarray) -> np.ndarray:
        return np.tensordot(self._root, np.tensordot(self._root.T, along, 1), 1)


def filtered_response(
    a: Float[np.ndarray, "r m C"],
    c: Coefficients,
    regression: SectionRegression,
    x: Float[np.ndarray, "S T m C"],
) -> Float[np.ndarray, "S T d m C"]:
    """Return q^-jN / chi of the fitted outputs, j = 1, ..., d."""
    fitted = regression.response(a, x)
    out = np.zeros((*x.shape[:2], len(c), *x.shape[2:]))
    for j in range(len(c)):
        out[:, :, j] = divide_by_chi(c, fitted, j + 1)
    return out


class Linearization(NamedTuple):
    """Sums of weighted residuals and of their derivatives with respect to c."""

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
    """Numerators of the first column of outputs; rows are lags, then inputs."""
    slope: Float[np.ndarray, "d N columns ny"]
    """Their derivative with respect to c."""
    roots: list[list[Float[np.ndarray, "columns r"]]]
    """root @ root.T is the covariance of the numerators of a section and output, given c."""
    fits: list[list[SectionFit]]
    """The fits of each section."""

    def as_residuals(self) -> tuple[Float[np.ndarray, " d1"], Float[np.ndarray, "d1 d"]]:
        """Return d + 1 residuals with their Jacobian that have the same sums."""
        values, vectors = np.linalg.eigh(self.curvature.sum(axis=0))
        size = np.sqrt(np.maximum(values, 0))
        along = vectors.T @ self.gradient.sum(axis=0)
        along = np.where(size > 0, along / np.where(size > 0, size, 1), 0.0)
        last = np.sqrt(max(self.square.sum() - along @ along, 0.0))
        jacobian = np.concatenate([size[:, None] * vectors.T, np.zeros((1, len(size)))])
        return np.append(along, last), jacobian


def measured_outputs(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny 1"]:
    """Return the outputs of a section as one column."""
    return part.y[:, :, n, :, None]


def sum_up(
    problem: OutputErrorProblem,
    c: Coefficients,
    outputs: Outputs,
    regress: Regress,
    prepare: Callable[[CycleGrid], Any],
) -> list[list[SectionSums]]:
    """Return the sums of each section, with one regression for each list of outputs."""
    sums = [[SectionSums(outputs, c) for outputs in alike] for alike in problem.alike]

    def of(work: Callable) -> Callable:
        def section(k, part, n, regressions):
            y = outputs(k, part, n)
            for each, regression in zip(sums[n], regressions, strict=True):
                work(each, regression, y[:, :, each.outputs])

        return section

    passes = [of(work) for work in (SectionSums.begin, SectionSums.refine, SectionSums.finish)]
    in_passes(problem, passes, regress, prepare)
    return sums


def linearize(
    problem: OutputErrorProblem, c: Coefficients, outputs: Outputs = measured_outputs
) -> Linearization:
    """Return the sums of all residuals and their derivatives with respect to c.

    **Arguments:** `outputs`: columns to take in place of the measured outputs.
    """
    N, nu, ny = problem.shape
    d, columns = len(c), problem.lags * nu
    sums = sum_up(problem, c, outputs, *_regressions_at(problem, c))
    out = Linearization(
        c=c,
        square=np.zeros((N, ny)),
        gradient=np.zeros((ny, d)),
        curvature=np.zeros((ny, d, d)),
        freedom=np.zeros((N, ny), int),
        numerators=np.zeros((N, columns, ny)),
        slope=np.zeros((d, N, columns, ny)),
        roots=[[np.zeros((0, 0))] * ny for _ in range(N)],
        fits=[[each.fit for each in section] for section in sums],
    )
    for n, (section, to_lags) in enumerate(zip(sums, problem.to_lags, strict=True)):
        for each in section:
            which, fit = each.outputs, each.fit
            out.square[n, which] = np.trace(each.products, axis1=1, axis2=2)
            out.gradient[which] += each.gradient
            out.curvature[which] += each.curvature
            out.freedom[n, which] = round(each.freedom) - fit.root.shape[1]
            out.numerators[n][:, which] = to_lags @ fit.coefficients[..., 0]
            out.slope[:, n][..., which] = to_lags @ np.moveaxis(fit.slopes[..., 0], 1, 0)
            for i in which:
                out.roots[n][i] = to_lags @ fit.root
    return out


def _regressions_at(problem: OutputErrorProblem, c: Coefficients) -> tuple[Regress, Callable]:
    def regress(part: CycleGrid, v: np.ndarray, n: int) -> list[SectionRegression]:
        return [problem.regression(part, v, c, n, alike[0]) for alike in problem.alike[n]]

    return regress, lambda part: divide_by_chi(c, part.u)


def each_part(
    problem: OutputErrorProblem,
    solution: Linearization,
    work: Callable[[int, CycleGrid, int, SectionFit, SectionRegression], Any],
    collect: Callable[[int, list[Any]], None],
) -> None:
    """Go through all grids, sections and lists of outputs once more, with the fits of a solution.

    **Arguments:** `collect`: takes the number of each grid and the results of `work`.
    """

    def section(k, part, n, regressions):
        pairs = zip(solution.fits[n], regressions, strict=True)
        return [work(k, part, n, fit, regression) for fit, regression in pairs]

    def flat(k, results):
        collect(k, [x for section in results for x in section])

    in_passes(problem, [section], *_regressions_at(problem, solution.c), flat)


def minimize(
    problem: OutputErrorProblem, start: Coefficients, max_steps: int
) -> tuple[Coefficients, Linearization, bool]:
    """Return the c that minimizes the sum of squares, the problem there, and whether it settled."""
    last: list[Linearization] = []

    def at(c: Coefficients) -> Linearization:
        if not last or c is not last[0].c:
            last[:] = [linearize(problem, c)]
        return last[0]

    c, converged = least_squares(lambda c: at(c).as_residuals(), start, max_steps)
    return c, at(c), converged
