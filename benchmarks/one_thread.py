"""One thread for everything in this process: call `pin` before numpy or jax is imported."""

import os


BLAS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Cores that this process had before `pin`, for processes that it starts.
CORES = "BENCHMARK_CORES"


def pin() -> None:
    """One core, where the system lets a process choose (Linux), and one thread for BLAS."""
    os.environ.update(dict.fromkeys(BLAS, "1"))
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.environ[CORES] = " ".join(map(str, cores))
        os.sched_setaffinity(0, cores[-1:])


def unpin(count: int) -> int:
    """At most `count` cores again, in a process that a pinned one started.

    **Returns:** how many there are.
    """
    for name in BLAS:
        os.environ.pop(name, None)
    if not hasattr(os, "sched_setaffinity"):
        return min(count, os.cpu_count() or 1)
    if CORES in os.environ:
        os.sched_setaffinity(0, [int(x) for x in os.environ[CORES].split()][-count:])
    return len(os.sched_getaffinity(0))
