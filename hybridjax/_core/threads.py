"""Compiled calls, and large ones of NumPy, on several cores."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any

import jax

from .blas import libraries, one_blas_thread
from .cores import core_count
from .device import on_cpu
from .precision import require_x64


def thread_count(workers: int | None) -> int:
    """How many threads to use: by default all cores on CPU, and one on an accelerator."""
    if workers is not None:
        return workers
    return core_count() if on_cpu() else 1


def in_threads(work: Callable[[Any], Any], items: Iterable[Any], workers: int) -> Iterator[Any]:
    """`work` of each item, in order, under the caller's configuration of JAX. A single worker is
    the caller's own thread: in a new one the allocator of memory starts empty."""
    if workers == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(_configured(work), items)


def on_all_cores(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """`work` of each item, in order: large operations of NumPy and SciPy, during which other
    threads can run. Each sees the caller's `np.errstate`.

    Threads of BLAS would be in the way of these: where they cannot be told to stop, the cores are
    left to them unless OPENBLAS_NUM_THREADS is 1.
    """
    alone = bool(libraries()) or os.environ.get("OPENBLAS_NUM_THREADS") == "1"
    with one_blas_thread(), ThreadPoolExecutor(core_count() if alone else 1) as pool:
        running = [pool.submit(copy_context().run, work, item) for item in items]
        return [one.result() for one in running]


def _configured(work):
    device = jax.config.jax_default_device  # which other threads would not know

    def configured(*arguments):
        require_x64()
        with jax.default_device(device):
            return work(*arguments)

    return configured
