"""How many cores a computation uses: compiled calls in threads, and BLAS in one."""

import contextlib
import ctypes
import dataclasses
import functools
import importlib.util
import os
import pathlib
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, Literal

import jax

from .boundary.checked import checked
from .boundary.kinds import ExperimentCount, WorkerCount
from .executor import on_cpu
from .precision import require_x64


Precision = Literal["double", "single"]


@checked
@dataclasses.dataclass(frozen=True)
class Execution:
    """How many experiments, or many systems, are run. It changes no result beyond rounding.

    **Fields:**

    - `batch`: experiments or systems per compiled call, by default what is fastest. Another size
      compiles another program.
    - `workers`: threads that run such calls at the same time; by default all cores on CPU, and one
      on an accelerator.
    - `precision`: "double" or "single". Single precision computes experiments in 32 bits, while the
      cycle, the sections and the plan remain in 64. What rounding costs is measured on the cycle
      and is part of `ExperimentData.error`.
    """

    batch: ExperimentCount | None = None
    workers: WorkerCount | None = None
    precision: Precision = "double"

    @property
    def threads(self) -> int:
        """The number of threads that `workers` stands for on this machine."""
        return thread_count(self.workers)


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


def core_count() -> int:
    """That this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# What the functions are called, with integers of 64 bits or 32, with and without a prefix.
_NAMES = [
    f"{prefix}openblas_{{}}_num_threads{bits}" for prefix in ("scipy_", "") for bits in ("64_", "")
]
_lock = threading.Lock()
_before: list[int] = []
_inside = 0


class Library:
    """One OpenBLAS."""

    def __init__(self, get: Any, set: Any):
        self.get, self.set = get, set


@functools.cache
def libraries() -> list[Library]:
    """Those of NumPy and SciPy."""
    found = []
    for package in ("numpy", "scipy"):
        spec = importlib.util.find_spec(package)
        root = pathlib.Path(spec.origin).parent  # pyright: ignore
        for folder in (root.with_name(f"{package}.libs"), root / ".dylibs"):
            for file in sorted(folder.glob("*openblas*")):
                with contextlib.suppress(OSError, StopIteration):
                    found.append(_library(ctypes.CDLL(str(file))))
    return found


def _library(loaded: ctypes.CDLL) -> Library:
    """**Raises:** `StopIteration` if its functions have other names."""
    name = next(name for name in _NAMES if hasattr(loaded, name.format("set")))
    return Library(getattr(loaded, name.format("get")), getattr(loaded, name.format("set")))


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """A context in which BLAS uses one thread, in the whole process; also a decorator."""
    global _inside
    with _lock:
        if _inside == 0:
            _before[:] = [library.get() for library in libraries()]
            _set([1] * len(_before))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _set(_before)


def _set(counts: list[int]) -> None:
    for library, count in zip(libraries(), counts, strict=True):
        library.set(count)
