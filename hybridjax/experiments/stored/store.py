"""Experiments in a Zarr store: many more than memory holds, by any number of processes."""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Index, Path
from ..._core.pieces.layout import Layout
from ..._core.pieces.place import absolute, filled
from ..._core.pieces.run import DaskClient
from ..._core.pieces.zarr_store import ZarrStore
from ..._core.signal import Signal
from ...errors import DefinitionError
from ..data import ExperimentData, Simulated, summary
from ..events import EventTimes
from .pieces import KIND, ExperimentJob, describe, layout_of


def store_experiments(
    store: Any,
    job: ExperimentJob,
    client: DaskClient | None = None,
    share: tuple[int, int] = (0, 1),
) -> "StoredExperiments":
    """Run what is missing of some experiments in a store; see `run_experiments`."""
    description = describe(job)

    def begin():
        return job, layout_of(job, description), job.arrays()

    def again(layout: Layout, start: list[np.ndarray]):
        return job.restored(start)

    filled(begin, again, description, store, client, share)
    return StoredExperiments(store)


@checked
class StoredExperiments:
    """Experiments in a store that `run_experiments(..., store=...)` fills.

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
                f"{gone[0]}: make the call that began it again to run them."
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
