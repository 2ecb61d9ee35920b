"""Pieces on a cluster of two processes: the same to the last bit, whoever is killed."""

import os
import re
import shutil
import signal
import threading
import time
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj


distributed = pytest.importorskip("distributed")
pytest.importorskip("zarr")

DRAWS = 24
STEPS = 100


class Plane(hj.Chart):
    states = ("x", "v")

    def field(self, t, q, u):
        push = u[0] + jnp.cos(2 * jnp.pi * t)
        spring = 20.0 * q[0]
        return q[1], push - spring - 1.0 * q[1]


class Driven(hj.HybridSystem):
    """A damped oscillator, driven with period 1."""

    def charts(self):
        return {"all": Plane()}

    def period(self):
        return 1.0


def walk(rng):
    """A random computation that takes a while."""
    time.sleep(0.02)
    steps = rng.normal(size=(STEPS, 2)).cumsum(axis=0)
    farthest = np.abs(steps).max()
    return {"end": steps[-1], "far": farthest}


def fails(rng):
    value = rng.uniform()
    if value < 0.5:
        raise hj.errors.ComputationError("too small")
    return value


@pytest.fixture(scope="module")
def client():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def whole():
    return hj.scale.monte_carlo(walk, DRAWS, seed=7, chunk=2)


def test_draws_have_streams_of_their_own(whole):
    for i in (0, 3, DRAWS - 1):
        stream = np.random.SeedSequence(7, spawn_key=(i,))
        expected = walk(np.random.default_rng(stream))
        assert_array_equal(whole.end[i], expected["end"])
        assert whole.far[i] == expected["far"]
    fewer = hj.scale.monte_carlo(walk, 3, seed=7)
    assert_array_equal(fewer.end, whole.end[:3])


def test_draws_that_fail_are_named():
    found = hj.scale.monte_carlo(fails, 20, seed=1)
    assert 0 < found.failed.sum() < 20
    assert_array_equal(np.isnan(found.value), found.failed == 1)


def test_an_interruption_leaves_whole_pieces(tmp_path):
    expected = [
        np.random.default_rng(np.random.SeedSequence(0, spawn_key=(i,)))
        for i in range(10)
    ]
    expected = [rng.normal() for rng in expected]
    again = tmp_path / "again"
    seventh = expected[6]

    def drawn(rng):
        value = rng.normal()
        if value == seventh and not again.exists():
            raise KeyboardInterrupt
        return value

    with pytest.raises(KeyboardInterrupt):
        hj.scale.monte_carlo(drawn, 10, chunk=2, store=tmp_path / "draws.zarr")
    assert len(list(tmp_path.glob("draws.zarr/value/c/*"))) == 3
    again.touch()
    draws = hj.scale.monte_carlo(drawn, 10, chunk=2, store=tmp_path / "draws.zarr")
    assert_array_equal(draws.value, expected)


def test_draws_must_stay_alike():
    turns = iter([1.0, 1.0, 1j, 1.0, 1.0, {}])
    for function, message in (
        (lambda rng: np.ones(rng.integers(1, 1000)), "one type and shape: first"),
        (lambda rng: next(turns), "one type and shape: first <f8"),
        (lambda rng: next(turns), "same names: `value` is in some draws only"),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.scale.monte_carlo(function, 2)


def test_a_store_knows_its_function(tmp_path):
    first, other = (partial(np.random.Generator.normal, scale=x) for x in (1.0, 2.0))
    for _ in range(2):
        hj.scale.monte_carlo(first, 2, store=tmp_path / "draws.zarr")
    with pytest.raises(
        hj.errors.DefinitionError, match="its `function` is not the same"
    ):
        hj.scale.monte_carlo(other, 2, store=tmp_path / "draws.zarr")


@pytest.mark.parametrize(
    "harm", ["link", "linked folder", "pipe", "large", "shape", "absent", "start"]
)
def test_nothing_of_others_is_read_or_replaced(tmp_path, harm):
    """A store that was made to look like that of the call."""
    first = partial(np.random.Generator.normal)
    victim = tmp_path / "x"
    store = tmp_path / "s.zarr"
    hj.scale.monte_carlo(first, 4, chunk=2, store=store)
    values = store / "value"
    victim.mkdir()
    (victim / "1").write_text("mine")
    if harm == "linked folder":
        (values / "c").rename(tmp_path / "y")
        (values / "c").symlink_to(victim)
    elif harm == "shape":
        about = (values / "zarr.json").read_text()
        larger = re.sub(r"\b4\b", f"{10**12}", about, count=1)
        (values / "zarr.json").write_text(larger)
    elif harm == "absent":
        shutil.rmtree(values)
    elif harm == "start":
        (store / "start/zarr.json").write_bytes(b"\xff\xfe")
    elif harm == "large":
        os.truncate(values / "c/1", 30 * 2**30)
    else:
        (values / "c/1").unlink()
        (values / "c/1").symlink_to(victim / "1") if harm == "link" else os.mkfifo(
            values / "c/1"
        )
    with pytest.raises(hj.errors.DefinitionError, match=r"s\.zarr"):
        hj.scale.monte_carlo(first, 4, chunk=2, store=store)
    assert (victim / "1").read_text() == "mine"


@pytest.mark.slow
def test_a_cluster_gives_the_same_numbers(client, whole):
    assert hj.scale.monte_carlo(walk, DRAWS, seed=7, chunk=2, client=client).identical(
        whole
    )


def test_a_killed_worker_takes_nothing_with_it(client, whole, tmp_path):
    store = tmp_path / "draws.zarr"
    victim = client.cluster.workers[0].pid

    def watched(count):
        while len(list(store.glob("far/c/*"))) < count:
            time.sleep(0.01)
        os.kill(victim, signal.SIGKILL)

    killer = threading.Thread(target=watched, args=(4,))
    killer.start()
    draws = hj.scale.monte_carlo(
        walk, DRAWS, seed=7, chunk=2, client=client, store=store
    )
    killer.join()
    assert draws.load().identical(whole)
    times = {path: path.stat().st_mtime_ns for path in store.glob("far/c/*[0-9]")}
    assert len(times) == DRAWS // 2  # (beside them, the victim may leave a `.partial`)
    (store / "end/c/3/0").unlink()
    again = hj.scale.monte_carlo(
        walk, DRAWS, seed=7, chunk=2, store=store
    )  # goes on without a cluster
    assert again.load().identical(whole)
    changed = [
        path.name for path, before in times.items() if path.stat().st_mtime_ns != before
    ]
    assert changed == ["3"]


def test_workers_with_another_version_are_refused(client, whole, monkeypatch):
    versions = client.get_versions(packages=("hybridjax", "jax", "jaxlib", "numpy"))
    versions["client"]["packages"]["jax"] = "9.9"
    monkeypatch.setattr(client, "get_versions", lambda packages: versions)
    with pytest.raises(
        hj.errors.DefinitionError, match="has jax .*, and this process has 9.9"
    ):
        hj.scale.monte_carlo(walk, DRAWS, client=client)


def test_workers_with_other_code_are_refused(client, monkeypatch):
    class Mine(Driven):
        """One that workers cannot import."""

    with pytest.raises(
        hj.errors.DefinitionError, match="`Mine` is defined in the script or notebook"
    ):
        hj.scale.monte_carlo(lambda rng: Mine().period(), 2, client=client)
    monkeypatch.setitem(globals(), "STEPS", 50)
    with pytest.raises(
        hj.errors.DefinitionError, match="`walk` on a Dask worker is not what it is in"
    ):
        hj.scale.monte_carlo(walk, DRAWS, client=client)


@pytest.fixture(scope="module")
def experiments():
    """A stable linear oscillator with a clock: compiled in a moment."""
    guess = hj.Guess("all", (0.0, 0.0))
    cycle = hj.find_limit_cycle(Driven(), guess)
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(6, 4 * 14, 1))
    u = 0.1 * draws
    return cycle, hj.ClockPhase(4), u, "x"


@pytest.mark.slow
def test_workers_run_experiments_into_a_store(client, experiments, tmp_path):
    call = {"discard": 2, "chunk": 2}
    stored = hj.run_experiments(
        *experiments, store=tmp_path / "a.zarr", client=client, **call
    )
    alone = hj.run_experiments(*experiments, store=tmp_path / "b.zarr", **call)
    assert len(stored) == 3
    assert stored.missing() == []
    for mine, theirs in zip(alone, stored, strict=True):
        assert_array_equal(mine.y, theirs.y)
    data = list(stored)
    parts = hj.fit_series(stored, 2, check=False)
    whole = hj.fit_series(data, 2, check=False)
    assert_allclose(parts.coefficients, whole.coefficients, rtol=0, atol=1e-12)
    assert_allclose(parts.covariance, whole.covariance, rtol=1e-12)
    of_store = repr(hj.validate(whole, stored))
    of_data = repr(hj.validate(whole, data))
    assert of_store == of_data
