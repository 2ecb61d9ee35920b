"""Whether inputs of experiments on a plant are too large, or too small."""

from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.findings import Finding
from .._core.text import listed
from .returns import ReturnMap


# Difference between the response to an input and twice that to half of it, relative to the
# response, that is reported. Larger: it biases weak multipliers. Smaller: every contact is doubted.
_NONLINEAR = 1e-3
# Scatter of returns over the grid of time, relative to the returns, that is a staircase. Larger:
# stairs that bias multipliers pass. Smaller: errors of integration are called stairs.
_STAIRS = 1e-3
# A response differs from twice that to half of the input because of stairs or because of curvature.
# Below this part of the scatter it differs so little that no contact moved to another time step.
# Larger: experiments that met a few stairs are doubted. Smaller: curvature within a stair counts as
# the next one.
_ON_ONE_STAIR = 0.1
# Above this multiple of the scatter, curvature is the reason. Larger: curvature passes. Smaller:
# stairs are called curvature, for which smaller inputs are advised, and these make stairs worse.
_MANY_STAIRS = 3.0


def doubts_about_inputs(
    cycle: Any, full: Float[np.ndarray, "n ny"], half: Float[np.ndarray, "n ny"]
) -> list[Finding]:
    """Return findings about an input, by the responses to it and to half of it, less what the plant
    does without input."""
    size = np.sqrt((full**2).mean(axis=0))
    stairs = _stairs(cycle)
    difference = np.sqrt(((full - 2 * half) ** 2).mean(axis=0))
    apart = difference / np.maximum(size, np.finfo(float).tiny)
    names = [str(output) for output in cycle.outputs]
    curved = np.where(difference > _MANY_STAIRS * stairs, apart, 0.0)
    k = int(np.argmax(curved))
    if curved[k] > _NONLINEAR:
        return [
            Finding(
                "amplitude",
                f"twice the response of {names[k]} to half of the input differs from that to the "
                f"input by {100 * curved[k]:.2g} %: the plant is not linear there, and weak "
                "multipliers are biased. Compare experiments with smaller inputs.",
            )
        ]
    below = difference < _ON_ONE_STAIR * stairs
    if not below.any():
        return []
    found = [name for name, x in zip(names, below, strict=True) if x]
    return [
        Finding(
            "stairs",
            f"the responses of {listed(found)} are so small that each contact begins at the same "
            "time step with and without the input. The time steps of the simulator make its "
            "returns a staircase, and the responses show the slope of one stair only: use larger "
            "inputs, or a shorter time step.",
        )
    ]


def _stairs(cycle: Any) -> Float[np.ndarray, " ny"]:
    """Return the scatter of the outputs over the grid of time. It is 0 where that is no staircase,
    and for a plant whose grid cannot be moved."""
    columns = list(cycle.drive.columns)
    if not cycle.drive.sets or cycle.drive.fixed:
        return np.zeros(len(columns))
    returns = ReturnMap(cycle)
    try:
        returns.measure_ranges()
        if not returns.grid_may_move():
            return np.zeros(len(columns))
        _, signals = returns.changes_over_grids()
    except (
        Exception
    ):  # (a plant that falls beside its cycle: experiments count all the same)
        return np.zeros(len(columns))
    changes = signals[:, columns]
    scatter = changes.std(axis=0, ddof=1)
    mean = np.sqrt((changes**2).mean(axis=0))
    return np.where(scatter > _STAIRS * mean, scatter, 0.0)
