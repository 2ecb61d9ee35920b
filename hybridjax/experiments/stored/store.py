"""Experiments in a Zarr store: many more than memory holds, by any number of processes."""

import functools
from collections.abc import Iterator
from typing import Any, Unpack

import numpy as np

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import ExperimentCount, Index, Path
from ..._core.pieces.layout import Layout
from ..._core.pieces.place import absolute, filled
from ..._core.pieces.run import DaskClient
from ..._core.pieces.zarr_store import ZarrStore
from ..._core.progress import working
from ..._core.signal import Signal
from ...errors import DefinitionError
from ...maps.placed import SectionsLike
from ...orbits.cycle import LimitCycle
from ...systems.output import OutputNames
from ..data import ExperimentData, Simulated, summary
from ..events import EventTimes
from ..inputs import DesignLike
from ..options import OptionsByName, options_of
from ..run import CHUNK
from .pieces import KIND, describe, layout_of, prepare_pieces


@checked
@working("store_experiments")
def store_experiments(
    store: Path,
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    chunk: ExperimentCount = CHUNK,
    client: DaskClient | None = None,
    share: tuple[Index, ExperimentCount] = (0, 1),
    **options: Unpack[OptionsByName],
) -> "StoredExperiments":
    """Run experiments and keep them in a Zarr store, in memory that does not depend on their
    number.

    Chunks that are there already are not run again: after an interruption, make the same call. The
    records are the same to the last bit for any number of processes and interruptions, on machines
    of one kind; so all wait for the program that is compiled thoroughly (10 s, once).

    **Arguments:** as for `run_experiments`, and

    - `store`: a folder, or an address that fsspec knows ("s3://bucket/records.zarr"). It holds the
        experiments of one call only.
    - `chunk`: the number of experiments in one piece.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`); with a client it has
        to be a `Design`, or small, since each worker gets it.
    - `client`: a `distributed.Client`, whose workers run the pieces.
    - `share`: `(rank, size)` where several processes without a client fill one store: this one does
        the pieces rank, rank + size, ...; those above 0 wait until the first has begun the store.

    **Returns:** `StoredExperiments`.

    **Raises:** `DefinitionError` if the store holds other experiments (with the difference), or
    cannot be written, or for a client whose workers cannot do it; `ComputationError` if the cluster
    is lost; `TypeError` for an argument that does not exist; and as `run_experiments`.
    """
    job = prepare_pieces(
        cycle, sections, design, outputs, options_of(store_experiments, options), chunk
    )
    description = describe(job)

    def begin():
        return job, layout_of(job, description), job.arrays()

    def again(layout: Layout, start: list[np.ndarray]):
        return job.restored(start)

    filled(begin, again, description, store, client, share)
    return StoredExperiments(store)


@checked
class StoredExperiments:
    """Experiments in a store that `store_experiments` fills.

    Iterating over them reads chunk after chunk as `ExperimentData`, so that
    `estimate_htf(StoredExperiments(store))` needs memory for one chunk only.
    """

    def __init__(self, store: Path):
        """**Arguments:** `store`, its folder or address.

        **Raises:** `DefinitionError` if it holds no experiments.
        """
        self.address = absolute(store)
        try:
            self._store = ZarrStore(self.address)
            about = self._store.layout.description
            if about["kind"] != KIND:
                raise KeyError
        except (DefinitionError, KeyError, TypeError, ValueError) as error:
            raise DefinitionError(f"'{store}' holds no experiments.") from error
        blocks = self._store.layout.blocks
        self.experiments, self.chunk = blocks.shape[0], blocks.block[0]
        self._about = about["data"]
        self.n_sections: int = self._about["n_sections"]

    def __len__(self) -> int:
        """The number of chunks, whether they are there or not."""
        return len(self._store.layout.blocks)

    def missing(self) -> list[int]:
        """The chunks that are not there yet."""
        return self._store.missing()

    def __getitem__(self, k: Index) -> ExperimentData:
        """Chunk k. **Raises:** `FileFormatError` if it is damaged."""
        if k >= len(self):
            raise IndexError(f"there are {len(self)} chunks, and none of number {k}.")
        x = self._store.read(k)
        events = self._events(x) if "event" in x else None
        return ExperimentData(
            x["u"],
            x["y"],
            n_sections=self.n_sections,
            periods=self._about["periods"],
            inputs=_signals(self._about["inputs"]),
            outputs=_signals(self._about["outputs"]),
            result=x["result"],
            simulated=Simulated(x["failed_at"], x["error"], events),
            cycle_outputs=self._constants["cycle_outputs"],
            label=self._about["label"],
        )

    def __iter__(self) -> Iterator[ExperimentData]:
        """Read chunk after chunk. **Raises:** `DefinitionError` if one is missing;
        `FileFormatError` if one is damaged."""
        gone = self.missing()
        if gone:
            raise DefinitionError(
                f"{len(gone)} of {len(self)} chunks in '{self.address}' are missing, the first is "
                f"{gone[0]}: call `store_experiments` as before to run them."
            )
        for k in range(len(self)):
            yield self[k]

    @property
    def dataset(self) -> Any:
        """All of it as `xarray.Dataset`, of which values are read when they are used."""
        return self._store.dataset()

    def summary(self, limit: Index = 5) -> str:
        """As `ExperimentData.summary`, of all experiments."""
        codes = self._store.whole("result"), self._store.whole("failed_at")
        return summary(*codes, self.n_sections, limit)

    @functools.cached_property
    def _constants(self) -> dict[str, np.ndarray]:
        return self._store.constants(("cycle_outputs", "cycle_time", "cycle_event", "cycle_period"))

    def _events(self, x: dict[str, np.ndarray]) -> EventTimes:
        width = max(int((x["event"] >= 0).sum(axis=1).max(initial=0)), 1)
        known = self._constants
        return EventTimes(
            *(x[name][:, :width] for name in ("event_time", "event", "event_sample")),
            known["cycle_time"],
            known["cycle_event"],
            known["cycle_period"],
            n_sections=self.n_sections,
            names=tuple(self._about["transitions"]),
        )

    def __repr__(self) -> str:
        ready = len(self) - len(self.missing())
        return (
            f"StoredExperiments('{self.address}': {self.experiments} experiments, {ready} of "
            f"{len(self)} chunks)"
        )


def _signals(named: list[list[str]]) -> tuple[Signal, ...]:
    return tuple(Signal(name, unit) for name, unit in named)
