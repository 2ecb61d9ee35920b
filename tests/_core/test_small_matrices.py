"""Factorizations that are written out give what LAPACK gives, without it."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.lanes.per_lane import by_lane
from hybridjax._core.vector_math.small_matrices import solve_positive


hj.enable_x64()
linalg = jax.scipy.linalg


def definite(A):
    return A @ A.T + 0.1 * jnp.eye(len(A))


FUNCTIONS = {
    "solve": jnp.linalg.solve,
    "inverse": lambda A, b: jnp.linalg.inv(A) @ b,
    "cho_solve": lambda A, b: linalg.cho_solve(linalg.cho_factor(definite(A)), b),
}


def samples(n, lanes=9):
    """The first number of the first matrix is zero: without pivoting nothing would be right."""
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(n, n, lanes)), rng.normal(size=(n, lanes))
    A[0, 0, 0] = 0.0
    return A, b


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_are_those_of_lapack(name):
    function, (A, b) = FUNCTIONS[name], samples(3)
    ours = by_lane(function)

    def value_and_gradient(f):
        return lambda A, b: (f(A, b), jax.grad(lambda A: jnp.sum(jnp.sin(f(A, b))))(A))

    program = jax.jit(value_and_gradient(ours))
    assert "lapack" not in program.lower(A, b).as_text()
    theirs = jax.jit(value_and_gradient(jax.vmap(function, -1, -1)))(A, b)
    for x, y in zip(program(A, b), theirs, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-10 * np.abs(y).max())


def test_a_single_lane_needs_no_lapack_either():
    A, b = samples(2, lanes=1)
    assert "lapack" not in jax.jit(by_lane(jnp.linalg.solve)).lower(A, b).as_text()


def test_matrices_that_are_not_positive_are_seen():
    singular = jnp.array([[1.0, 2.0], [2.0, 4.0]])
    tiny, matrices = 1e-30 * jnp.eye(2), [singular, -jnp.eye(2), jnp.zeros((2, 2))]
    found = jax.jit(jax.vmap(solve_positive))(jnp.stack([*matrices, tiny]), jnp.ones((4, 2)))
    np.testing.assert_allclose(found, [[np.nan] * 2] * 3 + [[1e30] * 2], rtol=1e-15)


THREADS = """
import equinox as eqx, jax.numpy as jnp, numpy as np, hybridjax as hj
hj.enable_x64()

class Swing(hj.Chart):
    states = ("a", "b", "va", "vb")
    def field(self, t, q, u):
        c = 0.5 * jnp.cos(q[0] - q[1])
        M = jnp.array([[3.0, c], [c, 1.0]])
        f = jnp.stack([jnp.sin(t) + u[0] - q[2], -q[3]]) - 4 * jnp.sin(q[:2])
        return jnp.concatenate([q[2:], jnp.linalg.solve(M, f)])

class Pendula(hj.HybridSystem):
    k: hj.Parameter = hj.parameter(1.0)
    def charts(self):
        return {"swing": Swing()}
    def period(self):
        return 2 * np.pi

cycle = hj.find_limit_cycle(Pendula(), hj.Guess("swing", (0.0, 0.0, 0.0, 0.0)))
u = 1e-3 * np.random.default_rng(0).normal(size=(64, 12, 4))
two = hj.Execution(workers=2, batch=32)
data = hj.run_experiments(cycle, hj.ClockPhase(4), u.reshape(64, 48), ("a",), execution=two)
print(data.summary())
"""


@pytest.mark.slow
def test_two_workers_that_solve_linear_systems_do_not_wait_for_each_other():
    found = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=300
    )
    assert "64/64 ok" in found.stdout, found.stderr
