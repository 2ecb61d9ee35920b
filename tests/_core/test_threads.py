"""Work on all cores."""

import threading

import numpy as np
import pytest

from hybridjax._core import threads


@pytest.mark.parametrize(("blas", "cores"), [("1", 2), ("2", 1), (None, 1)])
def test_cores_are_left_to_blas_unless_it_has_one_thread(monkeypatch, blas, cores):
    """In order, under the caller's treatment of overflow."""
    monkeypatch.setattr(threads, "core_count", lambda: 2)
    if blas is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", blas)
    met = threading.Barrier(cores)

    def work(k):
        met.wait(10.0)  # until as many are at work
        return k, np.float64(1e308) * k

    with np.errstate(over="ignore"):
        found = threads.on_all_cores(work, range(4))
    assert found == [(0, 0.0), (1, 1e308), (2, np.inf), (3, np.inf)]


def test_errors_are_raised():
    with pytest.raises(ZeroDivisionError):
        threads.on_all_cores(lambda k: 1 / k, [1, 0])
