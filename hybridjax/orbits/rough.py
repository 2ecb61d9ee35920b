"""A limit cycle up to what the search for it leaves open."""

from typing import Any

import numpy as np

from .cycle import LimitCycle


def rough(cycle: LimitCycle) -> dict[str, Any]:
    """A cycle in words that are the same however it was found: its period, and where it begins, in
    sizes of the states."""
    chart = int(np.asarray(cycle.anchor.chart)[0])
    q, size = np.asarray(cycle.anchor.q)[:, 0], np.asarray(cycle.settings.scale)[chart]
    return {
        "period": f"{float(cycle.period):.5g}",
        "time": f"{float(cycle.anchor.t[0]):.5g}",
        "chart": chart,
        "state": [f"{x:.4f}" for x in (q / size).round(4) + 0.0],
    }
