"""How a grid of independent points is cut into pieces."""

import dataclasses
import math
from collections.abc import Sequence


@dataclasses.dataclass(frozen=True)
class Blocks:
    """A grid of `shape`, cut into blocks of the shape `block`; those at its far sides may be
    smaller."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of blocks along each axis."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block, strict=True))

    def __len__(self) -> int:
        return math.prod(self.counts)

    def place(self, k: int) -> tuple[int, ...]:
        """Which block along each axis is number k."""
        found = []
        for count in reversed(self.counts):
            k, index = divmod(k, count)
            found.append(index)
        return tuple(reversed(found))

    def slices(self, k: int) -> tuple[slice, ...]:
        """The part of the grid that is block k."""
        return tuple(
            slice(i * b, min((i + 1) * b, n))
            for i, b, n in zip(self.place(k), self.block, self.shape, strict=True)
        )


def near_cube(shape: Sequence[int], most: int) -> tuple[int, ...]:
    """The shape of a block of at most so many points, whose points are neighbors: the longest side
    is halved until it fits."""
    block = list(shape)
    while math.prod(block) > most:
        longest = max(range(len(block)), key=block.__getitem__)
        block[longest] = -(-block[longest] // 2)
    return tuple(block)
