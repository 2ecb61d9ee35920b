"""Which outputs a system conserves near a limit cycle."""

import jax
import jax.numpy as jnp
import numpy as np

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
    s = Structure(cycle.system)
    a, t = int(cycle.anchor.chart[0]), cycle.anchor.t[0]
    q, u = cycle.anchor.q[: s.dims[a], 0], jnp.zeros(s.nu)
    returned = np.asarray(monodromy(cycle.factors))[: s.dims[a], : s.dims[a]]
    sizes = np.asarray(cycle.return_map.sizes)[: s.dims[a]]
    outputs = s.resolve_outputs(names)
    gradients = np.asarray(jax.jacfwd(lambda q: outputs(a, t, q, u))(q))
    changes = np.abs((gradients @ returned - gradients) * sizes).max(axis=1)
    kept = changes <= _CONSERVED * np.abs(gradients * sizes).max(axis=1)
    values = np.asarray(outputs(a, t, q, u))
    return {name: float(x) for name, x, same in zip(names, values, kept, strict=True) if same}
