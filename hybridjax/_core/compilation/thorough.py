"""Programs compiled thoroughly: by a process beside this one, that optimizes all it can.

What it writes are programs whose loops are single kernels (`loop_kernels.py`), which XLA can make
in a process of its own only, since it reads that option once. It says nothing, gives way to other
work, and ends with the process that started it.
"""

import atexit
import contextlib
import os
import pathlib
import subprocess
import sys
import threading

from .loop_kernels import with_loop_kernels
from .portable import Portable, build
from .program_store import ProgramStore


def start(folder: pathlib.Path, traced: str, compiled: str) -> subprocess.Popen | None:
    """A process that compiles a program of a store (`ProgramStore`) and writes it there, by their
    names; `None` where there can be none."""
    if not sys.executable or getattr(sys, "frozen", False):
        return None
    path = os.pathsep.join([str(pathlib.Path(__file__).parents[3]), *filter(None, sys.path)])
    environment = os.environ | {
        "PYTHONPATH": path,
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_X64": "1",
        "JAX_ENABLE_COMPILATION_CACHE": "0",
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "XLA_FLAGS": with_loop_kernels(os.environ.get("XLA_FLAGS")),
    }
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(folder), traced, compiled],
            stdin=subprocess.PIPE,  # closed by the system when this process ends, however it does
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
    except OSError:
        return None
    atexit.register(_end, process, os.getpid())
    return process


def _end(process: subprocess.Popen, owner: int) -> None:
    if os.getpid() == owner:  # and not one that was forked from it
        process.kill()
        process.wait()


def watch_parent() -> None:
    """End this process when the one that started it ends."""

    def watch():
        os.read(0, 1)  # returns when the other end is closed
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main(folder: str, traced: str, compiled: str) -> None:
    watch_parent()
    with contextlib.suppress(AttributeError):  # Windows has no such thing
        os.nice(10)
    store = ProgramStore(pathlib.Path(folder))
    program = store.read(traced)
    if program is not None:
        store.write(compiled, build(Portable.from_bytes(program), {}, kept=True).to_bytes())


if __name__ == "__main__":
    main(*sys.argv[1:])
