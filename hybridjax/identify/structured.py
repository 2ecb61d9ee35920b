"""Floquet multipliers from the exact structure of the harmonic transfer functions."""

from collections.abc import Sequence
from itertools import count
from typing import Literal

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Complex, Float

from .._core.errors import DefinitionError
from .._core.results import Result
from ..periodic.htf import HTF
from ..periodic.ldtp import LDTP
from ..periodic.transfer import check_harmonics
from .estimate import MultiplierEstimate, roots_of
from .likelihood import maximum_likelihood, noise_levels, summarize
from .projection import chi, groups_of, numerators


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
    - `harmonics` (M,), `sections`, `inputs`, `outputs`: what was fitted.
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
    sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def evaluate(self, f: ArrayLike, harmonics: int | Sequence[int] | None = None) -> HTF:
        """The fitted HTFs at frequencies f (cycles per period) inside the band of the data.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f = np.atleast_1d(np.asarray(f, float))
        wanted = self.harmonics if harmonics is None else check_harmonics(harmonics, self.sections)
        absent = [m for m in wanted if m not in self.harmonics]
        if absent:
            raise DefinitionError(
                f"harmonic {absent[0]} was not fitted; the harmonics are {self.harmonics}."
            )
        rows = [self.harmonics.index(m) for m in wanted]
        degrees = np.arange(self.numerators.shape[1])
        powers = np.exp(-2j * np.pi / self.sections * f[:, None] * degrees)
        H = np.einsum("fr,mrij->mfij", powers, self.numerators[rows])
        H = H / chi(np.exp(-2j * np.pi * f), self.coefficients)[:, None, None]
        return HTF(f, H, wanted, self.sections, self.inputs, self.outputs, "structured fit")

    def __repr__(self) -> str:
        misfit = ", ".join(
            f"{name} {x:.1e}" for name, x in zip(self.outputs, self.residual, strict=True)
        )
        state = "" if self.result == Result.OK else f"; {Result(self.result).message}"
        return (
            f"StructuredFit(multipliers {self.show_multipliers()}; residual {misfit}; "
            f"{len(self.harmonics)} harmonics, degree {self.numerators.shape[1] - 1}{state})"
        )


Errors = Literal["residuals", "variance"]


def fit_multipliers(
    htf: HTF,
    order: int | LDTP,
    harmonics: int | Sequence[int] | None = None,
    *,
    overhang: int | None = None,
    errors: Errors | None = None,
    max_steps: int = 50,
) -> StructuredFit:
    r"""Fit the common denominator of the HTFs, whose roots are the Floquet multipliers.

    The maximum-likelihood estimate for independent, circular, normally distributed errors of the
    HTFs with the variances `htf.variance`: the sum of $|H - B/\chi|^2 / \mathrm{var}$ is
    minimised over all numerators and c. Numerators are solved for inside (variable projection), so
    that Gauss and Newton's steps are taken in the d coefficients c only. They start from the
    linearised problem, solved by generalised total least squares, which is consistent (Pintelon
    and Schoukens, *System Identification: A Frequency Domain Approach*). Positive and negative
    frequencies are used, $H_m(-w) = \overline{H_{-m}(w)}$; for m = 0 (and N/2) numerators are
    real.

    **Arguments:**

    - `htf`: exact or estimated. Without variances each output counts relative to its misfit.
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model to take its rank from.
      `select_order` helps to find it.
    - `harmonics`: those to use; None means all of `htf`.
    - `overhang`: degree of the numerators beyond d N; None means N.
    - `errors`: what the covariance is computed from. `"residuals"`, the default: from the misfit
      at each frequency, so that it holds also where the errors of different harmonics are
      dependent (process noise, distortion) or the variances are only roughly known (White 1980).
      `"variance"`: from the variances, which must then be right.
    - `max_steps`: of Gauss and Newton's iteration.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, variances that are not
    positive, a harmonic that `htf` does not hold, or too few frequencies for so many coefficients
    (the message says how many).
    """
    order = order.rank() if isinstance(order, LDTP) else order
    N = htf.sections
    overhang = N if overhang is None else overhang
    if order < 1 or max_steps < 1 or overhang < 0:
        raise DefinitionError(
            "a structured fit needs order >= 1 (the number of non-zero multipliers), max_steps "
            f">= 1 and overhang >= 0, not {order}, {max_steps} and {overhang}."
        )
    if errors not in (None, "residuals", "variance"):
        raise DefinitionError(f"errors must be 'residuals' or 'variance', not {errors!r}.")
    if harmonics is not None:
        htf = htf.select(harmonics)
    rms = check_values(htf)
    if errors == "variance" and htf.variance is None:
        raise DefinitionError(
            "errors='variance' needs HTFs with variances; these have none: take 'residuals'."
        )
    unknowns = order * N + overhang + 1
    check_freedom(htf, order, unknowns)

    groups = groups_of(htf, weights_of(htf, rms), unknowns)
    c, converged = maximum_likelihood(groups, order, max_steps)
    if htf.variance is None:
        # Once more with the outputs weighted by what their misfit says.
        noise = np.maximum(noise_levels(groups, c, len(rms)), 1e-15)
        groups = groups_of(htf, weights_of(htf, rms * noise), unknowns)
        c, converged = maximum_likelihood(groups, order, max_steps, c)
    summary = summarize(groups, c, "residuals" if errors is None else errors)

    B = np.zeros((len(htf.harmonics), unknowns, len(htf.outputs), len(htf.inputs)), complex)
    for group in groups:
        b = numerators(group, c).T
        i, j = group.columns.T
        B[group.rows, :, i, j] = b
        if group.mirror is not None:
            B[group.mirror, :, i, j] = b.conj()
    fit = StructuredFit(
        multipliers=roots_of(c),
        coefficients=c,
        covariance=summary.covariance,
        covariance_freedom=summary.covariance_freedom,
        residual=np.zeros(len(rms)),
        numerators=B,
        cost=summary.cost,
        freedom=summary.freedom,
        result=Result.OK if converged else Result.NOT_CONVERGED,
        harmonics=htf.harmonics,
        sections=N,
        inputs=htf.inputs,
        outputs=htf.outputs,
    )
    misfit = np.abs(np.asarray(fit.evaluate(htf.f).H) - np.asarray(htf.H)) ** 2
    residual = np.sqrt(np.mean(misfit, axis=(0, 1, 3))) / rms
    return eqx.tree_at(lambda fit: fit.residual, fit, residual)


def check_values(htf: HTF) -> Float[np.ndarray, " ny"]:
    """The rms of each output's HTFs.

    **Raises:** `DefinitionError` for NaN, an output that is zero, bad variances.
    """
    H = np.asarray(htf.H)
    if not np.isfinite(H).all():
        raise DefinitionError("the HTFs hold NaN or infinity.")
    rms = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1, 3)))
    if (rms == 0).any():
        name = htf.outputs[int(np.argmin(rms))]
        raise DefinitionError(f"the HTFs of {name} are zero: leave this output out.")
    if htf.variance is not None:
        bad = np.argwhere(~(np.isfinite(htf.variance) & (np.asarray(htf.variance) >= 0)))
        if len(bad):
            m, k, i, _ = (int(x) for x in bad[0])
            raise DefinitionError(
                f"the variance of H_{htf.harmonics[m]} of {htf.outputs[i]} at f = "
                f"{float(htf.f[k]):g} is not a positive number; leave this frequency out, or give "
                "HTFs without variances."
            )
    return rms


def weights_of(htf: HTF, rms: Float[np.ndarray, " ny"]) -> Float[np.ndarray, "M F ny nu"]:
    """One over the standard deviation of real and imaginary part, known or supposed.

    Variances that were estimated with few degrees of freedom are poor weights: they are replaced
    by the nearest product of a factor for each frequency and one for each harmonic, up to its
    sign (which is what white noise and any spectrum of the input give).
    """
    rounding = (1e-15 * rms[:, None]) ** 2
    if htf.variance is None:
        return np.broadcast_to(1 / rms[:, None], htf.H.shape)
    variance = np.asarray(htf.variance)
    if htf.freedom is not None:
        variance = _smooth(variance, np.asarray(htf.harmonics), np.asarray(htf.freedom))
    return np.sqrt(2 / np.maximum(variance, rounding))


def _smooth(variance, harmonics, freedom):
    """The product of factors of frequency and harmonic with the same sums (gamma likelihood)."""
    if not variance.all():
        return variance
    _, same = np.unique(np.abs(harmonics), return_inverse=True)
    share = freedom / freedom.sum()
    size = np.ones((same.max() + 1, 1, *variance.shape[2:]))
    for _ in range(20):
        by_line = (variance / size[same]).mean(axis=0)
        each = np.tensordot(share, variance / by_line, axes=(0, 1))
        size = np.stack([each[same == k].mean(axis=0) for k in range(len(size))])[:, None]
    return size[same] * by_line


def check_freedom(htf: HTF, order: int, unknowns: int) -> None:
    frequencies = len(htf.f)
    if freedom(htf, frequencies, unknowns) < order:
        needed = next(F for F in count(1) if freedom(htf, F, unknowns) >= order)
        raise DefinitionError(
            f"{frequencies} frequencies are too few for numerators of {unknowns} coefficients and "
            f"{order} multipliers: {needed} or more are needed. Measure more, or lower `order` or "
            "`overhang`."
        )


def freedom(htf: HTF, frequencies: int, unknowns: int) -> int:
    """Real equations that so many frequencies leave when the numerators are gone."""
    places = {m % htf.sections for m in htf.harmonics}
    total = 0
    for m in places:
        if (-m) % htf.sections not in places:
            equations, coefficients = 2 * frequencies, 2 * unknowns
        else:  # half of a pair, or a harmonic that is its own mirror image
            equations, coefficients = 2 * frequencies, unknowns
        total += max(equations - coefficients, 0)
    return total * len(htf.outputs) * len(htf.inputs)
