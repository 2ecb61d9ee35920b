r"""Phase response curves from intervals: penalized least squares on durations.

The coefficients of a curve have prior variances $\tau^2 / k^4$, as those of a smoothing spline do
(Wahba, *Spline Models for Observational Data*, 1990), and $\tau$ maximizes the marginal likelihood
of the durations. Residuals of intervals of one block may add up to more than independent errors
would: the likelihood is that of errors with as much variance as sums over blocks have
(quasi-likelihood: McCullagh 1983).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize

from ...identify.denominator import Covariance, sandwich
from .model import Forecast, Intervals, Table, forecast, tabulated


# Half waves of a curve. More: time, for detail that the smoothness removes. Fewer: curves that jump
# are cut off.
WAVES = 20
# Most Gauss-Newton steps, and most halvings of a step or updates of jitter, smoothness and
# miscounted intervals. More: time. Fewer: fits end before convergence.
_STEPS, _ROUNDS = 30, 8
# Relative changes at convergence: of the cost, and of jitter and smoothness. Larger: estimates
# depend on the start. Smaller: more iterations for digits that noise hides.
_SETTLED, _SAME = 1e-6, 0.01
# Blocks from which standard errors are computed: one per trial if there are so many, else parts of
# trials with at least so many intervals. More, shorter: blocks are not independent. Fewer, longer:
# standard errors scatter.
_BLOCKS, _SHORTEST_BLOCK = 30, 10


class Smoothness(NamedTuple):
    """The prior of a curve."""

    penalty: Float[np.ndarray, " p"]
    """Addition to the curvature of the sum of squares; zero for the mean."""
    noise: float
    """Variance of the residual of an interval, s^2, times the excess."""
    excess: float
    """Variance of sums over blocks relative to that of independent errors; at least 1."""
    evidence: float
    """Twice the logarithm of the likelihood ratio to a flat curve."""


class CurveFit(NamedTuple):
    """A curve and the rates of the trials."""

    coefficients: Float[np.ndarray, " p"]
    rates: Float[np.ndarray, " trials"]
    jitter: float
    """Standard deviation of the phase at the end of a cycle."""
    used: Bool[np.ndarray, " L"]
    """Intervals that are not miscounted."""
    residual: Float[np.ndarray, " L"]
    """Residuals of the durations, in s."""
    forecast: Forecast
    smoothness: Smoothness
    converged: bool

    @property
    def penalty(self) -> Float[np.ndarray, " p"]:
        return self.smoothness.penalty

    def counted(self) -> Bool[np.ndarray, " L"]:
        """Return the intervals whose forecast is off by less than half a cycle: others contain a
        missed or a false event."""
        return np.abs(self.residual * self.forecast.rate) < 0.5


def fit_curve(
    intervals: Intervals, waves: int, start: CurveFit | None = None
) -> CurveFit:
    """Return the curve of so many half waves that forecasts durations best (least squares), as
    smooth as the marginal likelihood suggests.

    Intervals whose forecast is off by half a cycle or more were miscounted, and not used.
    `start`: a fit with as many half waves or fewer.
    """
    flat = Smoothness(np.zeros(waves + 1), 0.0, 1.0, 0.0)
    if start is None:
        used = np.ones(len(intervals.start), bool)
        rates = intervals.sums(1.0 * used) / intervals.sums(intervals.duration)
        ahead = Forecast(0.0 * used, 0.0 * used, np.zeros((len(used), waves + 2)))
        fit = CurveFit(
            np.zeros(waves + 1), rates, 0.0, used, ahead.rate, ahead, flat, True
        )
    else:
        a = np.pad(start.coefficients, (0, waves + 1 - len(start.coefficients)))
        fit = start._replace(coefficients=a, used=start.counted(), smoothness=flat)
    for _ in range(_ROUNDS):
        table, before = tabulated(waves, fit.jitter), fit
        if waves:
            rough = _look(intervals, table, fit._replace(smoothness=flat))
            fit = fit._replace(smoothness=_smoothness(intervals, rough))
        fit = _minimize(intervals, table, _look(intervals, table, fit))
        used = fit.counted()
        fit = fit._replace(
            jitter=float((fit.residual * fit.forecast.rate)[used].std()), used=used
        )
        same = abs(fit.jitter - before.jitter) < _SAME * fit.jitter
        change = abs(before.penalty[-1] - fit.penalty[-1])
        if (
            same
            and (used == before.used).all()
            and change <= 10 * _SAME * fit.penalty[-1]
        ):
            break
    return fit


def _look(intervals: Intervals, table: Table, fit: CurveFit) -> CurveFit:
    """Return a curve and rates with their residuals."""
    ahead = forecast(intervals, table, fit.coefficients, fit.rates)
    residual = intervals.duration - ahead.duration
    return fit._replace(residual=residual, forecast=ahead, converged=True)


def _minimize(intervals: Intervals, table: Table, fit: CurveFit) -> CurveFit:
    """Gauss-Newton iteration over curve and rates."""

    def cost_of(fit):
        a = fit.coefficients
        return float((fit.residual[fit.used] ** 2).sum() + a @ (fit.penalty * a))

    for _ in range(_STEPS):
        across, along = projected(intervals, fit)
        curvature = across.T @ across + np.diag(fit.penalty)
        downhill = across.T @ fit.residual - fit.penalty * fit.coefficients
        step = np.linalg.lstsq(curvature, downhill)[0]
        faster = along @ np.append(1.0, -step)
        for k in range(_ROUNDS):
            rates = np.maximum(fit.rates + faster / 2**k, fit.rates / 2)  # (never zero)
            new = fit._replace(coefficients=fit.coefficients + step / 2**k, rates=rates)
            new = _look(intervals, table, new)
            if cost_of(new) < cost_of(fit):
                break
        else:
            return fit
        gain, fit = 1 - cost_of(new) / cost_of(fit), new
        if gain < _SETTLED:
            return fit
    return fit._replace(converged=False)


def projected(
    intervals: Intervals, fit: CurveFit
) -> tuple[Float[np.ndarray, "L p"], Float[np.ndarray, "trials p1"]]:
    """Return derivatives with respect to the coefficients, without the part that the rates of the
    trials explain (zero for miscounted intervals), and what rates explain of the residuals, and of
    these derivatives."""
    slopes, by_rate = fit.forecast.slopes[:, :-1], fit.forecast.slopes[:, -1]
    square = np.maximum(intervals.sums(by_rate**2 * fit.used), np.finfo(float).tiny)
    columns = np.column_stack([fit.residual, slopes]) * (by_rate * fit.used)[:, None]
    along = np.stack([intervals.sums(x) for x in columns.T], axis=1) / square[:, None]
    return (slopes - by_rate[:, None] * along[intervals.trial, 1:]) * fit.used[
        :, None
    ], along


def _blocks(intervals: Intervals) -> Int[np.ndarray, " L"]:
    """Return the blocks whose errors count as independent: successive intervals of one trial."""
    trial, counts = intervals.trial, np.bincount(intervals.trial)
    if len(counts) >= _BLOCKS:
        return trial
    length = max(_SHORTEST_BLOCK, len(trial) // (2 * _BLOCKS))
    place = np.concatenate([np.arange(n) for n in counts])
    block = np.minimum(place // length, np.maximum(counts[trial] // length, 1) - 1)
    return np.unique(trial * (block.max() + 1) + block, return_inverse=True)[1]


def _smoothness(intervals: Intervals, fit: CurveFit) -> Smoothness:
    """Maximize the marginal likelihood of the durations near a fit."""
    tiny = np.finfo(float).tiny
    across, along = projected(intervals, fit)
    residual = (
        fit.residual - fit.forecast.slopes[:, -1] * along[intervals.trial, 0]
    ) * fit.used
    p = across.shape[1]
    curvature, pull = across.T @ across, across.T @ residual
    # Noise is what no curve explains, however rough: what a smooth one leaves may be its shape.
    noise_only = residual - across @ np.linalg.lstsq(curvature, pull)[0]
    freedom = max(int(fit.used.sum()) - len(fit.rates) - p, 1)
    variance = float(noise_only @ noise_only) / freedom
    block = _blocks(intervals)
    sums = np.stack([np.bincount(block, x * noise_only) for x in across.T], axis=1)
    values, axes = np.linalg.eigh(curvature)
    determined = values > 1e-6 * values[-1]  # beyond rounding
    excess = float(((sums @ axes[:, determined]) ** 2 / values[determined]).sum())
    excess = (
        max(excess / int(determined.sum()) / variance, 1.0) if variance > 0 else 1.0
    )
    noise, weight = variance * excess, np.arange(1.0, p) ** 4
    score = pull + curvature @ fit.coefficients
    # The mean is free: its part is taken out.
    share = curvature[1:, 0] / curvature[0, 0]
    inner = curvature[1:, 1:] - np.outer(share, curvature[0, 1:])
    gain, axes = np.linalg.eigh(inner / np.sqrt(np.outer(weight, weight)))
    gain = np.maximum(gain, 0.0) / max(noise, tiny)
    pull = (axes.T @ ((score[1:] - share * score[0]) / np.sqrt(weight))) ** 2
    pull = pull / max(noise, tiny) ** 2

    def improbable(log_size: float) -> float:
        size = np.exp(log_size)
        return float((np.log1p(size * gain) - size * pull / (1 + size * gain)).sum())

    # Logarithms of tau^2, around that at which the best direction is half noise.
    grid = np.arange(-24.0, 24.5, 0.5) - np.log(max(gain[-1], tiny))
    best = grid[np.argmin([improbable(x) for x in grid])]
    top = optimize.minimize_scalar(
        improbable, bounds=(best - 0.5, best + 0.5), method="bounded"
    )
    penalty = np.append(0.0, noise * weight / np.exp(top.x))
    return Smoothness(penalty, noise, excess, max(-float(top.fun), 0.0))


def accuracy_of(intervals: Intervals, fit: CurveFit) -> tuple[Covariance, float, float]:
    """Return the covariance of a curve, the sum of squared errors of intervals forecast by fits to
    other blocks, and the number of coefficients that the data determine.

    The errors of each block are those of a forecast by a curve fitted to the other blocks, to first
    order (the jackknife that deletes blocks: Bell and McCaffrey 2002). Smoothness makes a bias,
    whose expected square is added (Nychka 1988: such intervals hold the curve at as many phases as
    they claim).
    """
    across, _ = projected(intervals, fit)
    data, smooth = across.T @ across, np.diag(fit.penalty)
    curvature, block = data + smooth, _blocks(intervals)
    count, p = int(block.max()) + 1, across.shape[1]
    score, shares, left_out = (
        np.zeros((count, p)),
        np.zeros((count, p, p)),
        np.zeros(count),
    )
    for k in range(count):
        rows = (block == k) & fit.used
        x, error = across[rows], fit.residual[rows]
        shares[k] = x.T @ x
        error = error + x @ np.linalg.lstsq(curvature - shares[k], x.T @ error)[0]
        score[k], left_out[k] = x.T @ error, error @ error
    meat = score.T @ score + fit.smoothness.noise * smooth
    covariance = sandwich(curvature, meat, shares + smooth / count)
    detail = float(np.trace(np.linalg.lstsq(curvature, data)[0]))
    return covariance, float(left_out.sum()), detail
