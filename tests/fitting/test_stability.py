"""The smooth spectral radius keeps to its bounds, and so do its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import hybridjax as hj


def model(A):
    d = A.shape[-1]
    B = jnp.ones((len(A), d, 1))
    C = jnp.ones((len(A), 1, d))
    return hj.linear.LDTP(A, B, C)


@settings(max_examples=50)
@given(st.integers(0, 2**16), st.floats(1e-6, 0.5))
def test_it_is_bounded_as_stated(seed, smoothing):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 3, 3))
    product = A[1] @ A[0]
    values, vectors = np.linalg.eig(product)
    true = np.abs(values).max()
    loss = np.linalg.cond(vectors) ** 2 * smoothing
    radius = hj.fitting.spectral_radius(model(jnp.asarray(A)), smoothing)
    found = float(radius)
    lowest = true / np.sqrt(1 - smoothing / 3)
    assert found >= lowest * (1 - 1e-9)
    if loss < 1:
        largest = true / np.sqrt(1 - loss)
        assert found <= largest * (1 + 1e-9)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("e", [0.0, 1e-6, -1e-6])
def test_it_has_a_derivative_where_multipliers_meet(e, mode):
    """Multipliers are 1 +- sqrt(e): at e = 0 their matrix is a Jordan block."""

    def radius(e):
        A = jnp.array([[[1.0, 1.0], [e, 1.0]]])
        return hj.fitting.spectral_radius(model(A))

    h = 1e-6
    later = radius(e + h)
    change = later - radius(e - h)
    difference = change / (2 * h)
    slope = float(mode(radius)(e))
    assert slope == pytest.approx(float(difference), rel=1e-5)


def test_its_derivative_tends_to_that_of_the_radius():
    """A rotation by an angle that changes: the norm of a power would swing with it."""

    def radius(p, smoothing):
        c = 0.8 * jnp.cos(1 + 3 * p)
        s = 0.8 * jnp.sin(1 + 3 * p)
        skew = jnp.array([[1.0, 2.0], [0.0, 1.0]])
        rotation = jnp.array([[c, -s], [s, c]])
        inverse = jnp.linalg.inv(skew)
        A = (1 + p) * skew @ rotation @ inverse
        return hj.fitting.spectral_radius(model(A[None]), smoothing)

    errors = [
        abs(float(jax.grad(radius)(0.0, eps)) - 0.8) for eps in (1e-2, 1e-4, 1e-6)
    ]
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.05 * errors[1]
    assert errors[2] < 1e-4
