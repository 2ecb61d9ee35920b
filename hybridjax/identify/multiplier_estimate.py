"""Estimated Floquet multipliers: their confidence regions, and comparison with true ones."""

import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._core.arguments import Numbers, require_index
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Probability
from .._core.boundary.values import Complexes
from .._core.html import card, multiplier_table, text, unit_circle
from .._core.results import Result
from .._core.text import folded
from ..errors import DefinitionError, FindingWarning
from .denominator import Covariance, multipliers_of
from .descent import Coefficients


Multipliers = Annotated[Numbers, Complexes()]
"""Supposed or true multipliers, one or several."""

RoughFit = tuple[Coefficients, Callable[[], Covariance]]
"""Coefficients, and a function for their covariance."""


class MultiplierComparison(eqx.Module):
    """Estimated Floquet multipliers, each paired with a true one.

    The pairing has the smallest sum of distances; if the numbers of multipliers differ, the
    unpaired ones are not listed. Printing it shows a table.

    **Fields**, sorted by output, then by decreasing modulus of the true multiplier:

    - `true` and `estimated` (k,); `error` (k,), their distance, and `max_error`, the largest.
    - `outputs` (k,): the outputs' names; empty where all outputs have the same multipliers.
    """

    true: Complex[np.ndarray, " k"]
    estimated: Complex[np.ndarray, " k"]
    outputs: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def error(self) -> Float[np.ndarray, " k"]:
        return np.abs(self.estimated - self.true)

    @property
    def max_error(self) -> float:
        return float(np.max(self.error))

    def __repr__(self) -> str:
        width = max(map(len, self.outputs), default=-2) + 2
        rows = [" " * width + f"{'true':>26}  {'estimated':>26}  {'error':>8}"]
        names = self.outputs or [""] * len(self.true)
        pairs = zip(names, self.true, self.estimated, self.error, strict=True)
        for name, true, estimated, error in pairs:
            label = f"{name:>{width - 2}}  " if width else ""
            rows.append(
                f"{label}{_show(true):>26}  {_show(estimated):>26}  {error:8.1e}"
            )
        return "\n".join(rows)


def _show(value: complex) -> str:
    imaginary = f" {value.imag:+.9f}i" if value.imag else 14 * " "
    return f"{value.real:+.9f}{imaginary}"


def compare_multipliers(estimated: Numbers, true: Multipliers) -> MultiplierComparison:
    """Pair estimated with true multipliers so that the sum of distances is smallest.

    **Raises:** `DefinitionError` if either is empty.
    """
    from scipy.optimize import linear_sum_assignment  # (a third of a second)

    values, truth = (
        np.asarray(estimated, complex).ravel(),
        np.asarray(true, complex).ravel(),
    )
    if values.size == 0 or truth.size == 0:
        raise DefinitionError("`true` or the estimate holds no multiplier to compare.")
    rows, columns = linear_sum_assignment(np.abs(values[:, None] - truth))
    order = np.lexsort((-np.imag(truth[columns]), -np.abs(truth[columns])))
    return MultiplierComparison(
        true=truth[columns][order], estimated=values[rows][order]
    )


class MultiplierEstimate(eqx.Module):
    r"""Multipliers and their uncertainty: the part that all fits with the denominator $\chi$ share.

    **Fields:**

    - `multipliers` (d,): by decreasing modulus, the roots of
      $p(\lambda) = \lambda^d + c_1 \lambda^{d-1} + \ldots + c_d$.
    - `coefficients` (d,): c_1 to c_d, real.
    - `covariance` (d, d): that of the coefficients, infinite where it is unknown, estimated with
      `covariance_freedom` degrees of freedom (infinite where it is exact). All standard errors and
      confidence regions follow from it.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    covariance_freedom: float = eqx.field(static=True)

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
        powers = self.multipliers[:, None] ** np.arange(d - 1, -1, -1)
        slope = np.polyval(np.polyder([1.0, *self.coefficients]), self.multipliers)
        with np.errstate(all="ignore"):
            gradient = -powers / slope[:, None]
        real = np.imag(self.multipliers) == 0
        parts = np.stack(
            [gradient.real, np.where(real[:, None], 0.0, gradient.imag)], axis=1
        )
        return np.einsum("iaj,jk,ibk->iab", parts, self.covariance, parts)

    @property
    def standard_errors(self) -> Float[np.ndarray, " d"]:
        """Root of the expected squared distance of each multiplier from the true one."""
        return np.sqrt(np.trace(self.multiplier_covariances, axis1=1, axis2=2))

    @checked
    def distance(self, true: Multipliers) -> Float[np.ndarray, " k"]:
        r"""Squared distance of the estimate from supposed multipliers, in units of its covariance.

        $\lambda$ is a multiplier if $p(\lambda) = 0$, which is linear in c: one real equation for
        a real $\lambda$, two for a complex one. The result is
        $p^T \mathrm{Cov}(p)^{-1} p$, chi-squared distributed with one or two degrees of freedom at
        a true multiplier (Hotelling's $T^2$ where the covariance is estimated), also where
        multipliers are close to each other (Fieller 1954). Zero where the covariance is infinite.
        """
        truth = np.atleast_1d(np.asarray(true, complex)).ravel()
        if not np.isfinite(self.covariance).all():
            return np.zeros(len(truth))
        powers = truth[:, None] ** np.arange(len(self.coefficients), -1, -1)
        value = powers @ np.concatenate([[1.0], self.coefficients])
        out = np.empty(len(truth))
        for i, z in enumerate(truth):
            equations = 1 if z.imag == 0 else 2
            rows = np.array([powers[i, 1:].real, powers[i, 1:].imag])[:equations]
            p = np.array([value[i].real, value[i].imag])[:equations]
            cov = rows @ self.covariance @ rows.T
            # Scaled, since a tiny multiplier makes one of the two equations tiny.
            scale = np.sqrt(np.diag(cov))
            if not (scale > 0).all():
                out[i] = np.inf if p.any() else 0.0
                continue
            p, cov = p / scale, cov / scale / scale[:, None]
            out[i] = p @ np.linalg.lstsq(cov, p)[0]
        return out

    @checked
    def contains(
        self, true: Multipliers, level: Probability = 0.95
    ) -> Bool[np.ndarray, " k"]:
        """Test whether supposed multipliers lie in the confidence region of this level.

        A conjugate pair is one hypothesis, not two.
        """
        truth = np.atleast_1d(np.asarray(true, complex)).ravel()
        return self.distance(truth) <= self._radius(
            level, np.where(np.imag(truth) == 0, 1, 2)
        )

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
        degrees = 1 if self.multipliers[index].imag == 0 else 2
        values, vectors = np.linalg.eigh(self.multiplier_covariances[index])
        angle = np.linspace(0, 2 * np.pi, 100)
        circle = np.sqrt(np.maximum(values, 0))[:, None] * np.stack(
            [np.cos(angle), np.sin(angle)]
        )
        x, y = np.sqrt(self._radius(level, degrees)) * (vectors @ circle)
        return self.multipliers[index] + x + 1j * y

    @checked
    def compare(self, true: Multipliers) -> MultiplierComparison:
        """Pair the multipliers with the true ones; printing the result shows a table."""
        return compare_multipliers(self.multipliers, true)

    def contradiction(
        self, others: Iterable[Callable[[], RoughFit]], drift: str = ""
    ) -> str:
        """Return a sentence if the data do not determine the multipliers, or another fit
        contradicts them; else "".

        It does if a multiplier is outside of its confidence regions, and its nearest one outside of
        those of this fit. (Of 95 %: at 99 % half as many right orders are doubted, and a few more
        that are too low pass. Drift moves multipliers further: regions of 99.9 % notice it.)

        **Arguments:** `others`: the fits; a `DefinitionError` means too few data. `drift`: the
        sentence, for fits that allow for drift. Default: a sentence about their order.
        """
        if not np.isfinite(self.covariance).all():
            return "the data do not determine all multipliers, some may be spurious: fit fewer"
        level = 0.999 if drift else 0.95
        for fit in others:
            with suppress(DefinitionError):
                c, covariance = fit()
                multipliers = multipliers_of(c)
                near = np.abs(multipliers - self.multipliers[:, None]).argmin(axis=1)
                moved = ~self.contains(multipliers[near], level)
                if not moved.any():
                    continue
                other = MultiplierEstimate(multipliers, c, *covariance())
                if (moved & ~other.contains(self.multipliers, level)).any():
                    # (No numbers: those of a few iterations may be far from those of a fit.)
                    order = f"`order` may be too low: order {len(c)} gives other multipliers"
                    return drift or f"{order}; compare both fits"
        return ""

    def __repr__(self) -> str:
        about = "; ".join(filter(None, [self.show_multipliers(), self._about()]))
        return folded(f"{type(self).__name__}({about})")

    def _repr_html_(self) -> str:
        if getattr(self, "result", Result.OK) != Result.OK:
            return card(type(self).__name__, "", text(repr(self)))
        regions = []
        if np.isfinite(self.multiplier_covariances).all():
            regions = [self.ellipse(k) for k in range(len(self.multipliers))]
        shown = multiplier_table(self.multipliers, self.standard_errors)
        circle = unit_circle(self.multipliers, regions)
        return card(type(self).__name__, "", shown, circle, text(self._about()))

    def _about(self) -> str:
        """The rest of a `repr`, after the multipliers."""
        return ""

    def show_multipliers(self) -> str:
        """Return the multipliers of a minimum and their standard errors, for a `repr`."""
        if (code := getattr(self, "result", Result.OK)) != Result.OK:
            return f"no multipliers: {Result(code).message} (`multipliers` holds its last step)"
        shown = (
            f"{x.real:+.7f}{f'{x.imag:+.7f}i' if x.imag else ''} ± {error:.1e}"
            for x, error in zip(self.multipliers, self.standard_errors, strict=True)
        )
        return folded(f"multipliers (± standard error) {', '.join(shown)}")

    def _radius(self, level: float, degrees: int | np.ndarray) -> np.ndarray | float:
        """Quantile of `distance`."""
        from scipy import special  # (a fifth of a second)

        if np.isinf(self.covariance_freedom):
            return 2 * special.gammaincinv(degrees / 2, level)
        left = np.maximum(self.covariance_freedom - degrees + 1, 1.0)
        return (
            degrees
            * self.covariance_freedom
            / left
            * special.fdtri(degrees, left, level)
        )


def warned(doubt: str, check: bool) -> str:
    """Return a sentence of doubt, and emit it as a warning of a public function of fits."""
    if doubt and check:
        warnings.warn(f"Fit: {doubt}.", FindingWarning, stacklevel=5)
    return doubt
