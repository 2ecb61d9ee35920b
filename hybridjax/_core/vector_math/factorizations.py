"""Factorizations of matrices, in loops over their columns.

What `small_matrices` writes out for a few rows, these do for more, and for the factorizations that
are made of many steps: Q R, eigenvalues and singular values. Each step is a few operations on whole
matrices, for all lanes at once. LAPACK would be called once for each lane, and programs that call
it cannot run in several threads.

Matrices stand on the last two axes. G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed.
(2013): sections 3.4 (L U), 5.2 (Householder), 8.5 (Jacobi), 8.6.3 (one-sided Jacobi).
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


# Up to this number of rows and columns. Twice as many: as slow as LAPACK, or slower.
LARGEST_IN_LOOPS = 32
# Sweeps of Jacobi's methods; six or seven are usual for 32 rows. Doubled: NaN takes twice as long.
_SWEEPS = 16


@jax.jit
def lu(
    matrix: Float[Array, "*b n n"],
) -> tuple[Float[Array, "*b n n"], Int[Array, "*b n"], Int[Array, "*b n"]]:
    """`jax.lax.linalg.lu` of square matrices: L below the diagonal and U in one matrix, for each
    column the row that traded places with its own, and the order of all rows."""
    n = matrix.shape[-1]
    index = jnp.arange(n)

    def traded(x, k, chosen):
        """x with rows k and `chosen` in each other's place."""
        mask = jnp.reshape(chosen, (*chosen.shape, *(1,) * (x.ndim - chosen.ndim)))
        other = jnp.sum(jnp.where(mask, x, 0), axis=chosen.ndim - 1, dtype=x.dtype, keepdims=True)
        own = jax.lax.dynamic_slice_in_dim(x, k, 1, chosen.ndim - 1)
        here = jnp.reshape(index == k, mask.shape[chosen.ndim - 1 :])
        return jnp.where(here, other, jnp.where(mask, own, x))

    def eliminate(k, carry):
        X, pivots, order = carry
        column = _column(X, k)
        p = jnp.argmax(jnp.where(index >= k, jnp.abs(column), -1.0), axis=-1)
        chosen = index == p[..., None]
        X, order = traded(X, k, chosen), traded(order, k, chosen)
        pivots = jnp.where(index == k, p[..., None].astype(np.int32), pivots)
        row, column = _row(X, k), _column(X, k)
        pivot = _row(column[..., None], k)
        share = jnp.where(index > k, column / jnp.where(pivot == 0, 1.0, pivot), 0.0)
        beyond = jnp.where(index > k, row, 0.0)
        X = X - share[..., :, None] * beyond[..., None, :]
        below = (index == k) & (index[:, None] > k)
        return jnp.where(below, share[..., :, None], X), pivots, order

    order = jnp.broadcast_to(jnp.arange(n, dtype=np.int32), matrix.shape[:-1])
    return jax.lax.fori_loop(0, n, eliminate, (matrix, jnp.zeros_like(order), order))


@jax.jit
def cholesky(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """As `small_matrices.cholesky`."""
    n = matrix.shape[-1]
    index = jnp.arange(n)

    def eliminate(k, lower):
        column = _column(matrix, k) - _times(lower, _row(lower, k))
        pivot = _row(column[..., None], k)
        column = jnp.where(index >= k, column / jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan)), 0.0)
        return jnp.where(index == k, column[..., :, None], lower)

    return jax.lax.fori_loop(0, n, eliminate, jnp.zeros_like(matrix))


@ft.partial(jax.jit, static_argnames=("left_side", "lower", "transpose_a", "unit_diagonal"))
def triangular_solve(
    matrix: Float[Array, "*b n n"],
    right: Float[Array, "*b _ _"],
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
) -> Float[Array, "*b _ _"]:
    """As `small_matrices.triangular_solve`."""
    n = matrix.shape[-1]
    if not left_side:  # the transpose of the first form
        right, transpose_a = jnp.swapaxes(right, -1, -2), not transpose_a
    op = jnp.swapaxes(matrix, -1, -2) if transpose_a else matrix
    downwards, index = lower != transpose_a, jnp.arange(n)
    others = jnp.where(index == index[:, None], 0.0, op)

    def solve(k, found):
        i = k if downwards else n - 1 - k
        x = _row(right, i) - jnp.sum(_row(others, i)[..., :, None] * found, axis=-2)
        if not unit_diagonal:
            x = x / _row(_column(op, i)[..., None], i)
        return jnp.where((index == i)[:, None], x[..., None, :], found)

    solved = jax.lax.fori_loop(0, n, solve, jnp.zeros_like(right))
    return solved if left_side else jnp.swapaxes(solved, -1, -2)


@ft.partial(jax.jit, static_argnames="full_matrices")
def qr(
    matrix: Float[Array, "*b m n"], *, full_matrices: bool
) -> tuple[Float[Array, "*b m _"], Float[Array, "*b _ n"]]:
    """Q and R by Householder's reflections, with LAPACK's signs.

    A column that is zero below the diagonal is reflected, too, and its sign put back: so Q has the
    derivative there that it has nearby. It is zero where all of a column is, which has none.
    """
    m, n = matrix.shape[-2:]
    index, most = jnp.arange(m), min(m, n)
    sizes = _size(matrix, axis=-2)  # (Q is the same for columns of any sizes.)

    def reflect(k, carry):
        R, Q = carry
        below = jnp.where(index > k, _column(R, k), 0.0)
        first = _row(_column(R, k)[..., None], k)
        rest = jnp.sum(below**2, axis=-1, keepdims=True)
        there = first**2 + rest > 0
        size = jnp.sqrt(jnp.where(there, first**2 + rest, 1.0))
        v = jnp.where(index == k, first + jnp.where(first < 0, -size, size), below)
        scale = jnp.where(there, 2 / jnp.sum(jnp.where(there, v, 1.0) ** 2, -1, keepdims=True), 0.0)
        sign = jnp.where((index == k) & there & (rest == 0), -1.0, 1.0)
        R = R - (scale * v)[..., :, None] * jnp.sum(v[..., :, None] * R, -2, keepdims=True)
        Q = Q - _times(Q, v)[..., :, None] * (scale * v)[..., None, :]
        return sign[..., :, None] * R, sign[..., None, :] * Q

    eye = jnp.broadcast_to(jnp.eye(m, dtype=matrix.dtype), (*matrix.shape[:-1], m))
    R, Q = jax.lax.fori_loop(0, most, reflect, (matrix / sizes, eye))
    R = jnp.where(index[:, None] <= jnp.arange(n), R * sizes, 0.0)
    return (Q, R) if full_matrices else (Q[..., :, :most], R[..., :most, :])


@ft.partial(jax.jit, static_argnames="lower")
def eigh(
    matrix: Float[Array, "*b n n"], *, lower: bool
) -> tuple[Float[Array, "*b n n"], Float[Array, "*b n"]]:
    """Eigenvectors and eigenvalues, the smallest first, of symmetric matrices, of which one
    triangle is read, by Jacobi's method.

    Vectors have the signs that the rotations give them.
    """
    n = matrix.shape[-1]
    index, mirrored = jnp.arange(n), jnp.swapaxes(matrix, -1, -2)
    read = index[:, None] >= index if lower else index[:, None] <= index
    size = _size(matrix, axis=(-2, -1))
    matrix = jnp.where(read, matrix, mirrored) / size
    eye = jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype), matrix.shape)
    outside = ~np.eye(n, dtype=bool)

    def rotate(p, q, carry):
        A, V = carry
        at_p, at_q = _column(A, p)[..., None], _column(A, q)[..., None]
        both = _row(at_q, p), _row(at_p, p), _row(at_q, q)
        turned = _Rotation(p, q, *(x[..., None] for x in _angle(*both)))
        A = turned(A)
        return jnp.swapaxes(turned(jnp.swapaxes(A, -1, -2)), -1, -2), turned(V)

    def unsettled(carry):
        square = carry[0] ** 2
        off = jnp.sum(jnp.where(outside, square, 0.0), axis=(-1, -2))
        return jnp.any(off > (jnp.finfo(matrix.dtype).eps ** 2) * jnp.sum(square, axis=(-1, -2)))

    A, V = _swept(rotate, unsettled, n, (matrix, eye))
    values = jnp.diagonal(A, axis1=-2, axis2=-1) * size[..., 0]
    return _ordered(values, V, values)


@ft.partial(jax.jit, static_argnames=("full_matrices", "compute_uv"))
def svd(
    matrix: Float[Array, "*b m n"], *, full_matrices: bool, compute_uv: bool
) -> tuple[Float[Array, "..."], ...]:
    """Singular values, the largest first, and if wanted U and the transpose of V, by the one-sided
    method of Jacobi: the columns are turned until they are orthogonal."""
    m, n = matrix.shape[-2:]
    if m < n:
        options = {"full_matrices": full_matrices, "compute_uv": compute_uv}
        values, *both = svd(jnp.swapaxes(matrix, -1, -2), **options)
        return values, *(jnp.swapaxes(x, -1, -2) for x in reversed(both))
    eye = jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype), (*matrix.shape[:-2], n, n))
    outside = ~np.eye(n, dtype=bool)

    def rotate(p, q, carry):
        W, V = carry
        at_p, at_q = _column(W, p), _column(W, q)
        products = (at_p * at_q, at_p**2, at_q**2)
        both = (jnp.sum(x, axis=-1, keepdims=True) for x in products)
        turned = _Rotation(p, q, *(x[..., None] for x in _angle(*both)))
        return turned(W), turned(V)

    def unsettled(carry):
        W, _ = carry
        gram = jnp.sum(W[..., :, :, None] * W[..., :, None, :], axis=-3)
        size = jnp.sqrt(jnp.diagonal(gram, axis1=-2, axis2=-1))
        small = m * jnp.finfo(matrix.dtype).eps * size[..., :, None] * size[..., None, :]
        return jnp.any(outside & (jnp.abs(gram) > small))

    whole = _size(matrix, axis=(-2, -1))
    W, V = _swept(rotate, unsettled, n, (matrix / whole, eye))
    size = jnp.sum(W**2, axis=-2)
    V, _ = _ordered(-size, V, size)
    W, _ = _ordered(-size, W, size)
    Q, R = qr(W, full_matrices=full_matrices)
    signed = jnp.diagonal(R, axis1=-2, axis2=-1) * whole[..., 0]
    if not compute_uv:
        return (jnp.abs(signed),)
    sign = jnp.where(signed < 0, -1.0, 1.0)
    Q = jnp.concatenate([Q[..., :n] * sign[..., None, :], Q[..., n:]], axis=-1)
    return jnp.abs(signed), Q, jnp.swapaxes(V, -1, -2)


def _size(matrix, axis):
    """A power of two near the largest number along some axes (any, where all are zero): over it,
    squares neither overflow nor vanish, and nothing is rounded."""
    largest = jnp.max(jnp.abs(jax.lax.stop_gradient(matrix)), axis=axis, keepdims=True)
    exponent = np.array(np.inf, matrix.dtype).view(f"i{matrix.dtype.itemsize}")  # (all its bits)
    bits = jax.lax.bitcast_convert_type(largest, exponent.dtype) & exponent
    power = jax.lax.bitcast_convert_type(bits, matrix.dtype)
    return jnp.where((power > 0) & jnp.isfinite(power), power, 1.0)


def _angle(off, first, second):
    """Cosine and sine of the rotation by which a symmetric matrix of two rows becomes diagonal."""
    there = off != 0
    ratio = (second - first) / (2 * jnp.where(there, off, 1.0))
    tangent = jnp.where(ratio < 0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.hypot(1.0, ratio))
    tangent = jnp.where(there, tangent, 0.0)
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    return cosine, tangent * cosine


class _Rotation:
    """Columns p and q of a matrix, turned."""

    def __init__(self, p, q, cosine, sine):
        self.p, self.q, self.cosine, self.sine = p, q, cosine, sine

    def __call__(self, X):
        at_p, at_q = (_column(X, k)[..., None] for k in (self.p, self.q))
        index = jnp.arange(X.shape[-1])
        turned_p, turned_q = (
            self.cosine * at_p - self.sine * at_q,
            self.sine * at_p + self.cosine * at_q,
        )
        return jnp.where(index == self.p, turned_p, jnp.where(index == self.q, turned_q, X))


def _swept(rotate, unsettled, n, carry):
    """Rotations of all pairs of columns, again and again until no more are needed."""
    if n < 2:
        return carry
    pairs = jnp.asarray(np.stack(np.triu_indices(n, 1), axis=1))

    def sweep(state):
        carry, k = state
        turn = lambda carry, pair: (rotate(pair[0], pair[1], carry), None)  # noqa: E731
        return jax.lax.scan(turn, carry, pairs)[0], k + 1

    going = lambda state: (state[1] < _SWEEPS) & unsettled(state[0])  # noqa: E731
    return jax.lax.while_loop(going, sweep, (carry, 0))[0]


def _ordered(by, columns, values):
    """Columns and values in the ascending order of `by`."""
    order = jnp.argsort(by, axis=-1)
    columns = jnp.take_along_axis(columns, order[..., None, :], axis=-1)
    return columns, jnp.take_along_axis(values, order, axis=-1)


def _row(X, k):
    return jax.lax.dynamic_index_in_dim(X, k, axis=X.ndim - 2, keepdims=False)


def _column(X, k):
    return jax.lax.dynamic_index_in_dim(X, k, axis=X.ndim - 1, keepdims=False)


def _times(X, v):
    """X @ v as products and sums, which XLA makes loops over lanes of."""
    return jnp.sum(X * v[..., None, :], axis=-1)
