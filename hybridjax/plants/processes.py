"""Experiments in processes that may fail, hang or end without harm to the others.

The processes are not those of `multiprocessing`: these would run the main script again, and cannot
be ended one by one.
"""

import contextlib
import json
import os
import pickle
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
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
        timer, began = threading.Timer(limit, worker.kill), time.monotonic()
        timer.start()
        try:
            for x in work:
                pickle.dump(x, worker.stdin)
            worker.stdin.flush()
            answer = pickle.load(worker.stdout)
        except (EOFError, pickle.UnpicklingError, OSError):
            local.worker, code = None, worker.wait()
            hung = f"no answer within the limit of {limit:g} s"
            ended = f"the process ended with code {code}"
            return Trial([], [], hung if time.monotonic() - began >= limit else ended)
        finally:
            timer.cancel()
        if isinstance(answer, str):
            text = "define it in a module that can be imported, or use `processes=0`"
            raise DefinitionError(f"another process cannot make the plant ({answer}): {text}.")
        return Trial(*answer)

    with ThreadPoolExecutor(processes) as pool:
        try:
            yield from pool.map(run, items)
        finally:
            for worker in begun:
                worker.kill()
                worker.communicate()


def resume(
    file: Any, about: str, count: int, run: Callable[[list[int]], Iterator[Trial]]
) -> list[Trial]:
    """Run the experiments that a file of SQLite (None: memory) lacks, and keep each as it ends.

    **Raises:** `DefinitionError` for a file of another kind.
    """
    try:
        with contextlib.closing(sqlite3.connect(file or ":memory:", isolation_level=None)) as base:
            base.execute("create table if not exists trials (about, s, trial, unique (about, s))")
            kept = dict(base.execute("select s, trial from trials where about = ?", [about]))
            missing = [s for s in range(count) if s not in kept]
            for s, trial in zip(missing, run(missing), strict=True):
                kept[s] = json.dumps(trial)
                base.execute("replace into trials values (?, ?, ?)", (about, s, kept[s]))
    except sqlite3.Error as error:
        raise DefinitionError(f"'{file}' is no store of experiments ({error}).") from error
    return [Trial(*json.loads(kept[s])) for s in range(count)]


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
    module = sys.modules.get(type(experiment.plant).__module__)
    try:
        try:
            import cloudpickle as packer
        except ImportError:
            packer = pickle
        else:
            if module is not None and module.__spec__ is None:  # (in no file)
                packer.register_pickle_by_value(module)
        return packer.dumps(experiment)
    except Exception as error:
        text = f"the plant cannot be pickled ({error})"
        raise DefinitionError(f"{text}: give it `__getstate__`, or use `processes=0`.") from error
