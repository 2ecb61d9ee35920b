"""Work on all cores, and none of BLAS beside it."""

import threading

import numpy as np
import pytest

from hybridjax._core import blas as blas_threads, threads
from hybridjax._core.blas import Library, one_blas_thread


@pytest.fixture
def library(monkeypatch):
    """One that uses four threads."""
    count = [4]
    one = Library(lambda: count[0], lambda n: count.__setitem__(0, n))
    monkeypatch.setattr(blas_threads, "libraries", lambda: [one])
    return one


def test_the_library_of_numpy_is_found():
    """In wheels. It can be told how many threads to use."""
    found = blas_threads.libraries()
    if not found:
        pytest.skip("NumPy has another BLAS here")
    before = [one.get() for one in found]
    with one_blas_thread():
        assert [one.get() for one in found] == [1] * len(found)
    assert [one.get() for one in found] == before


def test_threads_come_back(library):
    """After an error, and when the last of several has ended."""
    with pytest.raises(ZeroDivisionError), one_blas_thread():
        1 / 0  # noqa: B018
    assert library.get() == 4
    entered, leave = threading.Event(), threading.Event()

    @one_blas_thread()
    def other():
        entered.set()
        leave.wait(10.0)

    thread = threading.Thread(target=other)
    with one_blas_thread():
        thread.start()
        entered.wait(10.0)
    assert library.get() == 1
    leave.set()
    thread.join()
    assert library.get() == 4


@pytest.mark.parametrize(("blas", "cores"), [("1", 2), ("2", 1), (None, 1), ("known", 2)])
def test_cores_are_left_to_blas_unless_it_has_one_thread(monkeypatch, library, blas, cores):
    """In order, under the caller's treatment of overflow."""
    monkeypatch.setattr(threads, "core_count", lambda: 2)
    monkeypatch.setattr(threads, "libraries", lambda: [library] if blas == "known" else [])
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
