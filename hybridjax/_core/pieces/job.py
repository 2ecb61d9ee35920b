"""What work in pieces is."""

from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Job(Protocol):
    """Work in pieces, which does not depend on who does which, and in which order. It is pickled
    where workers do it."""

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Piece k, by so many threads (by default all cores)."""
        ...
