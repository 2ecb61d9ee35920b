"""Process noise: a random input beside the excitation."""

import dataclasses

import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, NonNegative, Seed


@checked
@dataclasses.dataclass(frozen=True)
class ProcessNoise:
    """A white random input, held from section to section, that acts beside the excitation and is
    not recorded.

    **Fields:** `std`, its standard deviation, in units of the inputs; `seed`.
    """

    std: NonNegative
    seed: Seed = 0

    def draw(self, shape: tuple[int, ...], first: Index = 0) -> Float[np.ndarray, "S n nu"]:
        """The noise of some experiments of a set.

        **Arguments:** `shape`, experiments first; `first`, the number of the first one in the set:
        each has noise of its own, in whatever parts the set is run.
        """
        if shape[0] == 0:
            return np.zeros(shape)
        each = (np.random.default_rng((self.seed, first + s)) for s in range(shape[0]))
        return np.stack([self.std * rng.normal(size=shape[1:]) for rng in each])
