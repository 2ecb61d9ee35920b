r"""Errors of intervals: the jitter of each, and a rate that wanders.

The phase at the end of an interval has the variance $s^2 w T$ (the jitter), so that the duration
has this variance divided by the square of the rate at which the phase reaches 1. The rate $w + e$
of an interval may differ from that of its trial, by a stationary process with
$\mathrm{cov}(e_j, e_k) = \sigma^2 e^{-|t_j - t_k|/\theta}$: an autoregression of order 1 for evenly
spaced intervals, independent for $\theta = 0$, and a random walk if $\theta$ is longer than the
trial. Its parameters maximize the restricted likelihood (Patterson and Thompson 1971), which a
Kalman filter evaluates (Harvey, *Forecasting, Structural Time Series Models and the Kalman Filter*,
1989).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import linalg

from .model import Forecast, Intervals


Lanes = Float[np.ndarray, " L"]
Columns = Float[np.ndarray, "L c"]

# Times after which a rate is forgotten, in median intervals, and standard deviations of its change
# from an interval to the next, in units in which the jitter of an interval is 1, that are compared.
# Finer or wider: time. Coarser: errors of curves are those of the nearest pair, up to 20 % off.
_MEMORIES = 2.0 * 4.0 ** np.arange(6)
_CHANGES = 0.03 * 2.0 ** np.arange(7)
# Twice the logarithm of the likelihood ratio from which on a rate wanders. Larger: errors of curves
# under slow inputs are too small. Smaller: noise is taken for a wandering rate.
_LEAST_GAIN = 6.0
# Degrees of freedom that must be left for a test of wandering rates. Fewer: their variance is zero
# or unknown. More: short recordings never show one.
_FEWEST_LEFT = 3


class Wander(NamedTuple):
    """A rate that wanders within trials."""

    size: float
    """Standard deviation of the rate, in cycles per second and standard deviations of jitter."""
    memory: float
    """Time after which it is forgotten, in s; zero for a rate that every interval has anew."""

    @staticmethod
    def none() -> "Wander":
        return Wander(0.0, 0.0)


class Whitening(NamedTuple):
    """What turns deviations of durations into independent errors of one variance.

    The errors of successive intervals obey a recursion of first order, which a banded matrix
    undoes for many columns at once.
    """

    weight: Lanes
    """Standard deviation of a cycle's jitter over that of the duration; zero if not used."""
    by_drift: Lanes
    """Derivatives of weighted durations by the wandering rate."""
    kept: Lanes
    """Part of the forecast of the rate that the next one keeps."""
    learned: Lanes
    """Part of a deviation that the next forecast of the rate takes."""
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
        """Return by how much of a cycle forecasts miss that know all earlier intervals."""
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
    """Return how errors about a forecast become independent.

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
    """Return `kept`, `learned` and `scale` of Kalman filters for W wandering rates at once, which
    have the variances `stationary`, and of which `left` remains in the next interval."""
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
    """Return the rates of the largest restricted likelihood; wandering ones if they gain enough.

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

    # Rates that every interval has anew make some intervals noisier than others: without them, a
    # wandering rate would explain that, too.
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
    """Columns of independent errors without what the rates of the trials explain of them."""

    rest: Columns
    along: Float[np.ndarray, "trials c"]
    """Change of each trial's rate that explains most."""
    power: Float[np.ndarray, " trials"]
    """Sum of the squares of the derivatives by each rate."""


def without_rates(
    intervals: Intervals, by_rate: Lanes, columns: Columns
) -> WithoutRates:
    """Return columns without what rates explain, whose derivatives are `by_rate`, by least
    squares."""
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
