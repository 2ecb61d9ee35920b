"""Floquet multipliers from the exact structure of harmonic transfer functions, and their number."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order, Scalar, Vector
from .._core.execution import one_blas_thread
from .._core.results import Result
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from . import variable_projection as varpro, weights
from .denominator import chi, multipliers_of
from .descent import ROUNDING, Coefficients
from .multiplier_estimate import MultiplierEstimate, RoughFit, warned


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
    - `residual` (ny,): rms misfit of each output's HTFs relative to their rms, and `correlation`,
      that of the misfit at neighboring frequencies: about 0 if the order is large enough.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations, and
      `freedom`, its expected value. Without variances the unit is estimated from the misfit, and
      the two are equal.
    - `numerators` (M, degree + 1, ny, nu): coefficients of B_m, by rising power of z^-1. In a
      narrow band of frequencies many give the same fit; these are the smallest.
    - `result`: code of `Result`, OK or NOT_CONVERGED.
    - `harmonics` (M,), `n_sections`, `inputs`, `outputs`: names and numbers of the fitted HTFs.
    - `doubt`: a sentence if one more multiplier, or two, contradict those of this fit: they
      lie outside of each other's confidence regions. Empty otherwise, and without `check`.
    """

    residual: Float[np.ndarray, " ny"]
    correlation: float = eqx.field(static=True)
    numerators: Complex[np.ndarray, "M powers ny nu"]
    cost: float = eqx.field(static=True)
    freedom: int = eqx.field(static=True)
    result: int = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    doubt: str = eqx.field(static=True, default="")

    @checked
    def htf(self, f: Scalar | Vector, harmonics: Harmonics | None = None) -> HTF:
        """Return the fitted HTFs at frequencies f (F,), cycles per period, inside the data's band.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f, N = np.atleast_1d(np.asarray(f, float)), self.n_sections
        H = _evaluate(self.numerators, self.coefficients, f, N)
        htf = HTF(f, H, self.harmonics, N, self.inputs, self.outputs, "structured fit")
        return htf if harmonics is None else htf.select(harmonics)

    def _about(self) -> str:
        misfit = ", ".join(
            f"{n} {x:.1e}" for n, x in zip(self.outputs, self.residual, strict=True)
        )
        reduced = self.cost / self.freedom
        about = f"residual {misfit}; chi-square / degrees of freedom {reduced:.3g}; "
        about += (
            f"{len(self.harmonics)} harmonics, degree {self.numerators.shape[1] - 1}"
        )
        return "; ".join(filter(None, [about, self.doubt]))


def _evaluate(numerators, c, f, n_sections: int) -> Complex[np.ndarray, "M F ny nu"]:
    powers = np.exp(
        -2j * np.pi / n_sections * f[:, None] * np.arange(numerators.shape[1])
    )
    H = np.einsum("fr,mrij->mfij", powers, numerators)
    return H / chi(np.exp(-2j * np.pi * f), c)[:, None, None]


@checked
@one_blas_thread()
def fit_multipliers(
    htf: HTF,
    order: Order | LDTP,
    *,
    overhang: Index | None = None,
    errors: Literal["residuals", "variance"] = "residuals",
    check: bool = True,
) -> StructuredFit:
    r"""Fit the common denominator of the HTFs, whose roots are the Floquet multipliers.

    The maximum-likelihood estimate for independent, circular, Gaussian errors of the HTFs with the
    variances `htf.variance`: the sum of $|H - B/\chi|^2 / \mathrm{var}$ is minimized over all
    numerators B and the d coefficients c of the denominator $\chi$. Numerators are eliminated
    (variable projection), so that Gauss-Newton steps are taken in c only. The descent starts from
    the linearized problem, solved by generalized total least squares, which is consistent (Pintelon
    and Schoukens, *System Identification: A Frequency Domain Approach*). Positive and negative
    frequencies are used, $H_m(-w) = \overline{H_{-m}(w)}$; for m = 0 (and N/2) numerators are real.

    **Arguments:**

    - `htf`: exact or estimated; `htf.select` chooses harmonics. Without variances, weights are
      estimated from the residuals of each output, whose spectrum is modeled as white noise plus
      noise filtered by the system; frequencies are weighted by the power of their inputs
      (`htf.power`).
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model whose rank it is.
      `select_order` helps to find it.
    - `overhang`: degree of the numerators beyond d N. Default: N.
    - `errors`: source of the covariance. `"residuals"`: the residuals at each frequency. This
      remains valid if the errors of different harmonics are dependent (process noise, distortion)
      or the variances are only approximate (White 1980). `"variance"`: the variances, which must
      then be correct. Default: `"residuals"`.
    - `check`: whether to raise an error if the data do not support so many multipliers (a rank test
      at the level of 1 %): the surplus multipliers would only fit noise. Default: True.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, variances that are not
    positive, a harmonic that `htf` does not hold, too few frequencies for so many coefficients (the
    message gives the number needed), or an order that the data do not support.
    """
    order = order.rank() if isinstance(order, LDTP) else order
    rms = weights.check_values(htf)
    if errors == "variance" and htf.variance is None:
        raise DefinitionError(
            "errors='variance' needs HTFs with variances: take 'residuals'."
        )
    f, H = np.asarray(htf.f), np.asarray(htf.H)

    def weighted(order: int):
        size, weight = (
            varpro.numerator_size(htf, order, overhang),
            weights.error_weights(htf, rms),
        )
        groups = varpro.group_htf(htf, weight, size)
        c, converged = varpro.maximum_likelihood(groups, order)
        for _ in range(_REWEIGHTINGS * (htf.variance is None)):
            variance = varpro.error_spectrum(
                groups, c, f, weights.line_variances(htf), len(rms)
            )
            weight = np.broadcast_to(weights.weights_of(variance, rms), H.shape)
            groups = varpro.group_htf(htf, weight, size)
            c, converged = varpro.maximum_likelihood(groups, order, c)
        return groups, weight, size, c, converged

    groups, weight, size, c, converged = weighted(order)
    covariance, cost, freedom = varpro.summarize(groups, c, errors)
    B = varpro.unfold(htf, groups, [varpro.numerators_of(group, c) for group in groups])
    misfit, scale = _evaluate(B, c, f, htf.n_sections) - H, rms[:, None]
    residual = np.sqrt(np.mean(np.abs(misfit) ** 2, axis=(0, 1, 3))) / rms

    def ratios(k: int) -> NoiseRatios:
        used, *_, fitted, _ = (groups, c, True) if k == order else weighted(k)
        return noise_ratios(
            used, htf, fitted, htf.variance is None and residual.max() < ROUNDING
        )

    surplus = unsupported(ratios, order)
    if check and surplus:
        raise DefinitionError(f"{surplus}, or pass check=False.")

    correlation = weights.neighbor_correlation(misfit / scale, H / scale, f)
    result = Result.OK if converged else Result.NOT_CONVERGED
    fit = StructuredFit(
        multipliers_of(c),
        c,
        *covariance,
        residual,
        correlation,
        B,
        cost,
        freedom,
        result,
        htf.harmonics,
        htf.n_sections,
        htf.inputs,
        htf.outputs,
    )

    def of_order(order: int) -> RoughFit:
        # No larger numerators, if possible: without zero multipliers they are large enough.
        fewer = max(size - 1 - order * htf.n_sections, 0)
        groups = varpro.group_htf(htf, weight, varpro.numerator_size(htf, order, fewer))
        start = np.pad(fit.coefficients, (0, order - len(fit.coefficients)))
        c, _ = varpro.maximum_likelihood(groups, order, start, rough=True)
        return c, lambda: varpro.summarize(groups, c, errors)[0]

    # One more multiplier, or a pair.
    more = [functools.partial(of_order, order + k) for k in (1, 2) if check]
    return dataclasses.replace(
        fit, doubt=warned(surplus or fit.contradiction(more), check)
    )


@checked
@one_blas_thread()
def multiplier_bound(
    model: LDTP, htf: HTF, overhang: Index | None = None
) -> MultiplierEstimate:
    r"""Return the Cramer-Rao bound of the multipliers of a known model.

    The errors of the HTFs are independent, circular and Gaussian, and all numerators are unknown.
    The bound is the inverse of $J^T J$ at the true values, where J is the derivative of the HTFs in
    units of their standard deviations, projected orthogonally to all changes of the numerators. It
    limits the accuracy that an experiment can reach, before the experiment.

    **Arguments:**

    - `model`: the true system. `htf`: frequencies, harmonics and `variance`; its H is not used.
    - `overhang`: degree of the numerators beyond d N. Default: N.

    **Returns:** the true multipliers with the smallest covariance of an unbiased estimate;
    `standard_errors` are bounds of rms errors.

    **Raises:** `DefinitionError` if the two do not fit together, `htf` has no variances, or too
    few frequencies to find the multipliers at all.
    """
    exact, multipliers = exact_htf(model, htf), model.multipliers
    d, c = len(multipliers), np.poly(multipliers).real[1:]
    groups = varpro.grouped(exact, d, overhang)
    J = np.concatenate(
        [varpro.misfit_of(x, c).jacobian.reshape(d, -1) for x in groups], axis=1
    )
    return MultiplierEstimate(multipliers, c, np.linalg.inv(J @ J.T), np.inf)


def exact_htf(model: LDTP, htf: HTF) -> HTF:
    """Return the HTFs of a model with the frequencies, harmonics and variances of others.

    **Raises:** `DefinitionError` if the two do not fit together, or `htf` has no variances.
    """
    require_same("model and HTFs", model, htf)
    if htf.variance is None:
        text = "estimate them from several realizations or windows (`repeats`)."
        raise DefinitionError(f"a bound needs HTFs with variances: {text}")
    return dataclasses.replace(model.htf(htf.f, htf.harmonics), variance=htf.variance)


# Largest ratio of squares of rounding errors. Smaller: they count as multipliers of exact HTFs;
# larger: weak multipliers of clean HTFs are missed.
_ROUNDING_VARIES = 1e6
# Probability that noise alone is taken for a multiplier, and the random matrices from which its
# quantile is taken. Smaller: weak multipliers are missed; larger: orders are too high.
_FALSE_ALARMS, _DRAWS = 0.01, 20000


class OrderSelection(eqx.Module):
    """Criteria for each number of multipliers. Printing it shows a table.

    **Fields**, one entry for each order 0, 1, ..., the largest tried:

    - `orders`.
    - `strength`: the singular value that an order beyond this one would have to explain, in units
      of the noise: 1 where only noise is left. `deviation`: its distance from 1 in standard
      deviations, and `threshold` the value that noise alone exceeds in 1 % of cases.
    - `cost`, `freedom`: the misfit of the best fit, and its expected value (somewhat larger where
      the variances were estimated).
    - `mdl`: Rissanen's criterion, which penalizes each real coefficient, those of the numerators
      too, by the logarithm of the number of data. The smallest is best.
    - `by_rank`, `by_mdl`: the order that each criterion selects.
    - `order`: `by_rank` where variances were given: a longer denominator adds many coefficients
      of numerators, which `mdl` penalizes, so that it selects too few multipliers where
      noise is strong; and for exact HTFs, of which `mdl` counts rounding. Without variances
      `by_mdl`, which small errors that are not random do not mislead.
    """

    orders: Int[np.ndarray, " k"]
    strength: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    threshold: Float[np.ndarray, " k"]
    cost: Float[np.ndarray, " k"]
    freedom: Int[np.ndarray, " k"]
    mdl: Float[np.ndarray, " k"]
    variances: bool = eqx.field(static=True)

    @property
    def by_rank(self) -> int:
        small = self.deviation <= self.threshold
        return int(np.argmax(small)) if small.any() else int(self.orders[-1])

    @property
    def by_mdl(self) -> int:
        return int(np.argmin(self.mdl))

    @property
    def order(self) -> int:
        return self.by_rank if self.variances else self.by_mdl

    def __repr__(self) -> str:
        rows = ["order  left/noise  deviations (1 %)  chi-square/dof          MDL"]
        for k, d in enumerate(self.orders):
            rows.append(
                f"{d:5d}  {self.strength[k]:10.4g}  {self.deviation[k]:10.3g} "
                f"({self.threshold[k]:.1f})  {self.cost[k] / self.freedom[k]:14.4g} "
                f"{self.mdl[k]:12.5g}"
            )
        rows.append(
            f"by rank: {self.by_rank}, by MDL: {self.by_mdl}; order: {self.order}"
        )
        return "\n".join(rows)


@checked
@one_blas_thread()
def select_order(
    htf: HTF, max_order: Order = 5, *, overhang: Index | None = None
) -> OrderSelection:
    r"""Compare numbers of multipliers, from none to `max_order`.

    *Rank*: the part of $H, z^{-N} H, \ldots, z^{-DN} H$ that numerators explain is removed. The
    rest has one independent component for each multiplier (D at most), and noise. Components are
    counted by generalized singular values: each above the largest value of noise alone counts.
    *MDL*: Rissanen's criterion for a fit of each order, with numerators of the degree that belongs
    to this order.

    **Arguments:** as in `fit_multipliers`. Without variances the misfit of the largest order is
    taken for noise, so that `max_order` must be no smaller than the number of multipliers; errors
    that are not random (a transient, distortion by an input that was not drawn at random) then
    look like multipliers. `max_order` defaults to 5.

    **Raises:** `DefinitionError` as `fit_multipliers`.
    """
    rms = weights.check_values(htf)
    size = varpro.numerator_size(htf, max_order, overhang)
    weight = weights.error_weights(htf, rms)
    largest = varpro.group_htf(htf, weight, size)
    noise = np.ones(len(rms))
    if htf.variance is None:
        c, _ = varpro.maximum_likelihood(largest, max_order)
        square, number = np.zeros((2, len(rms)))
        for group in largest:
            residual = varpro.misfit_of(group, c).residual
            np.add.at(square, group.channel[:, 0], (residual**2).sum(axis=(0, 1)))
            np.add.at(number, group.channel[:, 0], group.freedom)
        noise = np.maximum(np.sqrt(square / number), weights.SMALLEST_ERROR)
        weight = weight / noise[:, None]
        largest = varpro.group_htf(htf, weight, size)
    costs, freedoms = [], []
    for d in range(max_order + 1):
        groups = varpro.group_htf(htf, weight, size - (max_order - d) * htf.n_sections)
        c = varpro.maximum_likelihood(groups, d)[0] if d else np.zeros(0)
        cost, freedom = varpro.cost_of(groups, c)
        costs.append(cost)
        freedoms.append(freedom - d)
    cost, freedom, data = np.array(costs), np.array(freedoms), 2 * htf.H.size
    level, _ = weights.estimated_noise(
        weights.largest_misfit(htf), cost[-1] / freedom[-1]
    )
    likelihood = (
        data * np.log(np.maximum(cost, 1e-300))
        if htf.variance is None
        else cost / level
    )
    exact = bool(noise.max() < ROUNDING)
    values, spread = noise_ratios(largest, htf, c, exact)
    return OrderSelection(
        orders=np.arange(max_order + 1),
        strength=np.sqrt(values[::-1]),
        deviation=(values[::-1] - 1) / spread,
        threshold=np.array(
            [_largest_of_noise(max_order + 1 - d) for d in range(max_order + 1)]
        ),
        cost=cost,
        freedom=freedom,
        mdl=likelihood + np.log(data) * (data - freedom),
        variances=htf.variance is not None or exact,
    )


@functools.lru_cache
def _largest_of_noise(size: int) -> float:
    """Return the value that the largest of `size` ratios of noise exceeds in 1 % of cases.

    In standard deviations from 1. The Gram matrix of independent noise differs from its mean by a
    matrix of the Gaussian orthogonal ensemble.
    """
    draws = np.random.default_rng(0).normal(size=(_DRAWS, size, size))
    symmetric = (draws + draws.swapaxes(1, 2)) / 2
    return float(np.quantile(np.linalg.eigvalsh(symmetric)[:, -1], 1 - _FALSE_ALARMS))


NoiseRatios = tuple[Float[np.ndarray, " d1"], float]
"""Of a fit of order d: d + 1 ratios, ascending, one of which is noise, that of chi itself; and the
standard deviation of each where it is noise."""


def noise_ratios(
    groups: list[varpro.HTFGroup], htf: HTF, c: Coefficients, exact: bool = False
) -> NoiseRatios:
    """Return squared singular values of the residuals of numerators of $z^{-jN} H$, j = 0..d, in
    units of the noise, for a fit to HTFs.

    **Arguments:** `exact`: whether the noise is rounding, which differs by orders of magnitude.
    """
    cost, freedom = varpro.cost_of(groups, c)
    level, tails = weights.estimated_noise(weights.largest_misfit(htf), cost / freedom)
    whitened, _ = varpro.delayed_responses(groups, np.zeros(len(c)))
    values = np.linalg.svd(whitened, compute_uv=False)[::-1] ** 2
    return values / level / _ROUNDING_VARIES**exact, tails * float(np.sqrt(2 / freedom))


def unsupported(ratios: Callable[[int], NoiseRatios], order: int) -> str:
    """Return a sentence if noise alone may account for multipliers of a fit; else "".

    The number that it names is supported by a fit of that order, too.

    **Arguments:** `ratios(k)`: those of a fit of order k.
    """
    most, weakest = order, 0.0
    while most:
        values, spread = ratios(most)
        sizes, limits = (
            (values - 1) / spread,
            [_largest_of_noise(k + 1) for k in range(most + 1)],
        )
        if (sizes[1:] > limits[1:]).all():
            break
        most, weakest = (
            int((sizes[1:] > limits[1:]).sum()),
            np.sqrt(max(values[1], 0.0)),
        )
    text = f"the data support {most} multipliers, not {order}: the weakest is {weakest:.3g} times "
    remedy = f"lower `order` to {most}" if most else "excite more"
    return f"{text}the noise, and may be noise alone; {remedy}, or measure longer" * (
        most < order
    )
