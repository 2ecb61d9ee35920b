"""What results of many points look like, wherever they are kept."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from .blocks import Blocks


class Variable(NamedTuple):
    """An array with a value for each point.

    **Fields:** `dims`, names of the axes that each value has beside those of the points, and
    their lengths `shape`; `attributes`, units for example.
    """

    dtype: str
    dims: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()
    attributes: Mapping[str, Any] = {}

    @property
    def fill(self) -> Any:
        """What stands where nothing has been computed yet."""
        return -1 if np.dtype(self.dtype).kind == "i" else np.nan


class Constant(NamedTuple):
    """An array that is known before anything is computed: a coordinate, for example."""

    dims: tuple[str, ...]
    values: np.ndarray
    attributes: Mapping[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class Layout:
    """**Fields:** `dims`, names of the axes of the points; `blocks`, the pieces; `variables` and
    `constants` by name; `coordinates`, which constants are coordinates; `description`, what the
    results are of, made of what JSON knows."""

    dims: tuple[str, ...]
    blocks: Blocks
    variables: Mapping[str, Variable]
    constants: Mapping[str, Constant]
    coordinates: tuple[str, ...]
    description: Mapping[str, Any]

    def axes(self, name: str) -> tuple[str, ...]:
        """All dimensions of a variable."""
        return (*self.dims, *self.variables[name].dims)

    def shape(self, name: str) -> tuple[int, ...]:
        return (*self.blocks.shape, *self.variables[name].shape)


@runtime_checkable
class Store(Protocol):
    """Where pieces are kept."""

    layout: Layout

    address: str | None
    """What another process opens to write into it; None for memory of this process."""

    def missing(self) -> list[int]:
        """The pieces that are not there."""
        ...

    def write(self, k: int, values: Mapping[str, np.ndarray]) -> None:
        """Keep piece k."""
        ...

    def dataset(self) -> Any:
        """All of it, as `xarray.Dataset`."""
        ...
