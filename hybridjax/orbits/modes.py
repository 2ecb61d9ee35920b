"""Floquet multipliers with right and left eigenvectors of the monodromy matrix, with derivatives.

`responses.py` calls `modes_of`. The eigenvectors of LAPACK, without derivatives, are starts of one
step of Newton's method (`_mode`), which adds them. The order and the scale of the modes are those
that `Responses` promises, and must stay.

If a multiplier or a derivative is wrong, look at `_newton_step`; if a mode has the wrong scale, at
`_scaled`; if modes are missing or in another order, at `modes_of`; if multipliers are said to
coincide and do not, at `_mode`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact

from .._core.executor import Array, namespace, on_host, stop_gradient
from ..errors import ComputationError, DefinitionError
from .return_map import SINGULAR
from .scale import in_sizes


# Modes with multipliers below this modulus have no amplitude response. Smaller: rounding errors,
# divided by the multiplier, take the place of digits. Larger: slower modes are left out.
_LEAST = 1e-6


class Modes(NamedTuple):
    """Multipliers and modes, by decreasing modulus of the multiplier."""

    multipliers: Complex[Array, " r"]
    right: Inexact[Array, "r d"]
    """The modes."""
    left: Inexact[Array, "r d"]
    """Derivatives of their amplitudes by the state."""


def modes_of(
    monodromy: Float[Array, "d d"], sizes: Float[Array, " d"], count: int | None
) -> Modes:
    """Return the slowest modes. Default: all with amplitude responses, which needs the values of
    the matrix.

    Of two conjugate modes, the first has the positive imaginary part.

    **Raises:** `ComputationError` for multipliers that coincide; `DefinitionError` for more modes
    than have amplitudes.
    """
    xp = namespace(monodromy)
    scaled = in_sizes(monodromy, sizes)
    values, right = xp.linalg.eig(stop_gradient(scaled))
    lower_last = 1e-9 * (xp.imag(values) < 0)
    order = xp.argsort(-xp.abs(values) + lower_last, stable=True)
    if on_host(monodromy):
        kept = int(np.sum(np.abs(values) > _LEAST))
        count = kept if count is None else count
        if count > kept:
            raise DefinitionError(
                f"{count} modes were asked for; {kept} have amplitudes."
            )
    modes = []
    for k in order[:count]:
        modes.append(_mode(scaled, sizes, values[k], right[:, k]))
    if not modes:
        return Modes(values[:0], right[:0], right[:0])
    return Modes(*(xp.stack(x) for x in zip(*modes, strict=True)))


def _mode(scaled: Float[Array, "d d"], sizes: Float[Array, " d"], value, right):
    """A multiplier with its right and left eigenvectors, in units of the states, near those that
    are given.

    **Arguments:** `scaled`: the monodromy matrix in sizes of the states. `value`, `right`: without
    derivatives.

    **Raises:** `ComputationError` for a multiplier that coincides with another one.
    """
    xp = namespace(scaled)
    fixed = stop_gradient(scaled)
    # The left eigenvector is the vector that this difference shortens most.
    _, _, rows = xp.linalg.svd(fixed.T - value * np.eye(len(fixed)))
    left = xp.conj(rows[-1])
    right, multiplier = _newton_step(scaled, fixed, value, right)
    left, _ = _newton_step(scaled.T, fixed.T, value, left)
    if on_host(scaled):
        lengths = np.linalg.norm(left) * np.linalg.norm(right)
        apart = np.abs(left @ right) / lengths
        if not apart > SINGULAR:
            raise ComputationError(
                "two multipliers coincide, and their modes have no amplitudes of their own: "
                "ask for the phase alone by `modes=0`, or change a parameter."
            )
    return multiplier, *_scaled(right, left, sizes)


def _newton_step(matrix, fixed, value, x):
    """One step of Newton's method for (matrix - value) x = 0 with x* x = 1. From a solution without
    derivatives, it gives x and the value those by the matrix.

    **Arguments:** `fixed`: the matrix without derivatives.
    """
    xp = namespace(matrix)
    n = len(matrix)
    shifted = fixed - value * np.eye(n)
    rows = xp.concatenate([shifted, xp.conj(x)[None]])
    last_column = xp.append(-x, 0.0)[:, None]
    bordered = xp.concatenate([rows, last_column], axis=1)
    residual = xp.append(matrix @ x - value * x, 0.0)
    step = xp.linalg.solve(bordered, residual)
    return x - step[:n], value - step[n]


def _scaled(right, left, sizes):
    """Both eigenvectors in units of the states: the left one of length 1, with a real largest entry
    (in sizes of the states), and the right one such that left . right = 1."""
    xp = namespace(left)
    largest = left[xp.argmax(xp.abs(left))]
    left = left / sizes
    left = (
        left * xp.conj(largest) / xp.abs(largest) / xp.sqrt(xp.sum(xp.abs(left) ** 2))
    )
    return right * sizes / (left @ (right * sizes)), left
