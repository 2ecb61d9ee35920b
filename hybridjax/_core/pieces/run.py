"""Run work that is divided into independent pieces, in this process or on the workers of Dask.

A piece is a block of points (of a sweep, say) that one call computes. Called by `scale` and
`experiments/stored.py`.

The order in `fill` must stay: a job begins, or resumes what a store holds, before its first piece;
all pieces then have the same beginning. A new kind of job is an object with what `fill` asks for.

If a piece is computed again without need, look at `missing` of the store (`store.py`); if results
differ after an interruption, at `resume` of the job; if they differ, or fail, on workers, at
`cluster.py`.
"""

from typing import Any, Protocol, runtime_checkable

from ..arguments import package
from ..progress import counted
from .store import ArrayStore, ZarrStore, absolute, make_store, open_store


@runtime_checkable
class DaskClient(Protocol):
    """A `distributed.Client`."""

    def submit(self, function: Any, *arguments: Any, **options: Any) -> Any: ...

    def wait_for_workers(self, n_workers: int) -> Any: ...


def fill(
    job: Any, address: Any = None, client: DaskClient | None = None
) -> ArrayStore | ZarrStore:
    """Compute the pieces of a job that are missing, and return the results.

    **Arguments:**

    - `job`: an object that can be pickled, and whose results do not depend on who computes them, in
      which order. `blocks`: the pieces; `description`: JSON from which the results can be told from
      those of other jobs; `begin()`: the job with what is computed before the first piece, and the
      `Layout` of its results; `arrays()`: what `begin` computed; `resume(layout, arrays)`: the job
      with the arrays that another process computed; `run(k, workers)`: piece k, with so many
      threads.
    - `address` of a store; None: memory. `client`: a Dask client. Default: this process computes
      all pieces.

    **Raises:** `DefinitionError` for a store that holds other results or cannot be written, and for
    a client whose workers cannot do the work; `ComputationError` if the cluster is lost; otherwise
    as the job. The store keeps what was computed.
    """
    address = None if address is None else absolute(address)
    store = None if address is None else open_store(address, job)
    if store is not None:
        job = job.resume(store.layout, store.start)
    else:
        job, layout = job.begin()
        if address:
            store = make_store(address, layout, job.arrays())
        else:
            store = ArrayStore(layout)
    missing = store.missing()
    if missing and client is not None:
        package("distributed")
        from .cluster import run_on

        run_on(client, job, store, missing)
    else:
        for k in counted(missing, "pieces", len(missing)):
            store.write(k, job.run(k, None))
    return store
