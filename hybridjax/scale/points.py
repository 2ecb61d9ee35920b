"""Points of a sweep: a grid, a list, or a design of random ones."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Seed
from .._core.boundary.values import Reals
from .._core.pieces.layout import Constant
from ..errors import DefinitionError


Axes = Mapping[str, Annotated[Numbers, Reals("n")]]
"""Values of parameters by name."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """All combinations of the values of its axes."""

    axes: Mapping[str, Float[np.ndarray, " n"]]

    @property
    def dims(self) -> tuple[str, ...]:
        return tuple(self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(map(len, self.axes.values()))

    def at(self, index: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
        """The values at some places of the grid, one index for each axis."""
        pairs = zip(self.axes.items(), index, strict=True)
        return {name: values[i] for (name, values), i in pairs}

    def constants(self, units: Mapping[str, str]) -> dict[str, Constant]:
        return {
            name: Constant((name,), values, {"units": units[name]} if units[name] else {})
            for name, values in self.axes.items()
        }


@checked
class Points:
    """A list of points, for `sweep`: one value of each parameter for each."""

    def __init__(self, values: Axes):
        """**Arguments:** `values` of each parameter by name, all of one length.

        **Raises:** `DefinitionError` if there are none, or lengths differ.
        """
        self.values = {name: np.asarray(x, float) for name, x in values.items()}
        lengths = sorted({len(x) for x in self.values.values()})
        if len(lengths) != 1 or lengths == [0]:
            raise DefinitionError(
                f"`values` must hold at least one point, and as many values of each parameter, "
                f"not {', '.join(map(str, lengths)) or 'none'}."
            )

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __repr__(self) -> str:
        return f"Points({len(self)} of {', '.join(self.values)})"

    @property
    def axes(self) -> Mapping[str, Float[np.ndarray, " n"]]:
        """Values of each parameter."""
        return self.values

    @property
    def dims(self) -> tuple[str, ...]:
        """The axis of results."""
        return ("point",)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of points."""
        return (len(self),)

    def at(self, index: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
        """The values of some points."""
        return {name: values[index[0]] for name, values in self.values.items()}

    def constants(self, units: Mapping[str, str]) -> dict[str, Constant]:
        """Coordinates of results."""
        return {
            name: Constant(("point",), values, {"units": units[name]} if units[name] else {})
            for name, values in self.values.items()
        }


@checked
def sobol_points(
    ranges: Mapping[str, tuple[float, float]], count: ExperimentCount, *, seed: Seed = 0
) -> Points:
    """Points spread evenly over a box, by a scrambled sequence of Sobol (Owen 1998).

    **Arguments:** `ranges`, the lowest and the highest value of each parameter; `count`, best a
    power of two; `seed` of the scrambling.

    **Raises:** `DefinitionError` for a range that is empty.
    """
    for name, (low, high) in ranges.items():
        if not low < high:
            raise DefinitionError(f"the range of `{name}` must go up, not from {low} to {high}.")
    if not ranges:
        raise DefinitionError("`ranges` must name at least one parameter.")
    sequence = qmc.Sobol(len(ranges), rng=np.random.default_rng(seed))
    unit = sequence.random_base2(max(count - 1, 0).bit_length())[:count]
    low, high = np.array(list(ranges.values())).T
    return Points(dict(zip(ranges, (low + (high - low) * unit).T, strict=True)))


def spread_out(shape: tuple[int, ...], count: int) -> tuple[np.ndarray, ...]:
    """Places on a grid that cover it evenly, always the same, with an index for each axis."""
    unit = qmc.Halton(len(shape), scramble=False).random(count + 1)[1:]
    index = np.unique((unit * np.array(shape)).astype(int), axis=0)
    return tuple(index.T)
