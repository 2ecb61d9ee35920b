"""Rank and non-zero eigenvalues of a product of matrices that is never formed (host side).

The factors `A[N-1] ... A[0]` may be rectangular: `A[n]` is `(d[n+1], d[n])`, cyclically. A product
in double precision destroys eigenvalues smaller than `1e-16` of the largest; the factors do not.
Tolerances are on factors only, never on eigenvalues.

`product_rank` and `product_eigenvalues` are the entries. If a multiplier is missing, look at
`_carry_range` and the tolerance that the caller gives; if one is wrong, at `_diagonal_blocks`; if a
pair is not conjugate, at `_eigenvalues`.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float, Int

from ..errors import ComputationError


Matrix = Float[np.ndarray, "_ _"]

# Sweeps of the orthogonal iteration. Fewer: moduli that differ by a factor of ten are not told
# apart, and the smaller one loses digits. More: time for moduli that hardly differ.
_MOST_SWEEPS = 16
# A subspace is found if the product maps a basis of it into the subspace, up to this part of the
# basis. Smaller: rounding hides that it was found. Larger: multipliers lose digits.
_SETTLED = 1e-14
# If that part changes by less than this factor from one sweep to the next, there is no progress.
# Smaller: sweeps in vain. Larger: subspaces that are about to be found are missed.
_STALLED = 4.0


def product_rank(factors: Sequence[Matrix], rtol: float) -> int:
    """Rank of the product: the range is carried through the factors on an orthonormal basis.

    **Arguments:** `factors`, in the order in which they act; `rtol`, the singular values of a
    factor below `rtol` times its largest one count as zero.

    **Raises:** `ComputationError` for NaN and infinity.
    """
    unit = np.eye(factors[0].shape[1])
    basis, _ = _carry_range(_balanced(factors), unit, rtol)
    return basis.shape[1]


def product_eigenvalues(
    factors: Sequence[Matrix], rtol: float
) -> Complex[np.ndarray, " r"]:
    """The non-zero eigenvalues of the product, the largest first, conjugate pairs exact. Those that
    are too small for a number are zero.

    The factors are restricted to the range of the product, on which they are square and regular.
    Orthogonal iteration (Golub and Van Loan, *Matrix Computations*, 2013, sec. 7.3) brings them to
    block triangular form together, eigenvalues of different sizes in different blocks. The product
    of the blocks is formed: their eigenvalues are similar in size, so that none drowns in others.

    **Arguments:** as in `product_rank`.

    **Raises:** `ComputationError` for NaN and infinity.
    """
    regular = _regular_part(_balanced(factors), rtol)
    if not regular:
        return np.zeros(0, complex)
    blocks = [_eigenvalues(block) for block in _diagonal_blocks(regular)]
    eigenvalues = np.concatenate(blocks)
    return eigenvalues[largest_first(eigenvalues)]


def largest_first(values: Complex[np.ndarray, "*B n"]) -> Int[np.ndarray, "*B n"]:
    """The indices that sort complex numbers by decreasing modulus; of a conjugate pair, the number
    with positive imaginary part comes first."""
    return np.lexsort((-np.imag(values), -np.abs(values)))


def conjugate_of(values: Complex[np.ndarray, " n"], k: int) -> int:
    """The index of the complex conjugate of number k, which is k for a real number."""
    return int(np.argmin(np.abs(values - values[k].conj())))


def _balanced(factors):
    """The factors in other units of each coordinate, powers of two, in which what comes in is as
    large as what goes out (Osborne, J. ACM 7, 1960): so that ranks do not depend on units."""
    factors = [np.array(factor, float) for factor in factors]
    for n, factor in enumerate(factors):
        if not np.all(np.isfinite(factor)):
            raise ComputationError(
                f"A[{n}] holds NaN or infinity, so there are no multipliers."
            )
    for _ in range(8):  # more rounds change nothing
        for n in range(len(factors)):
            incoming = np.linalg.norm(factors[n - 1], axis=1)
            outgoing = np.linalg.norm(factors[n], axis=0)
            both = (incoming > 0) & (outgoing > 0)
            ratio = np.divide(
                outgoing, incoming, out=np.ones_like(incoming), where=both
            )
            unit = 2.0 ** np.round(np.log2(ratio) / 2)
            factors[n - 1] *= unit[:, None]
            factors[n] /= unit
    return factors


def _carry_range(factors, basis, rtol):
    """Orthonormal basis of `A[N-1] ... A[0] basis`, and each factor in the bases on its way."""
    reduced = []
    for factor in factors:
        image = factor @ basis
        left, singular, _ = np.linalg.svd(image, full_matrices=False)
        left = left[:, singular > rtol * np.linalg.norm(factor, 2)]
        reduced.append(left.T @ image)
        basis = left
    return basis, reduced


def _regular_part(factors, rtol):
    """Square regular factors whose product has the non-zero eigenvalues of the whole.

    The range of the powers of the product shrinks until it is mapped onto itself.
    """
    smallest = int(np.argmin([factor.shape[1] for factor in factors]))
    factors = [*factors[smallest:], *factors[:smallest]]
    basis = np.eye(factors[0].shape[1])
    while basis.shape[1] > 0:
        image, reduced = _carry_range(factors, basis, rtol)
        if image.shape[1] == basis.shape[1]:
            reduced[-1] = basis.T @ image @ reduced[-1]
            return reduced
        basis = image
    return []


def _diagonal_blocks(factors):
    """Yield for each block on the diagonal its part of each factor, all unitarily and periodically
    similar to the given square ones."""
    d = len(factors[0])
    basis = np.eye(d)
    below = np.full(d - 1, np.inf)
    stalls = 0
    for _ in range(_MOST_SWEEPS):
        start = basis
        before = below
        triangles = []
        for factor in factors:
            basis, triangle = np.linalg.qr(factor @ basis)
            triangles.append(triangle)
        turn = start.T @ basis  # the basis after one turn in that before
        blocks = [turn[k:, :k] for k in range(1, d)]
        below = np.array([np.linalg.norm(block) for block in blocks])
        settled = below < _SETTLED
        alike = (below < _STALLED * before) & (before < _STALLED * below)
        stalls = stalls + 1 if (settled | alike).all() else 0
        if settled.all() or stalls == 2:
            break
    edges = [0, *(1 + np.flatnonzero(settled)), d]
    for begin, end in itertools.pairwise(edges):
        block = slice(begin, end)
        yield [x[block, block] for x in (*triangles, turn)]


def _eigenvalues(factors):
    """The eigenvalues of a product, which may be too small or too large for a number on its way."""
    product = np.eye(len(factors[0]))
    exponent = 0
    for factor in factors:
        product = factor @ product
        digits = int(np.frexp(np.abs(product).max())[1])
        product = np.ldexp(product, -digits)
        exponent += digits
    values = np.linalg.eigvals(product).astype(complex)
    return np.ldexp(values.view(float), exponent).view(complex)
