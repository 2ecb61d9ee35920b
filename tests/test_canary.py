"""Builds of jax that compute wrong numbers."""

import jax
import jax.numpy as jnp
import numpy as np


def test_batched_products_followed_by_a_reduction():
    """jax issue 39103: on CPU, jax 0.10.2 silently returns 267911424 for the last of these."""
    n = 16385
    rows = np.zeros((n, 3))
    rows[:, 0] = np.arange(n)

    def lengths(rows):
        return jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))(rows)

    np.testing.assert_array_equal(lengths(rows), np.arange(n) ** 2.0)
    np.testing.assert_array_equal(jax.jit(lengths)(rows), np.arange(n) ** 2.0)
