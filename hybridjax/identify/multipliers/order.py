"""How many multipliers do the data carry?"""

import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index, Order, StepCount
from ..._core.execution import one_blas_thread
from ...errors import DefinitionError
from ...linear.frequency_response import Harmonics
from ...linear.htf import HTF
from .denominator import chi
from .error_weights import ROUNDING, check_values, error_weights, require_frequencies
from .maximum_likelihood import maximum_likelihood, noise_levels
from .variable_projection import HTFGroup, delayed_responses, group_htf, misfit_of


# Largest misfit, relative to the rms, that rounding alone may leave. Doubled: noise up to 2e-12 of
# the HTFs is taken for rounding errors.
_NOTHING_BUT_ROUNDING = 1e-12
# By how much squares of rounding errors may differ from each other. Doubled: multipliers of exact
# HTFs must stand out by 1.4 times as much.
_ROUNDING_VARIES = 1e6
# Probability that noise alone is taken for a multiplier. Doubled: weaker multipliers are found, and
# 2 % of orders are too high.
_FALSE_ALARMS = 0.01
# Random matrices from which its quantile is taken. Doubled: it is known to 0.7 times its error.
_DRAWS = 20000


class OrderSelection(eqx.Module):
    """What speaks for each number of multipliers. Printing it shows a table.

    **Fields**, one entry for each order 0, 1, ..., the largest tried:

    - `orders`.
    - `strength`: the singular value that an order beyond this one would have to explain, in units
      of the noise: 1 where there is nothing left but noise. `deviation`: how many standard
      deviations it lies above 1, and `threshold` what noise alone exceeds in 1 % of cases.
    - `cost`, `freedom`: the misfit of the best fit, and what it is expected to be (somewhat more
      where the variances were estimated).
    - `aic`, `mdl`: Akaike's and Rissanen's criteria, which punish each real coefficient, those of
      the numerators too, by 2 and by the logarithm of the number of data. The smallest is best.
    - `by_rank`, `by_aic`, `by_mdl`: the order that each chooses.
    - `order`: `by_rank` where variances were given: a longer denominator brings many coefficients
      of numerators with it, for which the other two punish, so that they choose too few
      multipliers where there is much noise. Without variances `by_mdl`, which is not misled by
      small errors that are not random.
    """

    orders: Int[np.ndarray, " k"]
    strength: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    threshold: Float[np.ndarray, " k"]
    cost: Float[np.ndarray, " k"]
    freedom: Int[np.ndarray, " k"]
    aic: Float[np.ndarray, " k"]
    mdl: Float[np.ndarray, " k"]
    variances: bool = eqx.field(static=True)

    @property
    def by_rank(self) -> int:
        small = self.deviation <= self.threshold
        return int(np.argmax(small)) if small.any() else int(self.orders[-1])

    @property
    def by_aic(self) -> int:
        return int(np.argmin(self.aic))

    @property
    def by_mdl(self) -> int:
        return int(np.argmin(self.mdl))

    @property
    def order(self) -> int:
        return self.by_rank if self.variances else self.by_mdl

    def __repr__(self) -> str:
        rows = ["order  left/noise  deviations (1 %)   cost/expected          AIC          MDL"]
        for k, d in enumerate(self.orders):
            rows.append(
                f"{d:5d}  {self.strength[k]:10.4g}  {self.deviation[k]:10.3g} "
                f"({self.threshold[k]:.1f})  {self.cost[k] / self.freedom[k]:14.4g} "
                f"{self.aic[k]:12.5g} {self.mdl[k]:12.5g}"
            )
        rows.append(
            f"by rank: {self.by_rank}, by AIC: {self.by_aic}, by MDL: {self.by_mdl}; "
            f"order: {self.order}"
        )
        return "\n".join(rows)


@checked
@one_blas_thread()
def select_order(
    htf: HTF,
    max_order: Order = 5,
    harmonics: Harmonics | None = None,
    *,
    overhang: Index | None = None,
    max_steps: StepCount = 50,
) -> OrderSelection:
    r"""Compare numbers of multipliers, from none to `max_order`.

    *Rank*: what numerators leave of $H, z^{-N} H, \ldots, z^{-DN} H$ has as many independent
    parts as there are multipliers (D at most), and beside them only noise, whose covariance is
    known up to their variance. The generalized singular values are compared with
    those of noise alone, from the smallest on.
    *AIC and MDL*: of fits of every order, with numerators of the degree that belongs to it.

    **Arguments:** as in `fit_multipliers`. Without variances the misfit of the largest order is
    taken for noise, so that `max_order` must be no smaller than the number of multipliers; errors
    that are not random (a transient, distortion by an input that was not drawn at random) then
    look like multipliers.

    **Raises:** `DefinitionError` as `fit_multipliers`.
    """
    N = htf.n_sections
    overhang = N if overhang is None else overhang
    if harmonics is not None:
        htf = htf.select(harmonics)
    rms = check_values(htf)
    require_frequencies(htf, max_order, max_order * N + overhang + 1)
    weights = error_weights(htf, rms)
    largest = group_htf(htf, weights, max_order * N + overhang + 1)
    start, _ = maximum_likelihood(largest, max_order, max_steps)
    noise = np.ones(len(rms))
    if htf.variance is None:
        noise = np.maximum(noise_levels(largest, start, len(rms)), ROUNDING)
        weights = weights / noise[:, None]
        largest = group_htf(htf, weights, max_order * N + overhang + 1)
    values, deviation = noise_ratios(largest, np.zeros(max_order))
    if noise.max() < _NOTHING_BUT_ROUNDING:  # rounding errors come in all sizes
        values = values / _ROUNDING_VARIES

    cost, freedom, parameters = np.zeros(max_order + 1), np.zeros(max_order + 1, int), []
    for d in range(max_order + 1):
        groups = group_htf(htf, weights, d * N + overhang + 1)
        c = maximum_likelihood(groups, d, max_steps).coefficients if d else np.zeros(0)
        cost[d] = sum(float((misfit_of(g, c).residual ** 2).sum()) for g in groups)
        freedom[d] = sum(g.freedom * g.size for g in groups) - d
        parameters.append(sum((2 * len(g.period_delay) - g.freedom) * g.size for g in groups) + d)
    data = int(freedom[0] + parameters[0])
    level, tails = estimated_noise(htf, cost[-1] / freedom[-1])
    likelihood = data * np.log(np.maximum(cost, 1e-300)) if htf.variance is None else cost / level
    parameters = np.array(parameters)
    left, deviation = values[::-1] / level, tails * deviation
    return OrderSelection(
        orders=np.arange(max_order + 1),
        strength=np.sqrt(left),
        deviation=(left - 1) / deviation,
        threshold=np.array([largest_of_noise(max_order + 1 - d) for d in range(max_order + 1)]),
        cost=cost,
        freedom=freedom,
        aic=likelihood + 2 * parameters,
        mdl=likelihood + np.log(data) * parameters,
        variances=htf.variance is not None,
    )


class NoiseRatios(NamedTuple):
    """How much of $z^{-jN} H$, j = 0, ..., d, stands out of the noise."""

    values: Float[np.ndarray, " d1"]
    """Squares of the singular values, ascending, in units of the noise: 1 if there is no more."""
    deviation: float
    """The standard deviation of each where it is noise."""


def noise_ratios(groups: list[HTFGroup], c: Float[np.ndarray, " d"]) -> NoiseRatios:
    """Generalized singular values of what numerators leave, weighted as for the denominator c."""
    white = delayed_responses(groups, c).whitened()
    values = np.linalg.svd(white, compute_uv=False)[::-1] ** 2
    # Each is a weighted mean of squares of so many independent numbers.
    total, square = 0.0, 0.0
    for group in groups:
        share = group.freedom * group.size / len(group.period_delay)
        weight = 1 / np.abs(chi(group.period_delay, c)) ** 2
        total, square = total + share * weight.sum(), square + share * (weight**2).sum()
    return NoiseRatios(values, float(np.sqrt(2 * square) / total))


class NoiseLevel(NamedTuple):
    """What noise looks like in units of variances that were themselves estimated."""

    mean: float
    """L, the mean of its squares: 1 for variances that are known."""
    tails: float
    """How much wider than noise of known variance it scatters."""


def estimated_noise(htf: HTF, misfit: float) -> NoiseLevel:
    r"""The noise in units of `htf.variance`.

    With $\nu$ complex degrees of freedom $|\varepsilon|^2 / v$ has Fisher's distribution with 2 and
    $2 \nu$: its mean is $L = \nu / (\nu - 1)$, its standard deviation $L \sqrt{L / (2 - L)}$.
    Weights that are pooled have more degrees of freedom than each variance, so that L is taken
    from the misfit of a fit, as far as $\nu$ allows.

    **Arguments:** `misfit`: cost of the fit relative to what is expected.
    """
    if htf.scatter is None:
        return NoiseLevel(1.0, 1.0)
    freedom = float(np.median(htf.scatter.freedom))
    most = freedom / (freedom - 1) if freedom > 1 else np.inf
    level = float(np.clip(misfit, 1.0, most))
    return NoiseLevel(level, np.sqrt(level / (2 - level)) if level < 2 else np.inf)


@functools.lru_cache
def largest_of_noise(size: int) -> float:
    """What the largest of so many ratios of noise exceeds in 1 % of cases, in deviations from 1.

    The Gram matrix of independent noise differs from its mean by a matrix of the Gaussian
    orthogonal ensemble.
    """
    draws = np.random.default_rng(0).normal(size=(_DRAWS, size, size))
    symmetric = (draws + draws.swapaxes(1, 2)) / 2
    return float(np.quantile(np.linalg.eigvalsh(symmetric)[:, -1], 1 - _FALSE_ALARMS))


def refuse_invented(values: Float[np.ndarray, " d1"], spread: float) -> None:
    """Of the d + 1 ratios of a fit of order d, ascending, one may be noise: that of chi itself.

    **Raises:** `DefinitionError` if more of them may be.
    """
    order = len(values) - 1
    deviations = (values - 1) / spread
    carried = sum(deviations[k] > largest_of_noise(k + 1) for k in range(1, order + 1))
    if carried < order:
        raise DefinitionError(
            f"the data carry {carried} multipliers, not {order}: the weakest is "
            f"{np.sqrt(max(values[1], 0.0)):.3g} times the noise, which may be noise alone. Lower "
            "`order` (`select_order` shows what speaks for each), measure longer, or pass "
            "check=False."
        )
