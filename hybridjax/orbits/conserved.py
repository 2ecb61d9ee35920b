"""Which outputs a system conserves near a limit cycle."""

import numpy as np

from .._core.executor import to_host
from ..engine import kernels
from ..errors import DefinitionError
from ..linear.time_response import monodromy
from ..systems.structure import Structure
from .cycle import LimitCycle


# The gradient of a conserved quantity, in sizes of the states, is a left eigenvector of the
# monodromy up to this part of it. Doubled, half as much loss is noticed.
_CONSERVED = 1e-6


def check_conserved(cycle: LimitCycle) -> None:
    """**Raises:** `DefinitionError` where a quantity that should be conserved is not."""
    kept = conserved_outputs(cycle, tuple(cycle.conserved))
    lost = [name for name in cycle.conserved if name not in kept]
    if lost:
        raise DefinitionError(
            f"'{lost[0]}' is not conserved by {type(cycle.system).__name__}: neighbors of the "
            "cycle change it in one turn. Leave it out of `conserved`."
        )


def conserved_outputs(cycle: LimitCycle, names: tuple[str, ...]) -> dict[str, float]:
    """Those outputs that are conserved near the cycle, with their values: their gradients are left
    eigenvectors of the monodromy."""
    cycle = to_host(cycle)
    s, t = Structure(cycle.system), cycle.anchor.t
    a = int(cycle.anchor.chart[0])
    n = s.dims[a]
    returned, sizes = monodromy(cycle.factors)[:n, :n], cycle.settings.scale[a, :n]
    items = tuple(s.resolve_outputs(names).items)
    seen = kernels.outputs(s, a, items, t, cycle.anchor.q[:n], np.zeros((s.nu, 1)))[..., 0]
    values, gradients = seen[:, 0], seen[:, 2 : 2 + n]
    changes = np.abs((gradients @ returned - gradients) * sizes).max(axis=1)
    kept = changes <= _CONSERVED * np.abs(gradients * sizes).max(axis=1)
    return {name: float(x) for name, x, same in zip(names, values, kept, strict=True) if same}
