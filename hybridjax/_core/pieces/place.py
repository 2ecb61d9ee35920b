"""Results in memory or in a store, filled here or by a cluster."""

import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...errors import DefinitionError
from ..progress import say
from .job import Job
from .layout import Layout, Store
from .memory import MemoryStore
from .run import run_pieces
from .zarr_store import ZarrStore, make_store, open_store


# Seconds for which a process waits for another one to begin a store, and between two looks.
_PATIENCE, _LOOK = 3600.0, 0.5


def filled(
    begin: Callable[[], tuple[Job, Layout, list[np.ndarray]]],
    again: Callable[[Layout, list[np.ndarray]], Job],
    description: Mapping[str, Any],
    address: Any,
    client: Any,
    share: tuple[int, int],
) -> Any:
    """Do the pieces of a job that are missing, and give the results.

    **Arguments:** `begin` makes the job and says what its results look like, and which arrays it
    was made of; `again` makes it from these arrays, where a store has them already. `description`,
    by which a store is known. `address` of the store; None: memory. `client`, see `run_pieces`.
    `share`, (rank, size) of this process.

    **Raises:** as `open_store`, `make_store` and `run_pieces`.
    """
    check_share(share)
    store: Store
    if address is None:
        if share != (0, 1):
            raise DefinitionError("a `share` needs a `store` to put its pieces into.")
        job, layout, _ = begin()
        store = MemoryStore(layout)
    else:
        address = absolute(address)
        there = open_store(address, description) if share[0] == 0 else _wait(address, description)
        if there is None:
            job, layout, start = begin()
            store = make_store(address, layout, start)
        else:
            store, job = there, again(there.layout, there.start)
    run_pieces(job, store, client, share)
    return store


def check_share(share: tuple[int, int]) -> None:
    """**Raises:** `DefinitionError` for a share that no process has."""
    rank, size = share
    if rank >= size:
        raise DefinitionError(f"`share` is (rank, size) with 0 <= rank < size, not {share}.")


def absolute(address: Any) -> str:
    """An address that means the same in another process."""
    address = str(address).removeprefix("file://")
    return address if "://" in address else os.path.abspath(address)


def _wait(address: str, description: Mapping[str, Any]) -> ZarrStore:
    """A store that another process begins."""
    say("waiting for the process of rank 0")
    begin = time.monotonic()
    while (store := open_store(address, description)) is None:
        if time.monotonic() - begin > _PATIENCE:
            raise DefinitionError(
                f"nobody has begun '{address}' for an hour: the process of rank 0 does it."
            )
        time.sleep(_LOOK)
    return store
