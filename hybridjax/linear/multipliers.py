"""Rank and non-zero eigenvalues of a product of matrices that is never formed (host side).

The factors `A[N-1] ... A[0]` may be rectangular: `A[n]` is `(d[n+1], d[n])`, cyclically. A product
in double precision destroys eigenvalues smaller than `1e-16` of the largest; the factors do not.
Tolerances are on factors only, never on eigenvalues.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from ..errors import ComputationError


Matrix = Float[np.ndarray, "_ _"]

# QR sweeps for one eigenvalue; two or three are usual. Fewer: rare ones fail. More: failure takes
# longer.
_MOST_SWEEPS = 60
# Sweeps after which an exceptional shift breaks a cycle of shifts. Fewer: convergence is disturbed.
# More: a cycle of shifts ends later.
_EXCEPTIONAL_EVERY = 10


def product_rank(factors: Sequence[Matrix], rtol: float) -> int:
    """Rank of the product: the range is carried through the factors on an orthonormal basis.

    **Arguments:** `factors`, in the order in which they act; `rtol`, the singular values of a
    factor below `rtol` times its largest one count as zero.

    **Raises:** `ComputationError` for NaN and infinity.
    """
    basis, _ = _carry_range(_balanced(factors), np.eye(factors[0].shape[1]), rtol)
    return basis.shape[1]


def product_eigenvalues(factors: Sequence[Matrix], rtol: float) -> Complex[np.ndarray, " r"]:
    """The non-zero eigenvalues of the product, the largest first, conjugate pairs exact. Those that
    are too small for a number are zero.

    The factors are restricted to the range of the product, on which they are square and regular;
    then the periodic QR algorithm (Bojanczyk, Golub and Van Dooren, "The periodic Schur
    decomposition", SPIE 1770, 1992) brings them to triangular form together.

    **Arguments:** as in `product_rank`.

    **Raises:** `ComputationError` if the QR algorithm does not converge, or for NaN and infinity.
    """
    regular = _regular_part(_balanced(factors), rtol)
    if not regular:
        return np.zeros(0, complex)
    triangular = _periodic_schur([factor.astype(complex) for factor in regular])
    # (By logarithms, lest the product of some be too small or too large for a number.)
    logarithms = np.sum([np.log(np.diag(factor)) for factor in triangular], axis=0)
    eigenvalues = _pair_conjugates(np.exp(logarithms))
    return eigenvalues[np.lexsort((-np.imag(eigenvalues), -np.abs(eigenvalues)))]


def _balanced(factors):
    """The factors in other units of each coordinate, powers of two, in which what comes in is as
    large as what goes out (Osborne, J. ACM 7, 1960): so that ranks do not depend on units."""
    factors = [np.array(factor, float) for factor in factors]
    for n, factor in enumerate(factors):
        if not np.all(np.isfinite(factor)):
            raise ComputationError(f"Factor {n} of the monodromy holds NaN or infinity.")
    for _ in range(8):  # more rounds change nothing
        for n in range(len(factors)):
            incoming = np.linalg.norm(factors[n - 1], axis=1)
            outgoing = np.linalg.norm(factors[n], axis=0)
            both = (incoming > 0) & (outgoing > 0)
            ratio = np.divide(outgoing, incoming, out=np.ones_like(incoming), where=both)
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


def _rotation(a, b):
    """The unitary matrix that takes `(a, b)` to `(r, 0)`."""
    r = np.hypot(abs(a), abs(b))
    if r == 0:
        return np.eye(2, dtype=complex)
    return np.array([[np.conj(a), np.conj(b)], [-b, a]]) / r


def _rotate(factors, k, rotation):
    """Change coordinates `k, k+1` before the first factor; keep all but the last triangular."""
    pair = slice(k, k + 2)
    *triangles, hessenberg = factors
    hessenberg[pair] = rotation @ hessenberg[pair]
    for triangle in triangles:
        triangle[:, pair] = triangle[:, pair] @ rotation.conj().T
        rotation = _rotation(triangle[k, k], triangle[k + 1, k])
        triangle[pair] = rotation @ triangle[pair]
        triangle[k + 1, k] = 0
    hessenberg[:, pair] = hessenberg[:, pair] @ rotation.conj().T


def _hessenberg_triangular(factors):
    """Unitary changes of coordinates: the last factor Hessenberg, all others triangular."""
    basis = np.eye(len(factors[0]), dtype=complex)
    reduced = []
    for factor in factors[:-1]:
        basis, triangle = np.linalg.qr(factor @ basis)
        reduced.append(triangle)
    hessenberg = factors[-1] @ basis
    reduced.append(hessenberg)
    for column in range(len(hessenberg) - 2):
        for row in range(len(hessenberg) - 1, column + 1, -1):
            rotation = _rotation(hessenberg[row - 1, column], hessenberg[row, column])
            _rotate(reduced, row - 1, rotation)
            hessenberg[row, column] = 0
    return reduced


def _shift(factors, low, high, exceptional):
    """A shift for the product divided by the triangles' `[low, low]`: it may be rough.

    An eigenvalue of the trailing 2 x 2 block; an exceptional one breaks a stall (LAPACK's way).
    """
    pair = slice(high - 1, high + 1)
    *triangles, hessenberg = factors
    block = hessenberg[pair, pair]
    with np.errstate(all="ignore"):
        for triangle in reversed(triangles):
            block = block @ (triangle[pair, pair] / triangle[low, low])
    if not np.all(np.isfinite(block)):
        return 0.0
    if exceptional:
        return block[1, 1] + 0.75 * np.abs(block[1, 0])
    eigenvalues = np.linalg.eigvals(block)
    return eigenvalues[np.argmin(np.abs(eigenvalues - block[1, 1]))]


def _periodic_schur(factors):
    """Triangular factors, unitarily and periodically similar to the given square ones."""
    factors = _hessenberg_triangular(factors)
    hessenberg = factors[-1]
    eps = np.finfo(float).eps
    high, stalled = len(hessenberg) - 1, 0
    while high > 0:
        size = np.abs(np.diag(hessenberg))
        small = np.abs(np.diag(hessenberg, -1)) <= eps * (size[:-1] + size[1:])
        hessenberg[1:, :-1][np.diag(small)] = 0
        if small[high - 1]:
            high, stalled = high - 1, 0
            continue
        low = high - 1
        while low > 0 and not small[low - 1]:
            low -= 1
        stalled += 1
        if stalled > _MOST_SWEEPS:
            raise ComputationError("The periodic QR algorithm did not converge.")
        shift = _shift(factors, low, high, exceptional=stalled % _EXCEPTIONAL_EVERY == 0)
        start = (hessenberg[low, low] - shift, hessenberg[low + 1, low])
        _rotate(factors, low, _rotation(*start))
        for k in range(low + 1, high):
            _rotate(factors, k, _rotation(hessenberg[k, k - 1], hessenberg[k + 1, k - 1]))
            hessenberg[k + 1, k - 1] = 0
    return factors


def _pair_conjugates(eigenvalues):
    """The eigenvalues of a real matrix, made exactly real or exactly conjugate in pairs."""
    left = list(eigenvalues)
    paired = []
    while left:
        value = left.pop(int(np.argmax(np.abs(np.imag(left)))))
        to_others = np.abs(np.conj(value) - np.array(left))
        if left and to_others.min() < abs(2 * value.imag):
            partner = left.pop(int(np.argmin(to_others)))
            mean = (value + np.conj(partner)) / 2
            paired += [mean, np.conj(mean)]
        else:
            paired.append(complex(value.real, 0.0))
    return np.array(paired)
