"""Factorizations of small matrices in arithmetic that XLA vectorizes over lanes.

XLA on CPU hands `jnp.linalg.solve` and its relatives to LAPACK, one matrix after the other: some
150 ns for 3 equations, where the operations themselves, for several lanes at once, take 9 (for 7
equations 310 and 60; if the matrix is symmetric and positive, 4 and 16). Programs that call LAPACK
may also wait for each other for ever if they run in several threads. The functions below use
additions, multiplications, divisions and selections instead, written out without loops (except LU
factors and `solve_by_columns`). `rewrite.vectorized` puts them into functions that were written
with `jnp`. QR factorizations, eigenvalues, singular values and matrices of more than 12 rows are
left to LAPACK.

Matrices stand on the last two axes. Where LAPACK would report a failure, results are NaN or
infinite. Derivatives are those of the operations. G. H. Golub, C. F. Van Loan, Matrix Computations,
4th ed. (2013), sections 3.4 and 4.2.

A function that replaces one of JAX must return the same, up to rounding, and none may call LAPACK.
A further one is entered in `_FACTORIZATIONS` (`rewrite.py`), and the name of its primitive in
`_FUNCTIONS` (`jax_compat.py`).

If a solution is inaccurate, compare with `jnp.linalg` for the same matrix; if a program calls
LAPACK in spite of these, look at `rewrite.py`.
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


# Rows up to which matrices are factorized here, and up to which elimination with pivoting is
# unrolled. Fewer: LAPACK, and loops over columns, run slower. Two more: XLA compiles for twice as
# long, seconds, and at 16 rows LAPACK is as fast.
MOST_ROWS = 12
UNROLLED_PIVOTED = 7


@jax.jit
def solve_positive(
    matrix: Float[Array, "n n"], right: Float[Array, "*b n"]
) -> Float[Array, "*b n"]:
    """Return x in `matrix @ x = right` for a symmetric positive definite matrix, by L D L^T, which
    is computed once for all right sides and for derivatives.

    NaN where a pivot is not positive, up to rounding: the matrix is singular, or not definite.
    """
    n = right.shape[-1]
    lower: dict[tuple[int, int], Array] = {}  # L below its diagonal of ones
    scaled: dict[tuple[int, int], Array] = {}  # L D
    inverse: list[Array] = []  # of D
    singular = jnp.asarray(False)
    least = n * jnp.finfo(right.dtype).eps
    for j in range(n):
        for i in range(j, n):
            products = [(scaled[i, k], lower[j, k]) for k in range(j)]
            scaled[i, j] = _less(matrix[..., i, j], products)
        pivot = scaled[j, j]
        is_positive = pivot > least * matrix[..., j, j]
        singular = singular | ~is_positive
        inverse.append(1 / pivot)
        for i in range(j + 1, n):
            lower[i, j] = scaled[i, j] * inverse[j]

    def by_factors(_, right):
        rows = [right[..., i] for i in range(n)]
        rows[0] = jnp.where(singular, jnp.nan, rows[0])
        for i in range(n):
            known = [(lower[i, k], rows[k]) for k in range(i)]
            rows[i] = _less(rows[i], known)
        for i in reversed(range(n)):
            above = [(lower[k, i], rows[k]) for k in range(i + 1, n)]
            rows[i] = _less(rows[i] * inverse[i], above)
        return jnp.stack(rows, axis=-1)

    # (Derivatives use the factors, too.)
    return jax.lax.custom_linear_solve(
        lambda x: x @ matrix, right, by_factors, symmetric=True
    )


@jax.jit
def solve(
    matrix: Float[Array, "n n"], right: Float[Array, "*b n"]
) -> Float[Array, "*b n"]:
    """Return x in `matrix @ x = right`, by unrolled elimination with pairwise pivoting: a row
    trades places with any later one that has the larger number in its column.

    (D. C. Sorensen, Analysis of pairwise pivoting in Gaussian elimination, IEEE Trans. Computers
    34, 1985. To look for the largest number first would make every row depend on all choices.)
    """
    return jax.lax.custom_linear_solve(
        lambda x: x @ matrix.T,
        right,
        lambda _, b: _eliminated(matrix, b),
        lambda _, b: _eliminated(matrix.T, b),
    )


def _eliminated(matrix, right):
    """Return x (*b, n) in `matrix @ x = right`, for a matrix (n, n) and right sides (*b, n):
    elimination downwards with pairwise pivoting, then substitution upwards."""
    n = matrix.shape[-1]
    # Each row is a list of its coefficients and its right side.
    rows = []
    for i in range(n):
        coefficients = jnp.moveaxis(matrix[i], -1, 0)
        rows.append([*coefficients, right[..., i]])

    for k in range(n):
        for i in range(k + 1, n):
            above = rows[k][k:]
            below = rows[i][k:]
            upper, lower = _larger_first(above, below)
            pivot = upper[0]
            share = lower[0] / jnp.where(pivot == 0, 1.0, pivot)
            rows[k][k:] = upper
            pairs = zip(upper, lower, strict=True)
            rows[i][k:] = [y - share * x for x, y in pairs]

    x: dict[int, Array] = {}
    for i in reversed(range(n)):
        row = rows[i]
        known = [(row[k], x[k]) for k in x]
        x[i] = _less(row[n], known) / row[i]
    return jnp.stack([x[i] for i in range(n)], axis=-1)


def _larger_first(
    upper: list[Array], lower: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Return two rows, the one with the larger first element first, for each batch element."""
    trades = jnp.abs(lower[0]) > jnp.abs(upper[0])
    pairs = list(zip(upper, lower, strict=True))
    larger = [jnp.where(trades, y, x) for x, y in pairs]
    smaller = [jnp.where(trades, x, y) for x, y in pairs]
    return larger, smaller


@jax.jit
def solve_by_columns(
    matrix: Float[Array, "n n"], right: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return x in `matrix @ x = right`, by elimination with the largest pivot of each column, in a
    loop over the columns. Programs in which it runs now and then compile sooner than with `solve`,
    of which each operation is compiled."""
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _by_columns(matrix, b),
        lambda _, b: _by_columns(matrix.T, b),
    )


def _by_columns(matrix, right):
    """Return x (n,) in `matrix @ x = right`: in step k, column k becomes that of the unit
    matrix."""
    n = len(right)

    def eliminated(k, rows):
        is_done = jnp.arange(n) < k
        sizes = jnp.where(is_done, -1.0, jnp.abs(rows[:, k]))
        pivot = jnp.argmax(sizes)
        pivot_row = rows[pivot]
        chosen = pivot_row / rows[pivot, k]
        rows = rows.at[pivot].set(rows[k])
        shares = rows[:, k]
        rows = rows - jnp.outer(shares, chosen)
        return rows.at[k].set(chosen)

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    return jax.lax.fori_loop(0, n, eliminated, rows)[:, n]


@jax.jit
def cholesky(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Return L in `matrix = L @ L.T`, with zeros above the diagonal; of the matrix the lower
    triangle is read. NaN if it is not positive definite."""
    n = matrix.shape[-1]
    zero = jnp.zeros_like(matrix[..., 0, 0])
    lower = [[zero] * n for _ in range(n)]
    for j in range(n):
        for i in range(j, n):
            pairs = zip(lower[i][:j], lower[j][:j], strict=True)
            products = list(pairs)
            lower[i][j] = _less(matrix[..., i, j], products)
        pivot = lower[j][j]
        root = jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan))
        lower[j][j] = root
        for i in range(j + 1, n):
            lower[i][j] = lower[i][j] / root
    rows = [jnp.stack(row, axis=-1) for row in lower]
    return jnp.stack(rows, axis=-2)


@ft.partial(
    jax.jit, static_argnames=("left_side", "lower", "transpose_a", "unit_diagonal")
)
def triangular_solve(
    matrix: Float[Array, "*b n n"],
    right: Float[Array, "*b _ _"],
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
) -> Float[Array, "*b _ _"]:
    """Return X in `op(matrix) @ X = right`, or in `X @ op(matrix) = right`:
    `jax.lax.linalg.triangular_solve` for real numbers."""
    if not left_side:  # the transpose of the first form
        right = jnp.swapaxes(right, -1, -2)
        transpose_a = not transpose_a
    op = jnp.swapaxes(matrix, -1, -2) if transpose_a else matrix
    downwards = lower != transpose_a
    n = op.shape[-1]
    X: dict[int, Array] = {}
    order = list(range(n))
    if not downwards:
        order.reverse()
    for i in order:
        known = [(op[..., i, k, None], X[k]) for k in X]
        X[i] = _less(right[..., i, :], known)
        if not unit_diagonal:
            X[i] = X[i] / op[..., i, i, None]
    solution = jnp.stack([X[i] for i in range(n)], axis=-2)
    return solution if left_side else jnp.swapaxes(solution, -1, -2)


@jax.jit
def lu(
    matrix: Float[Array, "*b n n"],
) -> tuple[Float[Array, "*b n n"], Int[Array, "*b n"], Int[Array, "*b n"]]:
    """Return what `jax.lax.linalg.lu` returns for square matrices: L below the diagonal and U in
    one matrix, for each column the row that traded places with its own, and the order of all rows.
    """
    n = matrix.shape[-1]
    index = jnp.arange(n)

    def traded(rows, k, chosen):
        """(*b, n, m) with rows k and `chosen` (a mask) in each other's place."""
        mask = chosen[..., None]
        masked = jnp.where(mask, rows, 0)
        other = jnp.sum(masked, axis=-2, dtype=rows.dtype, keepdims=True)
        row = jax.lax.dynamic_slice_in_dim(rows, k, 1, rows.ndim - 2)
        here = (index == k)[:, None]
        replaced = jnp.where(mask, row, rows)
        return jnp.where(here, other, replaced)

    def eliminate(k, carry):
        X, pivots, order = carry
        sizes = jnp.abs(_column(X, k))
        candidates = jnp.where(index >= k, sizes, -1.0)
        largest = jnp.argmax(candidates, axis=-1)[..., None]
        chosen = index == largest
        X = traded(X, k, chosen)
        order = traded(order[..., None], k, chosen)[..., 0]
        pivots = jnp.where(index == k, largest.astype(np.int32), pivots)

        # Subtract shares of row k from the rows below, and keep these shares in its column.
        column = _column(X, k)
        pivot = _row(column[..., None], k)
        is_later = index > k
        share = column / jnp.where(pivot == 0, 1.0, pivot)
        share = jnp.where(is_later, share, 0.0)[..., :, None]
        row = jnp.where(is_later, _row(X, k), 0.0)[..., None, :]
        below = (index == k) & is_later[:, None]
        reduced = X - share * row
        X = jnp.where(below, share, reduced)
        return X, pivots, order

    order = jnp.broadcast_to(jnp.arange(n, dtype=np.int32), matrix.shape[:-1])
    begin = (matrix, jnp.zeros_like(order), order)
    return jax.lax.fori_loop(0, n, eliminate, begin)


def _less(x, products):
    """x less some products."""
    return ft.reduce(lambda x, pair: x - pair[0] * pair[1], products, x)


def _row(X, k):
    return jax.lax.dynamic_index_in_dim(X, k, axis=X.ndim - 2, keepdims=False)


def _column(X, k):
    return jax.lax.dynamic_index_in_dim(X, k, axis=X.ndim - 1, keepdims=False)
