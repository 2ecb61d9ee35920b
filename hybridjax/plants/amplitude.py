"""Test whether inputs of experiments on a plant are too large or too small.

`PlantCycle.run_experiments` calls `doubts_about_inputs` with the responses to an input, to half of
it, and to none. The response should be twice the response to half of the input. If it is not, the
input is too large (curvature) or too small: simulators with fixed time steps let contacts begin at
the ends of steps, so that the response is a *staircase* as a function of the input.

The constants may be changed. The responses must be less the motion without input, with the same
seed: noise and the rest of a transient would otherwise look like curvature. If a finding is
needless or missed, look at the constants first; if stairs are not seen, at `_stairs`, which returns
0 where the time steps of a plant cannot be shifted.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.findings import Finding
from .._core.text import listed
from .returns import ReturnMap


# Difference between the response to an input and twice the response to half of it, relative to the
# response, above which there is a finding. Larger: curvature biases weak multipliers, and there is
# no finding. Smaller: every contact gives a finding.
_NONLINEAR = 1e-3
# The response is a staircase if returns scatter by more than this part of their size when the grid
# of time steps is shifted. Larger: stairs that bias multipliers pass. Smaller: errors of
# integration count as stairs.
_STAIRS = 1e-3
# If the response differs from twice that to half of the input by less than this part of the scatter
# (see `_stairs`), no contact has moved to another time step: all inputs are on one stair. Larger:
# experiments that met a few stairs give a finding. Smaller: curvature within a stair counts as
# another stair.
_ON_ONE_STAIR = 0.1
# If this difference is above this multiple of the scatter, its cause is curvature. Larger:
# curvature passes. Smaller: stairs count as curvature; the advice is then a smaller input, which
# makes stairs worse.
_MANY_STAIRS = 3.0


def doubts_about_inputs(
    cycle: Any, full: Float[np.ndarray, "n ny"], half: Float[np.ndarray, "n ny"]
) -> list[Finding]:
    """Return findings about an input, from the responses to the input and to half of it, both less
    the motion without input."""
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
    """Return the scatter of each output when the grid of time steps is shifted. It is 0 for an
    output without a staircase, and for a plant whose grid cannot be shifted."""
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
    ):  # (a plant that falls near its cycle: experiments are kept all the same)
        return np.zeros(len(columns))
    changes = signals[:, columns]
    scatter = changes.std(axis=0, ddof=1)
    mean = np.sqrt((changes**2).mean(axis=0))
    return np.where(scatter > _STAIRS * mean, scatter, 0.0)
