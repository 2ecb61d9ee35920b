"""The cosines among which power is divided."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.partition import is_half_integer


class Candidates(NamedTuple):
    """The K cosines of a design: which line at which input."""

    line: Int[np.ndarray, " K"]
    """j, so that f = j / periods."""
    channel: Int[np.ndarray, " K"]
    """Index of the input."""
    periods: int
    n_sections: int
    strides: int
    """T, periods of all experiments together."""

    @classmethod
    def of(cls, design: Design) -> "Candidates":
        """**Raises:** `DefinitionError` for multiples of 1/2, and for lines that excite several
        inputs in one experiment."""
        half = is_half_integer(design.line, design.periods)
        if half.any():
            raise DefinitionError(
                f"f = {design.f[half][0]:g} is a multiple of 1/2, which is measured in two "
                "experiments that belong together: take a `design` without such lines."
            )
        shared = np.stack([design.experiment, design.line])
        if len(np.unique(shared, axis=1).T) < len(design.line):
            raise DefinitionError(
                "the `design` excites several inputs with one line of one experiment: take one "
                "with division='random' or 'disjoint'."
            )
        line, channel = np.unique(np.stack([design.line, design.channel]), axis=1)
        strides = design.experiments * design.periods
        return cls(line, channel, design.periods, design.n_sections, strides)

    @property
    def f(self) -> Float[np.ndarray, " K"]:
        return self.line / self.periods

    def only(self, some: Int[np.ndarray, " k"]) -> "Candidates":
        return self._replace(line=self.line[some], channel=self.channel[some])

    def places(self, design: Design) -> Int[np.ndarray, " L"]:
        """Which of these each line of a design is."""
        key = self.line * (self.channel.max() + 1) + self.channel
        order = np.argsort(key)
        wanted = design.line * (self.channel.max() + 1) + design.channel
        return order[np.searchsorted(key, wanted, sorter=order)]

    def power_of(self, design: Design) -> Float[np.ndarray, " K"]:
        """Mean square of each cosine in a design, over all of its experiments."""
        square = np.asarray(design.amplitude) ** 2 / 2
        return np.bincount(self.places(design), square, len(self.line)) / design.experiments
