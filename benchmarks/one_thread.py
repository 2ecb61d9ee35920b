"""One thread for everything in this process: call `pin` before numpy or jax is imported."""

import os


def pin() -> None:
    """One core, where the system lets a process choose (Linux), and one thread for BLAS."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
