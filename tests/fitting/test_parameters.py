"""Coordinates of free parameters: they keep to bounds and come back."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

import hybridjax as hj
from hybridjax.fitting.problem import free_parameters


HOPPER = hj.models.VerticalHopper
BOUNDS = st.sampled_from([None, (-np.inf, np.inf), (0.5, np.inf), (-np.inf, 40.0), (0.5, 40.0)])
VALUES = st.floats(0.6, 39.0)
COORDINATES = st.floats(-8.0, 8.0)


@given(VALUES, BOUNDS, COORDINATES)
def test_values_come_back_and_keep_to_their_bounds(value, bounds, x):
    parameters = free_parameters(HOPPER(k=value), {"k": bounds})
    values = parameters.read(HOPPER(k=value))
    np.testing.assert_allclose(parameters.decode(parameters.encode(values)), values, rtol=1e-12)
    low, high = (0.0, np.inf) if bounds is None else bounds
    assert low <= parameters.decode(jnp.array([x]))[0] <= high


def test_a_parameter_keeps_its_sign_by_default():
    system = HOPPER(k=-3.0, b=0.0)
    parameters = free_parameters(system, ("k", "b", "g"))
    far = parameters.decode(jnp.array([5.0, -5.0, -5.0]))
    assert far[0] < 0 and far[1] == -5.0 and far[2] > 0
    moved = parameters.insert(system, far)
    np.testing.assert_array_equal([moved.k, moved.b, moved.g], far)


@pytest.mark.parametrize(
    "free, message",
    [
        ((), "at least one"),
        (("k", "k"), "each once"),
        (("stiffness",), "'stiffness' is no parameter of VerticalHopper"),
        (("leg",), "those are m, M, k"),
        ({"k": (11.0, 20.0)}, "enclose the value"),
    ],
)
def test_bad_names_and_bounds_are_refused(free, message):
    with pytest.raises(hj.DefinitionError, match=message):
        free_parameters(HOPPER(), free)
