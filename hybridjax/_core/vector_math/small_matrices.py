"""Factorizations of small matrices, written out.

XLA on CPU hands `jnp.linalg.solve` and its relatives to LAPACK, one matrix after the other: some
150 ns for 3 equations, where the operations themselves, for several lanes at once, take 9 (for 7
equations 310 and 60; if the matrix is symmetric and positive, 4 and 16). Programs that call LAPACK
may also wait for each other for ever if they run in several threads. The functions here do the same
in additions, multiplications, divisions and selections. `rewrite.vectorized` puts them into
functions that were written with `jnp`.

Matrices stand on the last two axes. Where LAPACK would report a failure, results are NaN or
infinite. Derivatives are those of the operations.
"""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Up to this number of rows factorizations are written out, with and without pivoting. Two more
# rows: XLA compiles twice as long, for seconds.
LARGEST, LARGEST_PIVOTED = 12, 7


@jax.jit
def solve_positive(
    matrix: Float[Array, "n n"], right: Float[Array, "*b n"]
) -> Float[Array, "*b n"]:
    """x in `matrix @ x = right` for a symmetric positive definite matrix, of which the lower
    triangle is read, by L D L^T, which is found once for all right sides.

    NaN where a pivot is not positive, up to rounding: the matrix is singular, or not definite.
    """
    n = right.shape[-1]
    lower, below, pivots, solved = _square(n), _square(n), [], []
    singular = jnp.asarray(False)
    for j in range(n):
        for i in range(j, n):
            below[i][j] = _less(matrix[..., i, j], [(below[i][k], lower[j][k]) for k in range(j)])
        pivot = below[j][j]
        singular = singular | ~(pivot > n * jnp.finfo(right.dtype).eps * matrix[..., j, j])
        pivots.append(1 / pivot)
        for i in range(j + 1, n):
            lower[i][j] = below[i][j] * pivots[j]
    for i in range(n):
        x = right[..., i] if i else jnp.where(singular, jnp.nan, right[..., i])
        solved.append(_less(x, [(lower[i][k], solved[k]) for k in range(i)]))
    for i in reversed(range(n)):
        known = [(lower[k][i], solved[k]) for k in range(i + 1, n)]
        solved[i] = _less(solved[i] * pivots[i], known)
    return jnp.stack(solved, axis=-1)


@jax.jit
def cholesky(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """L in `matrix = L @ L.T`, with zeros above the diagonal; of the matrix the lower triangle is
    read. NaN if it is not positive definite."""
    n = matrix.shape[-1]
    lower = _square(n, jnp.zeros_like(matrix[..., 0, 0]))
    for j in range(n):
        for i in range(j, n):
            x = _less(matrix[..., i, j], [(lower[i][k], lower[j][k]) for k in range(j)])
            if i == j:
                root = jnp.sqrt(jnp.where(x > 0, x, jnp.nan))
            lower[i][j] = root if i == j else x / root
    return _stacked(lower)


@jax.jit
def solve(matrix: Float[Array, "n n"], right: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """x in `matrix @ x = right`, by elimination with pairwise pivoting: a row trades places with
    any later one that has the larger number in its column.

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
    n = matrix.shape[-1]
    rows = [[*(matrix[i, j] for j in range(n)), right[..., i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            both = list(zip(rows[k][k:], rows[i][k:], strict=True))
            upper = [jnp.where(larger, y, x) for x, y in both]
            lower = [jnp.where(larger, x, y) for x, y in both]
            share = lower[0] / jnp.where(upper[0] == 0, 1.0, upper[0])
            rows[k][k:] = upper
            rows[i][k:] = [y - share * x for x, y in zip(upper, lower, strict=True)]
    found: dict[int, Array] = {}
    for i in reversed(range(n)):
        found[i] = _less(rows[i][n], [(rows[i][k], found[k]) for k in found]) / rows[i][i]
    return jnp.stack([found[i] for i in range(n)], axis=-1)


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
    """X in `op(matrix) @ X = right`, or in `X @ op(matrix) = right`: `jax.lax.linalg`'s function of
    that name for real numbers."""
    n = matrix.shape[-1]
    if not left_side:  # the transpose of the first form
        right, transpose_a = jnp.swapaxes(right, -1, -2), not transpose_a
    entry = lambda i, j: matrix[..., j, i] if transpose_a else matrix[..., i, j]  # noqa: E731
    downwards = lower != transpose_a
    found: dict[int, Array] = {}
    for i in range(n) if downwards else reversed(range(n)):
        x = _less(right[..., i, :], [(entry(i, k)[..., None], found[k]) for k in found])
        found[i] = x if unit_diagonal else x / entry(i, i)[..., None]
    solved = jnp.stack([found[i] for i in range(n)], axis=-2)
    return solved if left_side else jnp.swapaxes(solved, -1, -2)


def _square(n, fill=None):
    return [[fill] * n for _ in range(n)]


def _less(x, products):
    """x less some products."""
    return ft.reduce(lambda x, pair: x - pair[0] * pair[1], products, x)


def _stacked(rows):
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
