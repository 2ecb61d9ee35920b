"""Plain regression of intervals on the input, which is biased."""

import numpy as np
from jaxtyping import Float

from .estimation import CurveFit
from .intervals import Intervals
from .phase_model import basis


def plain_curve(intervals: Intervals, fit: CurveFit) -> Float[np.ndarray, " p"]:
    """Coefficients by regression of durations on the input at phases that grow linearly from each
    event to the next, as smooth as those of the fit.

    An interval that ends late has other regressors than it would have had: these know its noise.
    """
    waves = len(fit.coefficients) - 1
    across = np.zeros((len(intervals.start), waves + 1))
    for rows, inputs in intervals.chunks():
        half, duration = intervals.step[rows] / 2, intervals.duration[rows]
        for k, u in enumerate(inputs):
            phase = k * half / duration
            across[rows] += (np.where(phase < 1, u, 0.0) * half)[:, None] * basis(phase, waves)
    across *= (-1 / fit.rates)[intervals.trial, None] * fit.used[:, None]
    count = np.maximum(intervals.sums(1.0 * fit.used), 1.0)
    both = np.column_stack([across, intervals.duration * fit.used])
    mean = np.stack([intervals.sums(x) for x in both.T], axis=1) / count[:, None]
    both -= mean[intervals.trial] * fit.used[:, None]
    across, deviation = both[:, :-1], both[:, -1]
    return np.linalg.lstsq(across.T @ across + np.diag(fit.penalty), across.T @ deviation)[0]
