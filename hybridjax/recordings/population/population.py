"""`Population`: estimates of several subjects, with their errors, and what they say together."""

from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from scipy import stats

from ..._core.arguments import Numbers
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import (
    Count,
    ExperimentCount,
    OptionalNames,
    Positive,
    Probability,
    Seed,
)
from ..._core.boundary.values import Reals
from ...errors import DefinitionError
from .planning import Allocation, allocate, power_of
from .quantities import Fit, Quantity, fit_of, measured
from .reml import Cells, meta, mixed, moderated, spread_interval
from .summary import PopulationTable, table_of
from .table import Columns, as_columns, cells_of, require_subjects, rows_with


Values = Annotated[Numbers, Reals("rows")]


_NONE: tuple[float, ...] = (np.nan, np.nan, np.nan)


class Selection(NamedTuple):
    """One estimate for each subject and cell; several trials are averaged by their precision."""

    y: np.ndarray
    v: np.ndarray
    subject: np.ndarray
    cell: np.ndarray
    covariates: np.ndarray


@checked
class Population:
    r"""Estimates of several subjects, each with its own error.

    The model is $\theta_s = \mu + b_s + e_s$: $e_s$ has the standard error of the estimate, and
    $b_s$ an unknown variance between subjects, estimated by restricted maximum likelihood.

    **Arguments:**

    - `table`: columns by name, or a data frame, with a row for each estimate. `subject` is
      required. `condition` (each subject may have several) and `group` (each subject has one) are
      factors; other columns with numbers can be covariates. Rows with the same subject, group and
      condition are trials.
    - `values`, `errors`: by name of a quantity, an estimate and its standard error in each row.
    - `units`: by name of a quantity. Default: none.
    - `freedom`: degrees of freedom of the errors, in each row. Where they are few, errors are
      moderated by those of the other subjects (Smyth 2004), with the trend of the column `strides`
      if there is one. Default: infinite.

    **Raises:** `DefinitionError` for a table without subjects, columns of different lengths, a
    subject in two groups, or errors that are not positive.
    """

    def __init__(
        self,
        table: Columns,
        values: Mapping[str, Values],
        errors: Mapping[str, Values],
        units: Mapping[str, str] | None = None,
        freedom: Annotated[Numbers, Reals("rows", infinite=True, sign="positive")] | None = None,
    ):
        if not values or set(values) != set(errors):
            raise DefinitionError("`values` and `errors` must hold the same quantities.")
        rows = len(np.asarray(next(iter(values.values()))))
        columns = as_columns(table, rows)
        for name in values:
            if not len(values[name]) == len(errors[name]) == rows:
                raise DefinitionError(f"`values` and `errors` of '{name}' must have {rows} rows.")
            bad = ~(np.asarray(errors[name]) > 0)
            if bad.any():
                subject = columns["subject"][bad.argmax()]
                raise DefinitionError(
                    f"the standard error of '{name}' of subject '{subject}' must be positive: "
                    "leave out estimates without an error."
                )
        self.table, self.units = columns, dict.fromkeys(values, "") | dict(units or {})
        self.values, self.errors = dict(values), dict(errors)
        self.freedom = np.full(rows, np.inf) if freedom is None else np.asarray(freedom, float)

    @classmethod
    def from_fits(
        cls, fits: Sequence[Fit], table: Columns, quantities: Sequence[Quantity] = ("modulus",)
    ) -> "Population":
        """Return the population of some fits, with a row of the table for each.

        **Arguments:** `fits`: estimates of multipliers, or results of `identify_recording`.
        `quantities`: "modulus" and "angle" (rad, upper half plane) of the leading multiplier,
        "coefficients" c1, c2, ... of the characteristic polynomial, "period" (s, of results of
        `identify_recording`; the error assumes independent cycles). Default: the modulus.

        **Raises:** `DefinitionError` for a fit without covariance, outputs or units that differ,
        coefficients of different orders, and the angle of a real multiplier.
        """
        columns = as_columns(table, len(fits))
        freedom = [fit_of(x).covariance_freedom for x in fits]
        return cls(columns, *measured(fits, list(columns["subject"]), quantities), freedom)

    def __repr__(self) -> str:
        subjects, cells = self.table["subject"], cells_of(self.table)
        count = {c: len(set(subjects[cells == c])) for c in dict.fromkeys(cells)}
        listed = "; ".join(f"{c}: {n} subjects" for c, n in count.items())
        return f"Population({', '.join(self.values)}; {listed}; {len(subjects)} estimates)"

    def mean(
        self, quantity: str, *, covariates: OptionalNames = (), level: Probability = 0.95
    ) -> PopulationTable:
        """Return the mean over subjects, and the spread between them, in each group and condition.

        Intervals of the mean, and of the slopes of covariates, are those of Hartung and Knapp
        (2001, 2003); those of the spread (a standard deviation, without the errors of the
        estimates) follow from the Q profile (Viechtbauer 2007). With covariates, the mean is that
        at the mean of each covariate.

        **Raises:** `DefinitionError` for an unknown quantity or covariate, and for too few
        subjects.
        """
        chosen = self._select(quantity, None, covariates)
        require_subjects(chosen.cell, chosen.subject, 2 + len(covariates))
        rows = []
        for cell in dict.fromkeys(chosen.cell):
            y, v, _, _, extra = (x[chosen.cell == cell] for x in chosen)
            x = np.column_stack([np.ones(len(y)), extra - extra.mean(axis=0)])
            fit = meta(y, v, x)
            spread = (np.sqrt(fit.variance), *spread_interval(y, v, x, level))
            for k, effect in enumerate(["mean", *(f"slope of {c}" for c in covariates)]):
                name = effect if cell == "all" else f"{effect}, {cell}"
                error = np.sqrt(fit.covariance[k, k])
                rows.append(
                    self._row(quantity, name, len(y), fit.coefficients[k], error, fit.freedom,
                              level, _NONE if k else spread, test=k > 0)
                )  # fmt: skip
        return table_of(
            rows,
            f"Means of {quantity} over subjects were estimated by restricted maximum likelihood "
            "from the estimate and the standard error of each subject (random-effects model), with "
            f"{100 * level:g} % intervals after Hartung and Knapp; intervals of the standard "
            "deviation between subjects follow from the Q profile.",
        )

    def difference(
        self,
        quantity: str,
        a: str,
        b: str,
        *,
        covariates: OptionalNames = (),
        level: Probability = 0.95,
    ) -> PopulationTable:
        """Return the mean difference a - b of two conditions or two groups, and test it.

        Differences are paired in subjects that have both; subjects with one of them count, too.
        The variances between subjects may differ in each group and condition. Covariance and
        degrees of freedom are those of Kenward and Roger (1997). If the table also has the other
        factor, the difference is averaged over it.

        **Arguments:** `covariates`: columns with common slopes. Default: none.

        **Raises:** `DefinitionError` as `mean`, and for labels that the table does not have.
        """
        factor, rows = rows_with(self.table, (a, b))
        chosen = self._select(quantity, rows, covariates)
        require_subjects(chosen.cell, chosen.subject)
        names = list(dict.fromkeys(chosen.cell))
        subjects = list(dict.fromkeys(chosen.subject))
        grid = _grid(chosen, subjects, names)
        fit = mixed(grid)
        cells = cells_of(self.table)
        side = np.array([self.table[factor][rows & (cells == name)][0] == a for name in names])
        weights = np.where(side, 1 / side.sum(), -1 / (~side).sum())
        weights = np.append(weights, np.zeros(len(covariates)))
        paired = grid.present.all(axis=1)
        spread = _NONE
        if len(names) == 2 and paired.sum() > 2:
            d, v = grid.y[paired] @ weights[:2], grid.v[paired].sum(axis=1)
            bounds = spread_interval(d, v, np.ones((len(d), 1)), level)
            spread = float(np.sqrt(weights[:2] @ fit.between @ weights[:2])), *bounds
        results = []
        for k, name in enumerate([f"{a} - {b}", *(f"slope of {c}" for c in covariates)]):
            w = weights if k == 0 else np.eye(len(weights))[len(names) + k - 1]
            results.append(
                self._row(quantity, name, len(subjects), w @ fit.coefficients,
                          np.sqrt(w @ fit.covariance @ w), fit.freedom(w), level,
                          _NONE if k else spread, test=True)
            )  # fmt: skip
        design = f"{paired.sum()} of them in all conditions" if paired.any() else "in groups"
        return table_of(
            results,
            f"The difference of {quantity} ({a} - {b}; {len(subjects)} subjects, {design}) "
            "was tested in a linear mixed model with the known variance "
            "of each estimate and free variances between subjects (restricted maximum likelihood), "
            f"with standard errors and degrees of freedom after Kenward and Roger and "
            f"{100 * level:g} % intervals.",
        )

    def predictions(self, quantity: str, *, level: Probability = 0.95) -> PopulationTable:
        """Return the best linear unbiased prediction of each subject: its estimate, shrunken
        towards the mean of its group and condition the more, the larger its error.

        Standard errors contain those of the mean and of the variance between subjects (Prasad and
        Rao 1990).

        **Raises:** `DefinitionError` as `mean`; three subjects are needed.
        """
        chosen = self._select(quantity, None, ())
        require_subjects(chosen.cell, chosen.subject, 3)
        rows = []
        for cell in dict.fromkeys(chosen.cell):
            y, v, subject, _, _ = (x[chosen.cell == cell] for x in chosen)
            fit = meta(y, v, np.ones((len(y), 1)))
            share = fit.variance / (fit.variance + v)
            value = fit.coefficients[0] + share * (y - fit.coefficients[0])
            square = share * v + (1 - share) ** 2 * fit.covariance[0, 0]
            square += 2 * v**2 / (v + fit.variance) ** 3 * fit.variance_error**2
            reach = stats.t.ppf((1 + level) / 2, fit.freedom) * np.sqrt(square)
            columns = (y, np.sqrt(v), value, np.sqrt(square), value - reach, value + reach)
            names = "estimate standard_error prediction prediction_error low high".split()
            for name, *numbers in zip(subject, *columns, strict=True):
                first = {"quantity": quantity, "unit": self.units[quantity], "subject": name}
                rows.append(first | {"cell": cell} | dict(zip(names, numbers, strict=True)))
        return table_of(
            rows,
            f"Single subjects are best linear unbiased predictions of {quantity} (shrunken towards "
            "the mean), with standard errors after Prasad and Rao.",
        )

    def power(
        self,
        quantity: str,
        difference: float,
        subjects: Sequence[Count] = (8, 12, 16, 24),
        *,
        labels: Sequence[str] | None = None,
        draws: ExperimentCount = 400,
        level: Probability = 0.05,
        seed: Seed = 0,
    ) -> PopulationTable:
        """Return the power of tests of a difference, by simulation of populations like this pilot.

        Simulated subjects have the spread of the pilot, and standard errors drawn from its own.
        With `labels` of two conditions the test is that of paired differences; without labels, that
        of two groups of the pilot's spread, with `subjects` in each.

        **Arguments:** `difference`: true difference, in units of the quantity. `subjects`: their
        numbers. `level`: that of the test. Default: 0.05.

        **Returns:** power at the pilot's spread, with a 95 % interval that contains the error of
        the simulation and the interval of the spread.

        **Raises:** `DefinitionError` as `difference`, and if xarray is not installed.
        """
        if labels is None:
            chosen = self._select(quantity, None, ())
            if len(set(chosen.cell)) > 1:
                raise DefinitionError("`labels` must be two conditions of the table.")
            require_subjects(chosen.cell, chosen.subject, 3)
            y, v = chosen.y, chosen.v
        else:
            a, b = labels
            _, rows = rows_with(self.table, (a, b))
            chosen = self._select(quantity, rows, ())
            names = list(dict.fromkeys(chosen.cell))
            grid = _grid(chosen, list(dict.fromkeys(chosen.subject)), names)
            both = grid.present.all(axis=1)
            if len(names) != 2 or both.sum() < 3:
                raise DefinitionError(f"fewer than three subjects have both '{a}' and '{b}'.")
            y, v = grid.y[both] @ np.array([1.0, -1.0]), grid.v[both].sum(axis=1)
        rows = power_of(y, v, difference, subjects, labels is not None, draws, level, seed)
        design = "two groups" if labels is None else "paired differences"
        return table_of(
            rows,
            f"The power to detect a difference of {difference:g} in {quantity} ({design}) was "
            f"computed from {draws} simulated populations with the spread and the standard errors "
            f"of a pilot of {len(y)} subjects.",
        )

    def allocation(
        self, quantity: str, subject_cost: Positive = 1.0, trial_cost: Positive = 1.0,
        stride_cost: Positive = 0.01,
    ) -> Allocation:  # fmt: skip
        """Return the numbers of strides and trials that give the mean its smallest variance for a
        given cost, from the table's column `strides` (closed form: Cochran, *Sampling Techniques*,
        1977, ch. 10).

        **Arguments:** costs of one more subject, trial and stride, in the same unit. Default: 1, 1
        and 0.01.

        **Raises:** `DefinitionError` without a column `strides`, and as `mean`.
        """
        self._require(quantity, ("strides",))
        cells, costs = cells_of(self.table), (subject_cost, trial_cost, stride_cost)
        chosen = self._select(quantity, None, ())
        require_subjects(chosen.cell, chosen.subject, 3)
        each = [chosen.cell == cell for cell in dict.fromkeys(chosen.cell)]
        between = np.mean([
            meta(chosen.y[i], chosen.v[i], np.ones((i.sum(), 1))).variance for i in each
        ])  # fmt: skip
        who = np.char.add(np.char.add(self.table["subject"], "\n"), cells)
        y, v = self.values[quantity], self._variance(quantity)
        return allocate(y, v, self.table["strides"].astype(float), who, float(between), costs)

    def _require(self, quantity: str, columns: Sequence[str]) -> None:
        if quantity not in self.values:
            listed = ", ".join(self.values)
            raise DefinitionError(f"there is no quantity '{quantity}'; quantities are {listed}.")
        for name in columns:
            if name not in self.table:
                raise DefinitionError(f"`table` has no column '{name}'.")
            if self.table[name].dtype.kind not in "iuf" or not np.isfinite(self.table[name]).all():
                raise DefinitionError(f"column '{name}' must hold a finite number in each row.")

    def _select(self, quantity: str, rows: np.ndarray | None, covariates) -> Selection:
        self._require(quantity, covariates)
        cells, subjects = cells_of(self.table), self.table["subject"]
        rows = np.ones(len(cells), bool) if rows is None else rows
        keys = list(dict.fromkeys(zip(subjects[rows], cells[rows], strict=True)))
        extra = np.stack([self.table[c].astype(float) for c in covariates], axis=1) if (
            covariates) else np.zeros((len(cells), 0))  # fmt: skip
        variance = self._variance(quantity)
        of = [(subjects == subject) & (cells == cell) for subject, cell in keys]
        v = np.array([1 / np.sum(1 / variance[i]) for i in of])
        y = v * np.array([np.sum(self.values[quantity][i] / variance[i]) for i in of])
        x = np.array([extra[i].mean(axis=0) for i in of])
        subject, cell = (np.array(part) for part in zip(*keys, strict=True))
        return Selection(y, v, subject, cell, x)

    def _variance(self, quantity: str) -> np.ndarray:
        """Return the variances of the estimates, moderated."""
        columns, strides = [np.ones(len(self.freedom))], self.table.get("strides")
        if strides is not None and strides.dtype.kind in "iuf" and np.ptp(strides) > 0:
            columns.append(np.log(np.maximum(strides.astype(float), 1.0)))
        return moderated(self.errors[quantity] ** 2, self.freedom, np.stack(columns, axis=1))

    def _row(self, quantity, effect, subjects, value, error, freedom, level, spread, test):
        reach = stats.t.ppf((1 + level) / 2, freedom) * error
        p = float(2 * stats.t.sf(abs(value) / error, freedom)) if test else np.nan
        first = {"quantity": quantity, "unit": self.units[quantity], "effect": effect}
        numbers = {
            "subjects": subjects, "estimate": value, "standard_error": error, "freedom": freedom,
            "low": value - reach, "high": value + reach, "p": p,
        }  # fmt: skip
        names = ("spread", "spread_low", "spread_high")
        return first | numbers | dict(zip(names, spread, strict=True))


def _grid(chosen: Selection, subjects: list[str], names: list[str]) -> Cells:
    """Return the estimates by subject and cell, with an indicator of each cell and covariates."""
    n, q, p = len(subjects), len(names), chosen.covariates.shape[1]
    y, v, present = np.zeros((n, q)), np.ones((n, q)), np.zeros((n, q), bool)
    x = np.zeros((n, q, q + p))
    x[:, np.arange(q), np.arange(q)] = 1.0
    centered = chosen.covariates - chosen.covariates.mean(axis=0)
    for k, (subject, cell) in enumerate(zip(chosen.subject, chosen.cell, strict=True)):
        i, j = subjects.index(subject), names.index(cell)
        y[i, j], v[i, j], present[i, j], x[i, j, q:] = chosen.y[k], chosen.v[k], True, centered[k]
    return Cells(y, v, x, present)
