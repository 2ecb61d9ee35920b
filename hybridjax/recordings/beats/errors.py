r"""Errors of intervals between events: jitter of each interval, and a rate that wanders.

The phase at the end of an interval of duration T has the variance $s^2 w T$ (the jitter), where w
is the rate. The duration has this variance divided by the square of the rate at which the phase
reaches 1. The rate $w + e$ of an interval may differ from the rate w of its trial. The difference e
is a stationary process with $\mathrm{cov}(e_j, e_k) = \sigma^2 e^{-|t_j - t_k|/\theta}$: an
autoregression of order 1 for evenly spaced intervals, independent for $\theta = 0$, and a random
walk if $\theta$ is longer than the trial. Its parameters maximize the restricted likelihood
(Patterson and Thompson 1971), which a Kalman filter evaluates (Harvey, *Forecasting, Structural
Time Series Models and the Kalman Filter*, 1989).

`estimation.py` calls `estimate_wander` with residuals of durations, and `whitening` to make errors
independent (`Whitening`). Intervals must be in the order of time, trial by trial, since the filter
passes from each to the next (`_left` is zero at the end of a trial).

A wrong standard error of a curve under slow inputs has its cause in `estimate_wander`. If errors
are still correlated, look at `_filters`; if a wandering rate is found without need, look at
`_LEAST_GAIN` and `_improbable`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import linalg

from .model import Forecast, Intervals


Lanes = Float[np.ndarray, " L"]
Columns = Float[np.ndarray, "L c"]

# Grid of wandering rates that are compared: memories (times after which a rate is forgotten, in
# median intervals), and standard deviations of the change of the rate from one interval to the
# next, in units of the jitter. Finer or wider: time. Coarser: errors of curves are wrong by up to
# 20 %.
_MEMORIES = 2.0 * 4.0 ** np.arange(6)
_CHANGES = 0.03 * 2.0 ** np.arange(7)
# A rate wanders if twice the logarithm of the likelihood ratio exceeds this. Larger: errors of
# curves under slow inputs are too small. Smaller: noise is taken for a wandering rate.
_LEAST_GAIN = 6.0
# Least degrees of freedom for a test of wandering rates. Fewer: their variance is zero or unknown.
# More: short recordings never show a wandering rate.
_FEWEST_LEFT = 3


class Wander(NamedTuple):
    """A rate that wanders within trials."""

    size: float
    """Standard deviation of the rate in cycles per second, divided by the standard deviation of the
    jitter."""
    memory: float
    """Time after which the rate is forgotten, in s; zero if the rates of intervals are
    independent."""

    @staticmethod
    def none() -> "Wander":
        return Wander(0.0, 0.0)


class Whitening(NamedTuple):
    """A linear filter that turns deviations of durations into independent errors of equal variance.

    Errors of successive intervals obey a recursion of first order. A banded matrix inverts it for
    many columns at once.
    """

    weight: Lanes
    """Standard deviation of a cycle's jitter over that of the duration; zero if not used."""
    by_drift: Lanes
    """Derivatives of weighted durations by the wandering rate."""
    kept: Lanes
    """Part of the forecast of the rate that is kept for the next interval."""
    learned: Lanes
    """Part of a deviation that is added to the next forecast of the rate."""
    scale: Lanes
    """Standard deviations of the deviations from forecasts."""

    def __call__(self, columns: Columns) -> Columns:
        """Return columns (L, c) of independent errors, in standard deviations of jitter."""
        y = columns * self.weight[:, None]
        if not self.by_drift.any():
            return y
        # m[k + 1] = kept[k] m[k] + learned[k] y[k]: the forecast of the rate.
        bands = np.ones((2, len(y)))
        bands[1] = -self.kept
        taken = np.zeros_like(y)
        learned = self.learned[:-1, None]
        taken[1:] = learned * y[:-1]
        rate = linalg.solve_banded((1, 0), bands, taken, check_finite=False)
        drifting = self.by_drift[:, None] * rate
        return (y - drifting) / self.scale[:, None]

    def missed(self, residual: Lanes) -> Lanes:
        """Return the errors, in cycles, of forecasts that use all earlier intervals."""
        return self(residual[:, None])[:, 0] * self.scale

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, less that of the jitter alone."""
        return 2 * float(np.log(self.scale).sum())


def whitening(
    intervals: Intervals,
    ahead: Forecast,
    rates: Lanes,
    used: Bool[np.ndarray, " L"],
    wander: Wander,
) -> Whitening:
    """Return the filter that makes errors of a forecast independent.

    **Arguments:** `ahead`: the forecast. `rates` (L,): of the trial of each interval. `used`: the
    intervals that are not miscounted.
    """
    L = len(rates)
    cycles = np.maximum(rates * ahead.duration, 1e-6)
    density = np.maximum(ahead.rate, 0.0) / np.sqrt(cycles)
    weight = np.where(used, density, 0.0)
    by_drift = weight * ahead.slopes[:, -1]
    nothing = np.zeros(L)
    if not wander.size:
        return Whitening(
            weight=weight,
            by_drift=nothing,
            kept=nothing,
            learned=nothing,
            scale=np.ones(L),
        )
    left = _left(intervals, wander.memory)
    square = np.array([wander.size**2])
    filters = _filters(by_drift, left[:, None], square)
    kept, learned, scale = (x[:, 0] for x in filters)
    return Whitening(
        weight=weight, by_drift=by_drift, kept=kept, learned=learned, scale=scale
    )


def _filters(
    by_drift: Lanes,
    left: Float[np.ndarray, "L W"],
    stationary: Float[np.ndarray, " W"],
) -> tuple[
    Float[np.ndarray, "L W"], Float[np.ndarray, "L W"], Float[np.ndarray, "L W"]
]:
    """Return `kept`, `learned` and `scale` of Kalman filters for W wandering rates at once.
    `stationary`: variances of the rates. `left`: part of a rate that is left in the next
    interval."""
    drift = by_drift[:, None]
    variance = np.empty_like(left)
    now = stationary
    for k, (g, a) in enumerate(zip(by_drift.tolist(), left * left, strict=True)):
        variance[k] = now
        carried = a * (now / (1.0 + g * g * now))
        now = carried + (1.0 - a) * stationary
    square = 1.0 + drift**2 * variance
    return left / square, left * variance * drift / square, np.sqrt(square)


def _left(intervals: Intervals, memory: float) -> Lanes:
    """Return the part of a rate that is left in the next interval; zero at the end of a trial."""
    left = np.zeros(len(intervals.start))
    if not memory:
        return left
    middle = intervals.start + intervals.duration / 2
    step = np.abs(np.diff(middle))
    left[:-1] = np.exp(-step / memory)
    left[:-1][np.diff(intervals.trial) != 0] = 0.0
    return left


def estimate_wander(
    intervals: Intervals,
    ahead: Forecast,
    rates: Lanes,
    used: Bool[np.ndarray, " L"],
    residual: Lanes,
    columns: Columns,
) -> Wander:
    """Return the wandering rate of the largest restricted likelihood; none if it is hardly larger
    than without wandering.

    **Arguments:** `residual` (L,): of the durations. `columns` (L, c): derivatives of the durations
    by what was fitted; the rates of trials are fitted, too.
    """
    period = float(np.median(intervals.duration))
    longest = float(intervals.sums(intervals.duration).max())
    trials = len(intervals.sums(intervals.duration))
    if int(used.sum()) - trials - columns.shape[1] < _FEWEST_LEFT:
        return Wander.none()

    plain = whitening(intervals, ahead, rates, used, Wander.none())
    by_drift = plain.weight * ahead.slopes[:, -1]
    deviations = np.column_stack([ahead.slopes[:, -1], residual, columns])

    def improbable(wanders: list[Wander]) -> list[tuple[float, Wander]]:
        left = np.stack([_left(intervals, x.memory) for x in wanders], axis=1)
        stationary = np.array([x.size**2 for x in wanders])
        filters = _filters(by_drift, left, stationary)
        rows = []
        for wander, *numbers in zip(wanders, *(x.T for x in filters), strict=True):
            white = Whitening(plain.weight, by_drift, *numbers)
            errors = white(deviations)
            rows.append((_improbable(intervals, white, errors), wander))
        return rows

    # Independent rates (without memory) make some intervals noisier than others. They are compared,
    # too: otherwise a wandering rate would explain this.
    changes = (_CHANGES / period).tolist()
    anew = [Wander.none()] + [Wander(change, 0.0) for change in changes]
    independent = min(improbable(anew))
    wandering = []
    for memory in (_MEMORIES * period).tolist():
        if memory > 4 * longest:
            break
        forgotten = 1 - np.exp(-2 * period / memory)
        for change in changes:
            wandering.append(Wander(float(change / np.sqrt(forgotten)), memory))
    correlated = min(improbable(wandering)) if wandering else independent
    if independent[0] - correlated[0] < _LEAST_GAIN:
        return independent[1]
    return correlated[1]


class WithoutRates(NamedTuple):
    """Columns of independent errors, without the part that changes of the trials' rates explain."""

    rest: Columns
    along: Float[np.ndarray, "trials c"]
    """Change of each trial's rate that explains most of the columns."""
    power: Float[np.ndarray, " trials"]
    """Sum of the squares of the derivatives by each rate."""


def without_rates(
    intervals: Intervals, by_rate: Lanes, columns: Columns
) -> WithoutRates:
    """Return columns without the part that changes of the rates explain (by least squares).
    `by_rate`: derivatives by the rates."""
    power = np.maximum(intervals.sums(by_rate**2), np.finfo(float).tiny)
    products = np.stack([intervals.sums(by_rate * x) for x in columns.T], axis=1)
    along = products / power[:, None]
    explained = by_rate[:, None] * along[intervals.trial]
    return WithoutRates(columns - explained, along, power)


def _improbable(intervals: Intervals, white: Whitening, errors: Columns) -> float:
    """Return minus twice the logarithm of the restricted likelihood of independent errors, with the
    variance at which it is largest.

    **Arguments:** `errors`: derivatives by the rates, residuals, and derivatives by what was
    fitted.
    """
    others = errors[:, 1:]
    rest, _, power = without_rates(intervals, errors[:, 0], others)
    y = rest[:, 0]
    x = rest[:, 1:]
    curvatures, axes = np.linalg.eigh(x.T @ x)
    determined = curvatures > 1e-9 * curvatures[-1]
    curvatures = curvatures[determined]
    explained = (axes.T @ (x.T @ y))[determined] / np.sqrt(curvatures)
    used = int(np.count_nonzero(white.weight))
    dof = used - len(power) - len(curvatures)
    left = float(y @ y - explained @ explained)
    of_curvatures = np.log(curvatures).sum()
    of_power = np.log(power).sum()
    of_fit = float(of_curvatures + of_power)
    return dof * np.log(left / dof) + white.log_determinant + of_fit
