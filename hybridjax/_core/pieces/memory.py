"""Results that are kept in the memory of this process."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arguments import package
from .layout import Layout


class MemoryStore:
    """See `Store`."""

    address: str | None = None

    def __init__(self, layout: Layout):
        self.layout = layout
        self.values = {
            name: np.full(layout.shape(name), x.fill, x.dtype)
            for name, x in layout.variables.items()
        }
        self._there: set[int] = set()

    def missing(self) -> list[int]:
        return [k for k in range(len(self.layout.blocks)) if k not in self._there]

    def write(self, k: int, values: Mapping[str, np.ndarray]) -> None:
        for name, x in values.items():
            self.values[name][self.layout.blocks.slices(k)] = x
        self._there.add(k)

    def dataset(self) -> Any:
        layout = self.layout
        variables = {
            name: (layout.axes(name), self.values[name], dict(x.attributes))
            for name, x in layout.variables.items()
        }
        constants = {
            name: (x.dims, x.values, dict(x.attributes)) for name, x in layout.constants.items()
        }
        coordinates = {name: constants.pop(name) for name in layout.coordinates}
        about = {"hybridjax": json.dumps(layout.description)}
        return package("xarray").Dataset({**variables, **constants}, coordinates, about)
