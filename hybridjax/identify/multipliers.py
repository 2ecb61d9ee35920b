"""Floquet multipliers from the exact structure of the harmonic transfer functions."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order, Scalar, StepCount, Vector
from .._core.execution import one_blas_thread
from .._core.results import Result
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics, check_harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from .denominator import chi, multipliers_of
from .htf_errors import (
    check_values,
    error_spectrum,
    error_weights,
    require_frequencies,
    weights_of,
)
from .multiplier_estimate import MultiplierEstimate
from .order import require_order
from .variable_projection import (
    group_htf,
    maximum_likelihood,
    misfit_of,
    numerators_of,
    summarize,
)


# Fits of HTFs without variances whose weights come from the last misfit. Fewer: weights of the
# wrong shape; more: multipliers move by a tenth of their standard errors at most.
_REWEIGHTINGS = 2


class StructuredFit(MultiplierEstimate):
    r"""All harmonics, outputs and inputs with one denominator in $z^{-N}$.

    $$H_m(z) = \frac{B_m(z^{-1})}{\chi(z^{-N})}, \qquad
    \chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN} = \prod_i (1 - \lambda_i z^{-N})$$

    which is exact for a periodic system with d non-zero multipliers $\lambda_i$, if the degree
    of the polynomials B_m is high enough (d N and an excess: at most N times the number of
    periods after which the zero multipliers' part of the state has vanished).

    **Fields:**

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d, real.
    - `covariance` (d, d): that of the coefficients, estimated with `covariance_freedom` degrees of
      freedom. `standard_errors`, `contains` and `ellipse` follow from it.
    - `residual` (ny,): rms misfit of each output's HTFs relative to their rms.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations, and
      `freedom`, its expected value. Without variances the unit is estimated from the misfit, and
      the two are equal.
    - `numerators` (M, degree + 1, ny, nu): coefficients of B_m, by rising power of z^-1. In a
      narrow band of frequencies many give the same fit; these are the smallest.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,), `n_sections`, `inputs`, `outputs`: names and numbers of the fitted HTFs.
    """

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
        """Return the fitted HTFs at frequencies f (F,), cycles per period, inside the data's band.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        chosen = (
            self.harmonics if harmonics is None else check_harmonics(harmonics, self.n_sections)
        )
        absent = [m for m in chosen if m not in self.harmonics]
        if absent:
            raise DefinitionError(
                f"harmonic {absent[0]} was not fitted; the harmonics are {self.harmonics}."
            )
        rows = [self.harmonics.index(m) for m in chosen]
        H = _evaluate(self.numerators[rows], self.coefficients, f, self.n_sections)
        return HTF(f, H, chosen, self.n_sections, self.inputs, self.outputs, "structured fit")

    def _about(self) -> str:
        misfit = ", ".join(
            f"{name} {x:.1e}" for name, x in zip(self.outputs, self.residual, strict=True)
        )
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        return (
            f"residual {misfit}; {self.cost / self.freedom:.3g} times what is expected; "
            f"{len(self.harmonics)} harmonics, degree {self.numerators.shape[1] - 1}{state}"
        )


def _evaluate(numerators, c, f, n_sections: int) -> Complex[np.ndarray, "M F ny nu"]:
    powers = np.exp(-2j * np.pi / n_sections * f[:, None] * np.arange(numerators.shape[1]))
    H = np.einsum("fr,mrij->mfij", powers, numerators)
    return H / chi(np.exp(-2j * np.pi * f), c)[:, None, None]


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

    The maximum-likelihood estimate for independent, circular, Gaussian errors of the
    HTFs with the variances `htf.variance`: the sum of $|H - B/\chi|^2 / \mathrm{var}$ is
    minimized over all numerators and c. Numerators are eliminated (variable projection), so
    that Gauss-Newton steps are taken in the d coefficients c only. The descent starts from the
    linearized problem, solved by generalized total least squares, which is consistent (Pintelon
    and Schoukens, *System Identification: A Frequency Domain Approach*). Positive and negative
    frequencies are used, $H_m(-w) = \overline{H_{-m}(w)}$; for m = 0 (and N/2) numerators are
    real.

    **Arguments:**

    - `htf`: exact or estimated. Without variances each output is weighted by its residuals, whose
      spectrum is modeled as white noise plus noise filtered by the system.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model whose rank it is.
      `select_order` helps to find it.
    - `harmonics`: the harmonics to fit. Default: all of `htf`.
    - `overhang`: degree of the numerators beyond d N. Default: N.
    - `errors`: source of the covariance. `"residuals"`: the residuals at each frequency. This
      remains valid if the errors of different harmonics are dependent (process noise, distortion)
      or the variances are only approximate (White 1980). `"variance"`: the variances, which must
      then be correct. Default: `"residuals"`.
    - `check`: whether to raise an error if the data do not support so many multipliers (a rank test
      at the level of 1 %): the surplus multipliers would only fit noise. Default: True.
    - `max_steps`: largest number of Gauss-Newton steps. Default: 50.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, variances that are not
    positive, a harmonic that `htf` does not hold, too few frequencies for so many coefficients (the
    message gives the number needed), or an order that the data do not support.
    """
    order = order.rank() if isinstance(order, LDTP) else order
    N = htf.n_sections
    if harmonics is not None:
        htf = htf.select(harmonics)
    rms = check_values(htf)
    if errors == "variance" and htf.variance is None:
        raise DefinitionError(
            "errors='variance' needs HTFs with variances; these have none: take 'residuals'."
        )
    size = order * N + (N if overhang is None else overhang) + 1
    require_frequencies(htf, order, size)

    f, H = np.asarray(htf.f), np.asarray(htf.H)
    groups = group_htf(htf, error_weights(htf, rms), size)
    c, converged = maximum_likelihood(groups, order, max_steps)
    if htf.variance is None:
        for _ in range(_REWEIGHTINGS):
            variance = error_spectrum(groups, c, f, len(rms))[..., None]
            groups = group_htf(htf, np.broadcast_to(weights_of(variance, rms), H.shape), size)
            c, converged = maximum_likelihood(groups, order, max_steps, c)
    covariance, cost, freedom = summarize(groups, c, errors)
    if check:
        require_order(groups, htf, order, cost / freedom)

    B = np.zeros((len(H), size, *H.shape[2:]), complex)
    for group in groups:
        b = numerators_of(group, c).T
        i, j = group.channel.T
        B[group.harmonic, :, i, j] = b
        if group.mirror is not None:
            B[group.mirror, :, i, j] = b.conj()
    misfit = np.abs(_evaluate(B, c, f, N) - H) ** 2
    return StructuredFit(
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=covariance.matrix,
        covariance_freedom=covariance.freedom,
        residual=np.sqrt(np.mean(misfit, axis=(0, 1, 3))) / rms,
        numerators=B,
        cost=cost,
        freedom=freedom,
        result=Result.OK if converged else Result.NOT_CONVERGED,
        harmonics=htf.harmonics,
        n_sections=N,
        inputs=htf.inputs,
        outputs=htf.outputs,
    )


@checked
@one_blas_thread()
def multiplier_bound(model: LDTP, htf: HTF, overhang: Index | None = None) -> MultiplierEstimate:
    r"""Return the Cramer-Rao bound of the multipliers of a known model.

    For independent, circular, Gaussian errors of the HTFs, with all numerators unknown: the inverse
    of $J^T J$ at the truth, where J is the derivative of the HTFs in units of their standard
    deviations, less the part that numerators can imitate. It limits the accuracy that an experiment
    can reach, before the experiment.

    **Arguments:**

    - `model`: the truth. `htf`: its frequencies, harmonics and `variance` count, H does not.
    - `overhang`: degree of the numerators beyond d N. Default: N.

    **Returns:** the true multipliers with the smallest covariance of an unbiased estimate;
    `standard_errors` are bounds of rms errors.

    **Raises:** `DefinitionError` if the two do not fit together, `htf` has no variances, or too
    few frequencies to find the multipliers at all.
    """
    exact = exact_htf(model, htf)
    multipliers = model.multipliers
    d, N = len(multipliers), model.n_sections
    size = d * N + (N if overhang is None else overhang) + 1
    require_frequencies(exact, d, size)
    c = np.poly(multipliers).real[1:]
    information = np.zeros((d, d))
    for group in group_htf(exact, error_weights(exact, check_values(exact)), size):
        jacobian = misfit_of(group, c).jacobian.reshape(d, -1)
        information += jacobian @ jacobian.T
    return MultiplierEstimate(multipliers, c, np.linalg.inv(information), np.inf)


def exact_htf(model: LDTP, htf: HTF) -> HTF:
    """Return the HTFs of a model with the frequencies, harmonics and variances of others.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    require_same("model and HTFs", model, htf)
    if htf.variance is None:
        raise DefinitionError("a bound needs the variances of the HTFs, and these have none.")
    H = model.htf(htf.f, htf.harmonics).H
    return HTF(
        htf.f, H, htf.harmonics, htf.n_sections, htf.inputs, htf.outputs,
        variance=htf.variance,
    )  # fmt: skip
