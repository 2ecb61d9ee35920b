r"""The output-error problem of time series: linear unknowns are eliminated section by section.

With $\chi(q^{-N}) y = B_{n \bmod N}(q^{-1}) u$ and $v = \chi^{-1} u$, filtered from cycle to cycle,

$$y[n] = \sum_r b_{n \bmod N}[r]\, v[n-r] + (\chi^{-1} g)[n] + \varepsilon[n],$$

where g is free in the first cycles of each record: it represents inputs and outputs before the
record. For given c (the coefficients of chi), the unknowns b and g of each section are a linear
regression.

`OutputErrorProblem` has the data of a fit that do not depend on c, and `SectionRegression` the
regression of one section at some c. `linearization.py` and `delayed_outputs.py` call them. If
unknowns are missing or too many, look at `SectionRegression.make`; if data are refused for too few
cycles, at `freedom_left`; if inputs are said to depend on each other, at `_independent`. What
depends on c must stay out of `OutputErrorProblem`, which is made once for a fit.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from ..._core.execution import on_all_cores
from ..._core.text import listed
from ...errors import DefinitionError
from ..descent import ROUNDING, positive, without
from .records import Columns, CycleGrid, PreparedRecords, lagged_inputs


ByInput = Float[np.ndarray, "r *columns"]
"""Coefficients of the inputs, for each column."""
Rows = Float[np.ndarray, "rows *columns"]
"""Columns with the rows of all records one below the other."""

# Singular values of regressors, relative to the largest, below which they are rounding errors.
# Larger: weakly excited combinations are dropped; smaller: rounding errors are fitted.
RANK = 1e-10


class TooFewCycles(DefinitionError):
    """Raised if an output at section n has no degrees of freedom left. `missing`: number of cycles
    that are missing."""

    def __init__(self, problem: Any, n: int, i: int, missing: int):
        self.missing = missing
        super().__init__(
            f"section {n} was sampled {problem.records.sampled[n, i]} times, too few for "
            f"{problem.lags} lags and {problem.free} unknown cycles at the start of each record: "
            f"add {missing} or more cycles, take fewer sections, or lower `order`."
        )


class SectionRegression(NamedTuple):
    """Regressors for those outputs of a section that have the same weights, in one grid (a group of
    records).

    Initial conditions and drift are unknowns of each record, and are projected out here. The
    coefficients of the inputs are common to all grids.
    """

    inputs: Float[np.ndarray, "S T r"]
    starts: Float[np.ndarray, "S T K"]
    """Responses to unknown initial conditions."""
    weight: Float[np.ndarray, "S T 1"]
    """1 for a sample, 0 for a missing one."""
    basis: Float[np.ndarray, "S T k"]
    """Orthonormal basis of the weighted rows of initial conditions and drift, by record."""
    to_starts: Float[np.ndarray, "S k K"]
    """Matrix from coefficients of the basis to coefficients of the initial conditions."""
    remainder: Float[np.ndarray, "rows r"]
    """The weighted rows of the inputs, without their part in the basis."""

    @classmethod
    def make(
        cls,
        inputs: Float[np.ndarray, "S T r"],
        starts: Float[np.ndarray, "S T K"],
        drift: Float[np.ndarray, "S T k"],
        weight: Shaped[np.ndarray, "S T"],
    ) -> "SectionRegression":
        """Return the regression of outputs that are sampled where `weight` is not zero."""
        rows = weight[:, :, None].astype(float)
        unknown = rows * np.concatenate([starts, drift], axis=2)
        basis, size, right = np.linalg.svd(unknown, full_matrices=False)
        kept = size > RANK * size.max(axis=1, initial=0, keepdims=True)
        basis = basis * kept[:, None]
        divisor = np.where(kept, size, 1)
        inverse = np.where(kept, 1 / divisor, 0)[:, None]
        scaled = right.mT * inverse
        to_starts = scaled[:, : starts.shape[2]]
        remainder = without(basis, rows * inputs)
        remainder = remainder.reshape(rows.size, inputs.shape[2])
        return cls(inputs, starts, rows, basis, to_starts, remainder)

    @property
    def dof(self) -> float:
        """Samples less unknown initial conditions and drift."""
        used = (self.weight > 0).sum()
        return float(used - (self.basis**2).sum())

    def reduced(self, x: Columns) -> Rows:
        """Return weighted outputs without their part in the basis."""
        in_columns = x.reshape(*x.shape[:2], -1)
        left = self.weight * in_columns
        for _ in range(2):  # the second time removes rounding errors
            left = without(self.basis, left)
        return left.reshape(len(self.remainder), *x.shape[2:])

    def residual(self, a: ByInput, x: Columns) -> Rows:
        """Return the weighted residuals of outputs x, given coefficients of the inputs."""
        return self.reduced(x) - np.tensordot(self.remainder, a, 1)

    def along(self, rows: Rows) -> ByInput:
        """Return the products of the inputs with weighted rows."""
        return np.tensordot(self.remainder.T, rows, 1)

    def response(self, a: ByInput, x: Columns) -> Columns:
        """Return the response to the inputs with coefficients a, and to the initial conditions that
        fit x best."""
        S, T = x.shape[:2]
        columns = x.reshape(S, T, -1)
        coefficients = a.reshape(len(a), columns.shape[2])
        forced = self.inputs @ coefficients
        left = self.weight * (columns - forced)
        starts = self.to_starts @ (self.basis.mT @ left)
        free = self.starts @ starts
        return (forced + free).reshape(x.shape)


class OutputErrorProblem(NamedTuple):
    """The parts of the problem that do not depend on c."""

    records: PreparedRecords
    lags: int
    """R: numerators have the lags -lead, ..., R - 1 - lead."""
    free: int
    """The number of cycles at the start of each record in which g is free."""
    to_lags: list[Float[np.ndarray, "columns r"]]
    """For each section: the combinations of lagged inputs that are linearly independent."""
    alike: list[list[list[int]]]
    """For each section, the outputs, grouped in lists with equal weights."""
    scale: Float[np.ndarray, " ny"]
    """The units of the outputs."""

    @classmethod
    def from_data(
        cls, records: PreparedRecords, order: int, extra_lags: int, free_start: bool
    ) -> "OutputErrorProblem":
        """**Arguments:** `order`: d. `extra_lags`: lags of the numerators beyond d N. `free_start`:
        whether the state at the start of records is unknown, or zero.

        **Raises:** `DefinitionError` for too few cycles, and for inputs that depend on each other.
        """
        N = records.n_sections
        nu = len(records.inputs)
        lags = records.lead + order * N + extra_lags + 1
        free = order + -(-extra_lags // N) if free_start else 0
        if lags > records.cycles * N:
            raise DefinitionError(
                f"{lags} lags, of one section each, reach beyond the longest record, of "
                f"{records.cycles} cycles of {N} sections: record longer, take fewer sections, or "
                "lower `order`."
            )

        def triangle(n: int):
            rows = []
            for grid in records.grids:
                cycle = np.arange(grid.y.shape[1])
                later = cycle >= grid.first[:, n, None] + free
                is_sampled = grid.sampled[:, :, n].any(axis=2)
                used = is_sampled & later
                lagged = lagged_inputs(grid.u, n, lags, records.lead)
                rows.append(lagged[used])
            return np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))

        # The section with the fewest samples is tested first, before the work on all sections.
        fewest = np.unravel_index(np.argmin(records.sampled), records.sampled.shape)
        n, i = map(int, fewest)
        if records.sampled[n, i] <= lags * nu:
            rows = triangle(n)
            if _independent(rows, nu).shape[1] == len(rows):
                problem = cls(records, lags, free, [], [], records.scale)
                missing = order + 1 - problem.freedom_left(n, i)
                raise TooFewCycles(problem, n, i, missing)
        triangles = on_all_cores(triangle, range(N))
        to_lags = on_all_cores(lambda rows: _independent(rows, nu), triangles)
        _require_different_inputs(records, triangles[0], to_lags[0].shape[1])
        return cls(records, lags, free, to_lags, _alike(records), records.scale)

    @property
    def shape(self) -> tuple[int, int, int]:
        """N, and the numbers of inputs and outputs."""
        return (
            self.records.n_sections,
            len(self.records.inputs),
            len(self.records.outputs),
        )

    def freedom_left(self, n: int, i: int) -> int:
        """Return the samples of an output at a section less all unknowns."""
        starts = (
            len(g.y) * (self.free + g.drift.shape[-1]) for g in self.records.grids
        )
        samples = int(self.records.sampled[n, i])
        unknowns = self.lags * self.shape[1]
        return samples - unknowns - sum(starts)

    def parts(self) -> list[CycleGrid]:
        """Return all grids, with the outputs in units of `scale`."""
        return [grid._replace(y=grid.y / self.scale) for grid in self.records.grids]


def _alike(records: PreparedRecords) -> list[list[list[int]]]:
    """Return the outputs of each section, grouped in lists of outputs that are sampled together."""
    N, ny = records.sampled.shape
    equal = np.ones((N, ny, ny), bool)
    for grid in records.grids:
        for i in range(ny):
            same = grid.sampled == grid.sampled[..., [i]]
            equal[:, i] &= same.all(axis=(0, 1))
    alike = []
    for table in equal:
        rows = np.unique(table, axis=0)[::-1]
        alike.append([np.flatnonzero(row).tolist() for row in rows])
    return alike


def _require_different_inputs(
    records: PreparedRecords, triangle: np.ndarray, rank: int
) -> None:
    """**Raises:** `DefinitionError` for inputs that depend on each other.

    **Arguments:** `triangle`: of the lagged inputs of a section, of this rank.
    """
    nu = len(records.inputs)
    alone = [_independent(triangle[:, i::nu], 1).shape[1] for i in range(nu)]
    # (Numerical ranks of inputs in a narrow band are not exact.)
    most = sum(alone) - min(alone) / 2
    if rank < min(len(triangle), most):
        raise DefinitionError(
            f"{listed(records.inputs)} cannot be told apart: leave out what others determine."
        )


def _independent(triangle: np.ndarray, nu: int) -> np.ndarray:
    """Return the combinations (lags nu, r) of lagged inputs that are linearly independent, from the
    triangular factor of the lagged inputs."""
    # Inputs have units of their own.
    size = np.linalg.norm(triangle.reshape(-1, nu), axis=0)
    lags = triangle.shape[1] // nu
    size = np.tile(positive(size), lags)
    _, values, right = np.linalg.svd(triangle / size, full_matrices=False)
    kept = values > RANK * values.max(initial=0)
    scaled = right[kept].T / values[kept]
    return scaled / size[:, None]


def root_of(gram: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "r k"]:
    """Return a matrix R such that R R^T is the pseudoinverse of a Gram matrix."""
    w, q = np.linalg.eigh(gram)
    kept = w > ROUNDING * w.max(initial=0)
    return q[:, kept] / np.sqrt(w[kept])
