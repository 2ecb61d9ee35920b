"""Steps of implicit methods, for many lanes of one chart at once.

The increments w_i = h f(t + c_i h, q + sum_j a_ij w_j) of all stages are found together, by
Newton's method with the Jacobian J of the field at the start of the step. Its linear systems
(1 - h A x J) dw = r are decoupled as by E. Hairer and G. Wanner, Solving Ordinary Differential
Equations II, section IV.8: with A = T R T^-1 and R triangular, they need inverses of 1 - h g J for
the diagonal entries g of R only, real or complex. All of it is written out for small matrices:
LAPACK's calls would be one for each lane.
"""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from ...systems.solver import Method
from .step import LaneField, Step


# Newton's iterations at most. Twice as many: longer steps where the field is most nonlinear.
_ITERATIONS = 12
# Iterations go on for a component that still moves by more than this many rounding errors, and by
# less than this part of what it moved by before. Nearer to 1, they chase rounding errors.
_ROUNDINGS, _SHRINKS = 4.0, 0.5
# Columns up to which an elimination is written out. Twice as many compile for twice as long.
_WRITTEN_OUT = 4


class _Decoupled(NamedTuple):
    """A matrix of stages as the real part of left @ R @ right, R lower triangular."""

    left: np.ndarray
    R: np.ndarray
    right: np.ndarray


@ft.lru_cache
def _decoupled(method: Method) -> _Decoupled:
    A = np.array(method.a)
    if not np.any(np.triu(A, 1)):
        return _Decoupled(np.eye(len(A)), A, np.eye(len(A)))
    values, T = np.linalg.eig(A)
    kept = values.imag >= 0  # one of each conjugate pair, twice
    values, left, right = values[kept], T[:, kept], np.linalg.inv(T)[kept]
    return _Decoupled(left * np.where(values.imag > 0, 2, 1), np.diag(values), right)


def implicit_step(
    method: Method,
    field: LaneField,
    t: Float[Array, " #L"],
    q: Float[Array, "n L"],
    h: Float[Array, " #L"],
    still: LaneField | None = None,
) -> Step:
    """One step of an implicit method from (t, q) over h. Both t and h may be the same for all
    lanes, as arrays of one.

    What Newton's iterations leave counts as an error of the step. For derivatives, give `still`,
    the field without any. The stages are then corrected twice by Newton's method with the true
    Jacobian at their solution: that changes them by rounding errors only, but carries their first
    and second derivatives, by the implicit function theorem.
    """
    start = [jax.lax.stop_gradient(x) for x in (t, q, h)]
    w, left, J = _increments(method, still or field, *start)
    if still is not None:
        w = _with_derivatives(method, field, still, (t, q, h), w)
    end = q + jnp.tensordot(np.array(method.b), w, 1)
    error = jnp.tensordot(np.array(method.error), w, 1)
    if method.filter:
        error = _apply(inverse(_shifted(J, method.filter * start[2])), error)
    error = jnp.where(error < 0, error - left, error + left)
    return Step(end, field(t, q), field(t + h, end), error)


def integrated_divergence(method: Method, field: LaneField, t, q, h) -> Float[Array, " L"]:
    """The divergence of the field, integrated over a step by the quadrature of the method."""
    w = _increments(method, field, t, q, h)[0]
    stages = q + jnp.tensordot(np.array(method.a), w, 1)
    J = jax.vmap(lambda t, q: _jacobian(field, t, q))(t + np.array(method.c)[:, None] * h, stages)
    return h * jnp.tensordot(np.array(method.b), jnp.trace(J, axis1=1, axis2=2), 1)


def _increments(method, field, t, q, h):
    """Increments (s, n, L) by Newton's method, what its last iteration changed (n, L), and the
    Jacobian (n, n, L) at the start."""
    J, c = _jacobian(field, t, q), np.array(method.c)[:, None]
    left, R, right = _decoupled(method)
    solve = {g: inverse(_shifted(J, g * h)) for g in set(np.diag(R)) if g != 0}
    evaluate = jax.vmap(field)
    small = _ROUNDINGS * jnp.finfo(q.dtype).eps

    def correction(w):
        stages = q + jnp.tensordot(np.array(method.a), w, 1)
        residual = h * evaluate(t + c * h, stages) - w
        residual = jnp.tensordot(right, residual, 1)
        found = []
        for row, r in zip(R, residual, strict=True):
            rest = sum((g * x for g, x in zip(row, found, strict=False) if g != 0), start=0.0)
            r = r if isinstance(rest, float) else r + h * _apply(J, rest)
            g = row[len(found)]
            found.append(_apply(solve[g], r) if g != 0 else r)
        return jnp.real(jnp.tensordot(left, jnp.stack(found), 1))

    def iterate(carry):
        w, last, _, i = carry
        change = correction(w)
        w, now = w + change, jnp.max(jnp.abs(change), axis=0)
        size = jnp.abs(q) + jnp.max(jnp.abs(w), axis=0)
        going = (now > small * size) & ((now < _SHRINKS * last) | (i < 2))
        return w, now, going.any(), i + 1

    def unsettled(carry):
        *_, going, i = carry
        return going & (i < _ITERATIONS)

    w = jnp.zeros((len(c), *q.shape), q.dtype).at[0].set(h * field(t, q))
    begin = w, jnp.full(q.shape, jnp.inf, q.dtype), jnp.array(True), 0
    w, last, *_ = jax.lax.while_loop(unsettled, iterate, begin)
    return w, last, J


def _with_derivatives(method, field, still, start, w):
    """The increments w, as functions of the field and of the `start` (t, q, h) of the step."""
    t, q, h = start
    A, c = np.array(method.a), np.array(method.c)[:, None]
    (s, n, L), at = w.shape, jax.lax.stop_gradient
    stages = at(q + jnp.tensordot(A, w, 1))
    J = jax.vmap(lambda t, q: _jacobian(still, t, q))(at(t + c * h), stages)
    coupled = jnp.einsum("ij,iabL->iajbL", A, J).reshape(s * n, s * n, L)
    back = inverse(jnp.eye(s * n)[..., None] - at(h) * coupled)
    for _ in range(2):
        stages = q + jnp.tensordot(A, w, 1)
        residual = h * jax.vmap(field)(t + c * h, stages) - w
        w = w + _apply(back, residual.reshape(s * n, L)).reshape(s, n, L)
    return w


def _jacobian(field: LaneField, t, q) -> Float[Array, "n n L"]:
    def push(direction):
        along = jnp.broadcast_to(direction[:, None], q.shape)
        return jax.jvp(lambda q: field(t, q), (q,), (along,))[1]

    return jax.vmap(push, out_axes=1)(jnp.eye(len(q), dtype=q.dtype))


def _shifted(J, g):
    """1 - g J."""
    return jnp.eye(len(J))[..., None] - g * J


def _apply(matrix: Inexact[Array, "n m #L"], x: Inexact[Array, "m L"]) -> Inexact[Array, "n L"]:
    return jnp.sum(matrix * x, axis=1)


def inverse(matrix: Inexact[Array, "n n L"]) -> Inexact[Array, "n n L"]:
    """Inverses of many small matrices, by Gauss and Jordan's elimination with pivots."""
    n = len(matrix)
    rows = np.arange(n)[:, None]

    def eliminate(k, X):
        column = jnp.where(rows >= k, jnp.abs(X[:, k]), -1.0)
        chosen = rows == jnp.argmax(column, axis=0)
        pivot = jnp.sum(jnp.where(chosen[:, None], X, 0.0), axis=0)
        X = jnp.where(chosen[:, None], X[k], X)
        pivot = pivot / pivot[k]
        X = X - X[:, k][:, None] * pivot
        return jnp.where((rows == k)[:, None], pivot, X)

    eye = jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype)[..., None], matrix.shape)
    X = jnp.concatenate([matrix, eye], axis=1)
    if n <= _WRITTEN_OUT:
        for k in range(n):
            X = eliminate(k, X)
    else:
        X = jax.lax.fori_loop(0, n, eliminate, X)
    return X[:, n:]
