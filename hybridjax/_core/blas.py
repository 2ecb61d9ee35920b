"""One thread for BLAS, while many problems of moderate size are solved.

OpenBLAS divides matrices of a hundred columns among threads that wait for each other longer than
they compute. Only what NumPy's and SciPy's wheels bring along is known; elsewhere (Accelerate, MKL,
the libraries of a distribution) nothing happens.
"""

import contextlib
import ctypes
import functools
import importlib.util
import pathlib
import threading
from collections.abc import Iterator
from typing import Any


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
