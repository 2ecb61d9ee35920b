"""Work on all cores, and none of BLAS beside it."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hybridjax._core import execution
from hybridjax._core.compilation import host_first
from hybridjax._core.execution import Execution, Library, on_all_cores, one_blas_thread
from hybridjax._core.executor import on_cpu, on_host, solve
from hybridjax.linear.frequency_response import harmonic_transfer
from hybridjax.linear.time_response import periodic_states


def test_the_default_device_counts_more_than_the_backend(monkeypatch):
    """A CPU that is asked for on a machine with a GPU is a CPU."""
    assert on_cpu()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not on_cpu()
    assert Execution().threads == 1
    with jax.default_device("cpu"):
        assert on_cpu()
        used = jnp.ones(1).devices()
        cpu = jax.devices("cpu")[0]
        assert used == {cpu}
    assert not on_cpu()


def test_a_machine_with_a_gpu_computes_few_lanes_on_its_cpu(monkeypatch):
    executors = []
    function = host_first(lambda x: (executors.append(on_host(x)), 2 * x)[1])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    used = function(jnp.ones(1)).devices()
    assert used == {jax.devices("cpu")[0]}
    assert executors == [True]


def test_programs_factorize_one_matrix_at_a_time():
    """Two stacks in one program wait for each other's threads for ever on two cores (JAX 0.10)."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(8, 3, 3))
    B = rng.normal(size=(8, 3, 2))
    C = rng.normal(size=(8, 1, 3))
    u = rng.normal(size=(1, 5, 8, 2))
    matrices = rng.normal(size=(3, 2, 4, 4))
    right = rng.normal(size=(4, 1))
    exact = np.linalg.solve(matrices, right)
    assert_allclose(jax.jit(solve)(matrices, right), exact, rtol=1e-10)
    for program, arguments in (
        (solve, (matrices, right)),
        (harmonic_transfer, (A, B, C, np.zeros((8, 1, 2)), np.arange(9.0) / 9)),
        (periodic_states, (A, B, u)),
    ):
        calls = (
            jax.jit(program)
            .lower(*map(jnp.asarray, arguments))
            .as_text()
            .split("getrf_ffi")
        )
        assert len(calls) == 2
        assert 'num_batch_dims = "0"' in calls[1]


@pytest.fixture
def library(monkeypatch):
    """One that uses four threads."""
    count = [4]
    library = Library(lambda: count[0], lambda n: count.__setitem__(0, n))
    monkeypatch.setattr(execution, "libraries", lambda: [library])
    return library


def test_the_libraries_of_numpy_and_scipy_use_one_thread():
    libraries = execution.libraries()
    if not libraries:
        pytest.skip("NumPy has another BLAS here")
    before = [x.get() for x in libraries]
    with one_blas_thread():
        numbers = [x.get() for x in libraries]
        assert numbers == [1] * len(libraries)
    assert [x.get() for x in libraries] == before


def test_threads_come_back(library):
    """After an error, and when the last of several has ended."""
    with pytest.raises(ZeroDivisionError), one_blas_thread():
        1 / 0  # noqa: B018
    assert library.get() == 4
    entered = threading.Event()
    leave = threading.Event()

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


def test_work_on_all_cores_is_in_order_under_the_callers_settings(library):
    with np.errstate(over="ignore"):
        assert on_all_cores(lambda k: np.float64(1e308) * k, range(3)) == [
            0.0,
            1e308,
            np.inf,
        ]
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda k: 1 / k, [1, 0])
