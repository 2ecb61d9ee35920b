"""Factorizations in vectorized arithmetic give what LAPACK gives, without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hybridjax._core.lanes import by_lane
from hybridjax._core.vector_math.factorizations import solve_by_columns, solve_positive
from hybridjax._core.vector_math.rewrite import vectorized


linalg = jax.scipy.linalg


def definite(A):
    square = A @ A.T
    return square + 0.1 * jnp.eye(len(A))


def by_cholesky(A, b):
    return linalg.cho_solve(linalg.cho_factor(definite(A)), b)


# With the numbers of rows: LU factors of more than 7 are computed in a loop.
FUNCTIONS = {
    "solve": (3, jnp.linalg.solve),
    "inverse": (3, lambda A, b: jnp.linalg.inv(A) @ b),
    "cho_solve": (3, by_cholesky),
    "solve in a loop": (8, jnp.linalg.solve),
    "solve by columns": (5, solve_by_columns),
}


def samples(n, lanes=9):
    """The first number of the first matrix is zero: without pivoting nothing would be right."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n, lanes))
    b = rng.normal(size=(n, lanes))
    A[0, 0, 0] = 0.0
    return A, b


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_are_those_of_lapack(name):
    n, function = FUNCTIONS[name]
    A, b = samples(n)

    def value_and_gradient(f):
        def loss(A, b):
            waves = jnp.sin(f(A, b))
            return jnp.sum(waves)

        def both(A, b):
            gradient = jax.grad(loss)(A, b)
            return f(A, b), gradient

        return both

    program = jax.jit(value_and_gradient(by_lane(function)))
    assert "lapack" not in program.lower(A, b).as_text()
    of_lanes = value_and_gradient(jax.vmap(function, -1, -1))
    theirs = jax.jit(of_lanes)(A, b)
    for x, y in zip(program(A, b), theirs, strict=True):
        tolerance = 1e-9 * np.abs(y).max()
        assert_allclose(x, y, rtol=1e-9, atol=tolerance)


@pytest.mark.parametrize(
    "function",
    [jnp.linalg.qr, jnp.linalg.eigh, jnp.linalg.svd],
    ids=["qr", "eigh", "svd"],
)
def test_other_factorizations_are_left_to_lapack(function):
    sample = samples(4)[0][..., 1]
    A = definite(sample)
    lowered = jax.jit(vectorized(function)).lower(A)
    assert "lapack" in lowered.as_text()


def test_matrices_that_are_not_positive_are_seen():
    singular = jnp.array([[1.0, 2.0], [2.0, 4.0]])
    tiny = 1e-30 * jnp.eye(2)
    matrices = [singular, -jnp.eye(2), jnp.zeros((2, 2))]
    x = jax.jit(jax.vmap(solve_positive))(
        jnp.stack([*matrices, tiny]), jnp.ones((4, 2))
    )
    unknown = [[np.nan] * 2] * 3
    known = [[1e30] * 2]
    assert_allclose(x, unknown + known, rtol=1e-15)
