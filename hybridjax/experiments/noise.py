"""Noise of any color: a random input beside the excitation, errors of what is measured."""

import dataclasses
from typing import Annotated

import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, NonNegative, SectionCount, Seed
from .._core.boundary.values import Reals
from ..errors import DefinitionError


@checked
@dataclasses.dataclass(frozen=True)
class ProcessNoise:
    r"""A random input, held from section to section, that acts beside the excitation and is not
    recorded: at section n of the experiment $\sigma_{n \bmod N} z_n$, where z is a first-order
    autoregressive series (AR(1)) of variance 1.

    **Fields:**

    - `std`: its standard deviation, in units of the inputs; one number, or N of them, by section
      (the noise is then cyclostationary).
    - `seed`.
    - `memory`: its correlation time in cycles, with which its correlation $e^{-k / (N \tau)}$ from
      a section to the k-th after it falls; 0 for white noise. It has run forever when an
      experiment begins.
    """

    std: Annotated[Numbers, Reals(sign="nonnegative")]
    seed: Seed = 0
    memory: NonNegative = 0.0

    def __post_init__(self):
        if np.ndim(self.std) > 1 or np.size(self.std) == 0:
            raise DefinitionError(
                f"ProcessNoise: `std` must be one number, or one for each section, not of shape "
                f"{np.shape(self.std)}."
            )
        # (Numbers and tuples of them can be compared and written down, arrays cannot.)
        plain = np.asarray(self.std).tolist()
        object.__setattr__(self, "std", tuple(plain) if isinstance(plain, list) else plain)

    def draw(
        self, shape: tuple[int, ...], n_sections: SectionCount, first: Index = 0
    ) -> Float[np.ndarray, "S n nu"]:
        """The noise of some experiments of a set, which begin at section 0.

        **Arguments:** `shape`, experiments first; `n_sections`, N; `first`, the number of the first
        one in the set: each has noise of its own, in whatever parts the set is run.

        **Raises:** `DefinitionError` for a `std` of another number of sections.
        """
        self.require(n_sections)
        if shape[0] == 0:
            return np.zeros(shape)
        each = (np.random.default_rng((self.seed, first + s)) for s in range(shape[0]))
        white = np.stack([rng.normal(size=shape[1:]) for rng in each])
        std = np.resize(self.std, shape[1])[:, None]
        return std * with_memory(white, self.memory, n_sections)

    def require(self, n_sections: SectionCount) -> None:
        """**Raises:** `DefinitionError` if `std` is one for each section, and these are not N."""
        if np.shape(self.std) not in ((), (n_sections,)):
            raise DefinitionError(
                f"`process_noise` has a `std` for each of {np.size(self.std)} sections, but the "
                f"experiments have {n_sections} in a cycle."
            )


def with_memory(
    white: Float[np.ndarray, "S n k"], memory: float, n_sections: int
) -> Float[np.ndarray, "S n k"]:
    """Series of the same variance, stationary, with a correlation time of `memory` cycles."""
    if memory == 0 or white.shape[1] == 0:
        return white
    from scipy.signal import lfilter  # takes long to import

    step = np.exp(-1 / (n_sections * memory))
    fresh = np.sqrt(-np.expm1(-2 / (n_sections * memory)))
    found, _ = lfilter([fresh], [1, -step], white[:, 1:], axis=1, zi=step * white[:, :1])
    return np.concatenate([white[:, :1], found], axis=1)
