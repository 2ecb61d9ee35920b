"""Experiments in processes that may fail, hang or end without harm to the others.

The processes are not those of `multiprocessing`: these would run the main script again, and cannot
be ended one by one.
"""

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ..errors import DefinitionError
from .drive import Experiment, Trial


class Worker:
    """A process with its own copy of a plant. `limit`: time for one answer in seconds.

    **Raises:** `DefinitionError` if the plant cannot be made in another process.
    """

    def __init__(self, packed: bytes, limit: float):
        # (One thread of BLAS: the processes use all cores. Path: that of this process.)
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        command = [sys.executable, "-m", "hybridjax.plants.worker"]
        path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), *sys.path]))
        environment = {**os.environ, **threads, "PYTHONPATH": path}
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment)
        self._limit, self._late = limit, False
        self._send(sys.path)
        self._send(packed)
        problem = self._receive()
        if problem != "":
            self.close()
            text = "ended" if problem is None else f"raised {problem}"
            raise DefinitionError(
                f"the plant cannot be made in another process, which {text}: define it in a module "
                "that can be imported, or use `processes=0`."
            )

    def run(self, seed: int, u: Any) -> Trial:
        """Run one experiment. The worker cannot be used again if the trial is empty."""
        self._send((seed, u))
        answer = self._receive()
        if answer is not None:
            return Trial(*answer)
        code = self._process.wait()
        hung = f"no answer within the limit of {self._limit:g} s"
        return Trial([], [], hung if self._late else f"the process ended with code {code}")

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        self._process.wait()

    def _send(self, x: Any) -> None:
        with contextlib.suppress(OSError):  # (of an ended process: there will be no answer)
            pickle.dump(x, self._process.stdin)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]

    def _receive(self) -> Any:
        """Return an answer; None if the process has ended, or was ended at its limit of time."""

        def expire() -> None:
            self._late = True
            self._process.kill()

        timer = threading.Timer(self._limit, expire)
        timer.start()
        try:
            return pickle.load(self._process.stdout)  # type: ignore[arg-type]
        except (EOFError, pickle.UnpicklingError, OSError):
            return None
        finally:
            timer.cancel()


class Workers:
    """Any number of workers; a context. Workers that ended are replaced."""

    def __init__(self, experiment: Experiment, processes: int, limit: float):
        self._experiment, self._processes, self._limit = experiment, processes, limit
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        if processes:
            self._packed = pack(experiment)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: Any) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._idle.get_nowait().close()

    def run(self, items: Iterable[tuple[int, Any]]) -> Iterator[Trial]:
        """Run experiments (seed, inputs), and yield them in order."""
        if not self._processes:
            yield from (self._experiment.run(*item) for item in items)
            return
        with ThreadPoolExecutor(self._processes) as pool:
            running = [pool.submit(self._one, *item) for item in items]
            try:
                for future in running:
                    yield future.result()
            finally:
                for future in running:
                    future.cancel()

    def _one(self, seed: int, u: Any) -> Trial:
        try:
            worker = self._idle.get_nowait()
        except queue.Empty:
            worker = Worker(self._packed, self._limit)
        trial = worker.run(seed, u)
        if worker.alive:
            self._idle.put(worker)
        else:
            worker.close()
        return trial


def pack(experiment: Experiment) -> bytes:
    """Return a pickle; of classes in notebooks and scripts by cloudpickle, where it is installed.

    **Raises:** `DefinitionError` for a plant that cannot be pickled.
    """
    try:
        import cloudpickle as packer
    except ImportError:
        packer = pickle
    try:
        return packer.dumps(experiment)
    except Exception as error:
        raise DefinitionError(
            f"the plant cannot be pickled ({error}): give it `__getstate__`, or use `processes=0`."
        ) from error
