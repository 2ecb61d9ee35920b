"""Factorizations in loops give what LAPACK gives, without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.lanes.per_lane import by_lane
from hybridjax._core.vector_math.rewrite import vectorized


hj.enable_x64()
linalg = jax.scipy.linalg


def by_triangle(A, b):
    Q, R = jnp.linalg.qr(A)
    return linalg.solve_triangular(R, Q.T @ b)


def by_eigenvectors(A, b):
    values, V = jnp.linalg.eigh(A + A.T)
    return V @ (jnp.exp(-values) * (V.T @ b))


def definite(A):
    return A @ A.T + 0.1 * jnp.eye(len(A))


# With the numbers of rows: those of four are in loops, too, where `small_matrices` has nothing.
FUNCTIONS = {
    "det": (4, lambda A, b: jnp.linalg.det(A) * b),
    "slogdet": (4, lambda A, b: jnp.linalg.slogdet(A)[1] * b),
    "Q R": (4, by_triangle),
    "lstsq": (4, lambda A, b: jnp.linalg.lstsq(A[:, 1:], b)[0]),
    "eigh": (4, by_eigenvectors),
    "solve": (14, jnp.linalg.solve),
    "cho_solve": (14, lambda A, b: linalg.cho_solve(linalg.cho_factor(definite(A)), b)),
}
MORE = {
    "wide lstsq": (5, lambda A, b: jnp.linalg.lstsq(A[1:], b[1:])[0]),
    "singular values": (4, lambda A, b: jnp.linalg.svd(A, compute_uv=False) * b),
    "complete Q R": (4, lambda A, b: jnp.linalg.qr(A[:, 1:], mode="complete")[0] ** 2 @ b),
    "pinv": (4, lambda A, b: jnp.linalg.pinv(A[1:]) @ b[1:]),
    "inverse": (14, lambda A, b: jnp.linalg.inv(A) @ b),
}


def samples(n, lanes=5):
    """The first number of the first matrix is zero: without pivoting nothing would be right."""
    rng = np.random.default_rng(n)
    A, b = rng.normal(size=(n, n, lanes)), rng.normal(size=(n, lanes))
    A[0, 0, 0] = 0.0
    return A, b


@pytest.mark.parametrize(
    "n, function",
    [
        *(pytest.param(*x, id=name) for name, x in FUNCTIONS.items()),
        *(pytest.param(*x, id=name, marks=pytest.mark.slow) for name, x in MORE.items()),
    ],
)
def test_values_and_derivatives_are_those_of_lapack(n, function):
    A, b = samples(n)

    def value_and_gradient(f):
        return lambda A, b: (f(A, b), jax.grad(lambda A: jnp.sum(jnp.sin(f(A, b))))(A))

    program = jax.jit(value_and_gradient(by_lane(function)))
    assert "lapack" not in program.lower(A, b).as_text()
    theirs = jax.jit(value_and_gradient(jax.vmap(function, -1, -1)))(A, b)
    for x, y in zip(program(A, b), theirs, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9 * np.abs(y).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["det", "Q R", "lstsq", "eigh"])
def test_second_derivatives(name):
    n, function = FUNCTIONS[name]
    A, b = (x[..., 1] for x in samples(n))
    curvature = lambda f: jax.jit(jax.hessian(lambda A: jnp.sum(jnp.sin(f(A, b)))))(A)  # noqa: E731
    ours, theirs = curvature(vectorized(function)), curvature(function)
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())


def test_matrices_that_are_singular():
    """A determinant and its derivative, and a least squares' problem without one solution."""
    A = np.diag([1.0, 2.0, 3.0, 0.0])

    @jax.jit
    def found(A):
        det = vectorized(jnp.linalg.det)
        return det(A), jax.grad(det)(A), vectorized(lambda A: jnp.linalg.lstsq(A, A @ A[0])[0])(A)

    value, gradient, least = found(A)
    assert value == 0.0
    np.testing.assert_allclose(gradient, np.diag([0.0, 0.0, 0.0, 6.0]), atol=1e-14)
    np.testing.assert_allclose(least, [1.0, 0.0, 0.0, 0.0], atol=1e-14)


# Matrices at which a column is zero below the diagonal, and in one is nothing else.
AT_ZEROS = {
    "diagonal": np.diag([1.0, -2.0, 3.0, 4.0]),
    "triangular": np.triu(np.arange(1.0, 17.0).reshape(4, 4) % 7 - 3.5),
}


@pytest.mark.parametrize("A", AT_ZEROS.values(), ids=AT_ZEROS)
def test_q_r_has_its_derivatives_at_zeros(A):
    function = lambda A: by_triangle(A, jnp.arange(1.0, 5.0))  # noqa: E731
    for f, g in ((function, vectorized(function)), (jnp.linalg.qr, vectorized(jnp.linalg.qr))):
        for x, y in zip(jax.tree.leaves(f(A)), jax.tree.leaves(g(A)), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-13)
        for x, y in zip(
            jax.tree.leaves(jax.jacfwd(f)(A)), jax.tree.leaves(jax.jacrev(g)(A)), strict=True
        ):
            np.testing.assert_allclose(x, y, atol=1e-13)


def test_q_r_of_a_column_of_zeros():
    A = np.array([[0.0, 1.0], [0.0, 2.0]])
    Q, R = vectorized(jnp.linalg.qr)(A)
    np.testing.assert_allclose(Q @ R, A, atol=1e-15)
    np.testing.assert_allclose(Q.T @ Q, np.eye(2), atol=1e-15)


@pytest.mark.parametrize("exponent", [-1000, -560, 560, 1000])
def test_sizes_do_not_matter(exponent):
    """Squares of these numbers are zero or infinite."""
    A, size = np.array([[4.0, 2.0], [2.0, 3.0]]), 2.0**exponent

    def found(size):
        def factors(A):
            (Q, R), (values, vectors) = jnp.linalg.qr(A), jnp.linalg.eigh(A)
            U, singular, V = jnp.linalg.svd(A)
            return Q, R / size, values / size, vectors, U, singular / size, V

        return vectorized(factors)(A * size)

    for x, y in zip(found(size), found(1.0), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("lower", [True, False])
def test_eigenvalues_of_one_triangle(lower):
    A = np.array([[2.0, 9.0], [1.0, 3.0]])
    options = {"lower": lower, "symmetrize_input": False}
    values = lambda A: jax.lax.linalg.eigh(A, **options)[1]  # noqa: E731
    np.testing.assert_allclose(vectorized(values)(A), values(A), rtol=1e-14)
