"""Work in independent pieces, done by this process, by several, or by the workers of Dask."""

import time
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ...errors import DefinitionError
from ..arguments import package
from ..boundary.kinds import ExperimentCount, Index
from ..progress import counted, say
from .store import Layout, MemoryStore, ZarrStore, absolute, make_store, open_store


# Seconds for which a process waits for another one to begin a store, and between two checks.
_PATIENCE, _CHECK = 3600.0, 0.5


@runtime_checkable
class Job(Protocol):
    """Work in pieces whose results do not depend on who computes them, and in which order. Workers
    get it pickled."""

    @property
    def description(self) -> Mapping[str, Any]:
        """JSON from which the results can be told from those of other jobs."""
        ...

    def begin(self, client: "DaskClient | None") -> tuple["Job", Layout]:
        """Return the job with what is computed before the first piece, and the form of its
        results."""
        ...

    def arrays(self) -> list[np.ndarray]:
        """Return the arrays that `begin` computed."""
        ...

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "Job":
        """Return the job with the arrays that another process computed."""
        ...

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Compute piece k with so many threads. Default: all cores."""
        ...


@runtime_checkable
class DaskClient(Protocol):
    """A `distributed.Client`."""

    def submit(self, function: Any, *arguments: Any, **options: Any) -> Any: ...

    def register_plugin(self, plugin: Any, name: str) -> Any: ...


Workers = DaskClient | tuple[Index, ExperimentCount]
"""A `distributed.Client`, or the rank of this process and the number of all."""


def fill(job: Job, address: Any = None, workers: Workers | None = None) -> MemoryStore | ZarrStore:
    """Compute the pieces of a job that are missing, and return the results.

    **Arguments:** `address` of a store; None: memory. `workers`: a Dask client, or (rank, size) if
    several processes fill one store. Default: this process computes all pieces.

    **Raises:** `DefinitionError` for a store that holds other results or cannot be written, for a
    share without a store, and for a client whose workers cannot do the work; `ComputationError` if
    the cluster is lost; otherwise as the job. The store keeps what was computed.
    """
    client = None if isinstance(workers, tuple) else workers
    rank, size = workers if isinstance(workers, tuple) else (0, 1)
    if rank >= size:
        raise DefinitionError(
            f"`client` must be a Dask client, or (rank, size) with 0 <= rank < size, not {workers}."
        )
    if address is None:
        if size > 1:
            raise DefinitionError("a `client` of (rank, size) needs a `store` for its pieces.")
        job, layout = job.begin(client)
        store = MemoryStore(layout)
    else:
        address, description = absolute(address), job.description
        store = open_store(address, description)
        if store is None and rank > 0:
            say("waiting for the process of rank 0")
            deadline = time.monotonic() + _PATIENCE
            while (store := open_store(address, description)) is None:
                if time.monotonic() > deadline:
                    raise DefinitionError(
                        f"the process of rank 0 has not begun '{address}' for an hour."
                    )
                time.sleep(_CHECK)
        if store is None:
            job, layout = job.begin(client)
            store = make_store(address, layout, job.arrays())
        else:
            job = job.resume(store.layout, store.start)
    missing = [k for k in store.missing() if k % size == rank]
    if not missing:
        return store
    if client is None:
        for k in counted(missing, "pieces", len(missing)):
            store.write(k, job.run(k, None))
    else:
        package("distributed")
        from .cluster import run_on

        run_on(client, job, store, missing)
    return store


def call(job: Any, method: str, client: DaskClient | None = None) -> Any:
    """Return the result of a method of a job, computed by a worker if there is a client."""
    if client is None:
        return getattr(job, method)()
    package("distributed")
    from .cluster import call_on

    return call_on(client, job, method)
