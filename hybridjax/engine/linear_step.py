r"""The derivatives of a Runge-Kutta step, on the host.

`replay.py` calls `linear_step` for many recorded steps at once, and multiplies the results. Stage i
of an explicit method has the state $x_i = q + h \sum_{j<i} a_{ij} k_j$ and the rate $k_i = f(t +
c_i h, x_i, u)$. The derivatives of the stages by t, q, u and h follow from the derivatives of the
field, one stage after the other (`_explicit`). The compiled derivative of the field exists already,
so that nothing more is compiled. A step of an implicit method is differentiated by JAX, in a
compiled function of its own (`kernels.linear_step`).

The columns of the answer must stay in their order, since `replay._after_steps` takes them by their
places: the end, the field there, then the derivatives. If derivatives of explicit steps are wrong,
compare `_explicit` with `kernels.linear_step`, which must give the same numbers. Stages are
computed in `_rate`, and their sums in `_state`.
"""

import numpy as np
from jaxtyping import Inexact

from ..systems.solver import Method
from ..systems.structure import Structure
from . import kernels
from .saltation import by_point


def linear_step(
    s: Structure,
    a: int,
    t: Inexact[np.ndarray, " M"],
    q: Inexact[np.ndarray, "n M"],
    u: Inexact[np.ndarray, "nu M"],
    h: Inexact[np.ndarray, " M"],
) -> Inexact[np.ndarray, "n columns M"]:
    """The ends of M steps in chart a, the field there, and the derivatives of the ends by time,
    states, inputs and length of the step."""
    method = s.method(a)
    if method.implicit or s.by_system:
        return kernels.linear_step(s, a, t, q, u, h)
    return _explicit(method, s, a, t, q, u, h)


def _explicit(method: Method, s: Structure, a: int, t, q, u, h):
    """The same as `linear_step` for an explicit method. (Arrays of the stages have the M steps
    first, then the states.)"""
    n, M = q.shape
    m = 1 + n + s.nu + 1  # by time, states, inputs and length of the step
    stages = len(method.b)
    a_rows = np.array(method.a)
    rates = np.zeros((stages, M, n), q.dtype)
    by_rates = np.zeros((stages, M, n, m), q.dtype)
    for i in range(stages):
        state, by_state = _state(a_rows[i, :i], rates, by_rates, q, h)
        at_stage = method.c[i]
        rates[i], by_rates[i] = _rate(s, a, at_stage, t, u, h, state, by_state)
    end, by_end = _state(np.array(method.b), rates, by_rates, q, h)
    field_at_end = kernels.field(s, a, t + h, end.T, u)
    rate = field_at_end[:, 0].T
    values = np.stack([end, rate], axis=2)
    expanded = np.concatenate([values, by_end], axis=2)
    return np.moveaxis(expanded, 0, -1)


def _state(weights, rates, by_rates, q, h):
    """The state q + h sum_j weights_j rates_j after the first stages, and its derivatives."""
    n = len(q)
    slope = _weighted(weights, rates)
    state = q.T + h[:, None] * slope
    by_state = h[:, None, None] * _weighted(weights, by_rates)
    by_state[:, :, 1 : 1 + n] += np.eye(n)
    by_state[:, :, -1] += slope
    return state, by_state


def _weighted(weights, stages):
    """The sum of the first stages with these weights."""
    rows = stages.reshape(len(stages), -1)
    return (weights @ rows[: len(weights)]).reshape(stages.shape[1:])


def _rate(s: Structure, a: int, c: float, t, u, h, state, by_state):
    """The field at a stage, and its derivatives."""
    n = state.shape[1]
    expanded = kernels.field(s, a, t + c * h, state.T, u)
    expanded = np.moveaxis(expanded, -1, 0)
    rate = expanded[:, :, 0]
    by = by_point(expanded, n)
    by_time = by.by_t[:, :, 0]
    by_rate = by.by_q @ by_state
    by_rate[:, :, 0] += by_time
    by_rate[:, :, 1 + n : -1] += by.by_u
    by_rate[:, :, -1] += c * by_time
    return rate, by_rate
