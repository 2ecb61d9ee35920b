"""Functions of single states over lanes: made once under a name, for the same trees."""

import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.systems.structure import Structure


def test_a_named_function_is_traced_once_for_the_same_trees():
    s, traced = Structure(hj.models.VerticalHopper()), []

    def shifted(s, shift, x):
        traced.append(shift)
        return s.system.k * x + shift

    x, one, two = jnp.arange(9.0), jnp.asarray(1.0), jnp.asarray(2.0)
    for _ in range(2):
        np.testing.assert_array_equal(s.by_lane(shifted, one, name="shifted")(x), 10 * x + 1)
    assert len(traced) == 1
    np.testing.assert_array_equal(s.by_lane(shifted, two, name="shifted")(x), 10 * x + 2)
    other = Structure(hj.models.VerticalHopper(k=3.0))
    np.testing.assert_array_equal(other.by_lane(shifted, one, name="shifted")(x), 3 * x + 1)
    s.by_lane(shifted, one)(x), s.by_lane(shifted, one)(x)
    assert len(traced) == 5
