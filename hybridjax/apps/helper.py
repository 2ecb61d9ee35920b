"""Another process, which works while this one does: Python's own threads take turns.

It is started before anything heavy is imported, so that both import at the same time.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from .._core.execution import core_count
from ..errors import ComputationError


class Helper:
    """Does one thing after another, in the order in which they are begun.

    Where there is only one core it is this process that does them. What is handed over is pickled;
    functions belong to modules. The process ends with the context, or with this one.
    """

    def __init__(self, *modules: str):
        """A helper that imports these modules to begin with."""
        self._done: list[Any] = []
        self._process = None
        if core_count() > 1:
            context = multiprocessing.get_context("spawn")
            self._line, other_end = context.Pipe()
            self._process = context.Process(target=_serve, args=(other_end, modules), daemon=True)
            self._process.start()
            other_end.close()

    def __enter__(self) -> "Helper":
        return self

    def __exit__(self, *_) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._line.close()

    def begin(self, work: Callable, *arguments: Any) -> None:
        """Begin `work(*arguments)`."""
        if self._process is None:
            self._done.append(work(*arguments))
        else:
            with contextlib.suppress(OSError):  # it has ended, as `result` will say
                self._line.send((work, arguments))

    def result(self) -> Any:
        """Of the first work that was begun and whose result nobody has asked for.

        **Raises:** what the work raised; `ComputationError` if the process has ended.
        """
        if self._process is None:
            return self._done.pop(0)
        try:
            good, result = self._line.recv()
        except (EOFError, OSError) as error:
            raise ComputationError(
                "the process that computes beside this one was ended from outside, perhaps for "
                "lack of memory: run it again."
            ) from error
        if not good:
            raise result
        return result


def _serve(line: Connection, modules: tuple[str, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interruption is for the other process
    # An accelerator's memory would not do for both. Arrays keep their digits on arrival.
    os.environ.update(JAX_PLATFORMS="cpu", JAX_ENABLE_X64="1")
    with contextlib.suppress(EOFError, OSError):  # it has ended
        for module in modules:
            importlib.import_module(module)
        while True:
            work, arguments = line.recv()
            try:
                answer = True, work(*arguments)
            except Exception as error:
                answer = False, error
            line.send(answer)
