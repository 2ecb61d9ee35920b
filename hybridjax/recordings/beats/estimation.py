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
_STEPS = 30
_ROUNDS = 8
# Relative changes at convergence: of the cost, and of jitter and smoothness. Larger: estimates
# depend on the start. Smaller: more iterations for digits that noise hides.
_SETTLED = 1e-6
_SAME = 0.01
# Blocks from which standard errors are computed: one per trial if there are so many, else parts of
# trials with at least so many intervals. More, shorter: blocks are not independent. Fewer, longer:
# standard errors scatter.
_BLOCKS = 30
_SHORTEST_BLOCK = 10


_TINY = np.finfo(float).tiny

Curve = Float[np.ndarray, " p"]
Square = Float[np.ndarray, "p p"]
Lanes = Float[np.ndarray, " L"]
"""A number for each interval."""
Slopes = Float[np.ndarray, "L p"]


class Smoothness(NamedTuple):
    """The prior of a curve."""

    penalty: Curve
    """Addition to the curvature of the sum of squares; zero for the mean."""
    noise: float
    """Variance of the residual of an interval, s^2, times the excess."""
    excess: float
    """Variance of sums over blocks relative to that of independent errors; at least 1."""
    evidence: float
    """Twice the logarithm of the likelihood ratio to a flat curve."""

    @staticmethod
    def none(waves: int) -> "Smoothness":
        return Smoothness(np.zeros(waves + 1), noise=0.0, excess=1.0, evidence=0.0)


class CurveFit(NamedTuple):
    """A curve and the rates of the trials."""

    coefficients: Curve
    rates: Float[np.ndarray, " trials"]
    jitter: float
    """Standard deviation of the phase at the end of a cycle."""
    used: Bool[np.ndarray, " L"]
    """Intervals that are not miscounted."""
    residual: Lanes
    """Residuals of the durations, in s."""
    forecast: Forecast
    smoothness: Smoothness
    converged: bool

    @property
    def penalty(self) -> Curve:
        return self.smoothness.penalty

    @property
    def by_rate(self) -> Lanes:
        """Derivatives of the durations with respect to the rate of their trial."""
        return self.forecast.slopes[:, -1]

    @property
    def missed(self) -> Lanes:
        """By how many cycles each interval misses its forecast."""
        return self.residual * self.forecast.rate

    def counted(self) -> Bool[np.ndarray, " L"]:
        """Return the intervals whose forecast is off by less than half a cycle: others contain a
        missed or a false event."""
        return np.abs(self.missed) < 0.5


def fit_curve(
    intervals: Intervals,
    waves: int,
    start: CurveFit | None = None,
) -> CurveFit:
    """Return the curve of so many half waves that forecasts durations best (least squares), as
    smooth as the marginal likelihood suggests.

    Intervals whose forecast is off by half a cycle or more were miscounted, and not used.
    `start`: a fit with as many half waves or fewer.
    """
    fit = _start(intervals, waves, start)
    rough = fit.smoothness
    for _ in range(_ROUNDS):
        before = fit
        table = tabulated(waves, fit.jitter)
        if waves:
            without = _look(intervals, table, fit._replace(smoothness=rough))
            fit = fit._replace(smoothness=_smoothness(intervals, without))
        fit = _minimize(intervals, table, _look(intervals, table, fit))
        used = fit.counted()
        fit = fit._replace(jitter=float(fit.missed[used].std()), used=used)
        if _is_settled(before, fit):
            break
    return fit


def _start(intervals: Intervals, waves: int, start: CurveFit | None) -> CurveFit:
    """Return another fit with so many half waves, or, without one, the mean rate of each trial."""
    smoothness = Smoothness.none(waves)
    if start is not None:
        more = waves + 1 - len(start.coefficients)
        return start._replace(
            coefficients=np.pad(start.coefficients, (0, more)),
            used=start.counted(),
            smoothness=smoothness,
        )
    L = len(intervals.start)
    counts = intervals.sums(np.ones(L))
    return CurveFit(
        coefficients=np.zeros(waves + 1),
        rates=counts / intervals.sums(intervals.duration),
        jitter=0.0,
        used=np.ones(L, bool),
        residual=np.zeros(L),
        forecast=Forecast(np.zeros(L), np.zeros(L), np.zeros((L, waves + 2))),
        smoothness=smoothness,
        converged=True,
    )


def _is_settled(before: CurveFit, fit: CurveFit) -> bool:
    """Return whether a round changed neither jitter, nor smoothness, nor the used intervals."""
    stiffness = fit.penalty[-1]
    change = abs(before.penalty[-1] - stiffness)
    return (
        abs(fit.jitter - before.jitter) < _SAME * fit.jitter
        and change <= 10 * _SAME * stiffness
        and bool((fit.used == before.used).all())
    )


def _look(intervals: Intervals, table: Table, fit: CurveFit) -> CurveFit:
    """Return a curve and rates with their residuals."""
    ahead = forecast(intervals, table, fit.coefficients, fit.rates)
    residual = intervals.duration - ahead.duration
    return fit._replace(residual=residual, forecast=ahead, converged=True)


def _minimize(intervals: Intervals, table: Table, fit: CurveFit) -> CurveFit:
    """Minimize the penalized sum of squares over curve and rates: Gauss-Newton steps, which are
    halved until the sum decreases.

    Rates are eliminated from each step. (In scipy's `least_squares`, those of hundreds of trials
    would be most of the unknowns.)
    """
    cost = _cost(fit)
    for _ in range(_STEPS):
        across, along = projected(intervals, fit)
        curvature = across.T @ across + np.diag(fit.penalty)
        downhill = across.T @ fit.residual - fit.penalty * fit.coefficients
        step = np.linalg.lstsq(curvature, downhill)[0]
        faster = along @ np.append(1.0, -step)
        for halving in range(_ROUNDS):
            part = 0.5**halving
            rates = fit.rates + part * faster
            trial = fit._replace(
                coefficients=fit.coefficients + part * step,
                rates=np.maximum(rates, fit.rates / 2),  # (never zero)
            )
            trial = _look(intervals, table, trial)
            if _cost(trial) < cost:
                break
        else:
            return fit
        gain = 1 - _cost(trial) / cost
        fit = trial
        cost = _cost(fit)
        if gain < _SETTLED:
            return fit
    return fit._replace(converged=False)


def _cost(fit: CurveFit) -> float:
    """Return the penalized sum of squares."""
    squares = fit.residual[fit.used] ** 2
    roughness = fit.coefficients @ (fit.penalty * fit.coefficients)
    return float(squares.sum() + roughness)


def projected(
    intervals: Intervals,
    fit: CurveFit,
) -> tuple[Slopes, Float[np.ndarray, "trials p1"]]:
    """Return derivatives with respect to the coefficients, without the part that the rates of the
    trials explain (zero for miscounted intervals), and what rates explain of the residuals, and of
    these derivatives."""
    slopes = fit.forecast.slopes[:, :-1]
    by_rate = fit.by_rate
    square = np.maximum(intervals.sums(by_rate**2 * fit.used), _TINY)
    columns = np.column_stack([fit.residual, slopes]) * (by_rate * fit.used)[:, None]
    products = np.stack([intervals.sums(x) for x in columns.T], axis=1)
    along = products / square[:, None]
    across = slopes - by_rate[:, None] * along[intervals.trial, 1:]
    return across * fit.used[:, None], along


def _blocks(intervals: Intervals) -> Int[np.ndarray, " L"]:
    """Return the blocks whose errors count as independent: successive intervals of one trial."""
    trial = intervals.trial
    counts = np.bincount(trial)
    if len(counts) >= _BLOCKS:
        return trial
    length = max(_SHORTEST_BLOCK, len(trial) // (2 * _BLOCKS))
    place = np.concatenate([np.arange(n) for n in counts])
    last = np.maximum(counts[trial] // length, 1) - 1
    block = np.minimum(place // length, last)
    return np.unique(trial * (block.max() + 1) + block, return_inverse=True)[1]


def _smoothness(intervals: Intervals, fit: CurveFit) -> Smoothness:
    """Maximize the marginal likelihood of the durations near a fit."""
    across, along = projected(intervals, fit)
    by_rates = fit.by_rate * along[intervals.trial, 0]
    residual = (fit.residual - by_rates) * fit.used
    noise, excess = _noise(intervals, fit, across, residual)
    weight = np.arange(1.0, across.shape[1]) ** 4
    curvature = across.T @ across
    score = across.T @ residual + curvature @ fit.coefficients
    # The mean is free: its part is taken out.
    share = curvature[1:, 0] / curvature[0, 0]
    inner = curvature[1:, 1:] - np.outer(share, curvature[0, 1:])
    pull = score[1:] - share * score[0]
    gain, axes = np.linalg.eigh(inner / np.sqrt(np.outer(weight, weight)))
    unit = max(noise, _TINY)
    gain = np.maximum(gain, 0.0) / unit
    power = (axes.T @ (pull / np.sqrt(weight)) / unit) ** 2

    def improbable(log_size: float) -> float:
        """Return minus twice the logarithm of the likelihood of tau^2."""
        size = np.exp(log_size)
        return float((np.log1p(size * gain) - size * power / (1 + size * gain)).sum())

    # Logarithms of tau^2, around that at which the best direction is half noise.
    grid = np.arange(-24.0, 24.5, 0.5) - np.log(max(gain[-1], _TINY))
    best = grid[np.argmin([improbable(x) for x in grid])]
    top = optimize.minimize_scalar(
        improbable,
        bounds=(best - 0.5, best + 0.5),
        method="bounded",
    )
    return Smoothness(
        penalty=np.append(0.0, noise * weight / np.exp(top.x)),
        noise=noise,
        excess=excess,
        evidence=max(-float(top.fun), 0.0),
    )


def _noise(
    intervals: Intervals,
    fit: CurveFit,
    across: Slopes,
    residual: Lanes,
) -> tuple[float, float]:
    """Return the variance of noise, and its excess in sums over blocks.

    Noise is what no curve explains, however rough: what a smooth one leaves may be its shape.
    """
    curvature = across.T @ across
    noise = residual - across @ np.linalg.lstsq(curvature, across.T @ residual)[0]
    dof = int(fit.used.sum()) - len(fit.rates) - across.shape[1]
    variance = float(noise @ noise) / max(dof, 1)
    if not variance > 0:
        return 0.0, 1.0
    block = _blocks(intervals)
    sums = np.stack([np.bincount(block, x * noise) for x in across.T], axis=1)
    values, axes = np.linalg.eigh(curvature)
    determined = values > 1e-6 * values[-1]  # beyond rounding
    ratios = (sums @ axes[:, determined]) ** 2 / values[determined]
    each = float(ratios.sum()) / int(determined.sum()) / variance
    excess = max(each, 1.0)
    return variance * excess, excess


def accuracy_of(intervals: Intervals, fit: CurveFit) -> tuple[Covariance, float, float]:
    """Return the covariance of a curve, the sum of squared errors of intervals forecast by fits to
    other blocks, and the number of coefficients that the data determine.

    The errors of each block are those of a forecast by a curve fitted to the other blocks, to first
    order (the jackknife that deletes blocks: Bell and McCaffrey 2002). Smoothness makes a bias,
    whose expected square is added (Nychka 1988: such intervals hold the curve at as many phases as
    they claim).
    """
    across, _ = projected(intervals, fit)
    data = across.T @ across
    smooth = np.diag(fit.penalty)
    curvature = data + smooth
    block = _blocks(intervals)
    score = []
    shares = []
    left_out = 0.0
    for k in range(int(block.max()) + 1):
        rows = (block == k) & fit.used
        x = across[rows]
        error = fit.residual[rows]
        share = x.T @ x
        by_others = np.linalg.lstsq(curvature - share, x.T @ error)[0]
        error = error + x @ by_others
        shares.append(share)
        score.append(x.T @ error)
        left_out += float(error @ error)
    scores = np.array(score)
    meat = scores.T @ scores + fit.smoothness.noise * smooth
    parts = np.array(shares) + smooth / len(shares)
    covariance = sandwich(curvature, meat, parts)
    detail = float(np.trace(np.linalg.lstsq(curvature, data)[0]))
    return covariance, left_out, detail
