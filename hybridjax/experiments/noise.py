"""Process noise: a random input beside the excitation."""

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError


def draw_process_noise(
    shape: tuple[int, ...], std: int | float, seed: int, first: int = 0
) -> Float[np.ndarray, "..."]:
    """A white random input, held from section to section, for some experiments of a set.

    **Arguments:** `shape`, experiments first; `first`, the number of the first one in the set: each
    has noise of its own, in whatever parts the set is run.

    **Raises:** `DefinitionError` for a standard deviation that is negative or not finite.
    """
    if not (np.isfinite(std) and std >= 0):
        raise DefinitionError(f"process_noise must be finite and not negative, but is {std}.")
    if std == 0 or shape[0] == 0:
        return np.zeros(shape)
    each = (np.random.default_rng((seed, first + s)) for s in range(shape[0]))
    return np.stack([std * rng.normal(size=shape[1:]) for rng in each])
