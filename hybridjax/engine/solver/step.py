"""The one place where integration steps are taken: for many lanes of one chart at once.

Lanes stand on the last axis: `t`, `h` are (L,), `q` is (n, L). A field here is a function
(t, q) -> (n, L) of whole arrays; one array per stage lets XLA compute each stage once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..._core.executor import Array, for_each_row, namespace
from ...systems.solver import Method


LaneField = Callable[[Array, Array], Array]

# From this number of lanes on, stages are always written out. Twice as many: batches of 128 to 255
# lanes compile in half the time, and run up to twice as long.
_WRITTEN_OUT = 128
# Shifts by which rounding errors of the field are seen, in those of states and of time: both signs,
# odd ones and even ones. Doubled, the errors seen are at most doubled.
_SHIFTS = np.array([-3.1, 1.9, -0.8, 4.4])


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


def explicit_step(
    method: Method,
    field: LaneField,
    t: Float[Array, " #L"],
    q: Float[Array, "n L"],
    h: Float[Array, " #L"],
    unroll: bool = False,
) -> Step:
    """One step of an explicit method from (t, q) over h. Both t and h may be the same for all
    lanes, as arrays of one.

    With `unroll`, or for many lanes, the stages are written out: faster, and slower to compile.
    """
    unroll = unroll or q.shape[1] >= _WRITTEN_OUT
    K = (_written_out if unroll else _in_a_loop)(method, field, t, q, h)
    weights = np.array(method.b), np.array(method.error)
    if unroll:
        end, error = (_combine(w, K) for w in weights)
    else:
        end, error = (jnp.tensordot(w, K, 1) for w in weights)
    end = q + h * end
    return Step(end, K[0], field(t + h, end), h * error)


def _in_a_loop(method, field, t, q, h) -> Float[Array, "stages n L"]:
    def stage(K, xs):
        row, c, k = xs
        return K.at[k].set(field(t + c * h, q + h * jnp.tensordot(row, K, 1))), None

    stages = len(method.c)
    begin = jnp.zeros((stages, *q.shape), q.dtype)
    tableau = jnp.asarray(method.a, q.dtype), jnp.asarray(method.c, q.dtype), jnp.arange(stages)
    return jax.lax.scan(stage, begin, tableau)[0]


def _written_out(method, field, t, q, h) -> list[Float[Array, "n L"]]:
    K: list[jax.Array] = []
    for row, c in zip(method.a, method.c, strict=True):
        K.append(field(t + c * h, q + h * _combine(row, K)))
    return K


def _combine(weights, K):
    """Sum of weights times stages. Written out, it is compiled into one loop with the stage."""
    return sum((float(w) * k for w, k in zip(weights, K, strict=False) if w != 0), start=0.0)


def rounding_error(
    field: LaneField,
    t: Float[Array, " #L"],
    q: Float[Array, "n L"],
    f: Float[Array, "n L"],
) -> Float[Array, "n L"]:
    """The largest change that rounding errors of time and states are seen to make in the field,
    which is f at (t, q); zero where it is not finite."""
    # Not all states by the same part, since a common factor may cancel.
    shifts = np.stack([np.roll(_SHIFTS, k) for k in range(len(q) + 1)], axis=1)
    xp = namespace(q)
    shifts = xp.asarray(shifts * xp.finfo(q.dtype).eps, dtype=q.dtype)

    def change(shift):
        return xp.abs(field(t * (1 + shift[0]), q * (1 + shift[1:, None])) - f)

    changes = for_each_row(change, shifts)
    return xp.max(xp.where(xp.isfinite(changes), changes, 0.0), axis=0)


def short_step(
    field: LaneField,
    t: Float[Array, " L"],
    q: Float[Array, "n L"],
    f: Float[Array, "n L"],
    h: Float[Array, " L"],
) -> tuple[Float[Array, "n L"], Float[Array, "n L"]]:
    """A short step of the classical method of order 4, given the field f at its start.

    Its derivatives at h = 0 are right to order 4.

    **Returns:** the state at t + h, and its distance from the midpoint rule's, of order h^3.
    """
    half = 0.5 * h
    k2 = field(t + half, q + half * f)
    k3 = field(t + half, q + half * k2)
    k4 = field(t + h, q + h * k3)
    slope = (f + 2 * k2 + 2 * k3 + k4) / 6
    return q + h * slope, h * (slope - k2)
