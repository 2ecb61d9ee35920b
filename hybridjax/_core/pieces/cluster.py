"""Pieces of work on the workers of a Dask cluster."""

import contextlib
import importlib
import math
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from typing import Any

from distributed import Client, as_completed
from distributed.scheduler import KilledWorker

from ...errors import ComputationError, DefinitionError, HybridJaxError
from ..progress import counted, say
from .job import Job
from .layout import Store
from .worker import Setup, method_of, nothing, work


# Part of a worker's time that may be spent on what a task costs beside its pieces. Halved, tasks
# are twice as long, and the end of a run waits longer for the last ones.
_OVERHEAD = 0.02
# Seconds of a task for each thread of the cluster, so that the scheduler, which gives them out one
# by one, keeps up (`benchmarks/scale.py`: workers). Halved, it does so on half as many workers.
_SCHEDULED = 2e-3
# Tasks that wait for each thread of a worker, so that none waits for work. Doubled, a lost worker
# takes twice as many with it.
_WAITING = 2
# How often a piece may take its worker with it; Dask has tried it several times by then.
_TRIES = 3
# Seconds between two looks at how many workers there are.
_LOOK = 2.0
_PACKAGES = ("hybridjax", "jax", "jaxlib", "numpy")


def run_on(client: Any, job: Job, store: Store, missing: Sequence[int]) -> None:
    """Do pieces on the workers of a client; see `run_pieces`."""
    with _cluster(client), _job(client, job, store.address) as name:
        _Run(client, name, store, missing).finish()


def call_on(client: Any, job: Any, method: str) -> Any:
    """What a method of a job gives, done by a worker."""
    with _cluster(client), _job(client, job, None) as name:
        return client.submit(method_of, name, method, pure=False).result()


@contextlib.contextmanager
def _cluster(client: Any) -> Iterator[None]:
    """A client that can do the work.

    **Raises:** `DefinitionError` if it cannot; `ComputationError` if it is lost meanwhile.
    """
    if not isinstance(client, Client):
        raise DefinitionError(
            f"`client` must be a distributed.Client, not a {type(client).__name__}: "
            "`from dask.distributed import Client`."
        )
    try:
        say("waiting for workers")
        client.wait_for_workers(1)
        _check_packages(client)
        say("")
        yield
    except (OSError, RuntimeError, CancelledError) as error:
        if isinstance(error, HybridJaxError) or client.status == "running":
            raise
        raise ComputationError(
            "the Dask cluster was lost while it worked. What is in a `store` is kept: make the "
            "same call again with a new client."
        ) from error


@contextlib.contextmanager
def _job(client: Client, job: Any, address: str | None) -> Iterator[str]:
    """The name of a job that all workers know."""
    name = f"hybridjax-{uuid.uuid4().hex}"
    plugin = Setup(name, job, address)
    _whoever_dies(client, lambda: client.register_plugin(plugin, name=name))
    try:
        yield name
    finally:
        if client.status == "running":
            _whoever_dies(client, lambda: client.unregister_worker_plugin(name))


def _whoever_dies(client: Client, talk: Callable[[], Any]) -> Any:
    """What is said to all workers, again where one of them dies meanwhile."""
    for _ in range(_TRIES):
        try:
            return talk()
        except (OSError, TimeoutError) as error:
            if client.status != "running":
                raise
            failed = error
            time.sleep(_LOOK)
    raise failed


def _check_packages(client: Client) -> None:
    """Refuse workers that cannot do the work, or would give other numbers."""
    find = "__import__('importlib').util.find_spec"
    # (A built-in function: those of this package are what a worker may not have.)
    expression = (
        f"(__import__('importlib.util'), {{x: __import__(x).__version__ for x in {_PACKAGES} "
        f"if {find}(x)}})[1]"
    )
    mine = {x: importlib.import_module(x).__version__ for x in _PACKAGES}
    found = _whoever_dies(client, lambda: client.run(eval, expression))
    for worker, theirs in found.items():
        for name, version in mine.items():
            if theirs.get(name) != version:
                has = f"has {name} {theirs[name]}" if name in theirs else f"lacks {name}"
                raise DefinitionError(
                    f"the Dask worker {worker} {has}, and this process has {version}: let workers "
                    "run in the same environment."
                )


class _Run:
    """Tasks of as many pieces as make their fixed cost small, a few for each thread at a time."""

    def __init__(self, client: Client, name: str, store: Store, missing: Sequence[int]):
        self.client, self.name, self.store = client, name, store
        self.left, self.tries = list(reversed(missing)), Counter[int]()
        self.fixed = self._fixed_cost()
        self.together, self.threads, self.looked = 1, 1, -math.inf

    def _fixed_cost(self) -> float:
        """Seconds that a task takes beside its work."""
        costs = []
        for _ in range(5):
            begin = time.monotonic()
            self.client.submit(nothing, pure=False).result()
            costs.append(time.monotonic() - begin)
        return min(costs)

    def finish(self) -> None:
        total = len(self.left)
        running: dict[Any, list[int]] = {}
        completed = as_completed()
        try:
            progress = counted(range(total), "pieces", total)
            next(progress)
            self._submit(running, completed)
            while running:
                future = next(completed)
                pieces = running.pop(future)
                for _ in range(self._take(future, pieces)):
                    next(progress, None)
                self._submit(running, completed)
            progress.close()
        finally:
            if self.client.status == "running":
                self.client.cancel(list(running))

    def _submit(self, running: dict[Any, list[int]], completed: as_completed) -> None:
        now = time.monotonic()
        if now - self.looked > _LOOK:
            self.threads, self.looked = max(sum(self.client.nthreads().values()), 1), now
        while self.left and len(running) < _WAITING * self.threads:
            # (At the end, work is shared evenly.)
            share = -(-len(self.left) // (_WAITING * self.threads))
            again = self.left[-1] in self.tries
            together = 1 if again else max(1, min(self.together, share))
            pieces = [self.left.pop() for _ in range(min(together, len(self.left)))]
            future = self.client.submit(work, self.name, pieces, pure=False)
            running[future] = pieces
            completed.add(future)

    def _take(self, future: Any, pieces: list[int]) -> int:
        """What a task has done; how many pieces it finished."""
        try:
            done, seconds = future.result()
        except KilledWorker as error:
            for k in pieces:
                self.tries[k] += 1
                if self.tries[k] == _TRIES:
                    raise ComputationError(
                        f"piece {k} has ended each worker that it was given to: too little memory, "
                        "or a fault in compiled code."
                    ) from error
            self.left += pieces
            return 0
        for k, values in zip(pieces, done, strict=True):
            if values is not None:
                self.store.write(k, values)
        long = max(self.fixed / _OVERHEAD, self.threads * _SCHEDULED)
        self.together = max(1, math.ceil(long / max(seconds, 1e-9)))
        return len(pieces)
