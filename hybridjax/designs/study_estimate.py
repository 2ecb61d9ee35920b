"""The estimate of the multipliers from all blocks of a study, with unknown noise.

`study.py` calls `block_of` for new data, `refuse_transient`, and `estimate` for all blocks
together, which returns an `Estimate`: the fit, the noise of each block, and an objection if the fit
cannot be used. The noise is estimated in turns with the fit: a wrong weight has its cause in this
loop. If good data are refused, look at `refuse_transient`; if a good fit is rejected, at
`_objection`. That the larger one of two standard errors counts must stay: the study stops when
errors are small, and so it would stop at one that is too small by chance.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.executor import from_host, to_host
from .._core.text import how_many
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.record import require_deviations
from ..identify.multiplier_estimate import MultiplierFit
from ..identify.multipliers import (
    NoiseRatios,
    StructuredFit,
    fit_multipliers,
    noise_ratios,
    supported,
)
from ..identify.spectral_sums import spectral_sums
from ..identify.variable_projection import (
    HTFGroup,
    grouped,
    maximum_likelihood,
    misfit_of,
)
from ..linear.htf import HTF
from .allocation import ENOUGH
from .goals import MultiplierGoal


# Largest number of estimates of the noise, each from the residual of a fit that is weighted by the
# last estimate. Fewer: the first estimate, which contains the signal, affects the weights.
_SWEEPS = 10
# Data are rejected if a transient exceeds the noise by this many standard deviations. Larger: weak
# transients bias the multipliers. Smaller: noise is taken for a transient.
_BEYOND_NOISE = 3.0


class Block(NamedTuple):
    """The data of one block of experiments that a study keeps."""

    htf: HTF
    """Responses to one cosine each, in one experiment each, with the variances for white noise of
    variance 1 on each sample."""
    cycles: int
    """All cycles of the records, with those that are discarded."""


def block_of(data: ExperimentData, goal: MultiplierGoal, repeats: int) -> Block:
    """**Raises:** `DefinitionError` in the cases of `estimate_htf`, and if no experiment ran to the
    end."""
    data.require_ok()
    require_deviations(data.records)
    each = []
    for s in np.flatnonzero(data.ok):
        one = slice(s, s + 1)
        single = dataclasses.replace(
            data,
            u=data.u[one],
            y=data.y[one],
            result=data.result[one],
            simulated=None,
        )
        each.append(spectral_sums(single, goal.fitted_harmonics, repeats=repeats))
    N = data.n_sections
    P = data.periods
    line = np.concatenate([sums.line for sums in each])
    gram = [np.real(sums.gram[:, 0, 0]) for sums in each]
    power = np.concatenate(gram)[:, None]
    along = np.concatenate([sums.along[:, 0] for sums in each])
    H = (along.swapaxes(0, 1) / power)[..., None]
    by_line = N * P / repeats / power
    variance = np.broadcast_to(by_line[..., None], H.shape)
    htf = HTF(
        np.arange(len(line)),
        H,
        each[0].harmonics,
        N,
        data.inputs,
        data.outputs,
        variance=variance,
    )
    # (A frequency may occur several times, once for each measurement.)
    htf = eqx.tree_at(lambda htf: htf.frequencies, htf, from_host(line / P))
    cycles = data.u.shape[0] * data.u.shape[1] // N
    return Block(htf, cycles)


class Estimate(NamedTuple):
    """The estimate from all blocks together."""

    fit: StructuredFit
    by_level: StructuredFit
    """The same fit, with standard errors for white noise of these levels."""
    noise: Float[np.ndarray, "B ny"]
    """Standard deviation of each output's noise in each block."""
    supported: int
    """Number of multipliers of the fit that cannot be noise alone."""
    objection: str
    """The reason to reject the fit; empty if the data support it."""

    @property
    def last_noise(self) -> dict[str, float]:
        """The noise in the last block, by the outputs' names."""
        return dict(zip(self.fit.outputs, self.noise[-1].tolist(), strict=True))


def estimate(blocks: tuple[Block, ...], order: int, goal: MultiplierGoal) -> Estimate:
    """Fit all responses of all blocks as `fit_multipliers` does, each weighted by the power of its
    cosine and by the noise of its block.

    A line that was measured in several experiments counts several times: the least-squares problem
    is that of the weighted mean. The noise level is one number for each block and output, from the
    residuals of all of its lines and harmonics (less the part that numerators take of it). With
    hundreds of degrees of freedom it hardly depends on the errors of single lines. (A variance for
    each line would depend on them, and bias the fit.)

    The standard errors are computed twice, and the larger ones are used: from the scatter of noise
    and distortion at the lines that matter, valid for any spectrum of the noise, but uncertain if
    such lines are few; and from the levels of the noise, as if it were white.
    """
    htfs = to_host([block.htf for block in blocks])
    f = np.concatenate([x.frequencies for x in htfs])
    H = np.concatenate([x.H for x in htfs], axis=1)
    counts = [len(htf.frequencies) for htf in htfs]
    member = np.repeat(np.arange(len(blocks)), counts)
    # (At first, the whole response counts as noise.)
    relative = [np.abs(htf.H) ** 2 / htf.variance for htf in htfs]
    noise = np.sqrt([np.mean(x, axis=(0, 1, 3)) for x in relative])
    c = None

    def weighted() -> tuple[HTF, list[HTFGroup]]:
        """Return all lines of all blocks, one after the other, with their variances."""
        variances = []
        for htf, std in zip(htfs, noise, strict=True):
            variances.append(htf.variance * std[:, None] ** 2)
        values = f, H, np.concatenate(variances, axis=1)
        htf = from_host(
            eqx.tree_at(lambda x: (x.frequencies, x.H, x.variance), htfs[0], values)
        )
        return htf, grouped(htf, order, goal.extra_lags)

    for _ in range(_SWEEPS):
        _, groups = weighted()
        c, _ = maximum_likelihood(groups, order, c)
        # The rms residual of each block and output, in units of the supposed noise.
        left = np.zeros(noise.shape)
        dof = np.zeros(noise.shape)
        for group in groups:
            misfit = misfit_of(group, c)
            block = member[group.line]
            free = (1 - misfit.leverage).sum(axis=0)
            for k, output in enumerate(group.channel[:, 0]):
                squares = (misfit.residual[:, :, k] ** 2).sum(axis=0)
                np.add.at(left[:, output], block, squares)
                np.add.at(dof[:, output], block, free)
        change = np.sqrt(left / dof)
        noise = noise * change
        if np.abs(np.log(change)).max() < ENOUGH:
            break
    htf, groups = weighted()
    by_scatter = fit_multipliers(htf, order, extra_lags=goal.extra_lags, check=False)
    by_level = fit_multipliers(
        htf, order, extra_lags=goal.extra_lags, check=False, covariance="variance"
    )
    fit = max(by_scatter, by_level, key=lambda fit: fit.standard_errors.max())

    def ratios(k: int) -> NoiseRatios:
        if k == order:
            return noise_ratios(groups, htf, fit.coefficients)
        fewer = grouped(htf, k, goal.extra_lags)
        coefficients, _ = maximum_likelihood(fewer, k)
        return noise_ratios(fewer, htf, coefficients)

    most, _ = supported(ratios, order)
    return Estimate(
        fit=fit,
        by_level=by_level,
        noise=noise,
        supported=most,
        objection=_objection(fit, most, order),
    )


def _objection(fit: MultiplierFit, most: int, order: int) -> str:
    """Return the reason why a fit of this order cannot be used; empty if it can. `most`: number of
    multipliers that the data support."""
    if not most:
        return (
            "the data show no multiplier above the noise (if that remains so, take a first design "
            "of more power or of more experiments)"
        )
    if most < order:
        return (
            f"the data support {how_many(most, 'multiplier', 'multipliers')}, not {order} "
            "(if that remains so, lower `order` in a new study)"
        )
    if (np.abs(fit.multipliers) >= 1).any():
        return (
            "the estimate is unstable, and an unstable system has no periodic response"
        )
    return ""


def refuse_transient(
    data: ExperimentData,
    repeats: int,
    multipliers: Complex[np.ndarray, " d"],
    noise: Float[np.ndarray, " ny"],
    allowed: float,
) -> None:
    """Check that the start of the records left no transient in the window.

    The transient is the difference between the cycles before the window and those P later. (The
    first cycle is left out, which also shows modes that decay within a cycle.)

    **Arguments:** `noise`: standard deviation of each output's. `allowed`: the part of the response
    that may be left of the transient when the window begins.

    **Raises:** `DefinitionError` if more is left.
    """
    N = data.n_sections
    P = data.periods
    y = data.y[data.ok]
    before = y.shape[1] // N - P * repeats
    if not before:
        return
    k = min(1, before - 1)
    whole = y.shape[1] // N * N
    kept = y[:, :whole]
    cycles = kept.reshape(len(y), -1, N, y.shape[2])
    early = cycles[:, k]
    late = cycles[:, k + P]
    difference = np.mean((early - late) ** 2, axis=(0, 1))
    excess = difference - 2 * noise**2
    numbers = early[..., 0].size
    threshold = _BEYOND_NOISE * 2 * noise**2 * np.sqrt(2 / numbers)
    square = np.mean(y**2, axis=(0, 1))
    size = np.sqrt(np.maximum(excess, 0) / square)
    decay = np.abs(multipliers).max() ** (before - k)
    left = np.where(excess > threshold, size, 0).max() * decay
    if left > allowed:
        raise DefinitionError(
            f"after {before} discarded cycles a part of {left:.1g} of the start's transient is "
            f"left (allowed: {allowed:.1g}): use `hj.identify.remove_transient(data).data`, or "
            "start='steady'."
        )
