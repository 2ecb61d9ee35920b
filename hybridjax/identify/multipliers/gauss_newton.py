"""Gauss and Newton's iteration, for problems whose linear unknowns are projected out."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


Coefficients = Float[np.ndarray, " d"]

# Expected decrease of the cost, relative to it, below which the minimum is reached. Doubled: c may
# be off by 1.4e-7 instead of 1e-7 of its standard errors, times the root of the residuals' number.
_SETTLED_GAIN = 1e-14
# Length of a step relative to 1 + |c| that rounding makes. Doubled: no step fewer.
_SETTLED_STEP = 1e-12
# If no halved step lowers the cost: the gain, relative to the cost, that rounding explains.
# Doubled: an iteration that stalls this close to the minimum more often counts as converged.
_STALLED_GAIN = 1e-6
# Halvings of a step that raises the cost. Doubled: steps down to 1e-12 instead of 1e-6 are tried.
_MAX_HALVINGS = 20


class Minimum(NamedTuple):
    """Where an iteration ended."""

    coefficients: Coefficients
    converged: bool
    """Whether the last step no longer mattered."""


def gauss_newton(
    linearize: Callable[[Coefficients], tuple[np.ndarray, np.ndarray]],
    start: Coefficients,
    max_steps: int,
    settled_gain: float = 0.0,
) -> Minimum:
    """Minimize a sum of squares, halving steps that do not lower it.

    **Arguments:** `linearize(c)` gives the residuals (n,) and their Jacobian (n, d), of full rank.
    `settled_gain`: an expected decrease of the sum that does not matter.
    """
    c = start
    residual, jacobian = linearize(c)
    cost = residual @ residual
    for _ in range(max_steps):
        step = np.linalg.lstsq(jacobian, -residual)[0]
        gain = ((jacobian @ step) ** 2).sum()
        small = np.linalg.norm(step) <= _SETTLED_STEP * (1 + np.linalg.norm(c))
        if gain <= max(_SETTLED_GAIN * cost, settled_gain) or small:
            return Minimum(c, True)
        for k in range(_MAX_HALVINGS):
            trial = c + step / 2**k
            with np.errstate(all="ignore"):
                new_residual, new_jacobian = linearize(trial)
                new_cost = new_residual @ new_residual
            if new_cost < cost:
                break
        else:
            return Minimum(c, bool(gain <= _STALLED_GAIN * cost))
        c, residual, jacobian, cost = trial, new_residual, new_jacobian, new_cost
    return Minimum(c, False)
