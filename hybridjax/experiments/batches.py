"""Many experiments through one compiled program: batches of one size, in threads."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from .._core.execution import Execution, in_threads
from .._core.executor import on_cpu
from .._core.precision import single, single_precision


# Experiments of one compiled call: on CPU, where fewer share the cost of what is done once for all
# lanes, and twice as many leave the cache; and on accelerators, where twice as many need twice the
# memory.
_BATCH, _BATCH_ON_ACCELERATOR = {"double": 320, "single": 640}, 16384
# Fewer experiments than this are not split among workers. Twice as many leave cores idle in small
# jobs.
_UNDIVIDED = 32
# Batches are multiples of this, as processors add several numbers at once: others are up to a third
# slower. Twice this fills more of a last batch with repetitions.
_VECTOR = 8


def divide(S: int, execution: Execution) -> Execution:
    """`execution` with the size of batches for S experiments, and the number of threads that share
    them, filled in."""
    workers = execution.threads
    if execution.batch is not None:
        size = min(execution.batch, S)
    else:
        most = _BATCH[execution.precision] if on_cpu() else _BATCH_ON_ACCELERATOR
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
) -> Iterator[tuple[slice, Any]]:
    """Rows, and what `program` gives for them, batch after batch.

    **Arguments:** `program`, compiled, with experiments first in all that it returns;
    `arguments`, its arguments for some experiments, in double precision; `execution` as `divide`
    returns it.
    """
    size = execution.batch
    assert size is not None and execution.workers is not None

    def work(k: int):
        some = slice(k, k + size)
        if k + size > S:  # the last batch is filled up with repetitions
            some = np.arange(k, k + size) % S
        with precision_of(execution) as convert:
            out = program(*convert(arguments(some)))
        return jax.tree_util.tree_map(lambda x: np.asarray(x)[: S - k], out)

    parts = in_threads(work, range(0, S, size), execution.workers)
    for k, part in zip(range(0, S, size), parts, strict=True):
        yield slice(k, min(k + size, S)), part


@contextlib.contextmanager
def precision_of(execution: Execution):
    """A context of this precision, and what brings arguments to it."""
    if execution.precision == "double":
        yield lambda tree: tree
    else:
        with single_precision():
            yield single
