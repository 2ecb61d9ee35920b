"""Pieces of work on the workers of a Dask cluster."""

import contextlib
import ctypes
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

import cloudpickle
import jax
import numpy as np
from distributed import Client, Reschedule, Worker, WorkerPlugin, as_completed
from distributed.scheduler import KilledWorker

from ...errors import ComputationError, DefinitionError, HybridJaxError
from ..cache import enable_compilation_cache
from ..progress import counted, say
from .store import ZarrStore


_PACKAGES = ["hybridjax", "jax", "jaxlib", "numpy"]
# Bytes of freed memory that a worker keeps. With less, the system clears every page again: a fifth
# of the time of a sweep. With more, a worker holds memory that it does not use.
_KEPT = 2**28
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # options of mallopt

# The jobs of this worker by name, each with its store.
_jobs: dict[str, tuple[Any, ZarrStore | None]] = {}


def run_on(client: Any, job: Any, store: ZarrStore, missing: Sequence[int]) -> None:
    """Compute pieces on the workers of a client.

    **Raises:** `DefinitionError` for a client whose workers cannot do it; `ComputationError` for a
    piece that ends its workers, and if the cluster is lost.
    """
    address = store.address if isinstance(store.address, str) else None
    with _job(client, job, address) as name:
        # Dask gives out the tasks again that a lost worker had.
        tasks = client.map(_piece, [name] * len(missing), missing, pure=False)
        pieces = dict(zip(tasks, missing, strict=True))
        del tasks  # a task whose result is written is forgotten
        try:
            for task in counted(as_completed(list(pieces)), "pieces", len(missing)):
                k = pieces.pop(task)
                try:
                    values = task.result()
                except KilledWorker as error:
                    raise ComputationError(
                        f"piece {k} has ended each worker that it was given to: too little "
                        "memory, or a fault in compiled code."
                    ) from error
                if values is not None:
                    store.write(k, values)
        finally:
            if client.status == "running":
                client.cancel(list(pieces))


@contextlib.contextmanager
def _job(client: Any, job: Any, address: str | None) -> Iterator[str]:
    """Give a job to all workers; the context is its name.

    **Raises:** `DefinitionError` if the workers cannot do it; `ComputationError` if the cluster is
    lost.
    """
    if not isinstance(client, Client):
        raise DefinitionError(
            f"`client` must be a distributed.Client, not a {type(client).__name__}: "
            "`from dask.distributed import Client`."
        )
    name = f"hybridjax-{uuid.uuid4().hex}"
    try:
        say("waiting for workers")
        client.wait_for_workers(1)
        _check_packages(client)
        say("")
        client.register_plugin(_Setup(name, job, address), name=name)
        try:
            yield name
        finally:
            if client.status == "running":
                with contextlib.suppress(OSError, TimeoutError):  # of a worker that has just ended
                    client.unregister_worker_plugin(name)
    except (OSError, RuntimeError, CancelledError) as error:
        if isinstance(error, HybridJaxError) or client.status == "running":
            raise
        raise ComputationError(
            "the Dask cluster was lost while it worked. What is in a `store` is kept: make the "
            "same call again with a new client."
        ) from error


def _check_packages(client: Client) -> None:
    """**Raises:** `DefinitionError` for workers that would compute other numbers, or none."""
    versions: Any = client.get_versions(packages=_PACKAGES)
    mine = versions["client"]["packages"]
    for worker, about in versions["workers"].items():
        for name in _PACKAGES:
            theirs = about["packages"].get(name)
            if theirs != mine[name]:
                has = f"has {name} {theirs}" if theirs else f"lacks {name}"
                raise DefinitionError(
                    f"the Dask worker {worker} {has}, and this process has {mine[name]}: let "
                    "workers run in the same environment."
                )


class _Setup(WorkerPlugin):
    """The job on every worker, also on those that start later."""

    def __init__(self, name: str, job: Any, address: str | None):
        self.name, self._address = name, address
        self._x64 = bool(jax.config.read("jax_enable_x64"))
        # (As bytes: arrays keep their digits only if the precision is set before they are made.)
        self._job = cloudpickle.dumps(job)

    def setup(self, worker: Worker) -> None:
        if self._x64:
            jax.config.update("jax_enable_x64", True)
        enable_compilation_cache()
        # Dask's nanny starts workers with MALLOC_TRIM_THRESHOLD_ = 65536.
        with contextlib.suppress(AttributeError, OSError):  # (glibc only)
            library = ctypes.CDLL(None)
            library.mallopt(_MMAP_THRESHOLD, _KEPT)
            library.mallopt(_TRIM_THRESHOLD, _KEPT)
        store = None if self._address is None else ZarrStore(self._address)
        _jobs[self.name] = cloudpickle.loads(self._job), store

    def teardown(self, worker: Worker) -> None:
        _jobs.pop(self.name, None)


def _piece(name: str, k: int) -> dict[str, np.ndarray] | None:
    """Compute a piece on a worker, which writes it if the job has a store and else returns it."""
    if name not in _jobs:
        raise Reschedule  # (the worker has just started, or is about to end)
    job, store = _jobs[name]
    if store is None:
        return job.run(k, 1)
    store.write(k, job.run(k, 1))
    return None
