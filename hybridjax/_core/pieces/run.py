"""Pieces of work, each in any process: here, or on the workers of a Dask cluster."""

from typing import Any, Protocol, runtime_checkable

from ..arguments import package
from ..progress import counted
from .job import Job
from .layout import Store


@runtime_checkable
class DaskClient(Protocol):
    """A `distributed.Client`."""

    def submit(self, function: Any, *arguments: Any, **options: Any) -> Any: ...

    def register_plugin(self, plugin: Any, name: str) -> Any: ...


def run_pieces(
    job: Job, store: Store, client: DaskClient | None = None, share: tuple[int, int] = (0, 1)
) -> None:
    """Do all pieces that are missing in a store.

    **Arguments:** `client`, a `distributed.Client`; without it, this process does the work, or of
    all pieces those rank, rank + size, ... of its `share`.

    **Raises:** what the job raises; `DefinitionError` for a client that cannot do it;
    `ComputationError` where the cluster is lost. What was done remains in the store.
    """
    rank, size = share
    missing = [k for k in store.missing() if k % size == rank]
    if not missing:
        return
    if client is None:
        for k in counted(missing, "pieces", len(missing)):
            store.write(k, job.run(k, None))
    else:
        package("distributed")
        from .cluster import run_on

        run_on(client, job, store, missing)


def call(job: Any, method: str, client: DaskClient | None = None) -> Any:
    """What a method of a job gives, which a worker does if there is a client."""
    if client is None:
        return getattr(job, method)()
    package("distributed")
    from .cluster import call_on

    return call_on(client, job, method)
