"""Experiments in processes that may fail, hang or end without harm to the others.

The processes are not those of `multiprocessing`: these would run the main script again, and cannot
be ended one by one.
"""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ..errors import DefinitionError
from .drive import Experiment, Trial


def run_all(
    experiment: Experiment, items: Iterable[tuple[int, Any]], processes: int, limit: float
) -> Iterator[Trial]:
    """Run experiments (seed, inputs) in processes with a limit of time, and yield them in order.
    Processes that ended are replaced.

    **Raises:** `DefinitionError` if the plant cannot be made in another process.
    """
    if not processes:
        yield from (experiment.run(*item) for item in items)
        return
    packed, local, begun = _pack(experiment), threading.local(), []

    def run(item: tuple[int, Any]) -> Trial:
        worker = getattr(local, "worker", None)
        work = [item]
        if worker is None:
            worker = local.worker = _start()
            begun.append(worker)
            work = [packed, item]
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            worker.kill()

        timer = threading.Timer(limit, expire)
        timer.start()
        try:
            for x in work:
                pickle.dump(x, worker.stdin)
            worker.stdin.flush()
            answer = pickle.load(worker.stdout)
        except (EOFError, pickle.UnpicklingError, OSError):
            local.worker, code = None, worker.wait()
            hung = f"no answer within the limit of {limit:g} s"
            return Trial(
                [], [], hung if expired.is_set() else f"the process ended with code {code}"
            )
        finally:
            timer.cancel()
        if isinstance(answer, str):
            raise DefinitionError(
                f"the plant cannot be made in another process, which raised {answer}: define it in "
                "a module that can be imported, or use `processes=0`."
            )
        return Trial(*answer)

    with ThreadPoolExecutor(processes) as pool:
        try:
            yield from pool.map(run, items)
        finally:
            for worker in begun:
                worker.kill()
                worker.communicate()


def _start() -> Any:
    # (One thread of BLAS: the processes use all cores. Path: that of this process.)
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), *sys.path]))
    command = [sys.executable, "-c", "from hybridjax.plants.drive import serve; serve()"]
    pipe, environment = subprocess.PIPE, {**os.environ, **threads, "PYTHONPATH": path}
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment)


def _pack(experiment: Experiment) -> bytes:
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
