"""The number of multipliers that the data support."""

import functools

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order, StepCount
from .._core.execution import one_blas_thread
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from .descent import ROUNDING
from .htf_errors import SMALLEST_ERROR, check_values, error_weights, require_frequencies
from .variable_projection import (
    HTFGroup,
    delayed_responses,
    group_htf,
    maximum_likelihood,
    misfit_of,
)


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
      noise is strong. Without variances `by_mdl`, which small errors that are not random do not
      mislead.
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
        rows = ["order  left/noise  deviations (1 %)   cost/expected          MDL"]
        for k, d in enumerate(self.orders):
            rows.append(
                f"{d:5d}  {self.strength[k]:10.4g}  {self.deviation[k]:10.3g} "
                f"({self.threshold[k]:.1f})  {self.cost[k] / self.freedom[k]:14.4g} "
                f"{self.mdl[k]:12.5g}"
            )
        rows.append(f"by rank: {self.by_rank}, by MDL: {self.by_mdl}; order: {self.order}")
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

    *Rank*: the part of $H, z^{-N} H, \ldots, z^{-DN} H$ that numerators do not explain has as many
    independent components as there are multipliers (D at most), and otherwise only noise, whose
    covariance is known up to a factor. The generalized singular values are compared with those of
    noise alone, from the smallest on. *MDL*: Rissanen's criterion for a fit of each order, with
    numerators of the degree that belongs to this order.

    **Arguments:** as in `fit_multipliers`. Without variances the misfit of the largest order is
    taken for noise, so that `max_order` must be no smaller than the number of multipliers; errors
    that are not random (a transient, distortion by an input that was not drawn at random) then
    look like multipliers. `max_order` defaults to 5.

    **Raises:** `DefinitionError` as `fit_multipliers`.
    """
    N = htf.n_sections
    overhang = N if overhang is None else overhang
    if harmonics is not None:
        htf = htf.select(harmonics)
    rms = check_values(htf)
    sizes = [d * N + overhang + 1 for d in range(max_order + 1)]
    require_frequencies(htf, max_order, sizes[-1])
    weights = error_weights(htf, rms)
    largest = group_htf(htf, weights, sizes[-1])
    noise = np.ones(len(rms))
    if htf.variance is None:
        c, _ = maximum_likelihood(largest, max_order, max_steps)
        square, number = np.zeros((2, len(rms)))
        for group in largest:
            residual = misfit_of(group, c).residual
            np.add.at(square, group.channel[:, 0], (residual**2).sum(axis=(0, 1)))
            np.add.at(number, group.channel[:, 0], group.freedom)
        noise = np.maximum(np.sqrt(square / number), SMALLEST_ERROR)
        weights = weights / noise[:, None]
        largest = group_htf(htf, weights, sizes[-1])
    values, deviation = _noise_ratios(largest, max_order)
    if noise.max() < ROUNDING:  # rounding errors differ by orders of magnitude
        values = values / _ROUNDING_VARIES

    costs, freedoms, parameters = [], [], []
    for d, size in enumerate(sizes):
        groups = group_htf(htf, weights, size)
        c = maximum_likelihood(groups, d, max_steps).coefficients if d else np.zeros(0)
        costs.append(sum(float((misfit_of(g, c).residual ** 2).sum()) for g in groups))
        freedoms.append(sum(g.freedom * g.size for g in groups) - d)
        parameters.append(sum((2 * len(g.period_delay) - g.freedom) * g.size for g in groups) + d)
    cost, freedom, count = np.array(costs), np.array(freedoms), np.array(parameters)
    data = int(freedom[0] + count[0])
    level, tails = _estimated_noise(htf, cost[-1] / freedom[-1])
    likelihood = data * np.log(np.maximum(cost, 1e-300)) if htf.variance is None else cost / level
    left = values[::-1] / level
    return OrderSelection(
        orders=np.arange(max_order + 1),
        strength=np.sqrt(left),
        deviation=(left - 1) / (tails * deviation),
        threshold=np.array([_largest_of_noise(max_order + 1 - d) for d in range(max_order + 1)]),
        cost=cost,
        freedom=freedom,
        mdl=likelihood + np.log(data) * count,
        variances=htf.variance is not None,
    )


def _noise_ratios(groups: list[HTFGroup], order: int) -> tuple[Float[np.ndarray, " d1"], float]:
    """Return the squared singular values of the numerators' residuals of $z^{-jN} H$, j = 0..d.

    They ascend, in units of the noise (1 where only noise is left); then the standard deviation of
    each where it is noise.
    """
    white = delayed_responses(groups, np.zeros(order)).whitened()
    values = np.linalg.svd(white, compute_uv=False)[::-1] ** 2
    return values, float(np.sqrt(2 / sum(group.freedom * group.size for group in groups)))


def _estimated_noise(htf: HTF, misfit: float) -> tuple[float, float]:
    r"""Return the mean square of the noise in units of `htf.variance`, and how wide it scatters.

    Both are 1 for variances that are known. With $\nu$ complex degrees of freedom
    $|\varepsilon|^2 / v$ has Fisher's distribution with 2 and $2 \nu$: its mean is
    $L = \nu / (\nu - 1)$, its standard deviation $L \sqrt{L / (2 - L)}$.
    Weights that are pooled have more degrees of freedom than each variance, so that L is taken
    from the misfit of a fit, as far as $\nu$ allows.

    **Arguments:** `misfit`: cost of the fit relative to its expected value.
    """
    if htf.scatter is None:
        return 1.0, 1.0
    freedom = float(np.median(htf.scatter.freedom))
    most = freedom / (freedom - 1) if freedom > 1 else np.inf
    level = float(np.clip(misfit, 1.0, most))
    return level, float(np.sqrt(level / (2 - level))) if level < 2 else np.inf


@functools.lru_cache
def _largest_of_noise(size: int) -> float:
    """Return the value that the largest of `size` ratios of noise exceeds in 1 % of cases.

    In standard deviations from 1. The Gram matrix of independent noise differs from its mean by a
    matrix of the Gaussian orthogonal ensemble.
    """
    draws = np.random.default_rng(0).normal(size=(_DRAWS, size, size))
    symmetric = (draws + draws.swapaxes(1, 2)) / 2
    return float(np.quantile(np.linalg.eigvalsh(symmetric)[:, -1], 1 - _FALSE_ALARMS))


def require_order(groups: list[HTFGroup], htf: HTF, order: int, misfit: float) -> None:
    """Check that HTFs carry so many multipliers.

    **Arguments:** `misfit`: cost of the fit relative to its expected value.

    **Raises:** `DefinitionError` if noise alone could account for one of the multipliers.
    """
    level, tails = _estimated_noise(htf, misfit)
    values, deviation = _noise_ratios(groups, order)
    refuse_invented(values / level, tails * deviation)


def refuse_invented(values: Float[np.ndarray, " d1"], spread: float) -> None:
    """Check the d + 1 ratios of a fit of order d, ascending: one is noise, that of chi itself.

    **Raises:** `DefinitionError` if more of them may be noise.
    """
    order = len(values) - 1
    deviations = (values - 1) / spread
    carried = sum(deviations[k] > _largest_of_noise(k + 1) for k in range(1, order + 1))
    if carried < order:
        raise DefinitionError(
            f"the data support {carried} multipliers, not {order}: the weakest is "
            f"{np.sqrt(max(values[1], 0.0)):.3g} times the noise, which may be noise alone. Lower "
            "`order` (`select_order` compares orders), measure longer, or pass check=False."
        )
