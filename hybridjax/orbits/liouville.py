"""What a turn leaves of volumes: the product of all multipliers, by Liouville's formula."""

import numpy as np

from .._core.compilation.compile import at_ease
from .._core.executor import to_host
from ..engine.chain import divergence
from ..engine.move import record
from .return_map import ReturnMap


def log_determinant(map: ReturnMap) -> float:
    """The logarithm of the determinant of the monodromy of a cycle without events: the divergence
    of the field, integrated over one turn.

    Steps of an implicit method forget a mode that decays within them; this is how it decays.
    """
    map = to_host(map)
    s, parts = map.structure, []

    def flow(lanes, target, h, result):
        u = np.zeros((s.nu, 1))
        moved, tape = record(s, lanes, u, target, map.settings, h, result, new_input=False)
        parts.append(divergence(s, lanes, tape))
        return moved, None

    with at_ease():
        map.travel(map.anchor.q[:, 0], flow)
    return float(np.sum(parts))
