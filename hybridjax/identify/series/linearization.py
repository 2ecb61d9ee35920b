"""The linearized output-error problem at given coefficients c of the denominator: sums over all
records, and the minimum over c.

`fit_series` calls `minimize`, which calls `linearize` at each c. `linearize` fits the numerators of
every section (`SectionFit`), and adds up residuals and their derivatives by c (`Linearization`). A
*grid* is a group of records of similar length (`records.py`). A wrong gradient comes from
`SectionFit.of`, wrong regressors from `_regressions_at`; a descent that ends too early, from
`least_squares` in `descent.py`. All sums here are in units of `OutputErrorProblem.scale`, and must
stay so: `series/fit.py` converts them.
"""

import functools
import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..._core.execution import on_all_cores
from ..descent import ROUGH, Coefficients, least_squares, positive
from .output_error import OutputErrorProblem, SectionRegression, root_of
from .records import (
    CycleGrid,
    delay_cycles,
    divide_by_chi,
    lagged_inputs,
    start_responses,
)


Outputs = Callable[[int, CycleGrid, int], Float[np.ndarray, "S T ny C"]]
"""A function (number of a grid, the grid, section) that returns C columns for each output."""
Regress = Callable[[int, CycleGrid, int], list[SectionRegression]]
"""A function (number of a grid, the grid, section) that returns one regression for each list of
outputs with equal weights."""


class SectionFit(NamedTuple):
    """The best fit of some outputs of a section, with equal weights, and sums over all records."""

    outputs: list[int]
    root: Float[np.ndarray, "r k"]
    """Root of the inverse of the inputs' Gram matrix."""
    coefficients: Float[np.ndarray, "r m C"]
    """Coefficients of the inputs, for C columns of each of m outputs."""
    slopes: Float[np.ndarray, "r d m C"]
    """Derivatives of the coefficients with respect to c."""
    dof: float
    products: Float[np.ndarray, "m C C"]
    """Products of the residuals of different columns."""
    gradient: Float[np.ndarray, "m d"]
    curvature: Float[np.ndarray, "m d d"]

    @classmethod
    def of(
        cls,
        outputs: list[int],
        c: Coefficients,
        regressions: list[SectionRegression],
        columns: list[Float[np.ndarray, "_ _ m C"]],
    ) -> "SectionFit":
        """Fit the columns of all grids.

        The normal equations are solved twice. The second solution removes rounding errors, so that
        the result is as accurate as by a QR decomposition. Derivatives of the residuals omit the
        term that is proportional to the residuals (Kaufman 1975).
        """
        pairs = list(zip(regressions, columns, strict=True))
        root = root_of(_total(r.along(r.remainder) for r in regressions))

        def solve(along: np.ndarray) -> np.ndarray:
            return np.tensordot(root, np.tensordot(root.T, along, 1), 1)

        first = solve(_total(r.along(r.reduced(x)) for r, x in pairs))
        refined = solve(_total(r.along(r.residual(first, x)) for r, x in pairs))
        a = first + refined
        filtered = [r.reduced(filtered_response(first, c, r, x)) for r, x in pairs]
        slopes = solve(_total(map(SectionRegression.along, regressions, filtered)))
        errors = [r.residual(a, x) for r, x in pairs]
        by_c = [r.residual(slopes, filtered_response(a, c, r, x)) for r, x in pairs]
        missed = _total(map(SectionRegression.along, regressions, by_c))
        taken = np.einsum("rimk,rjmk->mij", missed, solve(missed))
        return cls(
            outputs=outputs,
            root=root,
            coefficients=a,
            slopes=slopes,
            dof=sum(r.dof for r in regressions),
            products=_total(np.einsum("rmk,rml->mkl", e, e) for e in errors),
            gradient=_total(map(_along_slopes, by_c, errors)),
            curvature=_total(np.einsum("rimk,rjmk->mij", s, s) for s in by_c) - taken,
        )


def _along_slopes(slopes: np.ndarray, errors: np.ndarray) -> Float[np.ndarray, "m d"]:
    return np.einsum("rjmk,rmk->mj", slopes, errors)


def _total(terms: Iterable[np.ndarray]) -> np.ndarray:
    return functools.reduce(np.add, terms)


def filtered_response(
    a: Float[np.ndarray, "r m C"],
    c: Coefficients,
    regression: SectionRegression,
    x: Float[np.ndarray, "S T m C"],
) -> Float[np.ndarray, "S T d m C"]:
    """Return q^-jN / chi of the fitted outputs, j = 1, ..., d."""
    filtered = divide_by_chi(c, regression.response(a, x))
    S, T = x.shape[:2]
    shape = (S, T, len(c), *x.shape[2:])
    delayed = np.zeros(shape)
    for j in range(len(c)):
        delayed[:, :, j] = delay_cycles(filtered, j + 1)
    return delayed


class Linearization(NamedTuple):
    """Sums of weighted residuals and of their derivatives with respect to c."""

    c: Coefficients
    square: Float[np.ndarray, "N ny"]
    """Sum of the squares of the residuals."""
    gradient: Float[np.ndarray, "ny d"]
    """Sum of the products of residuals and their derivatives, over all sections."""
    curvature: Float[np.ndarray, "ny d d"]
    """Sum of the products of derivatives."""
    dof: Int[np.ndarray, "N ny"]
    """Samples less unknowns."""
    fits: list[list[SectionFit]]
    """The fits of each section."""

    def as_residuals(
        self,
    ) -> tuple[Float[np.ndarray, " d1"], Float[np.ndarray, "d1 d"]]:
        """Return d + 1 residuals and their Jacobian that have the same sums of squares and
        products."""
        values, vectors = np.linalg.eigh(self.curvature.sum(axis=0))
        size = np.sqrt(np.maximum(values, 0))
        along = vectors.T @ self.gradient.sum(axis=0)
        divided = along / positive(size)
        along = np.where(size > 0, divided, 0.0)
        unexplained = self.square.sum() - along @ along
        rest = np.sqrt(max(unexplained, 0.0))
        scaled = size[:, None] * vectors.T
        jacobian = np.pad(scaled, ((0, 1), (0, 0)))
        return np.append(along, rest), jacobian


def measured_outputs(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny 1"]:
    """Return the outputs of a section as one column."""
    return part.y[:, :, n, :, None]


def sum_up(
    problem: OutputErrorProblem, c: Coefficients, outputs: Outputs, regress: Regress
) -> list[list[SectionFit]]:
    """Return the fits of each section. Each list of outputs with equal weights is one
    regression."""
    parts = problem.parts()

    def section(n: int) -> list[SectionFit]:
        regressions = [regress(k, part, n) for k, part in enumerate(parts)]
        columns = [outputs(k, part, n) for k, part in enumerate(parts)]
        fits = []
        for i, alike in enumerate(problem.alike[n]):
            same_weights = [each[i] for each in regressions]
            chosen = [x[:, :, alike] for x in columns]
            fits.append(SectionFit.of(alike, c, same_weights, chosen))
        return fits

    return on_all_cores(section, range(problem.records.n_sections))


def linearize(
    problem: OutputErrorProblem, c: Coefficients, outputs: Outputs = measured_outputs
) -> Linearization:
    """Return the sums of all residuals and their derivatives with respect to c.

    **Arguments:** `outputs`: columns to take in place of the measured outputs.
    """
    N, _, ny = problem.shape
    d = len(c)
    out = Linearization(
        c=c,
        square=np.zeros((N, ny)),
        gradient=np.zeros((ny, d)),
        curvature=np.zeros((ny, d, d)),
        dof=np.zeros((N, ny), int),
        fits=sum_up(problem, c, outputs, _regressions_at(problem, c)),
    )
    for n, section in enumerate(out.fits):
        for fit in section:
            out.square[n, fit.outputs] = np.linalg.trace(fit.products)
            out.gradient[fit.outputs] += fit.gradient
            out.curvature[fit.outputs] += fit.curvature
            columns = fit.root.shape[1]
            out.dof[n, fit.outputs] = round(fit.dof) - columns
    return out


def _regressions_at(problem: OutputErrorProblem, c: Coefficients) -> Regress:
    """Return a function for the regressions of a section at c, on inputs divided by chi."""
    inputs = [divide_by_chi(c, part.u) for part in problem.parts()]

    def regress(k: int, part: CycleGrid, n: int) -> list[SectionRegression]:
        columns = lagged_inputs(inputs[k], n, problem.lags, problem.records.lead)
        rows = columns @ problem.to_lags[n]
        T = part.y.shape[1]
        free = min(problem.free, T)
        starts = start_responses(c, part.first[:, n], T, free)
        regressions = []
        for alike in problem.alike[n]:
            sampled = part.sampled[:, :, n, alike[0]]
            regressions.append(
                SectionRegression.make(rows, starts, part.drift, sampled)
            )
        return regressions

    return regress


def each_fit(
    problem: OutputErrorProblem,
    solution: Linearization,
    work: Callable[[int, CycleGrid, int, SectionFit, SectionRegression], Any],
) -> list[list[Any]]:
    """Return, for each grid, the results of `work` at all sections and lists of outputs."""
    parts = problem.parts()
    regress = _regressions_at(problem, solution.c)
    sections = range(problem.records.n_sections)

    def section(k: int, n: int) -> list[Any]:
        regressions = regress(k, parts[k], n)
        pairs = zip(solution.fits[n], regressions, strict=True)
        return [work(k, parts[k], n, *pair) for pair in pairs]

    results = []
    for k in range(len(parts)):
        by_section = on_all_cores(functools.partial(section, k), sections)
        results.append(list(itertools.chain(*by_section)))
    return results


def minimize(
    problem: OutputErrorProblem, start: Coefficients, rough: bool = False
) -> tuple[Linearization, bool]:
    """Return the problem at the c with the least sum of squares, and whether the descent has
    converged.

    **Arguments:** `rough`: whether to stop when noise of variance one could explain the next step.
    """
    last: list[Linearization] = []

    def at(c: Coefficients) -> Linearization:
        if not last or not np.array_equal(c, last[0].c):
            last[:] = [linearize(problem, c)]
        return last[0]

    limits = ROUGH if rough else {}
    c, converged = least_squares(lambda c: at(c).as_residuals(), start, **limits)
    return at(c), converged
