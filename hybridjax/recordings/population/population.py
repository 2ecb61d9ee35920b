"""`Population`: estimates of several subjects with their errors; means, differences and predictions
over subjects.

A mean or a difference takes three stages: trials of a subject are merged (`_trials`, `_merged`),
the means are fitted (`reml.py`), and contrasts of them become rows of a table (`_effects`). Checks
of the subjects' table are in `tables.py`. The names of the columns of results must stay: the
figures of `plot/subjects.py` read them.

A wrong mean or error has its cause in `reml.py`; a wrong number of subjects, in `_merged`; a wrong
sign or weight of a difference, in `_contrast`; a wrong power, in `_test`, which simulates.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from scipy import stats

from ..._core.arguments import Numbers, package, require_equal
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, OptionalNames, Positive, Seed
from ..._core.boundary.values import Reals
from ..._core.findings import Finding, warn_of
from ..._core.showable import Showable
from ..._core.text import folded, p_value
from ...errors import DefinitionError
from ...identify.multiplier_estimate import MultiplierFit
from ...scale.draws import monte_carlo
from ..natural import NaturalMultipliers
from .reml import Mixed, meta, mixed, moderated, spread_interval
from .tables import Columns, cells_of, factors_of, require, rows_with, signed, table_of


Numeric = Mapping[str, Annotated[Numbers, Reals("rows", missing=True)]]
_SLOPE = "slope of "
# Least number of subjects whose distribution is tested, and level of the test. Fewer subjects: the
# test has no power. Larger level: normally distributed subjects get a finding. Smaller: outliers
# pass.
_FEWEST_TESTED = 5
_NORMAL = 0.02
Freedom = Annotated[Numbers, Reals("rows", infinite=True, sign="positive")]


@checked
class Population(Showable):
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
    - `values`, `errors`: mappings from the name of a quantity to its estimates, and to their
      standard errors: one for each row, NaN where it is missing.
    - `units`: mapping from the name of a quantity to its unit. Default: none.
    - `dof`: degrees of freedom of the errors, one number for each row. If they are few, errors are
      shrunken towards those of the other subjects (Smyth 2004); with a column `strides`, towards
      their trend over the strides. Default: infinite.

    **Raises:** `DefinitionError` for a table without subjects, columns of different lengths, a
    subject in two groups, errors that are not positive, and if pandas is not installed.

    **Example:**

    ```python
    gain = np.array([0.61, 0.58, 0.66, 0.68, 0.63, 0.71])
    table = {"subject": ["S1", "S2", "S3"] * 2, "condition": ["slow"] * 3 + ["fast"] * 3}
    people = hj.recordings.Population(table, {"gain": gain}, {"gain": 0.02 + 0 * gain})
    print(people.difference("gain", "fast", "slow"))
    ```

    **Before:** `hj.identify_subjects`, or estimates with standard errors. **After:**
    `people.plot(quantity)`, `hj.plot.paired`.
    """

    def __init__(
        self,
        table: Columns,
        values: Numeric,
        errors: Numeric,
        units: Mapping[str, str] | None = None,
        dof: Freedom | None = None,
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
            known = np.isfinite(self.values[name])
            wrong = np.flatnonzero(known & ~(error > 0))
            if len(wrong):
                row = wrong[0]
                raise DefinitionError(
                    f"'{name}' of subject '{self.table['subject'][row]}' has the standard error "
                    f"{error[row]:.3g}: it must be a positive number."
                )
        self.units = dict.fromkeys(values, "") | dict(units or {})
        self.dof = np.full(rows, np.inf)
        if dof is not None:
            self.dof = np.asarray(dof, float)

    @classmethod
    def from_fits(
        cls,
        fits: Sequence[MultiplierFit | NaturalMultipliers]
        | Mapping[str, MultiplierFit | NaturalMultipliers],
        table: Columns | Sequence[str] | None = None,
    ) -> "Population":
        """Return the population of some fits, with a row of the table for each.

        Instead of a table, pass the names of the subjects, `from_fits(fits, ["S1", "S2"])`, or fits
        by name, `from_fits({"S1": fit, "S2": other})`.

        Quantities are the `modulus` and the `angle` (in rad, missing if real) of the leading
        multiplier, its `decay`, and the coefficients `c1`, `c2`, ... of the characteristic
        polynomial (missing in fits of lower order). `decay` is the rate -ln(modulus) per stride:
        half of a deviation is left after ln(2) / decay strides. It is negative if deviations grow.

        **Raises:** `DefinitionError` for a fit without covariance, and outputs or units that
        differ.
        """
        if isinstance(fits, Mapping):
            if table is not None:
                raise DefinitionError(
                    "Population.from_fits: fits by name stand for the table: leave out one of "
                    "both, or give the fits in a list, in the order of the table's rows."
                )
            table = list(fits)
            fits = list(fits.values())
        if table is None:
            raise DefinitionError(
                "Population.from_fits needs the subjects of the fits: `from_fits(fits, ['S1', "
                "'S2'])`, or a table with a column 'subject'."
            )
        rows = table if isinstance(table, Columns) else {"subject": list(table)}
        frame = table_of(rows, len(fits))
        _require_comparable(fits, frame["subject"])
        most = max((len(fit.coefficients) for fit in fits), default=0)
        kinds = ["modulus", "angle", "decay"]
        kinds += [f"c{k}" for k in range(1, most + 1)]
        values = {kind: np.full(len(fits), np.nan) for kind in kinds}
        errors = {kind: np.full(len(fits), np.nan) for kind in kinds}
        for row, fit in enumerate(fits):
            modulus, angle, squares = _polar(fit)
            decay, decay_square = _decay(modulus, squares[0])
            numbers = (modulus, angle, decay, *fit.coefficients)
            squares = (*squares, decay_square, *np.diag(fit.covariance))
            for kind, number, square in zip(kinds, numbers, squares, strict=False):
                values[kind][row] = number
                errors[kind][row] = np.sqrt(square)
        dof = [fit.covariance_dof for fit in fits]
        units = {"angle": "rad", "decay": "1/stride"}
        return cls(frame, values, errors, units, dof)

    def __repr__(self) -> str:
        cells = self.table.assign(cell=cells_of(self.table)).groupby("cell", sort=False)
        counts = cells["subject"].nunique().items()
        counted = "; ".join(f"{cell}: {count} subjects" for cell, count in counts)
        names = ", ".join(self.values)
        return folded(f"Population({names}; {counted}; {len(self.table)} estimates)")

    def plot(self, quantity: str, *, ax: object = None) -> Any:
        """Draw the estimate of each subject, and the mean of each group and condition.

        Estimates are squares with their 95 % intervals, predictions open circles, and means
        diamonds, as wide as their 95 % intervals.

        **Arguments:**

        - `quantity`: name of the quantity, such as "modulus".
        - `ax`: one Axes. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (1, 1), the quantity in its unit.

        **Raises:** `DefinitionError` for a quantity that does not exist, too few subjects for a
        mean, or if `ax` is not one Axes.

        **Example:**

        ```python
        gain = np.array([0.61, 0.58, 0.66, 0.63])
        table = {"subject": ["S1", "S2", "S3", "S4"]}
        people = hj.recordings.Population(table, {"gain": gain}, {"gain": 0.02 + 0 * gain})
        people.plot("gain")
        ```
        """
        return super().plot(quantity, ax=ax)

    def mean(self, quantity: str, *, covariates: OptionalNames = ()) -> Any:
        """Return the mean over subjects, and the spread between them, in each group and condition.

        Intervals of the mean, and of the slopes of covariates, are those of Hartung and
        Knapp (2001, 2003). The spread is a standard deviation, without the errors of
        the estimates; its intervals follow from the Q profile (Viechtbauer 2007). All
        intervals assume that the values of the subjects have a normal distribution. A
        warning (`FindingWarning`) reports values that do not (Shapiro and Wilk 1965).
        With covariates, the mean is that at the mean of each covariate.

        **Raises:** `DefinitionError` for an unknown quantity or covariate, and for too few
        subjects.
        """
        parts = []
        findings: list[Finding] = []
        for cell, data in self._cells(quantity, 2 + len(covariates), covariates):
            y = data["y"].to_numpy()
            v = data["v"].to_numpy()
            slopes = data.filter(like=_SLOPE)
            ones = np.ones(len(y))
            x = np.column_stack([ones, slopes - slopes.mean()])
            fit = meta(y, v, x)
            between = np.sqrt(fit.between[0, 0])
            spread = (between, *spread_interval(y, v, x))
            deviation = np.sqrt(v + fit.between[0, 0])
            residual = (y - x @ fit.coefficients) / deviation
            findings += _about_distribution(quantity, cell, residual)
            names = ["mean", *slopes]
            if cell != "all":
                names = [f"{name}, {cell}" for name in names]
            part = self._effects(
                quantity, names, len(y), fit, np.eye(x.shape[1]), spread
            )
            part.loc[0, "p"] = np.nan
            parts.append(part)
        warn_of(findings)
        return _result(
            parts,
            f"Means of {quantity} and 95 % intervals: random-effects model with the standard error "
            "of each subject, by restricted maximum likelihood (Hartung and Knapp).",
        )

    def difference(
        self,
        quantity: str,
        a: str,
        b: str,
        *,
        covariates: OptionalNames = (),
    ) -> Any:
        """Return the mean difference a - b of two conditions or two groups, and test it.

        Differences are paired in subjects that have both; subjects that have only one of the two
        count, too. The variances between subjects may differ in each group and condition.
        Covariance and degrees of freedom are those of Kenward and Roger (1997). If the table also
        has the other factor, the difference is averaged over it.

        **Arguments:** `covariates`: columns with common slopes. Default: none.

        **Raises:** `DefinitionError` in the cases of `mean`, and for labels that are not in the
        table.
        """
        data, cell, w, pairs = self._contrast(quantity, a, b, covariates)
        subject, _ = data["subject"].factorize()
        slopes = data.filter(like=_SLOPE)
        of_cell = np.eye(len(w))[cell]
        x = np.column_stack([of_cell, slopes - slopes.mean()])
        fit = mixed(data["y"].to_numpy(), data["v"].to_numpy(), x, subject, cell)
        weights = np.eye(x.shape[1])[len(w) - 1 :]
        weights[0, : len(w)] = w
        spread = (np.nan, np.nan, np.nan)
        y, v = pairs.to_numpy().T
        if len(y) > 2:
            bounds = spread_interval(y, v, np.ones((len(y), 1)))
            spread = (np.sqrt(w @ fit.between @ w), *bounds)
            deviation = np.sqrt(v + w @ fit.between @ w)
            residual = (y - y.mean()) / deviation
            warn_of(_about_distribution(quantity, f"{a} - {b}", residual))
        n = subject.max() + 1
        names = [f"{a} - {b}", *slopes]
        rows = self._effects(quantity, names, n, fit, weights, spread)
        return _result(
            [rows],
            f"Difference of {quantity} ({a} - {b}; {n} subjects, {len(y)} with all conditions) and "
            "95 % interval: linear mixed model with the variance of each estimate, by restricted "
            "maximum likelihood (Kenward and Roger).",
        )

    def predictions(self, quantity: str) -> Any:
        """Return the best linear unbiased prediction of each subject. It is the
        estimate, shrunken towards the mean of its group and condition; a larger error
        shrinks it more.

        Standard errors contain those of the mean and of the variance between subjects (Prasad and
        Rao 1990).

        **Raises:** `DefinitionError` in the cases of `mean`; three subjects are needed.
        """
        parts = []
        for _, data in self._cells(quantity, 3):
            y = data["y"].to_numpy()
            v = data["v"].to_numpy()
            fit = meta(y, v, np.ones((len(y), 1)))
            mean = fit.coefficients[0]
            between = fit.between[0, 0]
            share = between / (between + v)
            of_mean = (1 - share) ** 2 * fit.covariance[0, 0]
            by_between = 2 * v**2 / (v + between) ** 3
            of_spread = by_between * fit.uncertainty[0, 0]
            error = np.sqrt(share * v + of_mean + of_spread)
            value = mean + share * (y - mean)
            reach = stats.t.ppf(0.975, fit.most) * error
            part = data[["subject", "cell"]].assign(
                quantity=quantity,
                unit=self.units[quantity],
                estimate=y,
                standard_error=np.sqrt(v),
                prediction=value,
                prediction_error=error,
                low=value - reach,
                high=value + reach,
            )
            parts.append(part)
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

        Simulated subjects have the spread of the pilot, and standard errors drawn from
        those of the pilot. If `labels` are two conditions, the test is for paired
        differences. Without labels, it compares two groups with `subjects` in each, and
        both have the spread of the pilot.

        **Arguments:** `difference`: true difference, in units of the quantity. `subjects`: their
        numbers. `draws`: number of simulated populations.

        **Returns:** power at the pilot's spread, with a 95 % interval that contains the error of
        the simulation and the interval of the spread.

        **Raises:** `DefinitionError` in the cases of `difference`, and if xarray is not installed.
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
        ones = np.ones((len(y), 1))
        spread = np.sqrt(meta(y, v, ones).between[0, 0])
        narrow, wide = spread_interval(y, v, ones)
        paired = bool(labels)

        def significant(n: int, spread: float) -> int:
            test = _test(v, n, spread, difference, paired)
            return int(monte_carlo(test, draws, seed).value.sum())

        rows = []
        for n in subjects:
            # A wide spread between subjects gives a low power.
            low = stats.binomtest(significant(n, wide), draws).proportion_ci().low
            high = stats.binomtest(significant(n, narrow), draws).proportion_ci().high
            power = significant(n, spread) / draws
            rows.append((n, power, low, high, spread, draws))
        columns = ("subjects", "power", "power_low", "power_high", "spread", "draws")
        return _result(
            [package("pandas").DataFrame(rows, columns=columns)],
            f"Power for a difference of {difference:g} in {quantity} "
            f"({'paired differences' if paired else 'two groups'}): {draws} simulated populations "
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
        between = np.mean(
            [
                meta(
                    data["y"].to_numpy(), data["v"].to_numpy(), np.ones((len(data), 1))
                ).between
                for _, data in self._cells(quantity, 3)
            ]
        )
        trials = self._trials(quantity).assign(strides=self._numbers("strides"))
        trials = trials.dropna()
        by_subject = trials.groupby(["subject", "cell"])
        count = by_subject["y"].count()
        excess = by_subject["y"].var().fillna(0.0) - by_subject["v"].mean()
        surplus = (count - 1).sum()
        excess_square = ((count - 1) * excess).sum()
        trial = max(excess_square / max(surplus, 1), 0.0)
        if trial > 0:
            between -= trial * np.mean(1 / count)
        if not between > 0:
            raise DefinitionError(
                f"subjects differ in '{quantity}' by no more than their errors: find their spread "
                "from more subjects."
            )
        stride = np.mean(trials["v"] * trials["strides"])
        best = np.sqrt(trial / between * subject_cost / trial_cost)
        k = max(round(best), 1)
        cost = (subject_cost + k * trial_cost) / stride_cost
        row = {
            "quantity": quantity,
            "trials": k,
            "strides": np.sqrt(stride * cost / (k**2 * between + k * trial)),
            "subject_spread": np.sqrt(between),
            "trial_spread": np.sqrt(trial),
            "stride_spread": np.sqrt(stride),
        }
        return _result(
            [package("pandas").DataFrame([row])],
            "Trials and strides: smallest variance of the mean for its cost (Cochran).",
        )

    def _numbers(self, name: str) -> np.ndarray:
        """Return a column of the table (rows,).

        **Raises:** `DefinitionError` if it does not exist, or does not hold numbers alone.
        """
        values = np.asarray(self.table.get(name, ""))
        if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise DefinitionError(
                f"`table` needs a column '{name}' with a number in each row."
            )
        return values.astype(float)

    def _trials(self, quantity: str) -> Any:
        """Return subject, factors, cell, estimate and moderated variance of each row."""
        if quantity not in self.values:
            raise DefinitionError(
                f"there is no quantity '{quantity}'; quantities are {', '.join(self.values)}."
            )
        y = np.asarray(self.values[quantity])
        v = np.asarray(self.errors[quantity]) ** 2
        trend = np.ones((len(y), 1))
        strides = np.asarray(self.table.get("strides", ""))
        if strides.dtype.kind in "iuf" and np.ptp(strides) > 0:
            trend = np.column_stack([trend, np.log(np.maximum(strides, 1.0))])
        known = np.isfinite(y)
        v[~known] = np.nan
        v[known] = moderated(v[known], self.dof[known], trend[known])
        frame = self.table[["subject", *factors_of(self.table)]]
        return frame.assign(cell=cells_of(frame), y=y, v=v)

    def _merged(
        self,
        quantity: str,
        covariates: Sequence[str],
        rows: Any = None,
    ) -> Any:
        """Return a row for each subject in each group and condition; trials are averaged."""
        slopes = {_SLOPE + name: self._numbers(name) for name in covariates}
        trials = self._trials(quantity)
        weight = 1 / trials["v"]
        frame = trials.assign(w=weight, wy=weight * trials["y"], **slopes)
        if rows is not None:
            frame = frame[rows]
        frame = frame[np.isfinite(frame["y"])]
        by = frame.groupby(["subject", *factors_of(frame), "cell"], sort=False)
        sums = by[["w", "wy"]].sum()
        means = by[list(slopes)].mean()
        data = sums.join(means).reset_index()
        return data.assign(y=data["wy"] / data["w"], v=1 / data["w"])

    def _cells(self, quantity: str, needed: int, covariates: Sequence[str] = ()) -> Any:
        """Return the label and the merged estimates of each cell (group and condition).

        **Raises:** `DefinitionError` for a cell with fewer subjects than `needed`.
        """
        merged = self._merged(quantity, covariates)
        cells = dict(list(merged.groupby("cell", sort=False)))
        subjects = {cell: data["subject"] for cell, data in cells.items()}
        require(subjects or {"all": ()}, needed)
        return cells.items()

    def _contrast(self, quantity: str, a: str, b: str, covariates: Sequence[str] = ()):
        """Prepare the difference a - b of two conditions or groups. Returns a frame with the
        estimates of subjects; for each of its rows, the number of its cell (group and condition);
        the weight of each cell in the difference; and the differences of those subjects that have
        estimates in all cells."""
        factor, rows = rows_with(self.table, a, b)
        data = self._merged(quantity, covariates, rows)
        require(dict(list(data.groupby("cell")["subject"])), 2)
        cell, names = data["cell"].factorize()
        is_a = data.drop_duplicates("cell")[factor].to_numpy() == a
        weight_of_a = 1 / max(is_a.sum(), 1)
        weight_of_b = -1 / max((~is_a).sum(), 1)
        w = np.where(is_a, weight_of_a, weight_of_b)
        weighted = data.assign(
            y=data["y"] * w[cell],
            v=data["v"] * w[cell] ** 2,
        )
        of_subjects = weighted.groupby("subject")
        whole = of_subjects.size() == len(names)
        return data, cell, w, of_subjects[["y", "v"]].sum()[whole]

    def _effects(
        self,
        quantity: str,
        names: list[str],
        subjects: int,
        fit: Mixed,
        weights: np.ndarray,
        spread: tuple[float, ...],
    ) -> Any:
        """Return a row for each contrast of a fit; the first has the spread and its interval."""
        value, error, dof = np.array([fit.contrast(w) for w in weights]).T
        reach = stats.t.ppf(0.975, dof) * error
        frame = package("pandas").DataFrame(
            {
                "quantity": quantity,
                "effect": names,
                "unit": self.units[quantity],
                "subjects": subjects,
                "estimate": value,
                "standard_error": error,
                "dof": dof,
                "low": value - reach,
                "high": value + reach,
                "p": 2 * stats.t.sf(abs(value) / error, dof),
            }
        )
        frame.loc[0, ["spread", "spread_low", "spread_high"]] = spread
        return frame


def _decay(modulus: float, variance: float) -> tuple[float, float]:
    """Return the rate at which a deviation decays per stride, and its variance; NaN for a modulus
    of zero.

    (Means of half-lives would be biased: their errors grow with their values, so that weights by
    errors favor short half-lives. And there is no half-life if deviations do not decay.)
    """
    if modulus == 0:
        return np.nan, np.nan
    return float(-np.log(modulus)), variance / modulus**2


def _polar(fit: MultiplierFit | NaturalMultipliers) -> tuple[float, float, list[float]]:
    """Return modulus and angle of the leading multiplier, and their variances. The angle of a real
    multiplier is NaN."""
    z = complex(fit.multipliers[0])
    covariance = fit.multiplier_covariances[0]
    # Derivatives of modulus and angle with respect to real and imaginary part.
    radial = np.array([z.real, z.imag]) / abs(z)
    turned = np.array([-z.imag, z.real])
    angular = turned / abs(z) ** 2
    variances = [float(slope @ covariance @ slope) for slope in (radial, angular)]
    angle = abs(np.angle(z)) if z.imag else np.nan
    return abs(z), float(angle), variances


def _require_comparable(
    fits: Sequence[MultiplierFit | NaturalMultipliers],
    subjects: Sequence[str],
) -> None:
    """**Raises:** `DefinitionError` for a fit without covariance, and other outputs."""
    for subject, fit in zip(subjects, fits, strict=True):
        require_equal(
            f"the fits of subjects '{subjects[0]}' and '{subject}'",
            "outputs",
            getattr(fits[0], "outputs", ()),
            getattr(fit, "outputs", ()),
        )
        if not np.isfinite(fit.covariance).all():
            raise DefinitionError(
                f"the fit of subject '{subject}' has no covariance: record more strides, or leave "
                "the subject out."
            )


def _about_distribution(
    quantity: str, cell: str, residual: np.ndarray
) -> list[Finding]:
    """Return a finding if subjects are not normally distributed, by the test of Shapiro and
    Wilk."""
    if len(residual) < _FEWEST_TESTED or not np.ptp(residual) > 0:
        return []
    p = float(stats.shapiro(residual).pvalue)
    if p > _NORMAL:
        return []
    return [
        Finding(
            "not normal",
            f"{quantity} of the subjects ({cell}) is not normally distributed ({p_value(p)}), as "
            "intervals assume; that of the spread may be far too narrow. Look for outliers, or "
            "take logarithms.",
        )
    ]


def _result(parts: list, text: str) -> Any:
    frame = package("pandas").concat(parts, ignore_index=True)
    frame.attrs["methods"] = signed(text)
    return frame


def _test(
    variances: np.ndarray,
    n: int,
    spread: float,
    difference: float,
    paired: bool,
):
    """Return a function of a random generator that simulates subjects, and returns whether the
    difference differs from zero."""
    subjects = np.arange(n if paired else 2 * n)
    group = subjects // n
    x = np.eye(group[-1] + 1)[group]
    contrast = np.array([1.0, -1.0])[: group[-1] + 1]

    def draw(rng: np.random.Generator) -> int:
        v = rng.choice(variances, len(subjects))
        deviation = np.sqrt(spread**2 + v)
        y = deviation * rng.normal(size=len(subjects))
        y += difference * (group == 0)
        fit = meta(y, v, x) if paired else mixed(y, v, x, subjects, group)
        value, error, dof = fit.contrast(contrast)
        return int(abs(value) > stats.t.isf(0.025, dof) * error)

    return draw
