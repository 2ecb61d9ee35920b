"""The one place where integration steps are taken: for many lanes of one chart at once.

Lanes stand on the last axis: `t`, `h` are (L,), `q` is (n, L). A field here is a function
(t, q) -> (n, L) of whole arrays; one array per stage lets XLA compute each stage once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .tableau import VERNER76


LaneField = Callable[[jax.Array, jax.Array], jax.Array]


class Step(NamedTuple):
    """Result of one step."""

    q: Float[Array, "n L"]
    """State at t + h."""
    f0: Float[Array, "n L"]
    """Field at the start."""
    f1: Float[Array, "n L"]
    """Field at the end."""
    error: Float[Array, "n L"]
    """Embedded estimate of the local error."""


def rk_step(
    field: LaneField, t: Float[Array, " L"], q: Float[Array, "n L"], h: Float[Array, " L"]
) -> Step:
    """One step of Verner's 7(6) pair from (t, q) over h."""
    n = VERNER76.num_stages
    A = np.zeros((n, n))
    for k, row in enumerate(VERNER76.a_lower):
        A[k + 1, : k + 1] = row
    C = np.concatenate([[0.0], VERNER76.c])

    def stage(K, xs):
        row, c, k = xs
        point = q + h * jnp.tensordot(row, K, 1)
        return K.at[k].set(field(t + c * h, point)), None

    K, _ = jax.lax.scan(stage, jnp.zeros((n, *q.shape)), (A, C, np.arange(n)))
    end = q + h * jnp.tensordot(VERNER76.b_sol, K, 1)
    error = h * jnp.tensordot(VERNER76.b_error, K, 1)
    return Step(end, K[0], field(t + h, end), error)


def midpoint_step(
    field: LaneField, t: Float[Array, " L"], q: Float[Array, "n L"], h: Float[Array, " L"]
) -> Float[Array, "n L"]:
    """A very short step, with an error of order h^3: derivatives at h = 0 are right to order 2."""
    half = 0.5 * h
    return q + h * field(t + half, q + half * field(t, q))
