"""The part of `run.py` for Dask: hand pieces of work to the workers of a cluster, and check first
that the workers would compute the same numbers.

`run_on` is the entry. Results must be the same on all workers: if workers are refused without need,
look at `_check_packages` (versions) and `_unpacked` (users' modules); if a job cannot be sent, at
`_Packer`. Files are written by the workers or here, never by both for one piece.
"""

import contextlib
import ctypes
import functools
import io
import threading
import types
from collections.abc import Sequence
from concurrent.futures import CancelledError
from typing import Any

import cloudpickle
import equinox as eqx
import numpy as np
from distributed import Client, as_completed
from distributed.scheduler import KilledWorker

from .. import jax_compat
from ..cache import enable_compilation_cache
from ..exceptions import ComputationError, DefinitionError, HybridJaxError
from ..meaning import meaning
from ..progress import counted, say
from ..reading import is_packaged
from .store import ArrayStore, ZarrStore


_PACKAGES = ["hybridjax", "jax", "jaxlib", "numpy"]
# Bytes of freed memory that a worker keeps. With less, the system clears every page again: a fifth
# of the time of a sweep. With more, a worker holds memory that it does not use.
_KEPT = 2**28

_lock = threading.Lock()


def run_on(
    client: Any,
    job: Any,
    store: ArrayStore | ZarrStore,
    missing: Sequence[int],
) -> None:
    """Compute pieces on the workers of a client.

    **Raises:** `DefinitionError` for a client whose workers cannot do it; `ComputationError` for a
    piece that ends its workers, and if the cluster is lost.
    """
    try:
        say("waiting for workers")
        client.wait_for_workers(1)
        _check_packages(client)
        say("")
        _run(client, job, store, missing)
    except (OSError, RuntimeError, CancelledError) as error:
        if isinstance(error, HybridJaxError) or client.status == "running":
            raise
        raise ComputationError(
            "the Dask cluster is lost: call again with a new client."
        ) from error


def _run(
    client: Client,
    job: Any,
    store: ArrayStore | ZarrStore,
    missing: Sequence[int],
) -> None:
    """Send the job once and a task for each piece; write the values that tasks return."""
    # (As bytes: arrays keep their digits only if the precision is set before they are made.)
    packed = _packed((job, store.address))
    x64 = jax_compat.has_double_precision()
    # If a worker is lost, Dask runs its tasks again, and also the tasks whose results they need.
    needed = client.submit(bytes, packed, pure=False)
    tasks = client.map(_piece, missing, packed=needed, x64=x64, pure=False)
    pieces = dict(zip(tasks, missing, strict=True))
    del tasks  # a task whose result is written is forgotten
    try:
        for task in counted(as_completed(list(pieces)), "pieces", len(missing)):
            k = pieces.pop(task)
            try:
                values = task.result()
            except KilledWorker as error:
                raise ComputationError(
                    f"piece {k} has ended each worker that it was given to: give workers more "
                    "memory."
                ) from error
            if values is not None:
                store.write(k, values)
    finally:
        if client.status == "running":
            client.cancel(list(pieces))


class _Packer(cloudpickle.Pickler):
    """A pickler that lists what workers will import from users' modules, with digests."""

    imported: list[tuple[Any, str]]

    def reducer_override(self, obj: Any) -> Any:
        way = super().reducer_override(obj)
        if way is not NotImplemented:
            if isinstance(obj, type) and issubclass(obj, eqx.Module):
                raise DefinitionError(
                    f"`{obj.__name__}` is defined in the script or notebook: put it into a module."
                )
            return way
        if isinstance(obj, types.FunctionType | types.ModuleType | type):
            if not is_packaged(getattr(obj, "__module__", obj.__name__)):
                # (Errors may be of a module's other functions.)
                with contextlib.suppress(DefinitionError):
                    self.imported.append((obj, meaning(obj)))
        return way


def _packed(job: Any) -> bytes:
    """The job as bytes, with the digests of what workers import from users' modules."""
    file = io.BytesIO()
    packer = _Packer(file)
    packer.imported = []
    packer.dump(job)
    return cloudpickle.dumps((packer.imported, file.getvalue()))


def _check_packages(client: Client) -> None:
    """**Raises:** `DefinitionError` for workers that would compute other numbers, or none."""
    versions: Any = client.get_versions(packages=_PACKAGES)
    mine = versions["client"]["packages"]
    for worker, about in versions["workers"].items():
        for name in _PACKAGES:
            theirs = about["packages"].get(name)
            if theirs != mine[name]:
                raise DefinitionError(
                    f"the Dask worker {worker} has {name} {theirs}, and this process has "
                    f"{mine[name]}: use one environment."
                )


def _piece(k: int, packed: bytes, x64: bool) -> dict[str, np.ndarray] | None:
    """Compute a piece on a worker, which writes it if the job has a store and else returns it."""
    with _lock:
        job, store = _unpacked(packed, x64)
    if store is None:
        return job.run(k, 1)
    store.write(k, job.run(k, 1))
    return None


@functools.lru_cache(maxsize=4)  # a job keeps its compiled programs from piece to piece
def _unpacked(packed: bytes, x64: bool) -> tuple[Any, ZarrStore | None]:
    """Set up this process of a worker, and make the job and its store again.

    **Raises:** `DefinitionError` if a function or class in a user's module is not the same here.
    """
    # The precision comes first: arrays that are made before it lose digits.
    if x64:
        jax_compat.use_double_precision()
    enable_compilation_cache()
    # Dask's nanny starts workers with MALLOC_TRIM_THRESHOLD_ = 65536.
    with contextlib.suppress(AttributeError, OSError):  # (glibc only)
        library = ctypes.CDLL(None)
        library.mallopt(-3, _KEPT)  # M_MMAP_THRESHOLD
        library.mallopt(-1, _KEPT)  # M_TRIM_THRESHOLD
    imported, packed = cloudpickle.loads(packed)
    for x, digest in imported:
        if meaning(x) != digest:
            raise DefinitionError(
                f"`{x.__name__}` on a Dask worker is not what it is in this process: after changes "
                "of it, call `client.restart()`."
            )
    job, address = cloudpickle.loads(packed)
    return job, None if address is None else ZarrStore(address)
