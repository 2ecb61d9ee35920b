"""Builds of jax that compute wrong numbers."""

import os
import subprocess
import sys


# In a process of its own, since tests are compiled with other options than users' programs.
PRODUCTS = """
import jax, jax.numpy as jnp, numpy as np
n = 16385
rows = np.zeros((n, 3))
rows[:, 0] = np.arange(n)
lengths = lambda rows: jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))(rows)
np.testing.assert_array_equal(lengths(rows), np.arange(n) ** 2.0)
np.testing.assert_array_equal(jax.jit(lengths)(rows), np.arange(n) ** 2.0)
"""


def test_batched_products_followed_by_a_reduction():
    """jax issue 39103: on CPU, jax 0.10.2 silently returns 267911424 for the last of these."""
    kept = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment = kept | {"JAX_ENABLE_X64": "1"}
    run = subprocess.run(
        [sys.executable, "-c", PRODUCTS], env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
