"""The one place where integration steps are taken: for many lanes of one chart at once.

Lanes stand on the last axis: `t`, `h` are (L,), `q` is (n, L). A field here is a function
(t, q) -> (n, L) of whole arrays; one array per stage lets XLA compute each stage once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .tableau import VERNER65


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
    """One step of Verner's 6(5) pair from (t, q) over h."""
    stages = [field(t, q)]
    for row, c in zip(VERNER65.a_lower, VERNER65.c, strict=True):
        point = q + h * _combine(row, stages)
        stages.append(field(t + c * h, point))
    # First same as last: the last stage is evaluated at the solution itself.
    return Step(point, stages[0], stages[-1], h * _combine(VERNER65.b_error, stages))


def midpoint_step(
    field: LaneField, t: Float[Array, " L"], q: Float[Array, "n L"], h: Float[Array, " L"]
) -> Float[Array, "n L"]:
    """A very short step, with an error of order h^3: derivatives at h = 0 are right to order 2."""
    half = 0.5 * h
    return q + h * field(t + half, q + half * field(t, q))


def _combine(coefficients, stages):
    terms = [float(c) * k for c, k in zip(coefficients, stages, strict=False) if c != 0]
    return sum(terms[1:], terms[0]) if terms else jnp.zeros_like(stages[0])
