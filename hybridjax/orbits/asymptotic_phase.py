"""The asymptotic phase of a state: the phase of the cycle to which a trajectory from it converges.

`LimitCycle.asymptotic_phase` calls `asymptotic_phase`. The state is simulated from crossing to
crossing of the cycle's section, until it is so close to the cycle that the phase response
(`responses.py`) is accurate. The time that has passed, minus whole periods, then gives the phase.
The deviation must be that from the anchor, which has the phase 0.

If a state does not reach the cycle, look at the reason in the error, then at the search
(`engine/move.py`); each crossing is awaited for three periods. If a phase is inaccurate, look at
`near`, the distance below which it counts as linear. (Larger: phases are less accurate. Smaller:
more crossings are needed.)
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.compilation import at_ease
from .._core.results import Result
from ..engine.lanes import lane_at
from ..engine.move import move
from ..engine.target import toward
from ..errors import ComputationError, DefinitionError
from .crossing import to_section
from .responses import responses


def asymptotic_phase(
    cycle: Any, chart: str, state: Float[np.ndarray, " n"], turns: int
) -> float:
    """The asymptotic phase of a state (see `LimitCycle.asymptotic_phase`)."""
    map = cycle.return_map
    period = float(cycle.period)
    s = map.structure
    a = s.chart_index(chart)
    begin = lane_at(s, chart, state, map.anchor.t[0], "`state`")
    phase_response = responses(cycle, 0)._covector(None)[0, 0]
    size = map.sizes
    # (The error of a phase that is linear in the deviation is about the square of the deviation.)
    near = np.sqrt(map.settings.rtol)
    surface = getattr(s.charts[a], "surface", None)
    if surface is not None and abs(float(surface(map.anchor.t[0], state))) > near:
        raise DefinitionError(
            f"`state` does not lie on the surface on which '{chart}' slides."
        )
    lanes = begin
    for _ in range(turns):
        never = np.full(1, np.inf)
        target = toward(never, -1, lanes.t + 3 * period)
        target = to_section(target, map.base, map.event)
        with at_ease():
            no_input = np.zeros((s.nu, 1))
            moved = move(s, lanes, no_input, target, map.settings).moved
        lanes = moved.lanes
        if moved.result[0] != Result.OK:
            break
        deviation = (lanes.q - map.anchor.q)[:, 0]
        same_chart = lanes.chart[0] == map.anchor.chart[0]
        if same_chart and np.abs(deviation / size).max() < near:
            passed = (lanes.t - begin.t)[0]
            return float((phase_response @ deviation - passed) / period % 1.0)
    raise ComputationError(
        f"the state did not come to the cycle within {turns} crossings of its section (at t = "
        f"{lanes.t[0]:.6g}: {Result(int(moved.result[0])).message}): start nearer to a stable "
        "cycle, or allow more `cycles`."
    )
