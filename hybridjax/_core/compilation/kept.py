"""Where compiled programs are kept, and when they may be used."""

import atexit
import contextlib
import functools as ft
import logging
import math
import os
import pathlib
import shutil
import tempfile
import threading
from collections.abc import Iterator

import jax

from ..device import on_cpu
from . import compilation_cache
from .loader_messages import silence
from .portable import Executable
from .program_store import ProgramStore


_log = logging.getLogger(__name__)
one_by_one = threading.Lock()


def store() -> ProgramStore:
    """Programs on disk: of this process only, without `enable_compilation_cache()`."""
    return ProgramStore((compilation_cache.folder() or _temporary_folder()) / "programs")


def find(name: str) -> Executable | None:
    """A compiled program on disk."""
    data = store().read(name)
    if data is None:
        return None
    try:
        with silence():
            return Executable.from_bytes(data)
    except Exception as error:  # whatever JAX raises for programs of another XLA
        _log.debug("a program on disk is not used: %s", error)
        return None


@contextlib.contextmanager
def once() -> Iterator[None]:
    """A context in which JAX writes no programs to its own cache."""
    name = "jax_persistent_cache_min_compile_time_secs"
    with one_by_one:
        before = getattr(jax.config, name)
        jax.config.update(name, math.inf)
        try:
            yield
        finally:
            jax.config.update(name, before)


def is_simple() -> bool:
    """Whether JAX computes on the first CPU, and runs programs as they are."""
    device = jax.config.jax_default_device
    first = device in (None, "cpu") or device == jax.local_devices(backend="cpu")[0]
    names = "jax_disable_jit", "jax_debug_nans", "jax_debug_infs"
    return on_cpu() and first and not any(getattr(jax.config, name) for name in names)


@ft.cache
def _temporary_folder() -> pathlib.Path:
    """One that is deleted when this process ends."""
    folder, owner = tempfile.mkdtemp(prefix="hybridjax-"), os.getpid()
    atexit.register(lambda: os.getpid() == owner and shutil.rmtree(folder, ignore_errors=True))
    return pathlib.Path(folder)


def _forget() -> None:
    """A forked process has none of the other threads, one of which may have held the lock."""
    global one_by_one
    one_by_one = threading.Lock()
    _temporary_folder.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
