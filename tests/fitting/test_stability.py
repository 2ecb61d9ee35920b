"""The smooth spectral radius: above the true one, as near to it as is said, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

import hybridjax as hj


def model(A):
    d = A.shape[-1]
    return hj.LDTP(A, jnp.ones((len(A), d, 1)), jnp.ones((len(A), 1, d)))


@given(st.integers(0, 2**16), st.integers(0, 8))
def test_it_is_bounded_as_stated(seed, doublings):
    A = np.random.default_rng(seed).normal(size=(2, 3, 3))
    values, vectors = np.linalg.eig(A[1] @ A[0])
    true, k = np.abs(values).max(), 2**doublings
    found = float(hj.spectral_radius(model(jnp.asarray(A)), doublings))
    bound = (np.linalg.cond(vectors) * np.sqrt(3)) ** (1 / k)
    assert true * (1 - 1e-12) <= found <= true * bound * (1 + 1e-12)


@pytest.mark.parametrize("size", [0.6, 1e-6])
def test_it_has_a_derivative_where_multipliers_meet(size):
    """Multipliers are size +- sqrt(e): no derivative at e = 0, where their matrix has a Jordan
    block."""

    def radius(e):
        A = jnp.array([[[1.0, 1.0 / size], [e / size, 1.0]]]) * size
        return hj.spectral_radius(model(A)) / size

    slope = jax.grad(radius)(0.0)
    h = 1e-5 * size
    difference = (radius(h) - radius(-h)) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_a_cycle_and_its_sections_agree_as_far_as_the_bias_allows(hopper_cycle, isochron_ldtp):
    true = np.abs(hopper_cycle.multipliers).max()
    for which in (hopper_cycle, isochron_ldtp):
        errors = [float(hj.spectral_radius(which, k)) / true - 1 for k in (4, 8, 12)]
        assert errors[0] > errors[1] > errors[2] > 0 and errors[2] < 1e-3


def test_negative_doublings_are_refused(isochron_ldtp):
    with pytest.raises(hj.DefinitionError, match="doublings"):
        hj.spectral_radius(isochron_ldtp, -1)
