"""`Population`: estimates of several subjects, with their errors, and what they say together."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from scipy import stats

from ..._core.arguments import Numbers, package, require_equal
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, OptionalNames, Positive, Seed
from ..._core.boundary.values import Reals
from ..._core.text import folded
from ...errors import DefinitionError
from ...identify.multiplier_estimate import MultiplierFit
from ...scale.draws import monte_carlo
from .reml import Mixed, meta, mixed, moderated, spread_interval
from .tables import Columns, cells_of, factors_of, require, rows_with, signed, table_of


Numeric = Mapping[str, Annotated[Numbers, Reals("rows", missing=True)]]
_SLOPE = "slope of "
Freedom = Annotated[Numbers, Reals("rows", infinite=True, sign="positive")]


@checked
class Population:
    r"""Estimates of several subjects, each with its own error.

    The model is $\theta_s = \mu + b_s + e_s$: $e_s$ has the standard error of the estimate, and
    $b_s$ an unknown variance between subjects, estimated by restricted maximum likelihood.

    Results are data frames of pandas with 95 % intervals (`low`, `high`); their
    `attrs["methods"]` are sentences for the methods section of a paper.

    **Arguments:**

    - `table`: columns by name, or a data frame, with a row for each estimate. `subject` is
      required. `condition` (each subject may have several) and `group` (each subject has one) are
      factors; other columns with numbers can be covariates. Rows with the same subject, group and
      condition are trials, averaged by their precision.
    - `values`, `errors`: by name of a quantity, an estimate and its standard error in each row; NaN
      where it is missing.
    - `units`: by name of a quantity. Default: none.
    - `freedom`: degrees of freedom of the errors, in each row. Where they are few, errors are
      moderated by those of the other subjects (Smyth 2004), with the trend of the column `strides`
      if there is one. Default: infinite.

    **Raises:** `DefinitionError` for a table without subjects, columns of different lengths, a
    subject in two groups, errors that are not positive, and if pandas is not installed.
    """

    def __init__(
        self,
        table: Columns,
        values: Numeric,
        errors: Numeric,
        units: Mapping[str, str] | None = None,
        freedom: Freedom | None = None,
    ):
        if not values or set(values) != set(errors):
            raise DefinitionError(
                "`values` and `errors` must hold the same quantities."
            )
        rows = len(next(iter(values.values())))
        self.table = table_of(table, rows)
        self.values = {name: np.asarray(x, float) for name, x in values.items()}
        self.errors = {name: np.asarray(x, float) for name, x in errors.items()}
        for name, error in self.errors.items():
            if not len(values[name]) == len(error) == rows:
                raise DefinitionError(
                    f"`values` and `errors` of '{name}' must have {rows} rows."
                )
            wrong = np.isfinite(values[name]) & ~(error > 0)
            for subject, number in zip(
                self.table["subject"][wrong], error[wrong], strict=True
            ):
                text = f"has the standard error {number:.3g}: it must be a positive number."
                raise DefinitionError(f"'{name}' of subject '{subject}' {text}")
        self.units = dict.fromkeys(values, "") | dict(units or {})
        self.freedom = (
            np.full(rows, np.inf) if freedom is None else np.asarray(freedom, float)
        )

    @classmethod
    def from_fits(cls, fits: Sequence[MultiplierFit], table: Columns) -> "Population":
        """Return the population of some fits, with a row of the table for each.

        Quantities are `modulus` and `angle` (rad; missing if real) of the leading multiplier, and
        the coefficients `c1`, `c2`, ... of the characteristic polynomial (missing in fits of lower
        order).

        **Raises:** `DefinitionError` for a fit without covariance, and outputs or units that
        differ.
        """
        frame = table_of(table, len(fits))
        most = max((len(fit.coefficients) for fit in fits), default=0)
        numbers = np.full((2, 2 + most, len(fits)), np.nan)
        for row, (subject, fit) in enumerate(zip(frame["subject"], fits, strict=True)):
            outputs = [getattr(x, "outputs", ()) for x in (fits[0], fit)]
            pair = f"the fits of subjects '{frame['subject'][0]}' and '{subject}'"
            require_equal(pair, "outputs", *outputs)
            if not np.isfinite(fit.covariance).all():
                text = f"the fit of subject '{subject}' has no covariance"
                raise DefinitionError(
                    f"{text}: record more strides, or leave the subject out."
                )
            z, covariance = complex(fit.multipliers[0]), fit.multiplier_covariances[0]
            polar = np.array(
                [[z.real, z.imag], [-z.imag / abs(z), z.real / abs(z)]]
            ) / abs(z)
            squares = *np.diag(polar @ covariance @ polar.T), *np.diag(fit.covariance)
            values = abs(z), abs(np.angle(z)) if z.imag else np.nan, *fit.coefficients
            numbers[:, : len(values), row] = values, np.sqrt(squares)
        kinds = ["modulus", "angle", *(f"c{k}" for k in range(1, most + 1))]
        values, errors = (dict(zip(kinds, x, strict=True)) for x in numbers)
        return cls(
            frame,
            values,
            errors,
            {"angle": "rad"},
            [x.covariance_dof for x in fits],
        )

    def __repr__(self) -> str:
        count = self.table.assign(cell=cells_of(self.table)).groupby(
            "cell", sort=False
        )["subject"]
        cells = "; ".join(f"{c}: {n} subjects" for c, n in count.nunique().items())
        names = ", ".join(self.values)
        return folded(f"Population({names}; {cells}; {len(self.table)} estimates)")

    def mean(self, quantity: str, *, covariates: OptionalNames = ()) -> Any:
        """Return the mean over subjects, and the spread between them, in each group and condition.

        Intervals of the mean, and of the slopes of covariates, are those of Hartung and Knapp
        (2001, 2003); those of the spread (a standard deviation, without the errors of the
        estimates) follow from the Q profile (Viechtbauer 2007). With covariates, the mean is that
        at the mean of each covariate.

        **Raises:** `DefinitionError` for an unknown quantity or covariate, and for too few
        subjects.
        """
        parts = []
        for cell, data in self._cells(quantity, 2 + len(covariates), covariates):
            y, v, slopes = (
                data["y"].to_numpy(),
                data["v"].to_numpy(),
                data.filter(like=_SLOPE),
            )
            x = np.column_stack([np.ones(len(y)), slopes - slopes.mean()])
            fit, weights = meta(y, v, x), np.eye(x.shape[1])
            spread = np.sqrt(fit.between[0, 0]), *spread_interval(y, v, x)
            names = [n if cell == "all" else f"{n}, {cell}" for n in ("mean", *slopes)]
            parts.append(self._effects(quantity, names, len(y), fit, weights, spread))
            parts[-1].loc[0, "p"] = np.nan
        return _result(
            parts,
            f"Means of {quantity} and 95 % intervals: random-effects model with the standard error "
            "of each subject, by restricted maximum likelihood (Hartung and Knapp).",
        )

    def difference(
        self, quantity: str, a: str, b: str, *, covariates: OptionalNames = ()
    ) -> Any:
        """Return the mean difference a - b of two conditions or two groups, and test it.

        Differences are paired in subjects that have both; subjects with one of them count, too.
        The variances between subjects may differ in each group and condition. Covariance and
        degrees of freedom are those of Kenward and Roger (1997). If the table also has the other
        factor, the difference is averaged over it.

        **Arguments:** `covariates`: columns with common slopes. Default: none.

        **Raises:** `DefinitionError` as `mean`, and for labels that the table does not have.
        """
        data, cell, w, pairs = self._contrast(quantity, a, b, covariates)
        subject, slopes = data["subject"].factorize()[0], data.filter(like=_SLOPE)
        x = np.column_stack([np.eye(len(w))[cell], slopes - slopes.mean()])
        fit = mixed(data["y"].to_numpy(), data["v"].to_numpy(), x, subject, cell)
        weights = np.eye(x.shape[1])[len(w) - 1 :]
        weights[0, : len(w)] = w
        spread, (y, v) = (np.nan,) * 3, pairs.to_numpy().T
        if len(y) > 2:
            spread = (
                np.sqrt(w @ fit.between @ w),
                *spread_interval(y, v, np.ones((len(y), 1))),
            )
        n = subject.max() + 1
        rows = self._effects(quantity, [f"{a} - {b}", *slopes], n, fit, weights, spread)
        return _result(
            [rows],
            f"Difference of {quantity} ({a} - {b}; {n} subjects, {len(y)} with all conditions) and "
            "95 % interval: linear mixed model with the variance of each estimate, by restricted "
            "maximum likelihood (Kenward and Roger).",
        )

    def predictions(self, quantity: str) -> Any:
        """Return the best linear unbiased prediction of each subject: its estimate, shrunken
        towards the mean of its group and condition the more, the larger its error.

        Standard errors contain those of the mean and of the variance between subjects (Prasad and
        Rao 1990).

        **Raises:** `DefinitionError` as `mean`; three subjects are needed.
        """
        parts = []
        for _, data in self._cells(quantity, 3):
            y, v = data["y"].to_numpy(), data["v"].to_numpy()
            fit = meta(y, v, np.ones((len(y), 1)))
            mean, between = fit.coefficients[0], fit.between[0, 0]
            share = between / (between + v)
            square = share * v + (1 - share) ** 2 * fit.covariance[0, 0]
            square += 2 * v**2 / (v + between) ** 3 * fit.uncertainty[0, 0]
            value, error = mean + share * (y - mean), np.sqrt(square)
            reach = stats.t.ppf(0.975, fit.most) * error
            part = data[["subject", "cell"]].assign(
                quantity=quantity, unit=self.units[quantity]
            )
            part = part.assign(estimate=y, standard_error=np.sqrt(v), prediction=value)
            parts.append(
                part.assign(
                    prediction_error=error, low=value - reach, high=value + reach
                )
            )
        text = f"Single subjects: best linear unbiased predictions of {quantity} (Prasad and Rao)."
        return _result(parts, text)

    def power(
        self,
        quantity: str,
        difference: float,
        subjects: Sequence[Count] = (8, 12, 16, 24),
        *,
        labels: Sequence[str] = (),
        draws: Count = 400,
        seed: Seed = 0,
    ) -> Any:
        """Return the power of 5 % tests of a difference, by simulation of populations like this
        pilot.

        Simulated subjects have the spread of the pilot, and standard errors drawn from its own.
        With `labels` of two conditions the test is that of paired differences; without labels, that
        of two groups of the pilot's spread, with `subjects` in each.

        **Arguments:** `difference`: true difference, in units of the quantity. `subjects`: their
        numbers. `draws`: number of simulated populations.

        **Returns:** power at the pilot's spread, with a 95 % interval that contains the error of
        the simulation and the interval of the spread.

        **Raises:** `DefinitionError` as `difference`, and if xarray is not installed.
        """
        if len(labels) == 2:
            pilots = [self._contrast(quantity, *labels)[-1]]
        else:
            pilots = [data[["y", "v"]] for _, data in self._cells(quantity, 3)]
        y, v = pilots[0].to_numpy().T
        if len(y) < 3 or len(pilots) > 1 or len(labels) not in (0, 2):
            raise DefinitionError(
                "`labels` must be two conditions of three or more subjects."
            )
        ones, rows = np.ones((len(y), 1)), []
        low, high = spread_interval(y, v, ones)
        spread = np.sqrt(meta(y, v, ones).between[0, 0])
        for n in subjects:
            tests = [
                _test(v, n, x, difference, bool(labels)) for x in (spread, high, low)
            ]
            count, *bounds = (
                int(monte_carlo(f, draws, seed).value.sum()) for f in tests
            )
            least, most = (stats.binomtest(k, draws).proportion_ci() for k in bounds)
            rows.append((n, count / draws, least.low, most.high, spread, draws))
        columns = ("subjects", "power", "power_low", "power_high", "spread", "draws")
        return _result(
            [package("pandas").DataFrame(rows, columns=columns)],
            f"Power for a difference of {difference:g} in {quantity} "
            f"({'paired differences' if labels else 'two groups'}): {draws} simulated populations "
            f"with the spread and errors of a pilot of {len(y)} subjects.",
        )

    def allocation(
        self,
        quantity: str,
        subject_cost: Positive = 1.0,
        trial_cost: Positive = 0.1,
        stride_cost: Positive = 0.01,
    ) -> Any:
        r"""Return the numbers of trials per subject and of strides per trial that give the mean its
        smallest variance for a given cost, from the table's column `strides`.

        The mean of n subjects with k trials of m strides has the variance $(\sigma_s^2 + \sigma_t^2
        / k + \sigma^2 / k m) / n$ and costs $n (c_s + k c_t + k m c)$. The best numbers are $k^2 =
        \sigma_t^2 c_s / \sigma_s^2 c_t$, rounded, and $m^2 = \sigma^2 (c_s + k c_t) / (k^2
        \sigma_s^2 + k \sigma_t^2) c$ (Cochran, *Sampling Techniques*, 1977, ch. 10). If no subject
        has several trials, k is 1, and the variance of trials is part of that of subjects.

        **Arguments:** costs in the same unit. Default: 1, 0.1 and 0.01.

        **Raises:** `DefinitionError` without a column `strides` or a spread between subjects, and
        as `mean`.
        """
        cells = [data[["y", "v"]].to_numpy().T for _, data in self._cells(quantity, 3)]
        between = np.mean([meta(y, v, np.ones((len(y), 1))).between for y, v in cells])
        trials = (
            self._trials(quantity).assign(strides=self._numbers("strides")).dropna()
        )
        by = trials.groupby(["subject", "cell"])
        count = by["y"].count()
        scatter = (count - 1) * (by["y"].var().fillna(0.0) - by["v"].mean())
        trial = max(scatter.sum() / max((count - 1).sum(), 1), 0.0)
        between -= trial * np.mean(1 / count) * (trial > 0)
        if not between > 0:
            text = f"subjects differ in '{quantity}' by no more than their errors"
            raise DefinitionError(f"{text}: find their spread from more subjects.")
        stride = np.mean(trials["v"] * trials["strides"])
        k = max(round(np.sqrt(trial / between * subject_cost / trial_cost)), 1)
        cost = (subject_cost + k * trial_cost) / stride_cost
        row = {"quantity": quantity, "trials": k}
        row |= {"strides": np.sqrt(stride * cost / (k**2 * between + k * trial))}
        row |= {"subject_spread": np.sqrt(between), "trial_spread": np.sqrt(trial)}
        row |= {"stride_spread": np.sqrt(stride)}
        text = (
            "Trials and strides: smallest variance of the mean for its cost (Cochran)."
        )
        return _result([package("pandas").DataFrame([row])], text)

    def _numbers(self, name: str) -> np.ndarray:
        values = np.asarray(self.table.get(name, ""))
        if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise DefinitionError(
                f"`table` needs a column '{name}' with a number in each row."
            )
        return values.astype(float)

    def _trials(self, quantity: str) -> Any:
        """Return subject, factors, cell, estimate and moderated variance of each row."""
        if quantity not in self.values:
            listed = ", ".join(self.values)
            raise DefinitionError(
                f"there is no quantity '{quantity}'; quantities are {listed}."
            )
        y, v = np.asarray(self.values[quantity]), np.asarray(self.errors[quantity]) ** 2
        trend, strides = np.ones((len(y), 1)), np.asarray(self.table.get("strides", ""))
        if strides.dtype.kind in "iuf" and np.ptp(strides) > 0:
            trend = np.column_stack([trend, np.log(np.maximum(strides, 1.0))])
        v[~np.isfinite(y)] = np.nan
        i = np.isfinite(y)
        v[i] = moderated(v[i], self.freedom[i], trend[i])
        frame = self.table[["subject", *factors_of(self.table)]]
        return frame.assign(cell=cells_of(frame), y=y, v=v)

    def _merged(
        self, quantity: str, covariates: Sequence[str], rows: Any = None
    ) -> Any:
        """Return a row for each subject in each group and condition; trials are averaged."""
        slopes = {_SLOPE + name: self._numbers(name) for name in covariates}
        frame = self._trials(quantity).assign(**slopes)
        frame = frame.assign(w=1 / frame["v"], wy=frame["y"] / frame["v"])
        frame = frame[np.isfinite(frame["y"]) & (True if rows is None else rows)]
        by = frame.groupby(["subject", *factors_of(frame), "cell"], sort=False)
        data = by[["w", "wy"]].sum().join(by[list(slopes)].mean()).reset_index()
        return data.assign(y=data["wy"] / data["w"], v=1 / data["w"])

    def _cells(self, quantity: str, needed: int, covariates: Sequence[str] = ()) -> Any:
        cells = dict(
            list(self._merged(quantity, covariates).groupby("cell", sort=False))
        )
        require({c: x["subject"] for c, x in cells.items()} or {"all": ()}, needed)
        return cells.items()

    def _contrast(self, quantity: str, a: str, b: str, covariates: Sequence[str] = ()):
        """Return the estimates in two conditions or groups, the numbers and the weights of their
        cells, and the differences of subjects that have all."""
        factor, rows = rows_with(self.table, a, b)
        data = self._merged(quantity, covariates, rows)
        require(dict(list(data.groupby("cell")["subject"])), 2)
        cell, names = data["cell"].factorize()
        is_a = data.drop_duplicates("cell")[factor].to_numpy() == a
        w = np.where(is_a, 1 / max(is_a.sum(), 1), -1 / max((~is_a).sum(), 1))
        parts = data.assign(y=data["y"] * w[cell], v=data["v"] * w[cell] ** 2).groupby(
            "subject"
        )
        return data, cell, w, parts[["y", "v"]].sum()[parts.size() == len(names)]

    def _effects(
        self,
        quantity: str,
        names: list[str],
        subjects: int,
        fit: Mixed,
        weights,
        spread,
    ) -> Any:
        value, error, freedom = np.array([fit.contrast(w) for w in weights]).T
        reach = stats.t.ppf(0.975, freedom) * error
        frame = package("pandas").DataFrame({"quantity": quantity, "effect": names})
        frame = frame.assign(
            unit=self.units[quantity], subjects=subjects, estimate=value
        )
        frame = frame.assign(standard_error=error, freedom=freedom, low=value - reach)
        frame = frame.assign(
            high=value + reach, p=2 * stats.t.sf(abs(value) / error, freedom)
        )
        frame.loc[0, ["spread", "spread_low", "spread_high"]] = spread
        return frame


def _result(parts: list, text: str) -> Any:
    frame = package("pandas").concat(parts, ignore_index=True)
    frame.attrs["methods"] = signed(text)
    return frame


def _test(v, n: int, spread: float, difference: float, paired: bool):
    """Return a function of a random generator that simulates subjects, and returns whether the
    difference differs from zero."""
    subjects = np.arange(n if paired else 2 * n)
    group = subjects // n
    x, w = np.eye(group[-1] + 1)[group], np.array([1.0, -1.0])[: group[-1] + 1]

    def draw(rng: np.random.Generator) -> int:
        variance = rng.choice(v, len(subjects))
        y = np.sqrt(spread**2 + variance) * rng.normal(size=len(subjects))
        y += difference * (group == 0)
        fit = meta(y, variance, x) if paired else mixed(y, variance, x, subjects, group)
        value, error, freedom = fit.contrast(w)
        return int(abs(value) > stats.t.isf(0.025, freedom) * error)

    return draw
