"""Process noise: a random input beside the excitation."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..errors import DefinitionError


@dataclasses.dataclass(frozen=True)
class ProcessNoise:
    """A white random input, held from section to section, that acts beside the excitation and is
    not recorded.

    **Fields:** `std`, its standard deviation, in units of the inputs; `seed`.

    **Raises:** `DefinitionError` for a standard deviation that is negative or not finite.
    """

    std: float
    seed: int = 0

    def __post_init__(self):
        if not (np.isfinite(self.std) and self.std >= 0):
            raise DefinitionError(
                f"std of process noise must be finite and not negative, but is {self.std}."
            )

    def draw(self, shape: tuple[int, ...], first: int = 0) -> Float[np.ndarray, "S n nu"]:
        """The noise of some experiments of a set.

        **Arguments:** `shape`, experiments first; `first`, the number of the first one in the set:
        each has noise of its own, in whatever parts the set is run.
        """
        if shape[0] == 0:
            return np.zeros(shape)
        each = (np.random.default_rng((self.seed, first + s)) for s in range(shape[0]))
        return np.stack([self.std * rng.normal(size=shape[1:]) for rng in each])
