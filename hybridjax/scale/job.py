"""The pieces of a sweep."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._core.execution import Execution
from .._core.pieces.blocks import Blocks
from .._core.pieces.layout import Variable
from .._core.pieces.run import call
from .._core.progress import say
from ..orbits.batches import Known, Rounds, Tiles
from ..orbits.cycle import LimitCycle
from ..orbits.limit_cycles import BATCH, LimitCycles, as_cycles, map_for_sweep, programs_for
from ..orbits.return_map import ReturnMap
from .family import Family
from .points import Grid, Points, spread_out
from .wanted import Wanted


# Cycles that are found first. Doubled, the first guesses in each piece are better, and the coarse
# pass takes twice as long.
_COARSE = 250
# Digits of the guess, in sizes of the states. Fewer: the coarse pass takes a step more.
_DIGITS = 7


@dataclasses.dataclass(frozen=True)
class Begun:
    """What every piece begins with.

    **Fields:** `map`, the return map of the guess; `index`, where the points of the coarse pass
    lie; `known`, their cycles, without the systems.
    """

    map: ReturnMap
    index: tuple[np.ndarray, ...]
    known: Known

    def arrays(self) -> list[np.ndarray]:
        """All that is in it, but for what the model says."""
        return [np.asarray(x) for x in jax.tree_util.tree_leaves(self._parts())]

    def _parts(self) -> Any:
        map = self.map
        own = map.anchor, map.expected, map.settings.scale, map.conserved
        return own, self.index, self.known

    @classmethod
    def first(cls, job: "SweepJob", guess: LimitCycle) -> "Begun":
        """With the points of the coarse pass, before their cycles are known."""
        map = _rounded(map_for_sweep(guess, None, None))
        index = spread_out(job.blocks.shape, _COARSE)
        n, d = len(index[0]), map.anchor.q.shape[0]
        anchor = jax.tree_util.tree_map(lambda x: np.repeat(np.asarray(x)[None], n, 0), map.anchor)
        blank = np.zeros(n), np.zeros((n, d, d)), np.zeros(n, int)
        return cls(map, index, Known(None, anchor, *blank))

    @classmethod
    def restored(cls, job: "SweepJob", guess: LimitCycle, arrays: list[np.ndarray]) -> "Begun":
        """With the arrays of another call."""
        blank = cls.first(job, guess)
        structure = jax.tree_util.tree_structure(blank._parts())
        own, index, known = jax.tree_util.tree_unflatten(structure, arrays)
        return cls(_with(blank.map, *own), index, known)


@dataclasses.dataclass(frozen=True)
class SweepJob:
    """**Fields:** `family` of systems at `points`, cut into `blocks`; what is `wanted` of their
    cycles, as `variables`; what pieces begin with (`begun`)."""

    family: Family
    points: Grid | Points
    blocks: Blocks
    wanted: Wanted
    begun: Begun | None = None
    variables: Mapping[str, Variable] = dataclasses.field(default_factory=dict)

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Results of the points of piece k."""
        assert self.begun is not None
        place = self.blocks.slices(k)
        shape = tuple(x.stop - x.start for x in place)
        index = np.meshgrid(*(np.arange(x.start, x.stop) for x in place), indexing="ij")
        tiles = self._tiles(tuple(x.ravel() for x in index), workers)
        coarse = self.family.systems(self.points.at(self.begun.index))
        tiles = tiles._replace(known=self.begun.known._replace(systems=coarse))
        cycles = as_cycles(tiles, tiles.solve(int(np.prod(shape))))
        found = self.wanted.values(cycles, self.variables)
        return {name: x.reshape(*shape, *x.shape[1:]) for name, x in found.items()}

    def coarse(self) -> tuple[Known, LimitCycles]:
        """The cycles of the coarse pass."""
        assert self.begun is not None
        index = self.begun.index
        tiles = self._tiles(index, None)
        found = tiles.solve(len(index[0]))
        return _known(found), as_cycles(tiles, found)

    def _tiles(self, index: tuple[np.ndarray, ...], workers: int | None) -> Tiles:
        assert self.begun is not None
        systems = self.family.systems(self.points.at(index))
        programs = programs_for(int(np.prod(self.blocks.shape)))
        # (One size for all, whatever is left at the edges: there is one program.)
        size = min(BATCH, int(np.prod(self.blocks.block)))
        return Tiles(systems, self.begun.map, size, Execution(workers=workers).threads, programs)


def coarse_pass(job: SweepJob, guess: LimitCycle, client: Any) -> tuple[Begun, LimitCycles]:
    """What pieces begin with, and the cycles that were found for it."""
    say("a coarse pass")
    begun = Begun.first(job, guess)
    known, cycles = call(dataclasses.replace(job, begun=begun), "coarse", client)
    return dataclasses.replace(begun, known=known), cycles


def _known(found: Rounds) -> Known:
    return Known(None, found.anchor, found.period, found.turn.jacobian, np.asarray(found.result))


def _rounded(map: ReturnMap) -> ReturnMap:
    """With a state, a period and sizes that do not depend on the last digits of the guess: these
    depend on how it was found."""
    single = lambda x: np.asarray(x, np.float32).astype(float)  # noqa: E731
    scale = single(map.settings.scale)
    size = scale[np.asarray(map.anchor.chart)].T
    q = np.round(np.asarray(map.anchor.q) / size, _DIGITS) * size
    anchor = eqx.tree_at(lambda x: x.q, map.anchor, q)
    period = map.expected if map.base is None else single(map.expected)
    return _with(map, anchor, period, scale, map.conserved)


def _with(map: ReturnMap, anchor: Any, expected: Any, scale: Any, conserved: Any) -> ReturnMap:
    settings = dataclasses.replace(map.settings, scale=scale)
    return dataclasses.replace(
        map, anchor=anchor, expected=expected, settings=settings, conserved=conserved
    )
