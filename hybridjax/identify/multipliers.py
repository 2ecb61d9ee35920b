"""Floquet multipliers from the exact structure of harmonic transfer functions, and their number.

`fit_multipliers` takes weights from `weights.py`, and the minimum from `variable_projection.py`.
The second half of this file decides on the number of multipliers: `noise_ratios` and `supported`
ask which multipliers could be noise alone, and `compare_orders` (for `hj.select_order`) also
compares description lengths. A wrong multiplier has its cause in `variable_projection.py`, a wrong
number of multipliers in `supported`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order, Scalar, Vector
from .._core.execution import one_blas_thread
from .._core.findings import Finding, refuse, warn_of
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import how_many
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from . import variable_projection as varpro, weights
from .denominator import divided_by_chi, multipliers_of
from .descent import ROUNDING, Coefficients
from .fit import WithCost, not_converged
from .multiplier_estimate import (
    FitWithoutModel,
    RoughFit,
    order_doubts,
)


# HTFs without variances are fitted again this many times, with weights from the last residuals.
# Fewer: weights have the wrong shape. More: multipliers change by at most a tenth of their standard
# errors.
_REWEIGHTINGS = 2


class StructuredFit(WithCost, FitWithoutModel):
    r"""All harmonics, outputs and inputs with one denominator in $z^{-N}$.

    $$H_m(z) = \frac{B_m(z^{-1})}{\chi(z^{-N})}, \qquad
    \chi(z^{-N}) = 1 + c_1 z^{-N} + \ldots + c_d z^{-dN} = \prod_i (1 - \lambda_i z^{-N})$$

    which is exact for a periodic system with d non-zero multipliers $\lambda_i$, if the degree
    of the polynomials B_m is high enough (d N and an excess: at most N times the number of
    periods after which the zero multipliers' part of the state has vanished).

    **Fields** beside those of every `Fit` (`model` and `noise` are None):

    - `multipliers` (d,): by decreasing modulus. `coefficients` (d,): c_1 to c_d, real.
    - `covariance` (d, d): that of the coefficients. `standard_errors`, `contains` and `ellipse`
      follow from it.
    - `residual` (ny,): rms misfit of each output's HTFs relative to their rms, and `correlation`,
      that of the misfit at neighboring frequencies: about 0 if the order is large enough.
    - `cost`: sum of squares of the misfit in units of the errors' standard deviations; its expected
      value is `dof`. Without variances the unit is estimated from the misfit, and the two are
      equal.
    - `numerators` (M, degree + 1, ny, nu): coefficients of B_m, by rising power of
      z^-1. In a narrow band of frequencies, many numerators give the same fit;
      `numerators` are the smallest of them.
    - `harmonics` (M,), `n_sections`, `inputs`, `outputs`: names and numbers of the fitted HTFs.
    - `findings`: "order" if fits with one or two more multipliers contradict this fit
      (multipliers lie outside of each other's confidence regions), or if the data do
      not support so many; "undetermined"; "no convergence". Higher orders are not tried
      without `check`.
    """

    residual: Float[np.ndarray, " ny"]
    correlation: float = eqx.field(static=True)
    numerators: Complex[np.ndarray, "M powers ny nu"]
    cost: float = eqx.field(static=True)
    harmonics: tuple[int, ...] = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    @checked
    def htf(
        self, frequencies: Scalar | Vector, harmonics: Harmonics | None = None
    ) -> HTF:
        """Return the fitted HTFs at `frequencies` (F,), cycles per period, inside the data's band.

        **Raises:** `DefinitionError` for a harmonic that was not fitted.
        """
        f = np.atleast_1d(np.asarray(frequencies, float))
        N = self.n_sections
        H = divided_by_chi(self.numerators, self.coefficients, f, N)
        htf = HTF(f, H, self.harmonics, N, self.inputs, self.outputs, "structured fit")
        return htf if harmonics is None else htf.select(harmonics)

    def _about(self) -> str:
        pairs = zip(self.outputs, self.residual, strict=True)
        harmonics = how_many(len(self.harmonics), "harmonic", "harmonics")
        misfit = ", ".join(f"{name} {x:.1e}" for name, x in pairs)
        return (
            f"residual {misfit}; chi-square per degree of freedom {self.chi2_per_dof:.3g}; "
            f"{harmonics}, degree {self.numerators.shape[1] - 1}"
        )


@checked
@one_blas_thread()
def fit_multipliers(
    htf: HTF,
    order: Order | LDTP,
    *,
    extra_lags: Index | None = None,
    covariance: Literal["residuals", "variance"] = "residuals",
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

    - `htf`: exact or estimated; `htf.select` chooses harmonics. Without variances,
      weights are estimated from the residuals of each output. The model of their
      spectrum is white noise plus noise filtered by the system. Frequencies are then
      also weighted by the power of their inputs (`htf.power`).
    - `order`: d, the number of non-zero multipliers, or an `LDTP` model that has this
      number. `select_order` helps to find it.
    - `extra_lags`: degree of the numerators beyond d N. Default: N.
    - `covariance`: source of the covariance. `"residuals"`: the residuals at each frequency. This
      remains valid if the errors of different harmonics are dependent (process noise, distortion)
      or the variances are only approximate (White 1980). `"variance"`: the variances, which must
      then be correct. Default: `"residuals"`.
    - `check`: whether to raise an error if the data do not support so many multipliers (a rank test
      at the level of 1 %): the surplus multipliers would only fit noise. Default: True.

    **Returns:** `hj.identify.StructuredFit`: `multipliers` (d,), complex, without unit, by
    decreasing modulus; `standard_errors` (d,); `covariance` (d, d), that of the coefficients;
    `findings`.

    **Raises:** `DefinitionError` for an order below 1, NaN in the HTFs, variances that are not
    positive, a harmonic that `htf` does not hold, too few frequencies for so many coefficients (the
    message gives the number needed), or an order that the data do not support.

    **Example:**

    ```python
    fit = hj.fit_multipliers(htf, order=2)
    print(fit.multipliers, fit.standard_errors)
    ```

    **Before:** `hj.estimate_htf`, `hj.select_order`. **After:** `hj.plot.multipliers`.
    """
    order = order.rank() if isinstance(order, LDTP) else order
    rms = weights.check_values(htf)
    if covariance == "variance" and htf.variance is None:
        raise DefinitionError(
            "covariance='variance' needs HTFs with variances: take 'residuals'."
        )
    solution = _solve(htf, rms, order, extra_lags)
    groups = solution.groups
    c = solution.c
    spread, cost, dof = varpro.summarize(groups, c, covariance)
    numerators = varpro.unfold(
        htf, groups, [varpro.numerators_of(group, c) for group in groups]
    )
    f = np.asarray(htf.frequencies)
    H = np.asarray(htf.H)
    misfit = divided_by_chi(numerators, c, f, htf.n_sections) - H
    scale = rms[:, None]
    square = np.mean(np.abs(misfit) ** 2, axis=(0, 1, 3))
    residual = np.sqrt(square) / rms
    exact = htf.variance is None and residual.max() < ROUNDING

    def ratios(k: int) -> NoiseRatios:
        fitted = solution if k == order else _solve(htf, rms, k, extra_lags)
        return noise_ratios(fitted.groups, htf, fitted.c, exact)

    surplus = unsupported(ratios, order, check)
    refuse(surplus)
    result = int(Result.OK if solution.converged else Result.NOT_CONVERGED)
    fit = StructuredFit(
        multipliers_of(c),
        c,
        *spread,
        residual,
        weights.neighbor_correlation(misfit / scale, H / scale, f),
        numerators,
        cost,
        htf.harmonics,
        htf.n_sections,
        htf.inputs,
        htf.outputs,
        dof=float(dof),
        result=result,
    )

    def of_order(order: int) -> RoughFit:
        # With numerators of the same size, if possible. (They are large enough if there are no zero
        # multipliers.)
        fewer = max(solution.size - 1 - order * htf.n_sections, 0)
        size = varpro.numerator_size(htf, order, fewer)
        groups = varpro.group_htf(htf, solution.weight, size)
        more = order - len(fit.coefficients)
        start = np.pad(fit.coefficients, (0, more))
        c, _ = varpro.maximum_likelihood(groups, order, start, rough=True)

        def covariance_there():
            of_coefficients, *_ = varpro.summarize(groups, c, covariance)
            return of_coefficients

        return c, covariance_there

    # One more multiplier, or a pair.
    higher = [functools.partial(of_order, order + k) for k in (1, 2) if check]
    doubts = surplus or order_doubts(fit, higher)
    fit = dataclasses.replace(fit, findings=(*not_converged(result), *doubts))
    if check:
        warn_of(fit.findings)
    return fit


class _Solution(NamedTuple):
    """The solution of a fit with a given number of multipliers."""

    groups: list[varpro.HTFGroup]
    weight: Float[np.ndarray, "M F ny nu"]
    size: int
    """The number of coefficients of each numerator."""
    c: Coefficients
    converged: bool


def _solve(
    htf: HTF, rms: Float[np.ndarray, " ny"], order: int, extra_lags: int | None
) -> _Solution:
    """Return the solution weighted by the variances of the HTFs; if there are none, by variances
    estimated from its residuals."""
    size = varpro.numerator_size(htf, order, extra_lags)
    weight = weights.error_weights(htf, rms)
    groups = varpro.group_htf(htf, weight, size)
    c, converged = varpro.maximum_likelihood(groups, order)
    if htf.variance is None:
        f = np.asarray(htf.frequencies)
        lines = weights.line_variances(htf)
        for _ in range(_REWEIGHTINGS):
            variance = varpro.error_spectrum(groups, c, f, lines, len(rms))
            weight = np.broadcast_to(weights.weights_of(variance, rms), htf.H.shape)
            groups = varpro.group_htf(htf, weight, size)
            c, converged = varpro.maximum_likelihood(groups, order, c)
    return _Solution(
        groups=groups,
        weight=weight,
        size=size,
        c=c,
        converged=converged,
    )


# Squares of rounding errors differ from each other by at most this factor. Smaller: in exact HTFs,
# rounding errors count as multipliers. Larger: weak multipliers of HTFs without noise are missed.
_ROUNDING_VARIES = 1e6
# Probability that noise alone is taken for a multiplier; and the number of random matrices from
# which the quantile is computed. Smaller: weak multipliers are missed. Larger: orders are too high.
_FALSE_ALARMS = 0.01
_DRAWS = 20000


class OrderSelection(Showable, eqx.Module):
    """Criteria for each number of multipliers. Printing it shows a table.

    **Fields**, one entry for each order 0, 1, ..., the largest tried:

    - `orders`.
    - `strength`: the singular value that an order beyond this one would have to
      explain, in units of the noise: 1 where only noise is left. `deviation` is the
      distance of `strength` from 1 in standard deviations. `threshold` is the value
      that noise alone exceeds in 1 % of cases.
    - `cost`, `dof`: the misfit of the best fit, and its expected value (somewhat larger where
      the variances were estimated).
    - `mdl`: Rissanen's criterion. It penalizes each real coefficient, including those
      of the numerators, by the logarithm of the number of data. The smallest value is
      best.
    - `by_rank`, `by_mdl`: the order that each criterion selects.
    - `order`: `by_rank` for HTFs with variances and for exact ones, otherwise `by_mdl`.
      With strong noise, `mdl` selects too few multipliers, because a longer denominator
      adds many coefficients of numerators. In exact HTFs, `mdl` counts rounding as
      data. If there are no variances, small errors that are not random do not mislead
      `mdl`.
    """

    orders: Int[np.ndarray, " k"]
    strength: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    threshold: Float[np.ndarray, " k"]
    cost: Float[np.ndarray, " k"]
    dof: Int[np.ndarray, " k"]
    mdl: Float[np.ndarray, " k"]
    variances: bool = eqx.field(static=True)

    @property
    def by_rank(self) -> int:
        small = self.deviation <= self.threshold
        if small.any():
            return int(np.argmax(small))
        return int(self.orders[-1])

    @property
    def by_mdl(self) -> int:
        return int(np.argmin(self.mdl))

    @property
    def order(self) -> int:
        return self.by_rank if self.variances else self.by_mdl

    def __index__(self) -> int:
        """The order: functions take a selection as the number."""
        return self.order

    def __repr__(self) -> str:
        rows = ["order  left/noise  deviations (1 %)  chi-square/dof          MDL"]
        for k, d in enumerate(self.orders):
            rows.append(
                f"{d:5d}  {self.strength[k]:10.4g}  {self.deviation[k]:10.3g} "
                f"({self.threshold[k]:.1f})  {self.cost[k] / self.dof[k]:14.4g} "
                f"{self.mdl[k]:12.5g}"
            )
        rows.append(
            f"by rank: {self.by_rank}, by MDL: {self.by_mdl}; order: {self.order}"
        )
        return "\n".join(rows)


@one_blas_thread()
def compare_orders(htf: HTF, max_order: int, extra_lags: int | None) -> OrderSelection:
    """Compare numbers of multipliers of HTFs, see `hj.select_order`."""
    rms = weights.check_values(htf)
    size = varpro.numerator_size(htf, max_order, extra_lags)
    weight = weights.error_weights(htf, rms)
    largest = varpro.group_htf(htf, weight, size)
    noise = np.ones(len(rms))
    if htf.variance is None:
        c, _ = varpro.maximum_likelihood(largest, max_order)
        noise = np.maximum(_left_over(largest, c, len(rms)), weights.SMALLEST_ERROR)
        weight = weight / noise[:, None]
        largest = varpro.group_htf(htf, weight, size)
    orders = np.arange(max_order + 1)
    c = np.zeros(0)
    costs = []
    for d in orders.tolist():
        groups = varpro.group_htf(htf, weight, size - (max_order - d) * htf.n_sections)
        if d:
            c, _ = varpro.maximum_likelihood(groups, d)
        costs.append(varpro.cost_of(groups, c))
    cost, equations = np.transpose(costs)
    dof = equations.astype(int) - orders
    data = 2 * htf.H.size
    if htf.variance is None:
        likelihood = data * np.log(np.maximum(cost, 1e-300))
    else:
        largest_misfit = weights.largest_misfit(htf)
        misfit = cost[-1] / dof[-1]
        level, _ = weights.estimated_noise(largest_misfit, misfit)
        likelihood = cost / level
    exact = bool(noise.max() < ROUNDING)
    values, spread = noise_ratios(largest, htf, c, exact)
    return OrderSelection(
        orders=orders,
        strength=np.sqrt(values[::-1]),
        deviation=(values[::-1] - 1) / spread,
        threshold=np.array([_largest_of_noise(1 + k) for k in orders[::-1].tolist()]),
        cost=cost,
        dof=dof,
        mdl=likelihood + np.log(data) * (data - dof),
        variances=htf.variance is not None or exact,
    )


def _left_over(
    groups: list[varpro.HTFGroup], c: Coefficients, outputs: int
) -> Float[np.ndarray, " ny"]:
    """Return the rms residual of each output."""
    square = np.zeros(outputs)
    number = np.zeros(outputs)
    for group in groups:
        residual = varpro.misfit_of(group, c).residual
        of_channel = (residual**2).sum(axis=(0, 1))
        np.add.at(square, group.channel[:, 0], of_channel)
        np.add.at(number, group.channel[:, 0], group.dof)
    return np.sqrt(square / number)


@functools.lru_cache
def _largest_of_noise(size: int) -> float:
    """Return the value that the largest of `size` ratios of noise exceeds in 1 % of cases.

    In standard deviations from 1. The Gram matrix of independent noise differs from its mean by a
    matrix of the Gaussian orthogonal ensemble.
    """
    draws = np.random.default_rng(0).normal(size=(_DRAWS, size, size))
    symmetric = (draws + draws.mT) / 2
    largest = np.linalg.eigvalsh(symmetric)[:, -1]
    return float(np.quantile(largest, 1 - _FALSE_ALARMS))


NoiseRatios = tuple[Float[np.ndarray, " d1"], float]
"""For a fit of order d: d + 1 ratios, ascending, of which the smallest is always noise (that of chi
itself); and the standard deviation of a ratio that is noise."""


def noise_ratios(
    groups: list[varpro.HTFGroup], htf: HTF, c: Coefficients, exact: bool = False
) -> NoiseRatios:
    """Return squared singular values of the residuals of numerators of $z^{-jN} H$, j = 0..d, in
    units of the noise, for a fit to HTFs.

    **Arguments:** `exact`: whether the noise is rounding errors, which differ by orders of
    magnitude.
    """
    cost, dof = varpro.cost_of(groups, c)
    level, tails = weights.estimated_noise(weights.largest_misfit(htf), cost / dof)
    whitened, _ = varpro.delayed_responses(groups, np.zeros(len(c)))
    singular_values = np.linalg.svd(whitened, compute_uv=False)
    values = singular_values[::-1] ** 2 / level
    if exact:
        values = values / _ROUNDING_VARIES
    return values, tails * float(np.sqrt(2 / dof))


def supported(ratios: Callable[[int], NoiseRatios], order: int) -> tuple[int, float]:
    """Return the number of multipliers that cannot be noise alone; and the strength, relative to
    the noise, of the weakest one that may be noise.

    In a fit with the returned number of multipliers, none may be noise alone, either.

    **Arguments:** `ratios(k)`: the noise ratios of a fit of order k.
    """
    most = order
    weakest = 0.0
    while most:
        values, spread = ratios(most)
        sizes = (values - 1) / spread
        limits = np.array([_largest_of_noise(k + 1) for k in range(most + 1)])
        above = sizes[1:] > limits[1:]
        if above.all():
            break
        most = int(above.sum())
        weakest = float(np.sqrt(max(values[1], 0.0)))
    return most, weakest


def unsupported(
    ratios: Callable[[int], NoiseRatios], order: int, refused: bool = False
) -> list[Finding]:
    """Return a finding if multipliers of a fit may be noise alone.

    **Arguments:** as of `supported`. `refused`: whether such a fit is refused.
    """
    most, weakest = supported(ratios, order)
    if most == order:
        return []
    remedy = f"lower `order` to {most}" if most else "excite more"
    anyway = ", or pass check=False" if refused else ""
    text = (
        f"the data support {how_many(most, 'multiplier', 'multipliers')}, not {order}: the "
        f"weakest is {weakest:.3g} times the noise, and may be noise alone; {remedy}, or "
        f"measure longer{anyway}."
    )
    return [Finding("order", text, "refused" if refused else "warned")]
