"""How many cores a computation uses: compiled calls in threads, and BLAS in one.

Batches of experiments and of cycles call `in_threads`, large operations of NumPy `on_all_cores`.
Threads of BLAS would compete with these: `one_blas_thread` switches them off for the whole process
and counts how often it was entered, so that the last exit restores them. If a call is slow on many
cores, look whether `libraries` finds the OpenBLAS of NumPy and SciPy; others are left as they are.

Results must stand in the order of the items. The functions of another build of OpenBLAS are a line
in `_NAMES`. If calls in threads wait for each other for ever, look at `in_turn` (`compilation.py`).
"""

import contextlib
import ctypes
import dataclasses
import functools
import os
import pathlib
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy

from .boundary.checked import checked
from .boundary.kinds import ExperimentCount, WorkerCount
from .executor import default_device, on_cpu
from .precision import require_x64


@checked
@dataclasses.dataclass(frozen=True)
class Execution:
    """Batch size and threads of computations. They change results by rounding errors only.

    **Fields:**

    - `batch`: experiments or systems per compiled call. Another size requires another compilation.
      Default: the size that is usually fastest.
    - `workers`: threads that run such calls at the same time. Default: all cores on CPU, and one on
      an accelerator.

    **Example:**

    ```python
    single = hj.scale.Execution(workers=1)
    data = hj.run_experiments(cycle, sections, design, outputs, execution=single)
    ```

    **After:** `hj.run_experiments`, `hj.orbits.find_limit_cycles`.
    """

    batch: ExperimentCount | None = None
    workers: WorkerCount | None = None

    @property
    def threads(self) -> int:
        """The number of threads on this machine: `workers`, or its default."""
        return self.workers or (core_count() if on_cpu() else 1)


def in_threads(
    work: Callable[[Any], Any], items: Iterable[Any], workers: int
) -> Iterator[Any]:
    """`work` of each item, in order, under the caller's configuration of JAX. A single worker is
    the caller's own thread: in a new one the allocator of memory starts empty."""
    if workers == 1:
        yield from map(work, items)
        return
    device = default_device()  # which other threads would not know

    def configured(item):
        require_x64()
        with jax.default_device(device):
            return work(item)

    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(configured, items)


def on_all_cores(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """`work` of each item, in order: large operations of NumPy and SciPy, during which other
    threads can run. Each sees the caller's `np.errstate`.

    Threads of BLAS would be in the way of these: where they cannot be told to stop, the cores are
    left to them unless OPENBLAS_NUM_THREADS is 1.
    """
    alone = bool(libraries()) or os.environ.get("OPENBLAS_NUM_THREADS") == "1"
    with one_blas_thread(), ThreadPoolExecutor(core_count() if alone else 1) as pool:
        running = [pool.submit(copy_context().run, work, item) for item in items]
        return [future.result() for future in running]


def core_count() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# OpenBLAS divides matrices of a hundred columns among threads that wait for each other longer than
# they compute. Only the libraries in the wheels of NumPy and SciPy are known; other libraries
# (Accelerate, MKL, those of Linux distributions) are left as they are. Their functions have 64-bit
# or 32-bit integers, and a prefix or none.
_NAMES = (
    "scipy_openblas_{}_num_threads64_",
    "scipy_openblas_{}_num_threads",
    "openblas_{}_num_threads64_",
    "openblas_{}_num_threads",
)
_lock = threading.Lock()
_before: list[int] = []
_inside = 0


class Library(NamedTuple):
    """Functions of one OpenBLAS: its number of threads."""

    get: Callable[[], int]
    set: Callable[[int], Any]


@functools.cache
def libraries() -> list[Library]:
    """Return the libraries of NumPy and SciPy."""
    libraries = []
    for package in (np, scipy):
        root = pathlib.Path(str(package.__file__)).parent
        for folder in (root.with_name(f"{package.__name__}.libs"), root / ".dylibs"):
            for file in sorted(folder.glob("*openblas*")):
                with contextlib.suppress(OSError, StopIteration):
                    loaded = ctypes.CDLL(str(file))
                    name = next(x for x in _NAMES if hasattr(loaded, x.format("set")))
                    functions = (
                        getattr(loaded, name.format(what)) for what in ("get", "set")
                    )
                    libraries.append(Library(*functions))
    return libraries


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """A context in which BLAS uses one thread, in the whole process; also a decorator."""
    global _inside
    with _lock:
        if _inside == 0:
            _before[:] = [library.get() for library in libraries()]
            for library in libraries():
                library.set(1)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                for library, count in zip(libraries(), _before, strict=True):
                    library.set(count)
