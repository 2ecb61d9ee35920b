"""Programs in two tiers, in memory and on disk."""

import subprocess
import sys
import threading
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybridjax._core.compilation import compilation_cache, fingerprint, kept, stored, thorough
from hybridjax._core.compilation.portable import Portable, build, trace
from hybridjax._core.compilation.program_store import ProgramStore
from hybridjax._core.compilation.stored import Stored


class Pair(NamedTuple):
    x: Any
    nothing: None


def twice(x, y, factor):
    return {"a": Pair(2 * x, None), "b": factor * jnp.sum(y)}


def fails(x):
    raise ValueError("not the store's fault")


X, Y = jnp.arange(3.0), np.ones((2, 2), np.float32)


def check(result, x=X):
    assert set(result) == {"a", "b"} and result["a"].nothing is None
    np.testing.assert_array_equal(result["a"].x, 2 * x)
    assert result["b"].dtype == Y.dtype and float(result["b"]) == 12.0


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """No program in memory, a folder on disk, and functions of these tests as if they were ours."""
    monkeypatch.setattr(fingerprint, "_PACKAGE", __name__.partition(".")[0])
    monkeypatch.setattr(compilation_cache, "_folder", tmp_path)
    monkeypatch.setattr(stored, "_programs", {})


@pytest.fixture
def made(monkeypatch):
    """What was traced and compiled, in order."""
    made = []

    def tracing(*arguments):
        made.append("traced")
        return trace(*arguments)

    def building(program, options, kept):
        made.append("quick" if options else "thorough")
        return build(program, options, kept)

    trace = stored.trace
    monkeypatch.setattr(stored, "trace", tracing)
    monkeypatch.setattr(stored, "build", building)
    return made


@pytest.fixture
def beside(monkeypatch):
    """Processes that compile thoroughly have ended when they are started."""

    def start(folder, traced, compiled):
        started.append(compiled)
        store = ProgramStore(folder)
        program = build(Portable.from_bytes(store.read(traced)), {}, kept=True)
        store.write(compiled, program.to_bytes())
        process = subprocess.Popen([sys.executable, "-c", ""])
        process.wait()
        return process

    started = []
    monkeypatch.setattr(thorough, "start", start)
    return started


def forget():
    stored._programs.clear()


def test_a_program_is_made_once_and_found_by_the_next_process(made, tmp_path):
    check(Stored(twice, large=False)(X, Y, 3))
    check(Stored(twice, large=False)(X + 1, Y, 3), X + 1)
    assert made == ["traced", "quick"]
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert made == ["traced", "quick"]
    assert float(Stored(twice, large=False)(X, Y, 4)["b"]) == 16.0
    assert Stored(twice, large=False)(X[:2], Y, 3)["a"].x.shape == (2,)
    assert made == ["traced", "quick"] * 3


def test_what_is_written_does_not_say_where_it_comes_from(made, tmp_path):
    @jax.named_scope("a_place_in_the_source")
    def named(x, y, factor):
        return twice(jnp.sin(x), y, factor)

    traced = trace(lambda *arrays: named(*arrays, 3.0), [X, Y])
    program = build(traced, {}, kept=True)
    assert b"a_place_in_the_source" in traced.code
    assert b"a_place_in_the_source" not in program.to_bytes()
    np.testing.assert_allclose(program(X, Y)["a"].x, 2 * np.sin(X), rtol=1e-15)


def test_without_a_folder_nothing_outlives_the_process(made, monkeypatch):
    monkeypatch.setattr(compilation_cache, "_folder", None)
    check(Stored(twice, large=False)(X, Y, 3))
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert made == ["traced", "quick", "quick"]


def test_programs_come_from_one_cache_only(made, tmp_path):
    """What JAX has loaded from its own cache on disk does not run if it is written once more."""
    for _ in range(3):
        check(Stored(twice, large=False)(X, Y, 3))
        (path,) = (tmp_path / "programs").glob("*-quick")
        path.unlink()
        forget()
    assert made == ["traced", "quick", "quick", "quick"]
    check(Stored(twice, large=False)(X, Y, 3))
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert len(made) == 5


@pytest.mark.parametrize("mishap", [b"", b"no program", b"\x80\x04N."])
def test_what_cannot_be_loaded_is_made_again(made, tmp_path, mishap):
    check(Stored(twice, large=False)(X, Y, 3))
    (path,) = (tmp_path / "programs").glob("*-quick")
    ProgramStore(path.parent).write(path.name, mishap)
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert made == ["traced", "quick", "quick"]
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert len(made) == 3


def test_what_is_used_is_compiled_thoroughly_for_the_next_job(made, beside, monkeypatch):
    monkeypatch.setattr(stored, "_WORTH_A_PROCESS", 100.0)
    job = Stored(twice, large=False)
    job(X, Y, 3)
    assert not beside
    monkeypatch.setattr(stored, "_WORTH_A_PROCESS", 0.0)
    for _ in range(2):  # one job does not change from one program to the other
        check(job(X, Y, 3))
    (known,) = stored._programs.values()
    assert len(beside) == 1 and set(known._programs) == {"quick"}
    check(Stored(twice, large=False)(X, Y, 3))
    assert len(beside) == 1 and set(known._programs) == {"quick", "thorough"}
    forget()
    check(Stored(twice, large=False)(X, Y, 3))
    assert made == ["traced", "quick"]


def test_a_large_job_waits(made, beside):
    check(Stored(twice, large=True)(X, Y, 3))
    assert made == ["traced"] and len(beside) == 1


@pytest.mark.parametrize("process", ["none", "dies"])
def test_a_large_job_does_without_another_process(made, monkeypatch, process):
    dead = lambda *_: subprocess.Popen([sys.executable, "-c", "raise SystemExit(1)"])  # noqa: E731
    monkeypatch.setattr(thorough, "start", dead if process == "dies" else lambda *_: None)
    check(Stored(twice, large=True)(X, Y, 3))
    assert made == ["traced", "thorough"]


def test_a_process_of_its_own(made, tmp_path):
    check(Stored(twice, large=True)(X, Y, 3))
    assert made == ["traced"]
    assert [path.name[-8:] for path in (tmp_path / "programs").glob("*-thorough")] == ["thorough"]


def test_a_process_that_compiles_ends_with_the_one_that_started_it():
    script = f"import {thorough.__name__} as x, time; x.watch_parent(); time.sleep(100)"
    process = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE)
    process.stdin.close()  # as the system does
    assert process.wait(60) == 1


def test_threads_make_a_program_once(made):
    results, job = [], Stored(twice, large=False)
    work = lambda: results.append(job(X, Y, 3))  # noqa: E731
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for result in results:
        check(result)
    assert len(results) == 4 and made == ["traced", "quick"]


def test_a_forked_process_shares_no_lock_and_no_folder(monkeypatch):
    monkeypatch.setattr(compilation_cache, "_folder", None)
    before = kept.store().folder
    stored._programs["key"] = stored._Known("key")
    kept.one_by_one.acquire()
    stored._forget()
    kept._forget()
    assert not stored._programs and kept.one_by_one.acquire(timeout=0)
    kept.one_by_one.release()
    assert kept.store().folder != before


PLAINLY = {
    "jit": lambda job: jax.jit(lambda x: job(x, Y, 3))(X),
    "jvp": lambda job: jax.jvp(lambda x: job(x, Y, 3), (X,), (X,))[0],
    "no digest": lambda job: job(X, Y, Three()),
    "debugging": lambda job: debugging(job),
}


class Three:
    def __mul__(self, x):
        return 3 * x


def debugging(job):
    with jax.debug_nans(True):
        return job(X, Y, 3)


@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("way", PLAINLY)
def test_what_cannot_be_kept_is_computed_all_the_same(made, way, large):
    check(PLAINLY[way](Stored(twice, large)))
    assert not made


def test_errors_of_the_function_come_through():
    with pytest.raises(ValueError, match="not the store's fault"):
        Stored(fails, large=False)(X)


@pytest.mark.parametrize("large", [False, True])
def test_transformations_go_through(made, large):
    job = Stored(twice, large)
    double = lambda x: job(x, Y, 3)["a"].x  # noqa: E731
    expected = 2 * np.eye(3)
    np.testing.assert_array_equal(jax.jacfwd(double)(X), expected)
    np.testing.assert_array_equal(jax.jit(jax.jacrev(double))(X), expected)
    np.testing.assert_array_equal(jax.vmap(double)(jnp.eye(3)), expected)
    square = lambda x: jnp.sum(double(x) ** 2)  # noqa: E731
    np.testing.assert_array_equal(jax.hessian(square)(X), 4 * expected)
    assert not made
