r"""How smooth a curve is, from the data.

The coefficients of a curve are taken as drawn with variances $\tau^2 / k^4$, as those of a
smoothing spline are (Wahba, *Spline Models for Observational Data*, 1990), and $\tau$ is that with
which the durations are most probable (marginal likelihood). What is left of intervals of one block
may add up to more than independent errors would: the likelihood is that of errors with as much
variance as sums over blocks show (quasi-likelihood: McCullagh 1983).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize


# Logarithms of tau^2, relative to where the best seen direction is half noise, that are tried.
# Doubled: nothing changes.
_RANGE, _STEP = 24.0, 0.5
# Relative size of the least seen direction in which errors are compared. Halved: nothing changes.
_SEEN = 1e-6


class Smoothness(NamedTuple):
    """What keeps a curve smooth."""

    penalty: Float[np.ndarray, " p"]
    """Added to the curvature of the sum of squares; none for the mean."""
    noise: float
    """Variance of what is left of an interval, s^2, times the excess."""
    excess: float
    """Variance of sums over blocks, of that of independent errors; at least 1."""
    evidence: float
    """Twice the logarithm of how much more probable the durations are than with a flat curve."""


def smoothness_of(
    across: Float[np.ndarray, "L p"],
    residual: Float[np.ndarray, " L"],
    coefficients: Float[np.ndarray, " p"],
    block: Int[np.ndarray, " L"],
    freedom: int,
) -> Smoothness:
    """From derivatives by the coefficients, what is left with these, and the blocks; zero where
    intervals do not count. `freedom`: of what is left."""
    curvature, pull = across.T @ across, across.T @ residual
    # Noise is what no curve explains, however rough: what a smooth one leaves may be its shape.
    noise_only = residual - across @ np.linalg.lstsq(curvature, pull)[0]
    variance = float(noise_only @ noise_only) / max(freedom - len(coefficients), 1)
    excess = _excess(across, noise_only, curvature, block) / variance if variance > 0 else 1.0
    noise = variance * max(excess, 1.0)
    weight = np.arange(1.0, len(coefficients)) ** 4
    score = pull + curvature @ coefficients
    # The mean is free: what it explains is taken out.
    share = curvature[1:, 0] / curvature[0, 0]
    inner = curvature[1:, 1:] - np.outer(share, curvature[0, 1:])
    gain, axes = np.linalg.eigh(inner / np.sqrt(np.outer(weight, weight)))
    gain = np.maximum(gain, 0.0) / max(noise, np.finfo(float).tiny)
    pull = axes.T @ ((score[1:] - share * score[0]) / np.sqrt(weight))
    pull = pull**2 / max(noise, np.finfo(float).tiny) ** 2

    def improbable(log_size: float) -> float:
        size = np.exp(log_size)
        return float((np.log1p(size * gain) - size * pull / (1 + size * gain)).sum())

    middle = -np.log(max(gain[-1], np.finfo(float).tiny))
    grid = middle + np.arange(-_RANGE, _RANGE + _STEP, _STEP)
    best = grid[np.argmin([improbable(x) for x in grid])]
    found = optimize.minimize_scalar(
        improbable, bounds=(best - _STEP, best + _STEP), method="bounded"
    )
    penalty = np.append(0.0, noise * weight / np.exp(found.x))
    return Smoothness(penalty, noise, max(excess, 1.0), max(-float(found.fun), 0.0))


def _excess(
    across: Float[np.ndarray, "L p"],
    residual: Float[np.ndarray, " L"],
    curvature: Float[np.ndarray, "p p"],
    block: Int[np.ndarray, " L"],
) -> float:
    """The mean square of what pulls at the curve, over all directions that are seen."""
    pull = np.stack([np.bincount(block, x * residual) for x in across.T], axis=1)
    values, axes = np.linalg.eigh(curvature)
    seen = values > _SEEN * values[-1]
    return float(((pull @ axes[:, seen]) ** 2 / values[seen]).sum() / seen.sum())
