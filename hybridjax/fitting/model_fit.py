"""`ModelFit`: the result of a fit of physical parameters; and `Identifiability`, the combinations
of parameters that data identify.

`fit.py` makes both. `diagnose` finds combinations without effect from the singular values of the
sensitivities, and `_readable` and `_rounded` bring them to a form with small integers.
`ParameterFit` has what does not need the system: standard errors, confidence regions, comparisons.

If a combination is identified by rounding alone, or one that the data determine is not, look at
`_RANK`; if a combination is printed badly, at `_CLOSE` and `_describe`. Wrong standard errors come
from the covariance, which `fit.py` computes. A further finding is added in `ModelFit._doubts`. Two
things must stay: `values`, `covariance` and `unseen` have the order of `names`, and the fields of
`ParameterEstimate` are what `hj.save` writes.
"""

import itertools
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any, NamedTuple, Union

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.boundary.members import leading_on
from .._core.findings import Finding
from .._core.html import table, text
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import p_value, rounded, standard_error
from ..errors import DefinitionError
from ..identify.fit import Fit, WithCost, not_converged
from ..linear.ldtp import LDTP
from ..orbits.cycle import LimitCycle
from ..sections.families import AbstractSections
from ..sections.linearization import linearize
from ..systems.system import HybridSystem, arrays_of, name_of, unit_of_parameter
from .problem import DELAYS, FALSE_ALARMS, FitProblem, of_system, tail_of


# Singular values of the sensitivities below this, or below this part of the largest one, are zero.
# Larger: badly identified combinations count as unidentifiable. Smaller: rounding identifies them.
_RANK = 1e-9
# Entries of a direction (without unit) that are this close to zero, or to a ratio of integers with
# a denominator up to `_LARGEST_DENOMINATOR`, are replaced by it. A basis is solved for entries
# whose smallest singular value exceeds this. Larger: wrong exponents are printed as integers.
# Smaller: rounding errors of derivatives are printed.
_CLOSE, _LARGEST_DENOMINATOR = 1e-3, 6

# Residuals of this part of what the best identified combination would change are errors of
# integration. Larger: misfits to precise data pass. Smaller: data without noise are a misfit if
# their standard deviations are tiny.
_INTEGRATED = 1e-7


class Identifiability(Showable, eqx.Module):
    r"""The combinations of parameters that the data identify, near given values.

    S holds the sensitivities $S_{ij} = p_j\,\partial r_i/\partial p_j$ of the weighted
    residuals to relative changes. Changes in the null space of S do not change the data
    (to first order). If w is a row of `unseen`, the change $p_j \to p_j\, c^{w_j}$ of
    all parameters does not change the data. For a parameter that is zero, or that has
    bounds on both sides or no bound, the change is $p_j \to p_j + s_j w_j \log c$.

    **Fields:**

    - `names` (p,) of the parameters. `rank`: number of identified combinations.
    - `singular_values` (p,) of S, the largest first. If residuals are in units of standard
      deviations, the relative standard error of a combination is one divided by its singular value.
    - `unseen` (p - rank, p): a basis of the null space with as many zeros as possible; its rows are
      small integers if their ratios are.
    - `sensitivity` (r, p): S.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    singular_values: Float[np.ndarray, " p"]
    unseen: Float[np.ndarray, "k p"]
    sensitivity: Float[np.ndarray, "r p"]

    @property
    def complete(self) -> bool:
        """True if every parameter is identified."""
        return self.rank == len(self.names)

    def descriptions(self) -> list[str]:
        """Return the unidentifiable combinations, in words."""
        return [_describe(self.names, row) for row in self.unseen]

    def __repr__(self) -> str:
        nonzero = ", ".join(f"{x:.2g}" for x in self.singular_values[: self.rank])
        lost = ", ".join(f"{x:.1g}" for x in self.singular_values[self.rank :])
        names = ", ".join(self.names)
        p = len(self.names)
        lines = [
            f"Identifiability: {self.rank} of {p} combinations of ({names}) are identified"
        ]
        lines += [f"  not identified: {text}" for text in self.descriptions()]
        lines.append(
            f"  singular values {nonzero}" + (f"; zero: {lost}" if lost else "")
        )
        return "\n".join(lines)


def diagnose(
    names: tuple[str, ...], sensitivity: Float[np.ndarray, "r p"]
) -> Identifiability:
    """Return the identifiability from the sensitivities S of weighted residuals to relative changes
    of the parameters."""
    _, values, rows = np.linalg.svd(np.linalg.qr(sensitivity, mode="r"))
    values = np.concatenate([values, np.zeros(len(names) - len(values))])
    rank = int(np.sum(values > _RANK * max(values[0], 1.0)))
    return Identifiability(names, rank, values, _readable(rows[rank:]), sensitivity)


def _readable(basis: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Return the basis of the same space with the most zeros among those in echelon form."""
    k, p = basis.shape
    if k == 0:
        return basis
    forms = []
    for pivots in itertools.combinations(range(p), k):
        block = basis[:, pivots]
        if np.linalg.svd(block, compute_uv=False)[-1] >= _CLOSE:
            forms.append(_rounded(np.linalg.solve(block, basis)))
    return min(forms, key=lambda form: (np.count_nonzero(form), np.sum(form < 0)))


def _rounded(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Return rows scaled so that their entries are small integers, if their ratios allow it."""
    out = []
    for row in rows:
        nearest = [Fraction(x).limit_denominator(_LARGEST_DENOMINATOR) for x in row]
        if max(abs(float(n) - x) for n, x in zip(nearest, row, strict=True)) < _CLOSE:
            common = np.lcm.reduce([n.denominator for n in nearest])
            row = np.array([float(n * int(common)) for n in nearest])
        out.append(np.where(np.abs(row) < _CLOSE, 0.0, row))
    return np.array(out)


def _describe(names: tuple[str, ...], row: Float[np.ndarray, " p"]) -> str:
    """An unidentifiable combination in words, from its relative change of each parameter."""
    places = np.flatnonzero(row)
    moved = [names[k] for k in places]
    power = row[places]
    first = moved[0]
    if len(moved) == 1:
        return first
    last = moved[-1]
    together = ", ".join(moved)
    if np.all(power == power[0]):
        if len(moved) == 2:
            return f"a common factor of ({together}), only {first}/{last}"
        return f"a common factor of ({together})"
    if len(moved) == 2 and power[0] == -power[1]:
        return f"{first} and {last} apart, only their product"
    powers = []
    for name, x in zip(moved, power, strict=True):
        powers.append(name if x == 1 else f"{name}^{x:.3g}")
    return f"a common factor, with these powers, of ({', '.join(powers)})"


@leading_on
class ParameterGuess(NamedTuple):
    """A guess of a fit, and its result."""

    values: Float[np.ndarray, " p"]
    fitted: Float[np.ndarray, " p"]
    cost: float
    steps: int
    """Evaluations of the model with its derivatives."""
    result: int
    """Code of `Result`."""


class ParameterComparison(Showable, eqx.Module):
    """Fitted parameters compared with true values or with another fit. Printing it shows a table.

    **Fields:** `names`; `true` and `estimated` (p,); `error` (p,), their difference, and
    `standard_errors` (p,) of the difference. `p_value`: probability of differences at least as
    large if all true differences are zero. `with_fit`: whether `true` is another fit.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    true: Float[np.ndarray, " p"]
    estimated: Float[np.ndarray, " p"]
    standard_errors: Float[np.ndarray, " p"]
    p_value: float = eqx.field(static=True)
    with_fit: bool = eqx.field(static=True, default=False)

    @property
    def error(self) -> Float[np.ndarray, " p"]:
        return self.estimated - self.true

    def __repr__(self) -> str:
        width = max(9, *map(len, self.names))
        names = ("true", "estimated", "error", "standard error")
        if self.with_fit:
            names = ("other fit", "this fit", "change", "standard error")
        heads = "{:>12}  {:>12}  {:>9}  {:>14}".format(*names)
        rows = [f"{'parameter':>{width}}  {heads}"]
        columns = self.true, self.estimated, self.error, self.standard_errors
        for name, true, estimated, error, size in zip(
            self.names, *columns, strict=True
        ):
            rows.append(
                f"{name:>{width}}  {true:12.6g}  {estimated:12.6g}  {error:9.2g}  {size:14.2g}"
            )
        rows.append(f"all are equal: {p_value(self.p_value)}")
        return "\n".join(rows)


Truth = Union[HybridSystem, LimitCycle, "ParameterFit", Mapping[str, float]]
"""Values of parameters by name, or an object that has parameters with these names."""


class ParameterFit(WithCost, Fit):
    """Base class of fits of parameters, those with their system and those that were saved without.

    **Fields:**

    - `names`, `values` (p,), `units`: the free parameters.
    - `covariance` (p, p): of the values. `unseen` (p - rank, p): combinations that the data do not
      identify, see `Identifiability`.
    - `weighted`: whether all data have standard deviations. `dof`, `result`: as for all fits.
    """

    if TYPE_CHECKING:
        # (Fields of one, and properties of the other.)
        @property
        def names(self) -> tuple[str, ...]: ...
        @property
        def values(self) -> Float[np.ndarray, " p"]: ...
        @property
        def units(self) -> tuple[str, ...]: ...
        @property
        def unseen(self) -> Float[np.ndarray, "k p"]: ...
        @property
        def weighted(self) -> bool: ...

    @property
    def noise(self) -> None:
        return None

    @property
    def covariance_dof(self) -> float:
        return np.inf if self.weighted else self.dof

    @property
    def standard_errors(self) -> Float[np.ndarray, " p"]:
        """Standard error of each value; infinite for a parameter that is not identified alone, NaN
        without standard deviations of the data if `dof` is 0."""
        lost = np.any(self.unseen != 0, axis=0)
        return np.where(lost, np.inf, np.sqrt(np.diag(self.covariance)))

    @property
    def _rank(self) -> int:
        return len(self.names) - len(self.unseen)

    def _values_of(self, true: Any) -> Float[np.ndarray, " p"]:
        """Return the values of the fitted parameters in a mapping, a system, a cycle or a fit.

        **Raises:** `DefinitionError` if a value is missing or was not fitted.
        """
        if isinstance(true, ParameterFit):
            given: Mapping[str, Any] = dict(zip(true.names, true.values, strict=True))
        elif isinstance(true, HybridSystem | LimitCycle):
            given = self._changed(
                true if isinstance(true, HybridSystem) else true.system
            )
        else:
            given = true
        more = [name for name in given if name not in self.names]
        if more:
            raise DefinitionError(
                f"the other values have another '{more[0]}', which was not fitted: free it."
            )
        missing = [name for name in self.names if name not in given]
        if missing:
            raise DefinitionError(
                f"the other values lack '{missing[0]}', which was fitted."
            )
        return np.array([float(given[name]) for name in self.names])

    def _changed(self, system: HybridSystem) -> dict[str, Any]:
        """Return the numbers of a system that were fitted, or that differ from those of the fit."""
        return {x: y for x, y in arrays_of(system).items() if x in self.names}

    def _distance(
        self, missed: Float[np.ndarray, " p"], covariance: Float[np.ndarray, "p p"]
    ) -> float:
        """Return the squared size of a difference, in units of a covariance."""
        size = np.sqrt(np.diag(covariance))
        size = np.where(size > 0, size, 1.0)
        correlation = covariance / np.outer(size, size)
        weights = np.linalg.pinv(correlation, rcond=_RANK, hermitian=True)
        return float(missed / size @ weights @ (missed / size))

    @checked
    def chi_square(self, true: Truth) -> float:
        """Return the squared distance of the values from other ones, in units of the covariance."""
        return self._distance(self._values_of(true) - self.values, self.covariance)

    @checked
    def contains(self, true: Truth, level: Probability = 0.95) -> bool:
        """Test whether other values lie in the joint confidence region.

        **Example:**

        ```python
        observed = hj.fitting.ObservedHTF(htf, sections)
        found = hj.fit_model(hopper, observed, "k")
        print(found.contains({"k": 10.0}, level=0.99))
        ```
        """
        return self._tail(self.chi_square(true), self.covariance_dof) >= 1 - level

    @checked
    def compare(self, other: Truth) -> ParameterComparison:
        """Compare the values with true ones, or with those of another fit of the same parameters,
        to other data; printing the result shows a table.

        **Arguments:** `other`: values by name, a system or cycle with them, or a fit.

        **Raises:** `DefinitionError` if a value is missing or was not fitted, or if the fit has no
        standard errors.

        **Example:**

        ```python
        observed = hj.fitting.ObservedHTF(htf, sections)
        found = hj.fit_model(hopper, observed, "k")
        print(found.compare({"k": 10.0}))
        ```
        """
        true = self._values_of(other)
        errors = self.standard_errors
        if isinstance(other, ParameterFit):
            order = [other.names.index(name) for name in self.names]
            covariance = self.covariance + other.covariance[np.ix_(order, order)]
            errors = np.hypot(errors, other.standard_errors[order])
            distance = self._distance(self.values - true, covariance)
            dof = min(self.covariance_dof, other.covariance_dof)
        else:
            distance = self.chi_square(other)
            dof = self.covariance_dof
        tail = self._tail(distance, dof)
        with_fit = isinstance(other, ParameterFit)
        return ParameterComparison(
            self.names, true, self.values, errors, tail, with_fit
        )

    def _tail(self, distance: float, dof: float) -> float:
        """Return the probability of a larger squared distance from the true values."""
        from scipy import special  # (a fifth of a second)

        rank = max(self._rank, 1)
        if np.isinf(dof):
            return float(special.chdtrc(rank, distance))
        return float(special.fdtrc(rank, dof, distance / rank))

    def _estimates(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        return self.values, self.standard_errors

    def rows(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield each name with its value, standard error and unit."""
        for name, value, error, unit in zip(
            self.names, self.values, self.standard_errors, self.units, strict=True
        ):
            shown = (
                "not identified alone"
                if np.isinf(error)
                else f"± {standard_error(error)}"
            )
            yield name, rounded(value, error), shown, unit

    def _table(self) -> Iterator[str]:
        """Yield the lines of a summary with the values."""
        width = max(map(len, self.names))
        for name, value, error, unit in self.rows():
            shown = f"{error} {unit}" if "±" in error else error
            yield f"{name:{width}}  {value:<14} {shown}".rstrip()


class ParameterEstimate(ParameterFit):
    """Fitted parameters without their system: what `hj.save` writes of a `ModelFit`.

    **Fields** beside those of all fits of parameters: `system`, the name of its class;
    `multipliers` of its limit cycle; `cost`; `findings`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    system: str = eqx.field(static=True)
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    unseen: Float[np.ndarray, "k p"]
    multipliers: Complex[np.ndarray, " d"]
    cost: float = eqx.field(static=True)
    dof: float = eqx.field(static=True)
    weighted: bool = eqx.field(static=True)
    result: int = eqx.field(static=True)
    findings: tuple[Finding, ...] = eqx.field(default=())

    @property
    def model(self) -> None:
        return None

    def _summary(self) -> str:
        head = f"ParameterEstimate({self.system}: {Result(self.result).message})"
        return "\n  ".join([head, *self._table()])

    def _page(self) -> tuple[str, ...]:
        parameters = table(
            ("parameter", "value", "standard error", "unit"), self.rows()
        )
        return f"of {self.system}: {Result(self.result).message}", parameters


class ModelFit(ParameterFit):
    r"""A system whose parameters were fitted to data.

    **Fields** beside those of every `Fit` (`noise` is None):

    - `system`, and `model`: with the fitted parameters. `cycle`: the limit cycle of
        `system`, which has the `multipliers`. It is None for a fit to trajectories
        (`ObservedTrajectory`).
    - `names`, `values` (p,): the free parameters.
    - `covariance` (p, p): covariance of the values, $(J^T J)^+$ with the Jacobian J of
        the residuals in units of their standard deviations. Where the data have no
        standard deviations, they are estimated from the residuals; if `dof` is 0, the
        covariance is then NaN. It is zero along combinations that the data do not
        identify.
    - `residuals` (r,): weighted, those of all observations one after the other.
    - `cost`: sum of the squares of the residuals. `dof`: r less the number of
        identified combinations. It is the expected cost if all data have standard
        deviations.
    - `identifiability`: the combinations of parameters that the data identify.
    - `guesses`: for each guess, in order, its `values` (p,), the `fitted` ones (p,), their `cost`,
        the number of evaluations, `steps`, and the `result`. `result`: code of the best one.
    - `problem`: the minimized function.
    - `findings`: "misfit" if residuals are larger than the standard deviations of the data explain,
        by a chi-square test at the level of 0.1 %; "not identified", for combinations of
        parameters; "a bound", for parameters that reach theirs within their standard errors; "no
        convergence".
    """

    system: HybridSystem
    cycle: LimitCycle | None
    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    residuals: Float[np.ndarray, " r"]
    cost: float = eqx.field(static=True)
    dof: float = eqx.field(static=True)
    identifiability: Identifiability
    guesses: tuple[ParameterGuess, ...]
    result: int = eqx.field(static=True)
    problem: FitProblem

    @property
    def multipliers(self) -> Complex[np.ndarray, " d"]:
        return np.zeros(0, complex) if self.cycle is None else self.cycle.multipliers

    @property
    def model(self) -> HybridSystem:
        return self.system

    @property
    def findings(self) -> tuple[Finding, ...]:
        return tuple(self._doubts())

    @property
    def unseen(self) -> Float[np.ndarray, "k p"]:
        """Combinations that the data do not identify."""
        return self.identifiability.unseen

    @property
    def units(self) -> tuple[str, ...]:
        units = []
        for name in self.names:
            unit = ""
            if name in DELAYS:
                unit = self.system.time_unit
            elif of_system(name):
                unit = unit_of_parameter(self.system, name)
            units.append(unit)
        return tuple(units)

    @property
    def estimate(self) -> ParameterEstimate:
        """The numbers of the fit without its system, as `hj.save` writes them."""
        return ParameterEstimate(
            names=self.names,
            units=self.units,
            system=name_of(self.system),
            values=np.asarray(self.values),
            covariance=np.asarray(self.covariance),
            unseen=np.asarray(self.unseen),
            multipliers=self.multipliers,
            cost=float(self.cost),
            dof=float(self.dof),
            weighted=self.weighted,
            result=int(self.result),
            findings=self.findings,
        )

    def _linear_model(self, data: Any) -> LDTP:
        """Return the linearization at the sections of an observation with the data's sections.

        **Raises:** `DefinitionError` if there is none.
        """
        for observation in self.problem.observations:
            if self.cycle is None:
                break
            family = getattr(observation, "sections", None)
            if not isinstance(family, AbstractSections):
                continue
            if family.n_sections == data.n_sections:
                delay = getattr(observation, "delay", None)
                names = data.outputs, data.inputs
                return linearize(self.cycle, family, *names, delay)
        raise DefinitionError(
            f"no observation of this fit has {data.n_sections} sections: validate "
            "`hj.linearize(fit.cycle, sections)` at those of the data."
        )

    def _changed(self, system: HybridSystem) -> dict[str, Any]:
        kept = {x: y for x, y in arrays_of(self.system).items() if x not in self.names}
        return {
            x: y
            for x, y in arrays_of(system).items()
            if not np.array_equal(y, kept.get(x, np.nan))
        }

    @property
    def weighted(self) -> bool:
        """True if all data have standard deviations."""
        return self.problem.weighted

    @checked
    def chi_square(self, true: Truth) -> float:
        r"""Return the cost of other values less that of the fit.

        For the true values it has a chi square distribution with `identifiability.rank` degrees of
        freedom (Wilks 1938). Unlike $e^T J^T J e$ with the errors e of the values, it does not
        depend on the parametrization, and follows curved regions. If the data have no standard
        deviations, or estimated ones, its unit is estimated from the residuals.

        **Arguments:** `true`: values by name, or a system whose other parameters are those of the
        fit.

        **Raises:** `DefinitionError` if a value is missing or was not fitted, or if the fit has no
        standard errors.
        """
        values = jnp.array(self._values_of(true))
        if self.cycle is not None:
            self.cycle.require_current()
        x = self.problem.parameters.encode(values)
        r, *_ = self.problem.evaluated(x, self.cycle)
        unit = self.problem.unit(self.cost, self.dof)
        if np.isnan(unit):
            raise DefinitionError(
                "give `std`: no residual is left to estimate standard errors."
            )
        return (float(r @ r) - self.cost) / unit

    def _summary(self) -> str:
        lines = [
            f"ModelFit({name_of(self.system)}: {Result(self.result).message})",
            self._cost(),
            "standard errors include noise, but no distortion:",
            *self._table(),
        ]
        return "\n  ".join(lines)

    def _doubts(self) -> Iterator[Finding]:
        """Yield a misfit, what is not identified, and bounds that standard errors reach."""
        yield from not_converged(self.result)
        yield from self._misfit()
        for combination in self.identifiability.descriptions():
            yield Finding("not identified", f"{combination}.")
        errors = np.where(np.isfinite(self.standard_errors), self.standard_errors, 0.0)
        parameters = self.problem.parameters
        for bounds in (np.asarray(parameters.low), np.asarray(parameters.high)):
            for k in np.flatnonzero(np.abs(bounds - self.values) < errors):
                text = (
                    f"{self.names[k]} reaches its bound {bounds[k]:g} within its error."
                )
                yield Finding("a bound", text)

    def _misfit(self) -> Iterator[Finding]:
        """Yield a finding if the standard deviations of the data do not explain the residuals."""
        strongest = self.identifiability.singular_values[0]
        are_exact = np.sqrt(self.cost) <= _INTEGRATED * strongest
        if not self.weighted or not self.dof or are_exact:
            return
        most = self.problem.most
        p = float(tail_of(self.cost, self.dof, most))
        if p >= FALSE_ALARMS:
            return
        times = np.sqrt(self.chi2_per_dof / most)
        yield Finding(
            "misfit",
            f"residuals are {times:.2g} times as large as the standard deviations of the data "
            f"explain ({p_value(p)}), so that the standard errors do not hold: fit other "
            "parameters or another model, try more `guesses` (this minimum may be a local one), "
            "or give larger standard deviations if those of the data are too small.",
        )

    def _cost(self) -> str:
        size = (
            f"residuals {100 * np.sqrt(np.mean(self.residuals**2)):.2g} % of the data"
        )
        if self.weighted:
            size = f"chi-square per degree of freedom {self.chi2_per_dof:.3g}"
        good = sum(guess.result == Result.OK for guess in self.guesses)
        head = f"{size}; {good} of {len(self.guesses)} guesses converged"
        return f"{head}, {sum(guess.steps for guess in self.guesses)} evaluations"

    def _page(self) -> tuple[str, ...]:
        parameters = table(
            ("parameter", "value", "standard error", "unit"), self.rows()
        )
        of = f"of {name_of(self.system)}: {Result(self.result).message}"
        return of, parameters, text(self._cost())
