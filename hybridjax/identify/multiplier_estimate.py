"""`MultiplierFit`: estimated Floquet multipliers with confidence regions, and their comparison with
true ones.

All fits of multipliers are subclasses. They give the coefficients of the polynomial whose roots are
the multipliers, and the covariance of these coefficients; standard errors, confidence regions
(`contains`, `ellipse`) and tests follow from these here. If regions are wrong, first test the
covariance of the coefficients: it comes from the subclass. The last functions of the file make
findings about the number of multipliers (`order_doubts`, `left_out`).
"""

import dataclasses
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._core.arguments import Numbers, require_index
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.boundary.values import Complexes
from .._core.findings import Finding
from .._core.html import multiplier_table, text, unit_circle
from .._core.results import Result
from .._core.showable import Showable, WithMultipliers
from .._core.text import folded, p_value, rounded, standard_error
from ..errors import DefinitionError
from ..linear.multipliers import largest_first
from .denominator import Covariance, multipliers_of
from .descent import Coefficients, positive
from .fit import Fit


# Level of the test whether a fit needs one more multiplier. Larger: with process noise, whose
# errors are estimated from few blocks, fits of the right order get a finding. Smaller: missing weak
# multipliers that bias the others pass.
_NEEDED = 1e-4


Multipliers = Annotated[Numbers, Complexes()]
"""Supposed or true multipliers, one or several."""


@runtime_checkable
class HasMultipliers(Protocol):
    """A limit cycle, a model, or a fit."""

    @property
    def multipliers(self) -> Any: ...


Truth = Multipliers | HasMultipliers
"""Multipliers, or an object that has them."""


def multipliers_from(truth: Any) -> Complex[np.ndarray, " k"]:
    """Return the multipliers of a limit cycle, a model or a fit, or the given ones."""
    values = getattr(truth, "multipliers", truth)
    return np.atleast_1d(np.asarray(values, complex)).ravel()


RoughFit = tuple[Coefficients, Callable[[], Covariance]]
"""Coefficients, and a function for their covariance."""

# Eigenvalues of a correlation matrix below this part of the largest one are zero, so that the
# equations of two equal multipliers count as one. Larger: correlated equations count as one.
# Smaller: division by rounding errors.
_RANK = 1e-12
# Points of the border of a confidence region. Fewer: corners show; more: figures grow.
_BORDER_POINTS = 100


class MultiplierComparison(Showable, eqx.Module):
    """Estimated Floquet multipliers, each paired with a true multiplier or with a multiplier of
    another fit.

    The pairing has the smallest sum of distances; if the numbers of multipliers differ, the
    unpaired ones are not listed. Printing it shows a table.

    **Fields**, sorted by output, then by decreasing modulus of the true multiplier:

    - `true` and `estimated` (k,); `error` (k,), their distance, and `max_error`, the largest.
    - `outputs` (k,): the outputs' names; empty where all outputs have the same multipliers.
    - `p_value`: probability of distances at least as large if all true distances are zero. It is
      None if the covariance is unknown.
    - `with_fit`: whether `true` is another fit, and `error` the distance from its multipliers.
    """

    true: Complex[np.ndarray, " k"]
    estimated: Complex[np.ndarray, " k"]
    outputs: tuple[str, ...] = eqx.field(static=True, default=())
    p_value: float | None = eqx.field(static=True, default=None)
    with_fit: bool = eqx.field(static=True, default=False)

    @property
    def error(self) -> Float[np.ndarray, " k"]:
        return np.abs(self.estimated - self.true)

    @property
    def max_error(self) -> float:
        return float(np.max(self.error))

    def __repr__(self) -> str:
        labels = [f"{name}  " for name in self.outputs] or [""] * len(self.true)
        width = max(map(len, labels))
        heads = ("true", "estimated", "error")
        if self.with_fit:
            heads = ("other fit", "this fit", "distance")
        rows = [" " * width + "{:>26}  {:>26}  {:>8}".format(*heads)]
        pairs = zip(labels, self.true, self.estimated, self.error, strict=True)
        for label, true, estimated, error in pairs:
            numbers = f"{_show(true):>26}  {_show(estimated):>26}  {error:8.1e}"
            rows.append(f"{label:>{width}}{numbers}")
        if self.p_value is not None:
            rows.append(f"all are equal: {p_value(self.p_value)}")
        return "\n".join(rows)


def _show(value: complex) -> str:
    imaginary = f" {value.imag:+.9f}j" if value.imag else 14 * " "
    return f"{value.real:+.9f}{imaginary}"


def compare_multipliers(estimated: Any, true: Any) -> MultiplierComparison:
    """Pair estimated with true multipliers so that the sum of distances is smallest.

    **Raises:** `DefinitionError` if either is empty.
    """
    from scipy.optimize import linear_sum_assignment  # (a third of a second)

    values = multipliers_from(estimated)
    truth = multipliers_from(true)
    if values.size == 0 or truth.size == 0:
        raise DefinitionError("`true` or the estimate holds no multiplier to compare.")
    distances = np.abs(values[:, None] - truth)
    rows, columns = linear_sum_assignment(distances)
    paired_values = values[rows]
    paired_truth = truth[columns]
    order = largest_first(paired_truth)
    # (Cycles and models have multipliers without errors.)
    with_fit = hasattr(true, "standard_errors")
    return MultiplierComparison(
        paired_truth[order], paired_values[order], with_fit=with_fit
    )


class OfFit(WithMultipliers):
    """A result of several steps, which has the multipliers of its `fit` and their uncertainty."""

    if TYPE_CHECKING:
        fit: Any

    @property
    def multipliers(self) -> Complex[np.ndarray, " d"]:
        """Those of the fit."""
        return self.fit.multipliers

    @property
    def standard_errors(self) -> Float[np.ndarray, " d"]:
        """Those of the fit."""
        return self.fit.standard_errors

    @checked
    def interval(self, level: Probability = 0.95) -> Float[np.ndarray, "d 2"]:
        """Return bounds of the moduli of the multipliers, as `result.fit.interval` does.

        **Example:**

        ```python
        low, high = result.interval()[0]
        print(f"modulus {result.modulus[0]:.3f}, 95 %: {low:.3f} to {high:.3f}")
        ```
        """
        return self.fit.interval(level)

    @checked
    def contains(
        self, true: Truth, level: Probability = 0.95
    ) -> Bool[np.ndarray, " k"]:
        """Test whether supposed multipliers lie in the confidence region of this level, as
        `result.fit.contains` does.

        **Arguments:** `true`: multipliers, or a cycle, a model or a fit that has them.

        **Example:**

        ```python
        print(result.contains(cycle))
        ```
        """
        return self.fit.contains(true, level)

    @checked
    def compare(self, other: Truth) -> MultiplierComparison:
        """Pair the multipliers with true ones, or with those of another fit, as
        `result.fit.compare` does.

        **Arguments:** `other`: multipliers, or a cycle, a model or a fit that has them.

        **Example:**

        ```python
        print(result.compare(cycle))
        ```
        """
        return self.fit.compare(other)


class MultiplierFit(Fit):
    r"""The part that all fits with the denominator $\chi$ share.

    **Fields** beside those of every `Fit`:

    - `multipliers` (d,): by decreasing modulus, the roots of
      $p(\lambda) = \lambda^d + c_1 \lambda^{d-1} + \ldots + c_d$.
    - `coefficients` (d,): c_1 to c_d, real.
    - `covariance` (d, d): covariance of the coefficients, infinite where it is unknown. It is
      estimated with `covariance_dof` degrees of freedom (infinite: the covariance is exact). All
      standard errors and confidence regions follow from it.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    covariance_dof: float = eqx.field(static=True)
    dof: float = eqx.field(static=True, kw_only=True, default=np.inf)
    result: int = eqx.field(static=True, kw_only=True, default=int(Result.OK))
    findings: tuple[Finding, ...] = eqx.field(kw_only=True, default=())

    @property
    def multiplier_covariances(self) -> Float[np.ndarray, "d 2 2"]:
        r"""Covariance of (Re, Im) of each multiplier, to first order; infinite if it is unknown.

        From $d\lambda / dc_j = -\lambda^{d-j} / p'(\lambda)$. The imaginary part of a real
        multiplier has no variance. Where two multipliers nearly coincide, the first order is too
        small: `contains` does not use it.
        """
        d = len(self.coefficients)
        if not np.isfinite(self.covariance).all():
            return np.full((d, 2, 2), np.inf)
        exponents = np.arange(d - 1, -1, -1)
        powers = self.multipliers[:, None] ** exponents
        slope = np.polyval(np.polyder([1.0, *self.coefficients]), self.multipliers)
        is_real = np.imag(self.multipliers) == 0
        # (p' is zero where two multipliers coincide.)
        with np.errstate(all="ignore"):
            gradient = -powers / slope[:, None]
            imaginary = np.where(is_real[:, None], 0.0, gradient.imag)
            parts = np.stack([gradient.real, imaginary], axis=1)
            return parts @ self.covariance @ parts.mT

    @property
    def standard_errors(self) -> Float[np.ndarray, " d"]:
        """Standard error of each multiplier: the square root of the expected squared distance from
        the true multiplier."""
        return np.sqrt(np.linalg.trace(self.multiplier_covariances))

    def _estimates(self) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """Return the moduli and their standard errors."""
        modulus = self.modulus
        if not np.isfinite(self.covariance).all():
            return modulus, np.full(len(modulus), np.inf)
        along = self.multipliers / positive(modulus)
        parts = np.stack([along.real, along.imag], axis=1)
        outward = parts[:, :, None]
        with np.errstate(all="ignore"):
            variance = outward.mT @ self.multiplier_covariances @ outward
        return modulus, np.sqrt(variance[:, 0, 0])

    @checked
    def distance(self, true: Truth) -> Float[np.ndarray, " k"]:
        r"""Squared distance of the estimate from supposed multipliers, in units of its covariance.

        $\lambda$ is a multiplier if $p(\lambda) = 0$, which is linear in c: one real equation for
        a real $\lambda$, two for a complex one. The result is
        $p^T \mathrm{Cov}(p)^{-1} p$, chi-squared distributed with one or two degrees of freedom at
        a true multiplier (Hotelling's $T^2$ where the covariance is estimated), also where
        multipliers are close to each other (Fieller 1954). Zero where the covariance is infinite.
        """
        truth = multipliers_from(true)
        if not np.isfinite(self.covariance).all():
            return np.zeros(len(truth))
        return np.array(
            [self._distance_of(truth[k : k + 1])[0] for k in range(len(truth))]
        )

    def _distance_of(self, multipliers: Complex[np.ndarray, " k"]) -> tuple[float, int]:
        """Return the squared distance from the hypothesis that all of these are multipliers, and
        the number of independent equations."""
        exponents = np.arange(len(self.coefficients), -1, -1)
        powers = multipliers[:, None] ** exponents
        is_complex = np.imag(multipliers) != 0
        equations = np.concatenate([powers.real, powers[is_complex].imag])
        missed = equations @ [1.0, *self.coefficients]
        slopes = equations[:, 1:]
        covariance = slopes @ self.covariance @ slopes.T
        # (Scaled, since of the two equations of a tiny multiplier one is tiny.)
        scale = np.sqrt(np.diag(covariance))
        if not (scale > 0).all():
            return (np.inf if missed.any() else 0.0), len(missed)
        missed = missed / scale
        correlation = covariance / np.outer(scale, scale)
        solution, _, rank, _ = np.linalg.lstsq(correlation, missed, rcond=_RANK)
        return float(missed @ solution), int(rank)

    @checked
    def contains(
        self, true: Truth, level: Probability = 0.95
    ) -> Bool[np.ndarray, " k"]:
        """Test whether supposed multipliers lie in the confidence region of this level.

        A conjugate pair is one hypothesis, not two.

        **Arguments:** `true`: multipliers, or a cycle, a model or a fit that has them.

        **Example:**

        ```python
        print(fit.contains(cycle), fit.contains(0.0, level=0.99))
        ```
        """
        truth = multipliers_from(true)
        equations = np.where(np.imag(truth) == 0, 1, 2)
        return self.distance(truth) <= self._radius(level, equations)

    @checked
    def ellipse(
        self, index: int = 0, level: Probability = 0.95
    ) -> Complex[np.ndarray, " points"]:
        """Return the border of a multiplier's confidence region, to first order: a closed curve.

        For a real multiplier it is an interval, drawn forth and back. NaN if the covariance is
        unknown.

        **Raises:** `DefinitionError` for an index that is not there.
        """
        require_index("multiplier", index, len(self.multipliers))
        equations = 1 if self.multipliers[index].imag == 0 else 2
        values, vectors = np.linalg.eigh(self.multiplier_covariances[index])
        axes = vectors * np.sqrt(np.maximum(values, 0))
        angle = np.linspace(0, 2 * np.pi, _BORDER_POINTS)
        circle = np.stack([np.cos(angle), np.sin(angle)])
        radius = np.sqrt(self._radius(level, equations))
        x, y = radius * (axes @ circle)
        return self.multipliers[index] + x + 1j * y

    @checked
    def compare(self, other: Truth) -> MultiplierComparison:
        """Pair the multipliers with true ones, or with those of another fit, and test whether all
        are equal; printing the result shows a table.

        The test of true multipliers is that of `distance`, for all of them together. For another
        fit, to other data, it compares the coefficients of both polynomials; if the orders differ,
        each pair of multipliers to first order (Bonferroni). Estimated covariances are allowed for
        with the fewer degrees of freedom of both.

        **Arguments:** `other`: multipliers, or a cycle, a model or a fit that has them.

        **Example:**

        ```python
        print(fit.compare(cycle))
        print(fit.compare(result.fit).p_value)
        ```
        """
        paired = compare_multipliers(self.multipliers, other)
        if isinstance(other, MultiplierFit):
            p = self._p_value_of_fit(other, paired)
        elif isinstance(other, Fit):
            p = None  # (The covariance of its multipliers is unknown.)
        else:
            p = self._p_value_of_truth(paired.true)
        return dataclasses.replace(paired, p_value=p)

    def _p_value_of_truth(self, true: Complex[np.ndarray, " k"]) -> float | None:
        """Return the p value of the hypothesis that all of these are multipliers."""
        if not np.isfinite(self.covariance).all():
            return None
        # (One of a conjugate pair is enough.)
        is_upper = np.imag(true) >= 0
        is_alone = ~np.isin(np.conj(true), true)
        distinct = true[is_upper | is_alone]
        distance, equations = self._distance_of(distinct)
        return _tail(distance, equations, self.covariance_dof)

    def _p_value_of_fit(
        self, other: "MultiplierFit", paired: MultiplierComparison
    ) -> float | None:
        """Return the p value of the hypothesis that both fits have the same multipliers."""
        total = [self.covariance, other.covariance]
        if not all(np.isfinite(covariance).all() for covariance in total):
            return None
        dof = min(self.covariance_dof, other.covariance_dof)
        d = len(self.coefficients)
        if len(other.coefficients) == d:
            missed = self.coefficients - other.coefficients
            distance = missed @ np.linalg.lstsq(sum(total), missed, rcond=_RANK)[0]
            return _tail(float(distance), d, dof)
        tails = []
        for z, true in zip(paired.estimated, paired.true, strict=True):
            own = self.multiplier_covariances[np.argmin(abs(self.multipliers - z))]
            theirs = other.multiplier_covariances[
                np.argmin(abs(other.multipliers - true))
            ]
            missed = np.array([(z - true).real, (z - true).imag])
            weights = np.linalg.pinv(own + theirs, rcond=_RANK)
            equations = 2 if missed[1] else 1
            tails.append(_tail(float(missed @ weights @ missed), equations, dof))
        return min(1.0, len(tails) * min(tails))

    def _summary(self) -> str:
        parts = shown_multipliers(self), self._shown_moduli(), self._about()
        about = "; ".join(filter(None, parts))
        return folded(f"{type(self).__name__}({about})")

    def _page(self) -> tuple[str, ...]:
        if self.result != Result.OK:
            return "", text(self._summary())
        regions = []
        if np.isfinite(self.multiplier_covariances).all():
            regions = [self.ellipse(k) for k in range(len(self.multipliers))]
        shown = multiplier_table(self.multipliers, self.standard_errors)
        circle = unit_circle(self.multipliers, regions)
        return "", shown, circle, text(self._about())

    def _about(self) -> str:
        """The rest of a summary, after the multipliers."""
        return ""

    def _shown_moduli(self) -> str:
        """Return the moduli and their intervals, listing a pair of complex multipliers once."""
        if self.result != Result.OK:
            return ""
        shown = []
        for z, modulus, bounds in zip(
            self.multipliers, self.modulus, self.interval(), strict=True
        ):
            if np.imag(z) < 0:
                continue
            if not np.isfinite(bounds).all():
                shown.append(f"{modulus:.4f}")
                continue
            # (With as many digits as the width of the interval justifies.)
            width = max(bounds[1] - bounds[0], 1e-12)
            decimals = -np.log10(width / 2)
            digits = max(2, int(np.ceil(decimals)))
            low, high = np.maximum(bounds, 0.0)
            shown.append(
                f"{modulus:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
            )
        label = "modulus" if len(shown) == 1 else "moduli"
        return f"{label} (95 % interval) {', '.join(shown)}"

    def _radius(self, level: float, equations: int | np.ndarray) -> np.ndarray | float:
        """Quantile of `distance`."""
        from scipy import special  # (a fifth of a second)

        dof = self.covariance_dof
        if np.isinf(dof):
            return 2 * special.gammaincinv(equations / 2, level)
        left = np.maximum(dof - equations + 1, 1.0)
        return equations * dof / left * special.fdtri(equations, left, level)


def shown_multipliers(fit: MultiplierFit) -> str:
    """Return the multipliers of a minimum and their standard errors."""
    if fit.result != Result.OK:
        reason = Result(fit.result).message
        return f"no multipliers: {reason} (`multipliers` holds its last step)"
    shown = (
        f"{rounded(z, error)} ± {standard_error(error)}"
        for z, error in zip(fit.multipliers, fit.standard_errors, strict=True)
    )
    return f"multipliers (± standard error) {', '.join(shown)}"


def _tail(distance: float, equations: int, dof: float) -> float:
    """Return the probability of a larger squared distance from a true hypothesis."""
    from scipy import special  # (a fifth of a second)

    if np.isinf(dof):
        return float(special.gammaincc(equations / 2, distance / 2))
    left = max(dof - equations + 1, 1.0)
    ratio = distance * left / (equations * dof)
    return float(special.fdtrc(equations, left, ratio))


class FitWithoutModel(MultiplierFit):
    """A fit that has neither a model of the system nor one of the noise."""

    @property
    def model(self) -> None:
        return None

    @property
    def noise(self) -> None:
        return None


class MultiplierEstimate(FitWithoutModel):
    """Multipliers and their covariance alone, such as a bound of what any estimate can reach."""


def contradicted_by(
    fit: MultiplierFit,
    others: Iterable[Callable[[], RoughFit]],
    level: float = 0.95,
) -> int | None:
    """Return the order of the first of other fits that contradicts a fit; None if none does.

    Another fit contradicts if a multiplier of the fit lies outside of the confidence regions of the
    other fit, and the nearest multiplier of the other fit outside of those of the fit. (Regions of
    95 %: with 99 %, half as many fits of the right order get a finding, and a few more fits of too
    low order pass. Drift moves multipliers further: regions of 99.9 % notice it.)

    **Arguments:** `others`: the fits; a `DefinitionError` means too few data.
    """
    for make in others:
        with suppress(DefinitionError):
            coefficients, covariance = make()
            multipliers = multipliers_of(coefficients)
            apart = np.abs(multipliers - fit.multipliers[:, None])
            moved = ~fit.contains(multipliers[apart.argmin(axis=1)], level)
            if not moved.any():
                continue
            other = MultiplierEstimate(multipliers, coefficients, *covariance())
            if (moved & ~other.contains(fit.multipliers, level)).any():
                return len(coefficients)
    return None


def undetermined(fit: MultiplierFit) -> list[Finding]:
    """Return a finding if the data do not determine the multipliers of a fit."""
    if np.isfinite(fit.covariance).all():
        return []
    text = "the data do not determine all multipliers, some may be spurious: fit fewer."
    return [Finding("undetermined", text)]


def order_doubts(
    fit: MultiplierFit, higher: Iterable[Callable[[], RoughFit]]
) -> list[Finding]:
    """Return a finding if the data do not determine the multipliers of a fit, or if fits of a
    higher order contradict them."""
    unknown = undetermined(fit)
    if unknown:
        return unknown
    order = contradicted_by(fit, higher)
    if order is None:
        return []
    # (Without numbers: after a few iterations, they may be far from those of a complete fit.)
    text = f"`order` may be too low: order {order} gives other multipliers; compare both fits."
    return [Finding("order", text)]


def left_out(higher: Callable[[], RoughFit]) -> list[Finding]:
    """Return a finding if a fit needs one more multiplier. `higher`: a fit with one more multiplier
    that starts from it.

    With the same numerators, the present fit is the higher fit with a last coefficient of zero. If
    this coefficient differs from zero (Wald's test), the present fit has left out a multiplier.
    """
    with suppress(DefinitionError):
        coefficients, covariance = higher()
        matrix, dof = covariance()
        last = coefficients[-1]
        distance = float(last**2 / matrix[-1, -1])
        if _tail(distance, 1, dof) < _NEEDED:
            order = len(coefficients)
            text = (
                "`order` may be too low: the data determine one more multiplier. It may be too "
                "weak to be fitted well, and still move the others by several of their standard "
                f"errors; compare order {order} with check=False, or record longer."
            )
            return [Finding("order", text)]
    return []
