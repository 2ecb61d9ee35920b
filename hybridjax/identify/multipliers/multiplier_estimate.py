"""Estimated Floquet multipliers and how sure they are."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import PeriodCount, Probability
from ..._core.html import card, multiplier_table, text, unit_circle
from ...errors import DefinitionError
from .compare import MultiplierComparison, Multipliers, compare_multipliers


class MultiplierEstimate(eqx.Module):
    r"""What every fit with the denominator $\chi$ has: multipliers and their uncertainty.

    The multipliers are the roots of $p(\lambda) = \lambda^d + c_1 \lambda^{d-1} + \ldots + c_d$,
    and `covariance` is that of the real coefficients c, estimated with `covariance_freedom`
    degrees of freedom (infinite where it is known). Everything here follows from these.
    """

    multipliers: eqx.AbstractVar[Complex[np.ndarray, " d"]]
    coefficients: eqx.AbstractVar[Float[np.ndarray, " d"]]
    covariance: eqx.AbstractVar[Float[np.ndarray, "d d"]]
    covariance_freedom: eqx.AbstractVar[float]

    @property
    def multiplier_covariances(self) -> Float[np.ndarray, "d 2 2"]:
        r"""Covariance of (Re, Im) of each multiplier, to first order.

        From $d\lambda / dc_j = -\lambda^{d-j} / p'(\lambda)$. A real multiplier has no imaginary
        part to be uncertain about. Of two multipliers that nearly meet, the first order says too
        little: `contains` does not use it.
        """
        d = len(self.coefficients)
        powers = self.multipliers[:, None] ** np.arange(d - 1, -1, -1)
        slope = np.polyval(np.polyder([1.0, *self.coefficients]), self.multipliers)
        with np.errstate(all="ignore"):
            gradient = -powers / slope[:, None]
        real = self.multipliers.imag == 0
        parts = np.stack([gradient.real, np.where(real[:, None], 0.0, gradient.imag)], axis=1)
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
        multipliers are close to each other (Fieller 1954). Zero where the covariance is infinite:
        then nothing is known.
        """
        known = np.atleast_1d(np.asarray(true, complex)).ravel()
        if not np.isfinite(self.covariance).all():
            return np.zeros(len(known))
        powers = known[:, None] ** np.arange(len(self.coefficients), -1, -1)
        value = powers @ np.concatenate([[1.0], self.coefficients])
        out = np.empty(len(known))
        for i, z in enumerate(known):
            rows = [powers[i, 1:].real, powers[i, 1:].imag][: 1 if z.imag == 0 else 2]
            p = np.array([value[i].real, value[i].imag])[: len(rows)]
            cov = np.array(rows) @ self.covariance @ np.array(rows).T
            # Scaled, since a tiny multiplier makes one of the two equations tiny.
            scale = np.sqrt(np.diag(cov))
            if not (scale > 0).all():
                out[i] = np.inf if p.any() else 0.0
                continue
            p, cov = p / scale, cov / scale / scale[:, None]
            out[i] = p @ np.linalg.lstsq(cov, p)[0]
        return out

    @checked
    def contains(self, true: Multipliers, level: Probability = 0.95) -> Bool[np.ndarray, " k"]:
        """Whether supposed multipliers lie in the confidence region of this level.

        A conjugate pair is one statement, not two.
        """
        known = np.atleast_1d(np.asarray(true, complex)).ravel()
        return self.distance(known) <= self._radius(level, np.where(known.imag == 0, 1, 2))

    @checked
    def ellipse(
        self, index: int = 0, level: Probability = 0.95, points: PeriodCount = 100
    ) -> Complex[np.ndarray, " points"]:
        """The border of a multiplier's confidence region, to first order: a closed curve.

        For a real multiplier it is an interval, drawn forth and back.

        **Raises:** `DefinitionError` for an index that is not there.
        """
        if not -len(self.multipliers) <= index < len(self.multipliers):
            raise DefinitionError(
                f"there is no multiplier {index}: the fit has {len(self.multipliers)}."
            )
        covariance = self.multiplier_covariances[index]
        degrees = 1 if self.multipliers[index].imag == 0 else 2
        values, vectors = np.linalg.eigh(covariance)
        angle = np.linspace(0, 2 * np.pi, points)
        circle = np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(angle), np.sin(angle)])
        x, y = np.sqrt(self._radius(level, degrees)) * (vectors @ circle)
        return self.multipliers[index] + x + 1j * y

    @checked
    def compare(self, true: Multipliers) -> MultiplierComparison:
        """The multipliers beside the true ones, paired; printing it shows a table."""
        return compare_multipliers(self.multipliers, true)

    @checked
    def half_widths(self, level: Probability = 0.95) -> Float[np.ndarray, "d 2"]:
        """Half the widths of the intervals of each multiplier's real and imaginary part, to first
        order."""
        variances = np.diagonal(self.multiplier_covariances, axis1=1, axis2=2)
        return np.sqrt(self._radius(level, 1) * np.maximum(variances, 0))

    def _repr_html_(self) -> str:
        regions = []
        if np.isfinite(self.multiplier_covariances).all():
            regions = [self.ellipse(k) for k in range(len(self.multipliers))]
        shown = multiplier_table(self.multipliers, self.half_widths())
        circle = unit_circle(self.multipliers, regions)
        return card(type(self).__name__, "", shown, circle, text(self._about()))

    def _about(self) -> str:
        """What there is to say besides the multipliers, for a `repr`."""
        return ""

    def show_multipliers(self) -> str:
        """The multipliers and their standard errors, for a `repr`."""
        shown = [
            f"{x.real:+.7f}{x.imag:+.7f}i ± {s:.1e}"
            for x, s in zip(self.multipliers, self.standard_errors, strict=True)
        ]
        return ", ".join(shown)

    def _radius(self, level: float, degrees: int | np.ndarray) -> np.ndarray | float:
        """Quantile of `distance`."""
        from scipy import special  # (a fifth of a second)

        if np.isinf(self.covariance_freedom):
            return 2 * special.gammaincinv(degrees / 2, level)
        rest = np.maximum(self.covariance_freedom - degrees + 1, 1.0)
        return degrees * self.covariance_freedom / rest * special.fdtri(degrees, rest, level)
