"""Phase response curves from intervals: least squares on durations."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...identify.denominator import Covariance, sandwich
from .intervals import Intervals
from .phase_model import Forecast, Table, forecast
from .smoothness import Smoothness, smoothness_of


# Half waves of a curve. Doubled: finer detail, which few data show and the smoothness keeps out.
WAVES = 20
# Iterations of Gauss and Newton, at most. Doubled: slow ones come to their end.
_STEPS = 30
# Halvings of a step that raises the cost. Doubled: steps down to 1e-5 are tried.
_HALVINGS = 8
# Relative change of the cost that is the last. Doubled: minima are missed by 1.4 times as much.
_SETTLED = 1e-6
# How often jitter, smoothness and miscounted intervals are found anew, at most. Doubled: nothing
# changes.
_ROUNDS = 8
# Phase by which an interval may miss the model's: half a cycle more, and it is nearer to two.
# Doubled: intervals in which an event was missed count as one.
_MISCOUNTED = 0.5
# Relative changes of the jitter, and of the smoothness, that are the last. Doubled: they are known
# to 2 and 20 %.
_SAME_JITTER, _SAME_SMOOTHNESS = 0.01, 0.1
# Blocks from which standard errors are computed: one for each trial where there are so many, else
# parts of trials with so many intervals or more. Doubled: standard errors of few long trials
# scatter less, but know of shorter memory only.
_BLOCKS, _SHORTEST_BLOCK = 30, 10


class CurveFit(NamedTuple):
    """A curve and the rates of the trials."""

    coefficients: Float[np.ndarray, " p"]
    rates: Float[np.ndarray, " trials"]
    jitter: float
    """Standard deviation of the phase at the end of a cycle."""
    used: Bool[np.ndarray, " L"]
    """The intervals that count."""
    residual: Float[np.ndarray, " L"]
    """Of the durations, in s."""
    forecast: Forecast
    smoothness: Smoothness | None
    """None for a flat curve, and one that is given."""
    converged: bool

    @property
    def penalty(self) -> Float[np.ndarray, " p"]:
        return np.zeros(len(self.coefficients)) if self.smoothness is None else self.smoothness[0]


def fit_curve(
    intervals: Intervals,
    waves: int,
    start: CurveFit | None = None,
    given: Bool[np.ndarray, " L"] | None = None,
) -> CurveFit:
    """The curve of so many half waves that forecasts durations best (least squares), as smooth as
    the data say.

    Intervals that miss the forecast by half a cycle or more were miscounted (an event was missed,
    or one was none), and do not count. `start`: a fit with as many half waves or fewer. `given`:
    the intervals from which to learn; by default all.
    """
    given = np.ones(len(intervals.start), bool) if given is None else given
    a, jitter, used = np.zeros(waves + 1), 0.0, given
    if start is None:
        rates = _mean_rates(intervals, given)
    else:
        a[: len(start.coefficients)], rates = start.coefficients, start.rates
        jitter = start.jitter
        used = given & ~miscounted(start.residual, start.forecast.rate)
    smooth = None
    for _ in range(_ROUNDS):
        table, before = Table.of(waves, jitter), smooth
        if waves:
            smooth = _smoothness(intervals, _look(intervals, table, a, rates, used))
        fit = _minimize(intervals, table, a, rates, used, smooth)
        a, rates = fit.coefficients, fit.rates
        counted = given & ~miscounted(fit.residual, fit.forecast.rate)
        now = float((fit.residual * fit.forecast.rate)[counted].std())
        same = (counted == used).all() and abs(now - jitter) < _SAME_JITTER * now
        jitter, used = now, counted
        if same and _as_smooth(before, smooth):
            break
    return fit._replace(jitter=jitter, used=used)


def _as_smooth(before: Smoothness | None, now: Smoothness | None) -> bool:
    if before is None or now is None:
        return now is None
    return bool(abs(before.penalty[-1] - now.penalty[-1]) < _SAME_SMOOTHNESS * now.penalty[-1])


def _smoothness(intervals: Intervals, fit: CurveFit) -> Smoothness:
    """From the model near a fit."""
    across, along = projected(intervals, fit)
    left = (fit.residual - fit.forecast.by_rate * along[intervals.trial, 0]) * fit.used
    freedom = int(fit.used.sum()) - intervals.trials
    return smoothness_of(across, left, fit.coefficients, blocks_of(intervals), freedom)


def fit_rates(intervals: Intervals, table: Table, given: Bool[np.ndarray, " L"]) -> CurveFit:
    """The rates of the trials for a given curve."""
    rates, used = _mean_rates(intervals, given), given
    for _ in range(_ROUNDS):
        fit = _minimize(intervals, table, np.ones(1), rates, used, None, fixed=True)
        counted = given & ~miscounted(fit.residual, fit.forecast.rate)
        if (counted == used).all():
            break
        rates, used = fit.rates, counted
    return fit._replace(used=used)


def miscounted(
    residual: Float[np.ndarray, " L"], rate: Float[np.ndarray, " L"]
) -> Bool[np.ndarray, " L"]:
    """Intervals that miss the model's by half a cycle or more."""
    return np.abs(residual * rate) >= _MISCOUNTED


def _mean_rates(
    intervals: Intervals, given: Bool[np.ndarray, " L"]
) -> Float[np.ndarray, " trials"]:
    """Intervals over their duration; of trials without one, that of the others."""
    count, time = intervals.sums(1.0 * given), intervals.sums(given * intervals.duration)
    return np.where(count > 0, count / np.where(count > 0, time, 1.0), count.sum() / time.sum())


def _look(
    intervals: Intervals,
    table: Table,
    a: Float[np.ndarray, " p"],
    rates: Float[np.ndarray, " trials"],
    used: Bool[np.ndarray, " L"],
    smooth: Smoothness | None = None,
) -> CurveFit:
    """What a curve and rates leave."""
    found = forecast(intervals, table, a, rates)
    return CurveFit(a, rates, 0.0, used, intervals.duration - found.duration, found, smooth, True)


def _minimize(
    intervals: Intervals,
    table: Table,
    a: Float[np.ndarray, " p"],
    rates: Float[np.ndarray, " trials"],
    used: Bool[np.ndarray, " L"],
    smooth: Smoothness | None,
    fixed: bool = False,
) -> CurveFit:
    """Gauss and Newton's iteration; `fixed`: over the rates only."""

    def at(a, rates):
        fit = _look(intervals, table, a, rates, used, smooth)
        return fit, float((fit.residual[used] ** 2).sum() + a @ (fit.penalty * a))

    fit, cost = at(a, rates)
    for _ in range(_STEPS):
        across, along = projected(intervals, fit)
        step = np.zeros_like(a)
        if not fixed:
            curvature = across.T @ across + np.diag(fit.penalty)
            downhill = across.T @ fit.residual - fit.penalty * fit.coefficients
            step = np.linalg.lstsq(curvature, downhill)[0]
        faster = along @ np.append(1.0, -step)
        for k in range(_HALVINGS):
            slowest = fit.rates / 2  # (a rate is never zero)
            new, price = at(
                fit.coefficients + step / 2**k, np.maximum(fit.rates + faster / 2**k, slowest)
            )
            if price < cost:
                break
        else:
            return fit
        settled = cost - price < _SETTLED * cost
        fit, cost = new, price
        if settled:
            return fit
    return fit._replace(converged=False)


def projected(
    intervals: Intervals, fit: CurveFit
) -> tuple[Float[np.ndarray, "L p"], Float[np.ndarray, "trials p1"]]:
    """Derivatives by the curve's coefficients less what the rates of the trials explain of them,
    zero where intervals do not count; and how much rates explain of the residuals, and of these."""
    found = fit.forecast
    own = found.by_rate * fit.used
    square = np.maximum(intervals.sums(own**2), np.finfo(float).tiny)
    columns = np.column_stack([fit.residual, found.by_curve])
    along = np.stack([intervals.sums(own * x) for x in columns.T], axis=1) / square[:, None]
    explained = found.by_rate[:, None] * along[intervals.trial, 1:]
    return (found.by_curve - explained) * fit.used[:, None], along


def blocks_of(intervals: Intervals) -> Int[np.ndarray, " L"]:
    """The blocks whose errors count as independent."""
    if intervals.trials >= _BLOCKS:
        return intervals.trial
    return intervals.blocks(max(_SHORTEST_BLOCK, len(intervals.start) // (2 * _BLOCKS)))


class Accuracy(NamedTuple):
    """How well a curve is known."""

    covariance: Covariance
    left_out: Float[np.ndarray, " blocks"]
    """Sum of the squared errors of each block, of the forecast by a fit to the others."""
    detail: float
    """How many numbers the data determine: the trace of what they say of the coefficients."""


def accuracy_of(intervals: Intervals, fit: CurveFit) -> Accuracy:
    """From blocks of intervals whose errors may depend on each other.

    The errors of each are those of a forecast by a curve that was fitted to the other blocks, to
    first order (the jackknife that deletes blocks: Bell and McCaffrey 2002). Smoothness makes a
    bias, whose expected square is added (Nychka 1988: such intervals hold the curve at as many
    phases as they say).
    """
    across, _ = projected(intervals, fit)
    data, smooth = across.T @ across, np.diag(fit.penalty)
    curvature, block = data + smooth, blocks_of(intervals)
    count, p = int(block.max()) + 1, across.shape[1]
    score, shares, left_out = np.zeros((count, p)), np.zeros((count, p, p)), np.zeros(count)
    for k in range(count):
        rows = (block == k) & fit.used
        own, error = across[rows], fit.residual[rows]
        shares[k] = own.T @ own
        change = np.linalg.lstsq(curvature - shares[k], own.T @ error)[0]
        error = error + own @ change
        score[k], left_out[k] = own.T @ error, error @ error
    noise = 0.0 if fit.smoothness is None else fit.smoothness.noise
    covariance = sandwich(curvature, score.T @ score + noise * smooth, shares + smooth / count)
    return Accuracy(covariance, left_out, float(np.trace(np.linalg.lstsq(curvature, data)[0])))
