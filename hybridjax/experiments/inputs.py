"""Where the inputs of experiments come from."""

import dataclasses
from typing import Annotated

import numpy as np
from jax import Array
from jaxtyping import Float

from .._core.boundary.values import Reals
from ..errors import DefinitionError
from .design.design import Design


DesignLike = Design | Annotated[np.ndarray | Array, Reals("S n nu", missing=True, infinite=True)]
"""A design, or inputs. (What lies on disk is looked at part by part.)"""

# Experiments whose inputs are looked at together for NaN, since an array may lie on disk. Twice as
# many take twice the memory.
_LOOK = 1024


@dataclasses.dataclass(frozen=True)
class Inputs:
    """The inputs of a set of experiments, made or read a part at a time.

    **Fields:** `source`, a design or an array (S, n, nu); `cycles`, the length of the experiments
    in periods of the limit cycle; `periods`, how many of the last ones are for estimation.
    """

    source: Design | np.ndarray
    cycles: int
    periods: int

    def __len__(self) -> int:
        """S, the number of experiments."""
        return self.source.experiments if isinstance(self.source, Design) else len(self.source)

    def of(self, rows: slice) -> Float[np.ndarray, "S n nu"]:
        """The inputs of some experiments."""
        if isinstance(self.source, Design):
            return self.source.inputs(self.cycles, rows)
        return np.asarray(self.source[rows], float)


def check_inputs(design: DesignLike, discard: int, n_sections: int, nu: int) -> Inputs:
    """Inputs for N sections and nu inputs, the first `discard` cycles not for estimation.

    **Raises:** `DefinitionError` if they do not fit, or hold NaN.
    """
    if isinstance(design, Design):
        if design.n_sections != n_sections:
            raise DefinitionError(
                f"the design is for {design.n_sections} sections, but the family has {n_sections}."
            )
        if len(design.input_names) != nu:
            raise DefinitionError(
                f"the design has {len(design.input_names)} inputs, but the system has {nu}."
            )
        return Inputs(design, discard + design.periods, design.periods)
    u = np.asarray(design)  # may lie on disk (`numpy.memmap`), so never all of it is read at once
    if u.ndim != 3 or u.shape[2] != nu or u.shape[1] % n_sections or 0 in u.shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, {nu}) with samples a multiple of "
            f"the {n_sections} sections; got {u.shape}."
        )
    for k in range(0, len(u), _LOOK):
        finite = np.isfinite(np.asarray(u[k : k + _LOOK], float)).all(axis=(1, 2))
        if not finite.all():
            worst = k + int(np.argmin(finite))
            raise DefinitionError(
                f"`design` has NaN or infinity in the input of experiment {worst}."
            )
    cycles = u.shape[1] // n_sections
    if discard >= cycles:
        raise DefinitionError(
            f"inputs of {cycles} cycles less {discard} discarded ones leave none for estimation."
        )
    return Inputs(u, cycles, cycles - discard)
