"""Programs that are left to LAPACK are known, and take turns."""

import subprocess
import sys
import threading

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation.lapack import in_turn, is_left_to_lapack


hj.enable_x64()


def test_they_are_known():
    A = np.eye(2)
    assert is_left_to_lapack(eqx.filter_jit(lambda A: jnp.linalg.eigvals(A)), A)
    assert not is_left_to_lapack(eqx.filter_jit(lambda A: A @ A), A)


def test_they_take_turns():
    inside, seen, met = [], [], threading.Barrier(2)

    def work():
        met.wait(10.0)
        for _ in range(100):
            with in_turn(True):
                inside.append(1)
                seen.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [1] * 200


THREADS = """
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
            A = jnp.array([[2.0, q[0]], [-1.0, 1.0]])  # eigvals of this are left to LAPACK
            B = (2 + q[0] ** 2) * jnp.eye(33)  # and so is a system of so many equations
            x = jnp.linalg.eigvals(A).real.sum() + jnp.linalg.solve(B, jnp.ones(33))[0]
            return 0.1 * x + self.kick, 0.5 * q[1] + 0.2
        return [hj.Transition("kick", "a", "a", hj.Scheduled(1.0), reset=reset)]
    def period(self):
        return 1.0

two = hj.Execution(workers=2, batch=250)
cycle = hj.find_limit_cycle(Kicked(), hj.Guess("a", (0.5, 0.1), 0.5))
kicks = eqx.filter_vmap(lambda k: Kicked(kick=k))(jnp.linspace(0.5, 1.5, 500))
print(hj.find_limit_cycles(kicks, cycle, execution=two).summary())
u = 1e-3 * np.random.default_rng(0).normal(size=(500, 12, 1))
print(hj.run_experiments(cycle, hj.ClockPhase(4), u, ("x",), discard=0, execution=two).summary())
"""


@pytest.mark.slow
def test_two_workers_do_not_wait_for_each_other():
    found = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=900
    )
    assert "500/500 found" in found.stdout and "500/500 ok" in found.stdout, found.stderr
