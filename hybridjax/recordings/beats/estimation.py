r"""Phase response curves from intervals: penalized least squares on durations.

The coefficients of a curve have prior variances $\tau^2 / k^4$, as those of a smoothing spline do
(Wahba, *Spline Models for Observational Data*, 1990). $\tau$ maximizes its posterior density. Its
prior is exponential; the mean of the prior belongs to a curve under which an input of one standard
deviation would double the rate or stop the rhythm (a penalty of complexity: Simpson et al.,
Statistical Science 32, 2017). The covariance of the curve is averaged over all probable values of
$\tau$ (Kass and Steffey 1989): if the data hardly determine a shape, errors for a single value
would be far too small.

Errors of intervals are independent once a wandering rate is removed (`errors.py`). If sums of
errors over blocks still have a larger variance, the likelihood uses this variance
(quasi-likelihood: McCullagh 1983).

`response.py` calls `fit_curve` (jitter, smoothness, wander and curve in turn, until they do not
change; the curve in `_minimize`), `accuracy_of` (its covariance) and `carried_over`. The last
column of `Forecast.slopes` must stay the derivative by the rate: functions here split it off.

A curve that is too flat has its cause in `_smoothness`, a wrong standard error in `accuracy_of`, a
fit that does not converge in `_minimize`, and an interval that is needlessly left out in
`CurveFit.counted`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize

from ...identify.denominator import Covariance, sandwich
from .errors import (
    Wander,
    Whitening,
    estimate_wander,
    whitening,
    without_rates,
)
from .model import Forecast, Intervals, Table, forecast, tabulated


# Number of half waves of a curve. More: time, for detail that the smoothness removes. Fewer: jumps
# of curves are smoothed away.
WAVES = 20
# Largest number of Gauss-Newton steps; of halvings of a step; and of updates of jitter, smoothness
# and miscounted intervals. More: time. Fewer: fits end before convergence.
_STEPS = 30
_ROUNDS = 8
# Relative changes at convergence: of the cost, and of jitter and smoothness. Larger: estimates
# depend on the start. Smaller: more iterations for digits that noise hides.
_SETTLED = 1e-6
_SAME = 0.01
# Relative change of the cost at convergence, while jitter and smoothness still change. Larger: more
# updates are needed. Smaller: iterations compute digits that the next update changes.
_NEARLY_SETTLED = 1e-3
# Standard errors are computed from this number of blocks: one for each trial if there are enough
# trials, otherwise parts of trials with a least number of intervals. More or shorter blocks: they
# are not independent. Fewer or longer: standard errors scatter.
_BLOCKS = 30
_SHORTEST_BLOCK = 10


# The coefficients of this number of half waves may be as large as the first one. More: bands are
# wider. Fewer: if the data determine little, bands are those of a curve that hardly changes within
# a cycle.
_COARSE = 3.0
# Grid of values of log tau^2, relative to the mean of the prior. Wider or finer: time. Narrower:
# curves flatter than e^-8 of the prior's mean are not possible.
_LOG_SIZES = np.arange(-16.0, 4.5, 0.5)


_TINY = np.finfo(float).tiny

Curve = Float[np.ndarray, " p"]
Square = Float[np.ndarray, "p p"]
Lanes = Float[np.ndarray, " L"]
"""A number for each interval."""
Slopes = Float[np.ndarray, "L p"]


class Smoothness(NamedTuple):
    """The prior of a curve."""

    penalty: Curve
    """Penalty of each coefficient, added to the curvature of the sum of squares; zero for the mean
    of the curve."""
    noise: float
    """Variance of the phase at the end of a cycle, s^2, times the excess."""
    excess: float
    """Variance of sums over blocks relative to that of independent errors; at least 1."""
    evidence: float
    """Twice the logarithm of the likelihood ratio to a flat curve."""
    others: Float[np.ndarray, "T p"]
    """Penalties of other values of tau."""
    probability: Float[np.ndarray, " T"]
    """Posterior probability of each value of tau."""

    @staticmethod
    def none(waves: int) -> "Smoothness":
        return Smoothness(
            penalty=np.zeros(waves + 1),
            noise=0.0,
            excess=1.0,
            evidence=0.0,
            others=np.zeros((1, waves + 1)),
            probability=np.ones(1),
        )


class CurveFit(NamedTuple):
    """A curve and the rates of the trials."""

    coefficients: Curve
    rates: Float[np.ndarray, " trials"]
    jitter: float
    """Standard deviation of the phase at the end of a cycle, as forecast from earlier ones."""
    used: Bool[np.ndarray, " L"]
    """Intervals that are not miscounted."""
    residual: Lanes
    """Residuals of the durations, in s."""
    forecast: Forecast
    smoothness: Smoothness
    wander: Wander
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
        """Error of the forecast of each interval, in cycles."""
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
    """Return the curve with `waves` half waves that forecasts durations best (least squares), with
    the smoothness of the largest marginal likelihood.

    Intervals whose forecast is wrong by half a cycle or more were miscounted, and are not used.
    `start`: a fit with as many half waves or fewer.
    """
    fit = _start(intervals, waves, start)
    for _ in range(_ROUNDS):
        before = fit
        table = tabulated(waves, fit.jitter)
        fit = _look(intervals, table, fit)
        if waves:
            fit = fit._replace(smoothness=_smoothness(intervals, fit))
        fit = _minimize(intervals, table, fit, _NEARLY_SETTLED)
        fit = fit._replace(used=fit.counted())
        fit = fit._replace(wander=_wander(intervals, fit))
        missed = whitened(intervals, fit).missed(fit.residual)
        fit = fit._replace(jitter=float(missed[fit.used].std()))
        if _is_settled(before, fit):
            break
    return _minimize(intervals, table, fit, _SETTLED)


def _start(intervals: Intervals, waves: int, start: CurveFit | None) -> CurveFit:
    """Return the fit `start` with `waves` half waves; without one, a flat curve with the mean rate
    of each trial."""
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
        wander=Wander.none(),
        converged=True,
    )


def _wander(intervals: Intervals, fit: CurveFit) -> Wander:
    """Return the wandering rate that the residuals of a fit show."""
    return estimate_wander(
        intervals,
        fit.forecast,
        fit.rates[intervals.trial],
        fit.used,
        fit.residual,
        fit.forecast.slopes[:, :-1],
    )


def whitened(intervals: Intervals, fit: CurveFit) -> Whitening:
    """Return the filter that makes the residuals of a fit independent."""
    rates = fit.rates[intervals.trial]
    return whitening(intervals, fit.forecast, rates, fit.used, fit.wander)


def _is_settled(before: CurveFit, fit: CurveFit) -> bool:
    """Return whether a round changed neither jitter, smoothness, wander, nor the used intervals."""
    stiffness = fit.penalty[-1]
    change = abs(before.penalty[-1] - stiffness)
    return (
        abs(fit.jitter - before.jitter) < _SAME * fit.jitter
        and change <= 10 * _SAME * stiffness
        and before.wander == fit.wander
        and bool((fit.used == before.used).all())
    )


def _look(intervals: Intervals, table: Table, fit: CurveFit) -> CurveFit:
    """Return a curve and rates with their residuals."""
    ahead = forecast(intervals, table, fit.coefficients, fit.rates)
    residual = intervals.duration - ahead.duration
    return fit._replace(residual=residual, forecast=ahead, converged=True)


def _minimize(
    intervals: Intervals, table: Table, fit: CurveFit, settled: float
) -> CurveFit:
    """Minimize the penalized sum of squares over curve and rates: Gauss-Newton steps, which are
    halved until the sum decreases, up to a step that gains less than the fraction `settled`.

    Rates are eliminated from each step. (In scipy's `least_squares`, those of hundreds of trials
    would be most of the unknowns.)
    """
    white = whitened(intervals, fit)
    cost = _cost(fit, white)
    for _ in range(_STEPS):
        errors = projected(intervals, fit, white)
        curvature = errors.across.T @ errors.across + np.diag(fit.penalty)
        downhill = errors.across.T @ errors.residual - fit.penalty * fit.coefficients
        step = np.linalg.lstsq(curvature, downhill)[0]
        faster = errors.along @ np.append(1.0, -step)
        for halving in range(_ROUNDS):
            part = 0.5**halving
            rates = fit.rates + part * faster
            trial = fit._replace(
                coefficients=fit.coefficients + part * step,
                rates=np.maximum(rates, fit.rates / 2),  # (never zero)
            )
            trial = _look(intervals, table, trial)
            if _cost(trial, white) < cost:
                break
        else:
            return fit
        after = _cost(trial, white)
        gain = 1 - after / cost
        fit = trial
        cost = after
        if gain < settled:
            return fit
    return fit._replace(converged=False)


def _cost(fit: CurveFit, white: Whitening) -> float:
    """Return the penalized sum of squares."""
    errors = white(fit.residual[:, None])
    roughness = fit.coefficients @ (fit.penalty * fit.coefficients)
    return float((errors**2).sum() + roughness)


class Projected(NamedTuple):
    """Independent errors of intervals without what the rates of the trials explain."""

    residual: Lanes
    across: Slopes
    """Derivatives with respect to the coefficients."""
    along: Float[np.ndarray, "trials p1"]
    """Parts of the residuals and of the derivatives that the rates explain."""


def projected(intervals: Intervals, fit: CurveFit, white: Whitening) -> Projected:
    """Return residuals and derivatives of a fit as independent errors (zero for miscounted
    intervals), without what the rates of the trials explain."""
    columns = np.column_stack([fit.residual, fit.forecast.slopes])
    columns = white(columns)
    by_rate = columns[:, -1]
    others = columns[:, :-1]
    rest, along, _ = without_rates(intervals, by_rate, others)
    return Projected(rest[:, 0], rest[:, 1:], along)


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
    """Return the posterior of the smoothness near a fit, with the largest density as penalty."""
    errors = projected(intervals, fit, whitened(intervals, fit))
    across = errors.across
    noise, excess = _noise(intervals, fit, errors)
    half_waves = np.arange(1.0, across.shape[1])
    relative = (_COARSE**2 + half_waves**2) / (_COARSE**2 + 1)
    weight = relative**2
    curvature = across.T @ across
    score = across.T @ errors.residual + curvature @ fit.coefficients
    # The mean of the curve is free: its part is projected out.
    of_mean = max(curvature[0, 0], _TINY)
    share = curvature[1:, 0] / of_mean
    by_first = np.outer(share, curvature[0, 1:])
    inner = curvature[1:, 1:] - by_first
    pull = score[1:] - share * score[0]
    # In the axes of `gain`, the likelihood of tau is a sum. `gain` is the information of the data
    # along each axis, and `power` the square of the score, both in units of the noise.
    pairs = np.outer(weight, weight)
    gain, axes = np.linalg.eigh(inner / np.sqrt(pairs))
    unit = max(noise, _TINY)
    gain = np.maximum(gain, 0.0) / unit
    power = (axes.T @ (pull / np.sqrt(weight)) / unit) ** 2
    largest = float(np.median(fit.rates) / intervals.inputs.std())

    def improbable(log_size: float) -> float:
        """Return minus twice the logarithm of the likelihood of tau^2."""
        size = np.exp(log_size)
        information = 1 + size * gain
        explained = size * power / information
        return float((np.log1p(size * gain) - explained).sum())

    def unlikely(log_size: float) -> float:
        """Return minus twice the logarithm of the posterior density of the logarithm of tau."""
        log_tau = log_size / 2
        return improbable(log_size) + 2 * (np.exp(log_tau) / largest - log_tau)

    grid = _LOG_SIZES + 2 * np.log(largest)
    posterior = np.array([unlikely(x) for x in grid])
    best = grid[posterior.argmin()]
    top = optimize.minimize_scalar(
        unlikely,
        bounds=(best - 0.5, best + 0.5),
        method="bounded",
    )
    probability = np.exp(-(posterior - posterior.min()) / 2)
    penalty = noise * weight
    return Smoothness(
        penalty=np.append(0.0, penalty / np.exp(top.x)),
        noise=noise,
        excess=excess,
        evidence=max(-min(improbable(x) for x in grid), 0.0),
        others=np.pad(penalty / np.exp(grid)[:, None], ((0, 0), (1, 0))),
        probability=probability / probability.sum(),
    )


def _noise(
    intervals: Intervals,
    fit: CurveFit,
    errors: Projected,
) -> tuple[float, float]:
    """Return the variance of noise, and its excess in sums over blocks.

    Noise is the part that no curve explains, however rough. (Residuals of a smooth curve may
    contain a part of its true shape.)
    """
    across = errors.across
    residual = errors.residual
    curvature = across.T @ across
    fitted = np.linalg.lstsq(curvature, across.T @ residual)[0]
    noise = residual - across @ fitted
    used = int(fit.used.sum())
    dof = used - len(fit.rates) - across.shape[1]
    variance = float(noise @ noise) / max(dof, 1)
    if not variance > 0:
        return 0.0, 1.0
    block = _blocks(intervals)
    by_block = [np.bincount(block, x * noise) for x in across.T]
    sums = np.stack(by_block, axis=1)
    values, axes = np.linalg.eigh(curvature)
    determined = values > 1e-6 * values[-1]  # beyond rounding
    ratios = (sums @ axes[:, determined]) ** 2 / values[determined]
    each = float(ratios.sum()) / int(determined.sum()) / variance
    excess = max(each, 1.0)
    return variance * excess, excess


def accuracy_of(intervals: Intervals, fit: CurveFit) -> tuple[Covariance, float, float]:
    """Return the covariance of a curve, the sum of squared errors of intervals forecast by fits to
    other blocks, and the number of coefficients that the data determine.

    The errors of a block are those of a forecast by a curve that is fitted to the other blocks, to
    first order (delete-block jackknife: Bell and McCaffrey 2002). The expected square of the bias
    by smoothing is added. (With it, intervals of 95 % contain the curve at 95 % of the phases on
    average: Nychka 1988.)
    """
    errors = projected(intervals, fit, whitened(intervals, fit))
    across = errors.across
    # Errors of durations: differences from their forecasts, in s.
    of_rate = errors.along[intervals.trial, 1:]
    by_rates = of_rate * fit.by_rate[:, None]
    in_seconds = fit.forecast.slopes[:, :-1] - by_rates
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
        error = errors.residual[rows]
        share = x.T @ x
        by_others = np.linalg.lstsq(curvature - share, x.T @ error)[0]
        shares.append(share)
        score.append(x.T @ (error + x @ by_others))
        missed = fit.residual[rows] + in_seconds[rows] @ by_others
        left_out += float(missed @ missed)
    scores = np.array(score)
    meat = scores.T @ scores
    parts = np.array(shares) + smooth / len(shares)
    dof = sandwich(curvature, meat, parts).dof
    covariance = Covariance(_covariance(fit, data, meat), dof)
    detail = float(np.trace(np.linalg.lstsq(curvature, data)[0]))
    return covariance, left_out, detail


def _covariance(fit: CurveFit, data: Square, meat: Square) -> Square:
    """Return the covariance of a curve over all probable values of its smoothness.

    **Arguments:** `data`: the curvature of the sum of squares. `meat`: the covariance of its
    gradient.
    """
    smoothness = fit.smoothness
    toward = (data + np.diag(fit.penalty)) @ fit.coefficients
    total = np.zeros_like(data)
    for penalty, probability in zip(
        smoothness.others, smoothness.probability, strict=True
    ):
        smooth = np.diag(penalty)
        inverse = np.linalg.pinv(data + smooth, hermitian=True)
        apart = inverse @ toward - fit.coefficients
        spread = inverse @ (meat + smoothness.noise * smooth) @ inverse
        total += probability * (spread + np.outer(apart, apart))
    return total


def fit_rates(intervals: Intervals, coefficients: Curve, jitter: float) -> CurveFit:
    """Fit only the rate of each trial, for a known curve."""
    fit = _start(intervals, len(coefficients) - 1, None)
    fit = fit._replace(coefficients=coefficients, jitter=jitter)
    table = tabulated(len(coefficients) - 1, jitter)
    for _ in range(_STEPS):
        before = fit.rates
        fit = _look(intervals, table, fit)
        fit = fit._replace(used=fit.counted())
        faster = projected(intervals, fit, whitened(intervals, fit)).along[:, 0]
        rates = np.clip(before + faster, before / 2, before * 2)
        fit = fit._replace(rates=rates)
        if np.allclose(rates, before, rtol=_SETTLED, atol=0.0):
            return fit
    return fit._replace(converged=False)


def explained(intervals: Intervals, used: Bool[np.ndarray, " L"], left: float) -> float:
    """Return R2: the explained fraction of the variance of durations within trials.

    **Arguments:** `left`: the sum of squared errors of the used intervals.
    """
    count = np.maximum(intervals.sums(1.0 * used), 1)
    mean = intervals.sums(intervals.duration * used) / count
    deviation = intervals.duration - mean[intervals.trial]
    whole = (deviation[used] ** 2).sum()
    return float(1 - left / whole) if whole > 0 else 0.0


class Carried(NamedTuple):
    """The effect of a push on the interval after its own, relative to the effect on its own
    interval."""

    part: float
    error: float
    """Standard error; infinite if there are no two successive intervals."""


def follows(intervals: Intervals, fit: CurveFit) -> Bool[np.ndarray, " L1"]:
    """Return, for all intervals but the first, whether the interval begins where the one before
    ends, and both are used."""
    end = intervals.start + intervals.duration
    pause = np.abs(intervals.start[1:] - end[:-1])
    same = np.diff(intervals.trial) == 0
    both = fit.used[1:] & fit.used[:-1]
    return both & same & (pause < 1e-6 * intervals.duration[1:])


def carried_over(intervals: Intervals, fit: CurveFit) -> Carried:
    """Regress the residual of each interval on the fitted response of the interval before.

    If a push acts in its own interval only, the slope is zero (Lagrange multiplier test: Breusch
    and Pagan 1980). The part of the regressor that curve and rates explain is removed first.
    """
    white = whitened(intervals, fit)
    response = fit.forecast.duration - 1 / fit.rates[intervals.trial]
    before = np.zeros(len(response))
    is_next = follows(intervals, fit)
    before[1:] = np.where(is_next, response[:-1], 0.0)
    errors = projected(intervals, fit, white)
    of_rate = fit.forecast.slopes[:, -1:]
    by_rate = white(of_rate)[:, 0]
    parts = without_rates(intervals, by_rate, white(before[:, None]))
    column = parts.rest[:, 0]
    across = errors.across
    curvature = across.T @ across + np.diag(fit.penalty)
    taken = np.linalg.lstsq(curvature, across.T @ column)[0]
    rest = column - across @ taken
    power = float(rest @ column)
    if not power > 1e-9 * float(column @ column):
        return Carried(0.0, np.inf)
    part = float(rest @ errors.residual) / power
    scores = np.bincount(_blocks(intervals), rest * (errors.residual - part * column))
    return Carried(part, float(np.linalg.norm(scores)) / power)
