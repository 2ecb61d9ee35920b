"""Which executable runs, where it may be used, and what is kept on disk."""

import gc
import os
import pathlib
import pickle
import shutil
import threading
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax._core import compilation, jax_compat
from hybridjax._core.compilation import Program, in_turn, kernel, quick_jit
from hybridjax._core.lanes import by_lane

from ..sessions import run_python


@quick_jit
def double(x):
    return 2 * x


@quick_jit
def wrong(x):
    raise ValueError("compiler_options are not to blame")


X = jnp.arange(3.0)
WAYS = {
    "plain": lambda f: f(X),
    "jit": lambda f: jax.jit(f)(X),
    "cond": lambda f: jax.lax.cond(True, lambda: f(X), lambda: X),
    "vmap": lambda f: jax.vmap(f)(X),
    "jvp": lambda f: jax.jvp(f, (X,), (X,))[1],
    "no jit": lambda f: jax.disable_jit()(f)(X),
}


@pytest.mark.parametrize("function", [double, Program(lambda x: 2 * x, False)])
@pytest.mark.parametrize("way", WAYS)
def test_programs_work_wherever_they_are_called(way, function):
    assert_array_equal(WAYS[way](function), 2 * X)


def test_errors_of_the_function_come_through():
    for call in (wrong, jax.jit(wrong), Program(wrong, False)):
        with pytest.raises(ValueError, match="not to blame"):
            call(X)
    assert gc.isenabled()


class Pair(NamedTuple):
    sum: jax.Array
    nothing: None


@pytest.fixture
def compiled(monkeypatch):
    """The options of all programs that are compiled, which begin with none."""
    compiled = []
    compile = jax.stages.Lowered.compile

    def count(self, compiler_options=None):
        compiled.append(compiler_options)
        return compile(self, compiler_options)

    monkeypatch.setattr(jax.stages.Lowered, "compile", count)
    compilation._by_kind.clear()
    compilation._by_text.clear()
    return compiled


def total(x, make, k):
    return Pair(make(x).sum() + k, None)


def test_functions_that_are_written_anew_share_a_program(compiled):
    job = Program(total, loops=False)
    for _ in range(3):
        job(X, lambda x: 2 * x, 1)
    assert len(compiled) == 1
    values = [
        job(X, lambda x: 3 * x, 1),
        job(X[:2], lambda x: 2 * x, 1),
        job(X, jnp.cos, 4),
    ]
    sums = [x.sum for x in values]
    of_cosine = jnp.cos(X).sum() + 4
    assert_allclose(sums, [10, 3, of_cosine])
    assert len(compiled) == 4


def test_a_large_job_does_not_wait_for_a_program_of_a_small_one(compiled):
    """Both have a program of their own, and lower the function once."""
    small = Program(total, loops=False)
    large = Program(total, loops=True)
    turns = (small, large, small, large)
    results = [job(X, jnp.sin, 1).sum for job in turns]
    assert_allclose(results, jnp.sin(X).sum() + 1)
    assert compiled == [jax_compat.quick_options(), jax_compat.loop_options()]
    assert len(compilation._by_kind) == 1


def point(power, tree, x, y):
    wave = jnp.sin(x) ** power
    return tree["k"] * 3.0 * wave + y


def plain(function, *trees):
    return by_lane(function, *trees)


@pytest.mark.parametrize("lanes", [1, 3, 4, 8])
def test_a_kernel_of_any_number_of_lanes(lanes):
    x = np.linspace(0.0, 1.0, 4)[None]
    y = np.ones((1, 1))
    before = len(compilation._kernels)
    for k in (1.0, 2.0):
        constants = {"k": jnp.asarray(k)}
        run = kernel(point, plain, (2,), (constants,), lanes)
        values = run(x, y)
        waves = k * 3 * np.sin(x) ** 2
        expected_values = waves + y
        assert_allclose(values, expected_values, rtol=1e-15)
    assert len(compilation._kernels) == before + 1
    some = np.array([False, True, False, True])
    values = kernel(point, plain, (2,), ({"k": jnp.asarray(1.0)},), lanes)(
        x, y, some=some
    )
    all_lanes = 3 * np.sin(x) ** 2 + y
    expected = all_lanes[:, some]
    assert_allclose(values[:, some], expected, rtol=1e-15)


def test_programs_that_call_lapack_take_turns():
    A = np.eye(2)
    Program(jnp.linalg.eigvals, False)(A)
    Program(jnp.linalg.matmul, False)(A, A)
    programs = compilation._by_kind.items()
    alone = {key[0]: program.alone for key, program in programs}
    assert alone[jnp.linalg.eigvals]
    assert not alone[jnp.linalg.matmul]
    inside = []
    counts = []
    met = threading.Barrier(2)

    def work():
        met.wait(10.0)
        for _ in range(100):
            with in_turn(True):
                inside.append(1)
                counts.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == [1] * 200


@pytest.fixture
def cache_setting():
    before = jax.config.jax_compilation_cache_dir
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_cache_is_a_folder_of_its_own(tmp_path, monkeypatch, cache_setting):
    """Nothing in the folder that is given is read or changed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared/jit_f-cache").write_bytes(b"a colleague's")
    for _ in range(2):
        folder = hj.scale.enable_compilation_cache("shared")
        assert folder == tmp_path / "shared/programs"
    assert jax.config.jax_compilation_cache_dir == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "shared/jit_f-cache").read_bytes() == b"a colleague's"
    assert {x.name for x in (tmp_path / "shared").iterdir()} == {
        "jit_f-cache",
        "programs",
    }


def test_programs_are_not_unpickled(monkeypatch):
    """A program is read from the cache while pickle does not work."""
    events = []
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.delattr(pickle, name)
    for _ in range(2):
        events.clear()
        program = jax.jit(lambda x: x + 1.2345)
        program.lower(jnp.ones(7)).compile()
    assert "/jax/compilation_cache/cache_hits" in events


ATTACKS = {
    "open to all": lambda x: (x / "programs").chmod(0o777),
    "open to a group": lambda x: (x / "programs").chmod(0o770),
    "exchanged by those who write the folder above": lambda x: x.chmod(0o777),
    "exchanged by the owner of the folder above": lambda x: os.chown(x, 12345, -1),
    "of another user": lambda x: os.chown(x / "programs", 12345, -1),
    "a link": lambda x: (x / "programs").symlink_to((x / "programs").rename(x / "y")),
    "a copy": lambda x: shutil.copytree(
        (x / "programs").rename(x / "y"), x / "programs"
    ),
    "a pipe in it": lambda x: os.mkfifo(x / "programs/jit_f-cache"),
    "a link in it": lambda x: (x / "programs/jit_f-cache").symlink_to(x),
    "a file of 30 GiB in it": lambda x: os.truncate(
        os.open(x / "programs/jit_f-cache", os.O_CREAT | os.O_WRONLY), 30 * 2**30
    ),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_cache_of_others_is_refused(tmp_path, attack, cache_setting):
    if "user" in attack or "owner" in attack:
        os.geteuid() == 0 or pytest.skip("only root gives files away")
    hj.scale.enable_compilation_cache(tmp_path / "x")
    (tmp_path / "x/programs/notes").symlink_to(__file__)  # which JAX does not read
    hj.scale.enable_compilation_cache(tmp_path / "x")
    ATTACKS[attack](tmp_path / "x")
    with pytest.raises(hj.errors.DefinitionError, match="give another folder"):
        hj.scale.enable_compilation_cache(tmp_path / "x")


def test_without_a_home_nothing_is_kept(tmp_path, monkeypatch, cache_setting):
    for name in ("HYBRIDJAX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for has_home in (True, False):
        if not has_home:
            monkeypatch.setattr(pathlib.Path, "home", raise_no_home)
        monkeypatch.setenv("HOME", "/dev/null")
        with pytest.warns(UserWarning, match="nothing is kept"):
            assert hj.scale.enable_compilation_cache() is None
    assert hj.scale.enable_compilation_cache(tmp_path) == tmp_path / "programs"


def raise_no_home():
    raise RuntimeError("Could not determine home directory.")


LATE = """
import jax, os, hybridjax as hj
from hybridjax._core.jax_compat import loops_are_kernels
always = loops_are_kernels()
try:
    hj.scale.enable_loop_kernels()
    print("done", always)
except hj.errors.ComputationError as error:
    print(os.environ.get("XLA_FLAGS"), error)
"""
LAPACK = """
import equinox as eqx, jax.numpy as jnp, numpy as np, hybridjax as hj
hj.enable_x64()

class Decay(hj.Chart):
    states = ("x", "y")
    def field(self, t, q, u):
        return -q[0] + u[0], -2 * q[1] + 0.0 * jnp.sin(2 * jnp.pi * t)

class Kicked(hj.HybridSystem):
    kick: hj.Parameter = hj.parameter(1.0)
    def charts(self):
        return {"a": Decay()}
    def transitions(self):
        def reset(t, q, u):
            A = jnp.array([[2.0, q[0]], [-1.0, 1.0]])  # its eigenvalues are left to LAPACK
            B = (2 + q[0] ** 2) * jnp.eye(33)  # and so is a system of so many equations
            x = jnp.linalg.eigvals(A).real.sum() + jnp.linalg.solve(B, jnp.ones(33))[0]
            return 0.1 * x + self.kick, 0.5 * q[1] + 0.2
        return [hj.Transition("kick", "a", "a", hj.systems.Scheduled(1.0), reset=reset)]
    def period(self):
        return 1.0

two = hj.scale.Execution(workers=2, batch=250)
cycle = hj.find_limit_cycle(Kicked(), hj.Guess("a", (0.5, 0.1), 0.5))
kicks = eqx.filter_vmap(lambda k: Kicked(kick=k))(jnp.linspace(0.5, 1.5, 500))
print(hj.orbits.find_limit_cycles(kicks, cycle, execution=two).summary())
u = 1e-3 * np.random.default_rng(0).normal(size=(500, 12, 1))
print(hj.run_experiments(cycle, hj.ClockPhase(4), u, ("x",), discard=0, execution=two).summary())
"""


def run(code: str, **environment: str) -> str:
    variables = os.environ.items()
    before = {k: v for k, v in variables if k != "XLA_FLAGS"}
    environment = before | {"JAX_PLATFORMS": "cpu"} | environment
    return run_python("-c", code, env=environment, timeout=900)


def test_loop_kernels_that_come_too_late_are_refused():
    """The options stay as they were; unless XLA makes whole loops by default."""
    printed = run(LATE)
    if printed.strip() == "done True":
        pytest.skip("this XLA makes single kernels of loops by default")
    assert printed.startswith(" XLA has read")
    assert "before JAX computes anything" in printed


@pytest.mark.slow
def test_two_workers_with_lapack_do_not_wait_for_each_other():
    printed = run(LAPACK)
    assert "500/500 found" in printed
    assert "500/500 ok" in printed
