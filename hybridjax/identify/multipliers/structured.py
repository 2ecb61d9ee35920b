"""Floquet multipliers from the exact structure of the harmonic transfer functions."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index, Order, Scalar, StepCount, Vector
from ..._core.execution import one_blas_thread
from ..._core.results import Result
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics, check_harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .denominator import chi, multipliers_of
from .error_spectrum import error_spectrum
from .error_weights import check_values, error_weights, require_frequencies, spectral_weights
from .maximum_likelihood import maximum_likelihood, summarize
from .multiplier_estimate import MultiplierEstimate
from .order import estimated_noise, noise_ratios, refuse_invented
from .variable_projection import group_htf, numerators_of


# How often HTFs without variances are fitted with weights that the last misfit suggests. Doubled:
# multipliers move by a tenth of their standard errors at most.
_REWEIGHTINGS = 2


class StructuredFit(MultiplierEstimate):
    r"""All harmonics, outputs and inputs with one denominator in $z^{-N}$.

    $$H_m(z) = \frac{B_m(z^{-1})}{\chi(z^{-N})}, \qquad
    \chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN} = \prod_i (1 - \lambda_i z^{-N})$$

    which is exact for a periodic system with d non-zero multipliers $\lambda_i$, if the degree
    of the polynomials B_m is high enough (d N and an overhang: at most N times the number of
    periods after which the zero multipliers' part of the state is gone).

    **Fields:**

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d, real.
    - `covariance` (d, d): of the coefficients, estimated with `covariance_freedom` degrees of
      freedom. `standard_errors`, `contains` and `ellipse` give what follows for multipliers.
    - `residual` (ny,): rms misfit of each output's HTFs relative to their rms.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations, and
      `freedom`, the number that it is expected to be. Where no variances were given the unit is
      what the misfit itself says, and the two are equal.
    - `numerators` (M, degree + 1, ny, nu): coefficients of B_m, by rising power of z^-1. In a
      narrow band of frequencies many give the same fit; these are the smallest.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,), `n_sections`, `inputs`, `outputs`: what was fitted.
    """

    multipliers: Complex[np.ndarray, " d"]
    coefficients: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]
    covariance_freedom: float = eqx.field(static=True)
    residual: Float[np.ndarray, " ny"]
    numerators: Complex[np.ndarray, "M coefficients ny nu"]
    cost: float = eqx.field(static=True)
    freedom: int = eqx.field(static=True)
    result: int = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    @checked
    def htf(self, f: Scalar | Vector, harmonics: Harmonics | None = None) -> HTF:
        """The fitted HTFs at frequencies f (F,), cycles per period, inside the band of the data.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        wanted = (
            self.harmonics if harmonics is None else check_harmonics(harmonics, self.n_sections)
        )
        absent = [m for m in wanted if m not in self.harmonics]
        if absent:
            raise DefinitionError(
                f"harmonic {absent[0]} was not fitted; the harmonics are {self.harmonics}."
            )
        rows = [self.harmonics.index(m) for m in wanted]
        degrees = np.arange(self.numerators.shape[1])
        powers = np.exp(-2j * np.pi / self.n_sections * f[:, None] * degrees)
        H = np.einsum("fr,mrij->mfij", powers, self.numerators[rows])
        H = H / chi(np.exp(-2j * np.pi * f), self.coefficients)[:, None, None]
        return HTF(f, H, wanted, self.n_sections, self.inputs, self.outputs, "structured fit")

    def __repr__(self) -> str:
        return f"StructuredFit(multipliers {self.show_multipliers()}; {self._about()})"

    def _about(self) -> str:
        misfit = ", ".join(
            f"{name} {x:.1e}" for name, x in zip(self.outputs, self.residual, strict=True)
        )
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        return (
            f"residual {misfit}; {self.cost / self.freedom:.3g} times what is expected; "
            f"{len(self.harmonics)} harmonics, degree {self.numerators.shape[1] - 1}{state}"
        )


@checked
@one_blas_thread()
def fit_multipliers(
    htf: HTF,
    order: Order | LDTP,
    harmonics: Harmonics | None = None,
    *,
    overhang: Index | None = None,
    errors: Literal["residuals", "variance"] = "residuals",
    check: bool = True,
    max_steps: StepCount = 50,
) -> StructuredFit:
    r"""Fit the common denominator of the HTFs, whose roots are the Floquet multipliers.

    The maximum-likelihood estimate for independent, circular, normally distributed errors of the
    HTFs with the variances `htf.variance`: the sum of $|H - B/\chi|^2 / \mathrm{var}$ is
    minimized over all numerators and c. Numerators are solved for inside (variable projection), so
    that Gauss and Newton's steps are taken in the d coefficients c only. They start from the
    linearized problem, solved by generalized total least squares, which is consistent (Pintelon
    and Schoukens, *System Identification: A Frequency Domain Approach*). Positive and negative
    frequencies are used, $H_m(-w) = \overline{H_{-m}(w)}$; for m = 0 (and N/2) numerators are
    real.

    **Arguments:**

    - `htf`: exact or estimated. Without variances each output counts relative to its misfit, which
      is taken for white noise and noise that has passed the system.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model to take its rank from.
      `select_order` helps to find it.
    - `harmonics`: those to use; None means all of `htf`.
    - `overhang`: degree of the numerators beyond d N; None means N.
    - `errors`: what the covariance is computed from. `"residuals"`, the default: from the misfit
      at each frequency, so that it holds also where the errors of different harmonics are
      dependent (process noise, distortion) or the variances are only roughly known (White 1980).
      `"variance"`: from the variances, which must then be right.
    - `check`: refuse an order that the data do not carry (a rank test at the level of 1 %): beside
      those that they carry, the other multipliers would be invented by noise.
    - `max_steps`: of Gauss and Newton's iteration.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, variances that are not
    positive, a harmonic that `htf` does not hold, too few frequencies for so many coefficients
    (the message says how many), or an order that the data do not carry.
    """
    order = order.rank() if isinstance(order, LDTP) else order
    N = htf.n_sections
    overhang = N if overhang is None else overhang
    if harmonics is not None:
        htf = htf.select(harmonics)
    rms = check_values(htf)
    if errors == "variance" and htf.variance is None:
        raise DefinitionError(
            "errors='variance' needs HTFs with variances; these have none: take 'residuals'."
        )
    size = order * N + overhang + 1
    require_frequencies(htf, order, size)

    groups = group_htf(htf, error_weights(htf, rms), size)
    c, converged = maximum_likelihood(groups, order, max_steps)
    if htf.variance is None:
        f = np.asarray(htf.f)
        for _ in range(_REWEIGHTINGS):
            variance = error_spectrum(groups, c, f, len(rms))
            groups = group_htf(htf, spectral_weights(htf, rms, variance), size)
            c, converged = maximum_likelihood(groups, order, max_steps, c)
    summary = summarize(groups, c, errors)
    if check:
        level, tails = estimated_noise(htf, summary.cost / summary.freedom)
        ratios = noise_ratios(groups, np.zeros(order))
        refuse_invented(ratios.values / level, tails * ratios.deviation)

    B = np.zeros((len(htf.harmonics), size, len(htf.outputs), len(htf.inputs)), complex)
    for group in groups:
        b = numerators_of(group, c).T
        i, j = group.channel.T
        B[group.harmonic, :, i, j] = b
        if group.mirror is not None:
            B[group.mirror, :, i, j] = b.conj()
    fit = StructuredFit(
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=summary.covariance.matrix,
        covariance_freedom=summary.covariance.freedom,
        residual=np.zeros(len(rms)),
        numerators=B,
        cost=summary.cost,
        freedom=summary.freedom,
        result=Result.OK if converged else Result.NOT_CONVERGED,
        harmonics=htf.harmonics,
        n_sections=N,
        inputs=htf.inputs,
        outputs=htf.outputs,
    )
    misfit = np.abs(np.asarray(fit.htf(htf.f).H) - np.asarray(htf.H)) ** 2
    residual = np.sqrt(np.mean(misfit, axis=(0, 1, 3))) / rms
    return eqx.tree_at(lambda fit: fit.residual, fit, residual)
