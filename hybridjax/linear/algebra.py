r"""Series, parallel, inverse and feedback of linear periodic systems.

Systems are joined side by side first, with inputs w and outputs z; then
$w = K z + L r$ and $y = M z$ connect them.

HTFs are matrices, one for each class of frequencies f + integers: components of the input at
f + b become components of the output at f + a by $H(f)[a, b] = H_{a-b}(f + b)$, indices modulo N.

`LDTP` and `HTF` call these functions. If a connection of systems is wrong, look at `connect`; if
that of HTFs is, at `Lines` (which line stands where), then at the operation; if only variances are,
at the pairs (G, H) that the operation returns. `feedback` is negative, $u = r - F y$, as in all
callers. A further operation on HTFs is a function like `series` (see `Operation`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from .._core.arguments import require_axes
from .._core.compilation import host_first
from .._core.executor import Array, is_traced, namespace, solve
from ..errors import DefinitionError


# Distance in cycles per period up to which two frequencies are the same. Smaller: rounding makes
# them different. Larger: lines of very long designs coincide.
SAME_FREQUENCY = 1e-9
# Smallest singular value of I - K D, relative to the largest, with which systems can be connected.
# Smaller: responses are rounding errors. Larger: loops that have a response are refused.
_WELL_POSED = 1e-12


class Matrices(NamedTuple):
    """Padded matrices and true dimensions of an LDTP."""

    A: Float[Array, "N d d"]
    B: Float[Array, "N d nu"]
    C: Float[Array, "N ny d"]
    D: Float[Array, "N ny nu"]
    dims: Int[Array, " N"]


def static_gain(
    gain: Float[Array, "*N ny nu"], n_sections: int, shape: tuple[int, int]
):
    """Return a gain, or N of them, as a system without states, for `shape` (ny, nu).

    **Raises:** `DefinitionError` for another shape.
    """
    xp = namespace(gain)
    N = n_sections
    ny, nu = shape
    # (The axes have the names of the signals of the plant: its outputs, ny, are inputs of a gain.)
    one = {"inputs": ny, "outputs": nu}
    require_axes("a gain", gain, one, {"sections": N} | one)
    return Matrices(
        A=xp.zeros((N, 0, 0)),
        B=xp.zeros((N, 0, nu)),
        C=xp.zeros((N, ny, 0)),
        D=xp.broadcast_to(gain, (N, ny, nu)),
        dims=xp.zeros(N, int),
    )


@host_first
def connect(
    a: Matrices,
    b: Matrices,
    K: Float[Array, "nw nz"],
    L: Float[Array, "nw nr"],
    M: Float[Array, "ny nz"],
) -> Matrices:
    """Connect two systems, with inputs w = K z + L r and outputs y = M z.

    States of both stand one after the other at each section, and padding behind both.
    """
    xp = namespace(a.A)
    pairs = zip(a[:4], b[:4], strict=True)
    A, B, C, D = (_side_by_side(x, y) for x, y in pairs)
    d = C.shape[2]
    outside = xp.broadcast_to(L, (len(D), *L.shape))
    loop = xp.eye(len(K)) - K @ D
    to_inputs = solve(loop, xp.concatenate([K @ C, outside], 2))
    by_state = to_inputs[..., :d]
    by_input = to_inputs[..., d:]
    # Padding goes behind the states of both, which stay in their order.
    is_padding = []
    for x in (a, b):
        index = xp.arange(x.A.shape[1])
        is_padding.append(index >= x.dims[:, None])
    key = xp.concatenate(is_padding, axis=1) * d + xp.arange(d)
    order = xp.argsort(key, axis=1)
    before = order[:, None, :]
    after = xp.roll(order, -1, axis=0)[:, :, None]
    A = xp.take_along_axis(A + B @ by_state, after, 1)
    return Matrices(
        A=xp.take_along_axis(A, before, 2),
        B=xp.take_along_axis(B @ by_input, after, 1),
        C=xp.take_along_axis(M @ (C + D @ by_state), before, 2),
        D=M @ D @ by_input,
        dims=a.dims + b.dims,
    )


def _side_by_side(
    x: Float[Array, "N a b"], y: Float[Array, "N c d"]
) -> Float[Array, "N ac bd"]:
    """Return block diagonal matrices."""
    xp = namespace(x)
    _, a, b = x.shape
    _, c, d = y.shape
    upper_left = xp.pad(x, ((0, 0), (0, c), (0, d)))
    lower_right = xp.pad(y, ((0, 0), (a, 0), (b, 0)))
    return upper_left + lower_right


def require_well_posed(D: Float[Array, "N ny nu"], F: Float[Array, "N nu ny"]) -> None:
    """**Raises:** `DefinitionError` where a section answers itself without bounds by -F."""
    if is_traced(D, F):
        return
    loop = np.asarray(D) @ np.asarray(F)
    answer = np.eye(D.shape[1]) + loop
    size = np.linalg.svd(answer, compute_uv=False)
    least = _WELL_POSED * np.maximum(size[:, 0], 1)
    singular = size[:, -1] < least
    if singular.any():
        raise DefinitionError(
            f"direct feed-through answers itself at section {np.argmax(singular)} (I + D of plant "
            "times D of controller is singular): let the controller wait a section."
        )


class Lines(NamedTuple):
    """Where the entries of harmonic matrices lie in HTFs: of K classes, each with N lines."""

    row: Int[np.ndarray, "K N"]
    """For each class and component b, the index of a frequency of the HTF."""
    mirrored: Bool[np.ndarray, "K N"]
    """True if this frequency is minus that of the component: then the conjugate of the HTF there is
    taken."""

    @classmethod
    def of(cls, f: Float[np.ndarray, " F"], N: int) -> "Lines":
        """Find the lines of each class f + integers.

        **Raises:** `DefinitionError` for a class that lacks a line.
        """
        start = np.sort(np.minimum(f % 1, -f % 1))
        is_new = np.insert(np.diff(start) > SAME_FREQUENCY, 0, True)
        wanted = start[is_new][:, None] + np.arange(N)
        each = wanted[..., None]
        apart = np.abs(_centered(f - each, N))
        from_mirror = np.abs(_centered(f + each, N))
        there = apart.min(axis=2) < SAME_FREQUENCY
        mirrored = from_mirror.min(axis=2) < SAME_FREQUENCY
        lost = wanted[~(there | mirrored)]
        if len(lost):
            raise DefinitionError(
                f"the HTFs do not hold f = {abs(_centered(lost[0], N)):.10g} cycles per period: "
                f"algebra takes all lines f + integers, up to N/2 = {N / 2:g}."
            )
        row = np.where(there, apart.argmin(axis=2), from_mirror.argmin(axis=2))
        return cls(row, ~there)

    def matrices(self, x: Array) -> Complex[Array, "K Nny Nnu"]:
        """Return the harmonic matrices of values (N, F, ny, nu), in the order of all harmonics."""
        xp = namespace(x)
        K, N = self.row.shape
        _, _, ny, nu = x.shape
        m = np.arange(N)[:, None] - np.arange(N)
        sign = np.where(self.mirrored, -1, 1)[:, None]
        harmonic = (sign * m + N // 2) % N
        values = x[harmonic, self.row[:, None]]  # (K, a, b, ny, nu)
        conjugated = self.mirrored[:, None, :, None, None]
        values = xp.where(conjugated, xp.conj(values), values)
        return values.swapaxes(2, 3).reshape(K, N * ny, N * nu)

    def entries(self, matrices: Array) -> Complex[Array, "N F ny nu"]:
        """Return the values of all lines, whose harmonic matrices these are."""
        xp = namespace(matrices)
        K, N = self.row.shape
        ny = matrices.shape[1] // N
        values = matrices.reshape(K, N, ny, N, -1).swapaxes(2, 3)
        # Class k and column b in which each line stands first.
        _, first = np.unique(self.row, return_index=True)
        k, b = np.unravel_index(first, self.row.shape)
        mirrored = self.mirrored[k, b]
        # H_m stands m rows below the diagonal; of a line that stands for its mirror image -f, it is
        # the conjugate of H_-m.
        m = np.arange(N)[:, None] - N // 2
        a = (b + np.where(mirrored, -m, m)) % N
        values = values[k, a, b]
        return xp.where(mirrored[:, None, None], xp.conj(values), values)


def _centered(f: Float[np.ndarray, "*shape"], N: int) -> Float[np.ndarray, "*shape"]:
    """Return frequencies modulo N, between -N/2 and N/2."""
    return (f + N / 2) % N - N / 2


Operation = Callable[..., tuple[Array, list[tuple]]]
"""Takes matrices X, and returns the result Y with pairs (G, H), one for each X: to first order
dY is the sum of the G dX H, up to signs, which variances do not need. None is an identity."""


def series(P, Q):
    return P @ Q, [(None, Q), (P, None)]


def parallel(P, Q):
    return P + Q, [(None, None)] * 2


def inverse(P):
    R = namespace(P).linalg.inv(P)
    return R, [(R, R)]


def feedback(P, F):
    xp = namespace(P)
    loop = xp.eye(P.shape[1]) + P @ F
    before = xp.linalg.inv(loop)
    R = before @ P
    after = xp.eye(P.shape[2]) - F @ R
    return R, [(before, after), (R, R)]


def variance_of(pairs: list[tuple], variances: list[Array]) -> Array:
    """Return the variance of a result from those of independent errors of all entries."""
    total = 0.0
    for (before, after), variance in zip(pairs, variances, strict=True):
        if before is not None:
            variance = abs(before) ** 2 @ variance
        if after is not None:
            variance = variance @ abs(after) ** 2
        total = total + variance
    return total
