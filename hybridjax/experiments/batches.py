"""Many experiments through one compiled function: batches of one size, in threads."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from .._core.execution import Execution, in_threads
from .._core.executor import on_cpu
from .._core.progress import counted


# Experiments per compiled call. On CPU: fewer pay more for the work that is done once for all of
# them, more leave the cache. On accelerators: more need more memory.
_BATCH, _BATCH_ON_ACCELERATOR = 320, 16384
# Fewer experiments than this are not split among workers: smaller batches cost more than they gain.
_UNDIVIDED = 32
# Batches are multiples of this, the width of vector instructions: others take up to a third longer.
_VECTOR = 8


def divide(S: int, execution: Execution) -> Execution:
    """Return `execution` with the batch size for S experiments and the number of threads filled
    in."""
    workers = execution.threads
    if execution.batch is not None:
        size = min(execution.batch, S)
    else:
        most = _BATCH if on_cpu() else _BATCH_ON_ACCELERATOR
        # So many batches that all workers take equally many, and all batches of one size.
        rounds = -(-S // (most * workers))
        size = max(-(-S // (rounds * workers)), min(_UNDIVIDED, S))
        size = min(-(-size // _VECTOR) * _VECTOR, max(S, 1))
    return dataclasses.replace(execution, batch=size, workers=min(workers, -(-S // size)))


def in_batches(
    program: Callable[..., Any],
    arguments: Callable[[slice | np.ndarray], tuple],
    S: int,
    execution: Execution,
    name: str,
) -> Iterator[tuple[slice, Any]]:
    """Yield rows and the results of `program` for them, batch after batch.

    **Arguments:** `program`: compiled, with experiments first in all that it returns. `arguments`:
    returns its arguments for some experiments. `execution`: from `divide`.
    `name`: of the experiments, for the progress line.
    """
    size = execution.batch or S

    def work(k: int):
        rows = slice(k, k + size)
        if k + size > S:  # the last batch is filled up with repetitions
            rows = np.arange(k, k + size) % S
        out = program(*arguments(rows))
        return jax.tree_util.tree_map(lambda x: np.asarray(x)[: S - k], out)

    starts = range(0, S, size)
    parts = in_threads(work, starts, execution.workers or 1)
    for k, part in counted(zip(starts, parts, strict=True), f"batches of {name}", len(starts)):
        yield slice(k, min(k + size, S)), part
