"""How many subjects, trials and strides."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from ...scale.draws import monte_carlo
from .reml import Cells, meta, mixed, spread_interval


class Allocation(NamedTuple):
    """Standard deviations between subjects, between trials of a subject, and within a trial (of one
    stride), and the best numbers of `trials` per subject and `strides` per trial.

    The variance of the mean of n subjects is `(between² + (trial² + within² / strides) / trials) /
    n`.
    """

    between: float
    trial: float
    within: float
    trials: float
    strides: float

    def standard_error(self, subjects: int, trials: int, strides: int) -> float:
        """Return the standard error of the mean for other numbers."""
        inside = self.trial**2 + self.within**2 / strides
        return float(np.sqrt((self.between**2 + inside / trials) / subjects))


def allocate(y, v, strides, who, between: float, costs) -> Allocation:
    """**Arguments:** estimates `y` and variances `v` of trials; `who` they belong to."""
    within = float(np.mean(v * strides))
    groups = [who == name for name in dict.fromkeys(who)]
    extra = [(y[i].var(ddof=1) - v[i].mean(), i.sum() - 1) for i in groups if i.sum() > 1]
    freedom = sum(n for _, n in extra)
    trial = max(sum(x * n for x, n in extra) / max(freedom, 1), 0.0)
    subject_cost, trial_cost, stride_cost = costs
    if trial > 0:
        length = np.sqrt(trial_cost / stride_cost * within / trial)
        count = max(np.sqrt(subject_cost / trial_cost * trial / max(between, 1e-300)), 1.0)
    else:  # trials differ no more than their strides: one long trial
        length = np.sqrt((subject_cost + trial_cost) / stride_cost * within / max(between, 1e-300))
        count = 1.0
    parts = (np.sqrt(between), np.sqrt(trial), np.sqrt(within), count, length)
    return Allocation(*map(float, parts))


def power_of(
    y, v, difference: float, subjects: Sequence[int], paired: bool, draws: int, level: float,
    seed: int,
) -> list[dict]:  # fmt: skip
    """Return the power for each number of subjects, at the spread of a pilot and at its bounds."""
    ones = np.ones((len(y), 1))
    middle = float(np.sqrt(meta(y, v, ones).variance))
    rows = []
    for n in subjects:

        def counted(spread, n=n):
            draw = lambda rng: rejected(rng, v, n, spread, difference, paired, level)  # noqa: E731
            return int(monte_carlo(draw, draws, seed).value.sum())

        low, high = (counted(x) for x in reversed(spread_interval(y, v, ones)))
        rows.append({
            "subjects": n, "power": counted(middle) / draws,
            "power_low": stats.binomtest(low, draws).proportion_ci().low,
            "power_high": stats.binomtest(high, draws).proportion_ci().high,
            "spread": middle, "draws": draws,
        })  # fmt: skip
    return rows


def rejected(rng, v, n: int, spread, difference, paired: bool, level: float) -> int:
    """Simulate subjects, and return whether the test rejects that there is no difference."""
    cells = 1 if paired else 2
    variance = rng.choice(v, (n, cells))
    y = np.sqrt(spread**2 + variance) * rng.normal(size=(n, cells))
    y[:, 0] += difference
    if paired:
        fit = meta(y[:, 0], variance[:, 0], np.ones((n, 1)))
        value, square, freedom = fit.coefficients[0], fit.covariance[0, 0], fit.freedom
    else:
        x = np.broadcast_to(np.eye(2), (2 * n, 2, 2))
        side = np.arange(2 * n)[:, None] // n == np.arange(2)
        groups = mixed(Cells(np.tile(y.T.reshape(-1, 1), 2), np.tile(variance.T.reshape(-1, 1), 2),
                             x, side))  # fmt: skip
        w = np.array([1.0, -1.0])
        value, square = w @ groups.coefficients, w @ groups.covariance @ w
        freedom = groups.freedom(w)
    return int(2 * stats.t.sf(abs(value) / np.sqrt(square), freedom) < level)
