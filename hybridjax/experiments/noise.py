"""Process noise: a random input beside the excitation."""

import numpy as np
from jaxtyping import Float

from .._core.errors import DefinitionError


def draw_process_noise(
    shape: tuple[int, ...], std: int | float, seed: int
) -> Float[np.ndarray, "..."]:
    """A white random input, held from section to section.

    **Raises:** `DefinitionError` for a standard deviation that is negative or not finite.
    """
    if not (np.isfinite(std) and std >= 0):
        raise DefinitionError(f"process_noise must be finite and not negative, but is {std}.")
    if std == 0:
        return np.zeros(shape)
    return std * np.random.default_rng(seed).normal(size=shape)
