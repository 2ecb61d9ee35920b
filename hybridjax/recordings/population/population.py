"""`Population`: estimates of several subjects, with their errors, and what they say together."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from scipy import stats

from ..._core.arguments import Numbers
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, OptionalNames, Positive, Probability, Seed
from ..._core.boundary.values import Reals
from ..._core.signal import unit_of
from ...errors import DefinitionError
from ...identify.multiplier_estimate import MultiplierEstimate
from ...scale.draws import monte_carlo
from .reml import Cells, meta, mixed, moderated, spread_interval
from .tables import Columns, PopulationTable, as_columns, cells_of, require, rows_with, table_of


Quantity = Literal["modulus", "angle", "coefficients"]
Numeric = Mapping[str, Annotated[Numbers, Reals("rows")]]


_NONE = (np.nan, np.nan, np.nan)


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
        self, table: Columns, values: Numeric, errors: Numeric,
        units: Mapping[str, str] | None = None,
        freedom: Annotated[Numbers, Reals("rows", infinite=True, sign="positive")] | None = None,
    ):  # fmt: skip
        if not values or set(values) != set(errors):
            raise DefinitionError("`values` and `errors` must hold the same quantities.")
        rows = len(np.asarray(next(iter(values.values()))))
        self.table = as_columns(table, rows)
        self.values, self.errors = dict(values), dict(errors)
        for name, error in self.errors.items():
            if not len(self.values[name]) == len(error) == rows:
                raise DefinitionError(f"`values` and `errors` of '{name}' must have {rows} rows.")
            if np.min(error) <= 0:
                subject = self.table["subject"][np.argmin(error)]
                raise DefinitionError(
                    f"the standard error of '{name}' of subject '{subject}' must be positive."
                )
        self.units = dict.fromkeys(values, "") | dict(units or {})
        self.freedom = np.full(rows, np.inf) if freedom is None else np.asarray(freedom, float)

    @classmethod
    def from_fits(
        cls, fits: Sequence[MultiplierEstimate], table: Columns,
        quantities: Sequence[Quantity] = ("modulus",),
    ) -> "Population":  # fmt: skip
        """Return the population of some fits, with a row of the table for each.

        **Arguments:** `quantities`: "modulus" and "angle" (rad, upper half plane) of the leading
        multiplier, "coefficients" c1, c2, ... of the characteristic polynomial. Default: the
        modulus.

        **Raises:** `DefinitionError` for a fit without covariance, outputs or units that differ,
        coefficients of different orders, and the angle of a real multiplier.
        """
        columns = as_columns(table, len(fits))
        subjects = columns["subject"]
        parts = [_of(fit, s, quantities) for fit, s in zip(fits, subjects, strict=True)]
        kinds = [(_signals(x), f"of order {len(x.coefficients)}") for x in fits]
        for subject, kind, part in zip(subjects, kinds, parts, strict=True):
            if kind[0] != kinds[0][0] or part.keys() != parts[0].keys():
                raise DefinitionError(
                    f"the fit of subject '{subject}' is {' '.join(kind)}, but that of "
                    f"'{subjects[0]}' is {' '.join(kinds[0])}: use the same outputs, units and "
                    "`order`, or take the modulus."
                )
        values, errors = ({n: np.array([p[n][i] for p in parts]) for n in parts[0]} for i in (0, 1))
        freedom = [fit.covariance_freedom for fit in fits]
        units = {"angle": "rad"} if "angle" in values else {}
        return cls(columns, values, errors, units, freedom)

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
        rows = []
        for cell, (_, y, v, extra) in self._cells(quantity, 2 + len(covariates), covariates):
            x = np.column_stack([np.ones(len(y)), extra - extra.mean(axis=0)])
            fit = meta(y, v, x)
            errors = np.sqrt(np.diag(fit.covariance))
            spread = (np.sqrt(fit.variance), *spread_interval(y, v, x, level))
            for k, effect in enumerate(["mean", *(f"slope of {c}" for c in covariates)]):
                name = effect if cell == "all" else f"{effect}, {cell}"
                estimate = fit.coefficients[k], errors[k], fit.freedom
                row = self._row(quantity, name, len(y), estimate, level, _NONE if k else spread)
                rows.append(row if k else row | {"p": np.nan})
        return table_of(
            rows,
            f"Means of {quantity} and {100 * level:g} % intervals: random-effects model with the "
            "standard error of each subject, by restricted maximum likelihood (Hartung and Knapp).",
        )

    def difference(
        self, quantity: str, a: str, b: str, *, covariates: OptionalNames = (),
        level: Probability = 0.95,
    ) -> PopulationTable:  # fmt: skip
        """Return the mean difference a - b of two conditions or two groups, and test it.

        Differences are paired in subjects that have both; subjects with one of them count, too.
        The variances between subjects may differ in each group and condition. Covariance and
        degrees of freedom are those of Kenward and Roger (1997). If the table also has the other
        factor, the difference is averaged over it.

        **Arguments:** `covariates`: columns with common slopes. Default: none.

        **Raises:** `DefinitionError` as `mean`, and for labels that the table does not have.
        """
        grid, names, is_a = self._grid(quantity, a, b, covariates)
        fit = mixed(grid)
        weights = np.eye(len(names) + len(covariates))[len(names) - 1 :]
        weights[0] = 0.0
        weights[0, : len(names)] = np.where(is_a, 1 / is_a.sum(), -1 / (~is_a).sum())
        paired, rows = np.flatnonzero(grid.present.all(axis=1)), []
        for k, effect in enumerate([f"{a} - {b}", *(f"slope of {c}" for c in covariates)]):
            w, spread = weights[k], _NONE
            if k == 0 and len(names) == 2 and len(paired) > 2:
                d, v = grid.y[paired] @ w[:2], grid.v[paired].sum(axis=1)
                bounds = spread_interval(d, v, np.ones((len(d), 1)), level)
                spread = np.sqrt(w[:2] @ fit.between @ w[:2]), *bounds
            estimate = w @ fit.coefficients, np.sqrt(w @ fit.covariance @ w), fit.freedom(w)
            rows.append(self._row(quantity, effect, len(grid.y), estimate, level, spread))
        return table_of(
            rows,
            f"Difference of {quantity} ({a} - {b}; {len(grid.y)} subjects, {len(paired)} with "
            f"all conditions) and {100 * level:g} % interval: linear mixed model with the variance "
            "of each estimate, by restricted maximum likelihood (Kenward and Roger).",
        )

    def predictions(self, quantity: str, *, level: Probability = 0.95) -> PopulationTable:
        """Return the best linear unbiased prediction of each subject: its estimate, shrunken
        towards the mean of its group and condition the more, the larger its error.

        Standard errors contain those of the mean and of the variance between subjects (Prasad and
        Rao 1990).

        **Raises:** `DefinitionError` as `mean`; three subjects are needed.
        """
        rows = []
        for cell, (subject, y, v, _) in self._cells(quantity, 3):
            fit = meta(y, v, np.ones((len(y), 1)))
            share = fit.variance / (fit.variance + v)
            value = fit.coefficients[0] + share * (y - fit.coefficients[0])
            square = share * v + (1 - share) ** 2 * fit.covariance[0, 0]
            square += 2 * v**2 / (v + fit.variance) ** 3 * fit.variance_error**2
            reach = stats.t.ppf((1 + level) / 2, fit.freedom) * np.sqrt(square)
            columns = {
                "subject": subject, "cell": [cell] * len(y), "estimate": y,
                "standard_error": np.sqrt(v), "prediction": value,
                "prediction_error": np.sqrt(square), "low": value - reach, "high": value + reach,
            }  # fmt: skip
            first = {"quantity": quantity, "unit": self.units[quantity]}
            rows += [first | dict(zip(columns, row, strict=True))
                     for row in zip(*columns.values(), strict=True)]  # fmt: skip
        text = f"Single subjects: best linear unbiased predictions of {quantity} (Prasad and Rao)."
        return table_of(rows, text)

    def power(
        self, quantity: str, difference: float, subjects: Sequence[Count] = (8, 12, 16, 24), *,
        labels: Sequence[str] = (), draws: Count = 400, level: Probability = 0.05,
        seed: Seed = 0,
    ) -> PopulationTable:  # fmt: skip
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
        more: Any = len(labels) not in (0, 2)
        if labels:
            grid, names, _ = self._grid(quantity, labels[0], labels[-1])
            both = np.flatnonzero(grid.present.all(axis=1) & (len(names) == 2))
            y, v = grid.y[both, 0] - grid.y[both, -1], grid.v[both].sum(axis=1)
        else:
            ((_, (_, y, v, _)), *more) = self._cells(quantity, 3)
        if len(y) < 3 or more:
            raise DefinitionError("`labels` must be two conditions of three or more subjects.")
        ones, rows = np.ones((len(y), 1)), []
        low, high = spread_interval(y, v, ones)
        spreads = [float(np.sqrt(meta(y, v, ones).variance)), high, low]
        for n in subjects:
            tests = [_test(v, n, x, difference, bool(labels), level) for x in spreads]
            count, *bounds = (int(monte_carlo(f, draws, seed).value.sum()) for f in tests)
            least, most = (stats.binomtest(k, draws).proportion_ci() for k in bounds)
            rows.append({
                "subjects": n, "power": count / draws, "power_low": least.low,
                "power_high": most.high, "spread": spreads[0], "draws": draws,
            })  # fmt: skip
        design = "paired differences" if labels else "two groups"
        return table_of(
            rows,
            f"Power for a difference of {difference:g} in {quantity} ({design}): {draws} simulated "
            f"populations with the spread and errors of a pilot of {len(y)} subjects.",
        )

    def allocation(
        self, quantity: str, subject_cost: Positive = 1.0, stride_cost: Positive = 0.01
    ) -> float:
        r"""Return the number of strides per subject that gives the mean its smallest variance for a
        given cost, from the table's column `strides`.

        It is $\sigma_w / \sigma_b \sqrt{c_s / c}$ with the standard deviations of one stride and
        between subjects and the costs of a subject and a stride (Cochran, *Sampling Techniques*,
        1977, ch. 10); the variance of the mean of n subjects with m strides is $(\sigma_b^2 +
        \sigma_w^2 / m) / n$.

        **Arguments:** costs in the same unit. Default: 1 and 0.01.

        **Raises:** `DefinitionError` without a column `strides`, and as `mean`.
        """
        cells = [(y, v, np.ones((len(y), 1))) for _, (_, y, v, _) in self._cells(quantity, 3)]
        between = np.mean([meta(*cell).variance for cell in cells])
        within = np.mean(self._variance(quantity) * self._numbers("strides"))
        return float(np.sqrt(subject_cost / stride_cost * within / max(between, 1e-300)))

    def _numbers(self, name: str) -> np.ndarray:
        values = self.table.get(name, np.array(""))
        if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise DefinitionError(f"`table` needs a column '{name}' with a number in each row.")
        return values.astype(float)

    def _merged(self, quantity: str, covariates: Sequence[str], rows: np.ndarray):
        """Return subject, cell, estimate, variance and covariates of each subject in each cell;
        several trials are averaged by their precision."""
        if quantity not in self.values:
            listed = ", ".join(self.values)
            raise DefinitionError(f"there is no quantity '{quantity}'; quantities are {listed}.")
        cells, subjects = cells_of(self.table), self.table["subject"]
        keys = list(dict.fromkeys(zip(subjects[rows], cells[rows], strict=True)))
        extra = np.array([self._numbers(c) for c in covariates]).reshape(-1, len(cells)).T
        variance = self._variance(quantity)
        of = [(subjects == subject) & (cells == cell) for subject, cell in keys]
        v = np.array([1 / np.sum(1 / variance[i]) for i in of])
        y = v * np.array([np.sum(self.values[quantity][i] / variance[i]) for i in of])
        x = np.array([extra[i].mean(axis=0) for i in of])
        return *map(np.array, zip(*keys, strict=True)), y, v, x

    def _cells(self, quantity: str, needed: int, covariates: Sequence[str] = ()):
        """Return subjects, estimates, variances and covariates by group and condition."""
        every = np.ones(len(self.freedom), bool)
        subjects, cells, *numbers = self._merged(quantity, covariates, every)
        require(cells, subjects, needed)
        parts = (subjects, *numbers)
        return [(cell, [x[cells == cell] for x in parts]) for cell in dict.fromkeys(cells)]

    def _grid(self, quantity: str, a: str, b: str, covariates: Sequence[str] = ()):
        """Return the estimates by subject and cell, with an indicator of each cell and covariates;
        the names of the cells, and which belong to `a`."""
        factor, rows = rows_with(self.table, (a, b))
        subjects, cells, y, v, extra = self._merged(quantity, covariates, rows)
        require(cells, subjects)
        names, all_cells = list(dict.fromkeys(cells)), cells_of(self.table)
        row = [list(dict.fromkeys(subjects)).index(subject) for subject in subjects]
        place, q = (row, [names.index(cell) for cell in cells]), len(names)
        shape = (max(row) + 1, q)
        grid = Cells(np.zeros(shape), np.ones(shape), np.zeros((*shape, q + len(covariates))),
                     np.zeros(shape, bool))  # fmt: skip
        grid.x[:, np.arange(q), np.arange(q)] = 1.0
        grid.y[place], grid.v[place], grid.present[place] = y, v, True
        grid.x[..., q:][place] = extra - extra.mean(axis=0)
        side = [self.table[factor][rows & (all_cells == name)][0] == a for name in names]
        return grid, names, np.array(side)

    def _variance(self, quantity: str) -> np.ndarray:
        """Return the variances of the estimates, moderated."""
        columns, strides = [np.ones(len(self.freedom))], self.table.get("strides")
        if strides is not None and strides.dtype.kind in "iuf" and np.ptp(strides) > 0:
            columns.append(np.log(np.maximum(strides.astype(float), 1.0)))
        return moderated(self.errors[quantity] ** 2, self.freedom, np.stack(columns, axis=1))

    def _row(self, quantity: str, effect: str, subjects: int, estimate, level: float, spread):
        value, error, freedom = estimate
        reach = stats.t.ppf((1 + level) / 2, freedom) * error
        return {
            "quantity": quantity, "unit": self.units[quantity], "effect": effect,
            "subjects": subjects, "estimate": value, "standard_error": error, "freedom": freedom,
            "low": value - reach, "high": value + reach,
            "p": float(2 * stats.t.sf(abs(value) / error, freedom)),
            **dict(zip(("spread", "spread_low", "spread_high"), spread, strict=True)),
        }  # fmt: skip


def _test(v, n: int, spread: float, difference: float, paired: bool, level: float):
    """Return a function of a random generator that simulates subjects, and returns whether the
    difference differs from zero."""
    cells = 1 if paired else 2
    table = {"subject": np.arange(n * cells), "group": np.repeat(["a", "b"][:cells], n)}

    def draw(rng: np.random.Generator) -> int:
        variance = rng.choice(v, (n, cells))
        y = np.sqrt(spread**2 + variance) * rng.normal(size=(n, cells))
        y[:, 0] += difference
        people = Population(table, {"y": y.T.ravel()}, {"y": np.sqrt(variance.T.ravel())})
        test: Any = people.difference("y", "a", "b", level=1 - level) if not paired else (
            people.mean("y", level=1 - level))  # fmt: skip
        return int(test["low"][0] * test["high"][0] > 0)

    return draw


def _signals(fit: MultiplierEstimate) -> str:
    names = getattr(fit, "outputs", ("multipliers",))
    return "of " + ", ".join(f"{x} ({unit_of(x)})" if unit_of(x) else str(x) for x in names)


def _of(fit: MultiplierEstimate, subject: str, quantities: Sequence[Quantity]):
    """Return values and standard errors of one fit by name."""
    if not np.isfinite(fit.covariance).all():
        raise DefinitionError(
            f"the fit of subject '{subject}' has no covariance: record more strides, or leave the "
            "subject out."
        )
    z, covariance = complex(fit.multipliers[0]), fit.multiplier_covariances[0]
    parts: dict[str, tuple[float, float]] = {}
    if "angle" in quantities and z.imag == 0:
        raise DefinitionError(
            f"the leading multiplier of subject '{subject}' is real, so its angle has no standard "
            "error: take the modulus or the coefficients."
        )
    slopes = {"modulus": (abs(z), z / abs(z)), "angle": (abs(np.angle(z)), 1j * z / abs(z) ** 2)}
    for name in (x for x in slopes if x in quantities):
        value, slope = slopes[name]
        w = np.array([slope.real, slope.imag])
        parts[name] = value, float(np.sqrt(w @ covariance @ w))
    if "coefficients" in quantities:
        pairs = zip(fit.coefficients, np.sqrt(np.diag(fit.covariance)), strict=True)
        parts |= {f"c{k}": pair for k, pair in enumerate(pairs, 1)}
    return parts
