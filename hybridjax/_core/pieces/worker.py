"""What happens in a Dask worker."""

import time
from collections.abc import Sequence
from typing import Any

import cloudpickle
import jax
import numpy as np
from distributed import Reschedule, Worker, WorkerPlugin

from ..compilation import enable_compilation_cache
from .allocator import keep_freed_memory
from .zarr_store import ZarrStore


# The jobs of this worker by name, each with its store.
_jobs: dict[str, tuple[Any, ZarrStore | None]] = {}


class Setup(WorkerPlugin):
    """Brings a job to every worker, also to those that come later."""

    def __init__(self, name: str, job: Any, address: str | None):
        self.name, self._address = name, address
        self._x64 = bool(jax.config.read("jax_enable_x64"))
        # (As bytes: arrays keep their digits only where the precision has been set before.)
        self._job = cloudpickle.dumps(job)

    def setup(self, worker: Worker) -> None:
        if self._x64:
            jax.config.update("jax_enable_x64", True)
        enable_compilation_cache()
        keep_freed_memory()
        store = None if self._address is None else ZarrStore(self._address)
        _jobs[self.name] = cloudpickle.loads(self._job), store

    def teardown(self, worker: Worker) -> None:
        _jobs.pop(self.name, None)


def work(name: str, pieces: Sequence[int]) -> tuple[list[dict[str, np.ndarray] | None], float]:
    """Do some pieces of a job, and write them if it has a store.

    **Returns:** what was not written, and the seconds that a piece took.
    """
    if name not in _jobs:
        raise Reschedule  # (a worker that has just been started, or is about to end)
    job, store = _jobs[name]
    begin, done = time.monotonic(), []
    for k in pieces:
        if store is None:
            done.append(job.run(k, 1))
        elif not store.has(k):
            store.write(k, job.run(k, 1))
    return done or [None] * len(pieces), (time.monotonic() - begin) / len(pieces)


def method_of(name: str, method: str) -> Any:
    """What a method of a job gives."""
    return getattr(_jobs[name][0], method)()


def nothing() -> None:
    """A task without work, to see what one costs."""
