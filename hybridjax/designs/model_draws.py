"""Models that may be true as well as an estimate."""

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Seed
from ..errors import DefinitionError
from ..identify.joint.ldtp_fit import LDTPFit
from ..linear.ldtp import LDTP


# Draws for each model that is wanted. More: estimates that are nearly unstable are not refused.
_TRIES = 20


@checked
def draws(fit: LDTPFit, count: Count, seed: Seed = 0) -> list[LDTP]:
    """Stable models from the region of an estimate, to be handed to `optimal_design` together.

    Normal, with the covariance of the fit; those with a multiplier of modulus one or more are left
    out.

    **Raises:** `DefinitionError` if hardly any are stable.
    """
    rng, found = np.random.default_rng(seed), []
    for _ in range(_TRIES * count):
        step = fit._root @ rng.normal(size=fit._root.shape[1])
        moved = fit._coordinates.moved(step)
        if np.abs(np.linalg.eigvals(moved.monodromy())).max() < 1:
            found.append(moved.to_ldtp(fit._scale, fit.inputs, fit.outputs))
        if len(found) == count:
            return found
    raise DefinitionError(
        f"only {len(found)} of {_TRIES * count} models in the region of this estimate are stable: "
        "measure more before a design is made."
    )
