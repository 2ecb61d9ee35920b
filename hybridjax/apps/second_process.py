"""A second process, which computes while this one does: threads of Python take turns."""

import contextlib
import importlib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from ..errors import ComputationError


@contextlib.contextmanager
def second_process(*modules: str) -> Iterator[ProcessPoolExecutor]:
    """An executor with one process, which begins at once to import these modules.

    **Raises:** `ComputationError` if the process ends before its work is done.
    """
    executor = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (modules,))
    try:
        executor.submit(int)  # the process starts with the first task
        yield executor
    except BrokenProcessPool as error:
        raise ComputationError(
            "the second process was ended from outside, perhaps for lack of memory: run it again."
        ) from error
    finally:
        executor.shutdown(cancel_futures=True)


def _begin(modules: tuple[str, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process handles interruptions
    # An accelerator's memory does not suffice for both. Arrays keep their digits on arrival.
    os.environ.update(JAX_PLATFORMS="cpu", JAX_ENABLE_X64="1")
    for module in modules:
        importlib.import_module(module)
