r"""State-space models from impulse responses, and the steps that all realizations share.

The state at a section represents the effect of earlier inputs on the outputs from there on. Its
dimension at section n is the rank of a Hankel matrix, whose block `[i, j]` is the response at
section n + i to an input at section n - 1 - j (Ho and Kalman 1966, for each section of the period).
The range of this matrix is the observability matrix O[n], and A[n] follows from O[n], shifted by
one section, and O[n+1].

`realized` makes a model from impulse responses (for `SeriesFit.model`, bounds and designs).
`ranges` and `shifted` are also used by `joint/realization.py`.

If a model has a wrong number of states, look at `ranges` and at the level of noise (`edge`); if A
and C are wrong, at `shifted`. The basis at a section gives the B of the section before it, so that
`realized` shifts B by one section; this must stay.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.arguments import require_axes
from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .descent import ROUNDING, positive


Matrices = list[Float[np.ndarray, "_ _"]]
"""One matrix for each section."""

# Least number of sections over which a state is observed, by default. Smaller: less averaging.
_SHORTEST_HORIZON = 8
# A singular value must exceed the largest one of noise alone (its mean) by this factor. Larger:
# weak states are missed. Smaller: noise counts as states.
_NOISE_MARGIN = 1.1


def default_horizon(N: int) -> int:
    """Return the number of sections in which a state is observed; twice as many lags are needed."""
    return max(_SHORTEST_HORIZON, 2 * N)


def largest_of_noise(rows: int, columns: int) -> float:
    """Return the singular value that states must exceed, for noise of variance one in a matrix of
    this shape."""
    return _NOISE_MARGIN * (np.sqrt(rows) + np.sqrt(columns))


def realized(
    markov: Float[np.ndarray, "N lags ny nu"],
    *,
    noise: Float[np.ndarray, "ny nu"] | None = None,
    dims: Sequence[int] | None = None,
    order: int = 1,
    inputs: tuple[str, ...] | None = None,
    outputs: tuple[str, ...] | None = None,
) -> LDTP:
    """Return a minimal model with these Markov parameters, as of `LDTP.impulse_response`.

    **Arguments:**

    - `noise`: variances of the Markov parameters. States below the noise are left out. Default:
      only states below rounding errors are left out.
    - `dims`: dimension of the state at each section. Default: the ranks. `order`: the number of
      multipliers expected, a lower bound of dimensions.

    **Raises:** `DefinitionError` for too few lags, or more dimensions than these support.
    """
    N, lags, ny, nu = markov.shape
    p = min(default_horizon(N), (lags - 1) // 2)
    if p < 1:
        raise DefinitionError(f"{lags} lags are too few: 3 or more are needed.")
    # Outputs and inputs in units of their noise, or else of the responses.
    spread = np.mean(markov**2, axis=(0, 1)) if noise is None else noise
    input_unit = positive(np.sqrt(spread.mean(axis=0)))
    output_unit = positive(np.sqrt((spread / input_unit**2).mean(axis=1)))
    units = output_unit[:, None] * input_unit
    relative = markov / units
    hankels = []
    for n in range(N):
        rows = [
            [relative[(n + i) % N, i + j + 1] for j in range(p)] for i in range(p + 1)
        ]
        hankels.append(np.block(rows))
    edge = 0.0 if noise is None else largest_of_noise((p + 1) * ny, p * nu)
    bases = ranges(hankels, dims, order, edge, ny)
    A, C = shifted(bases, ny)
    B = [
        basis.T @ hankel[:, :nu] * input_unit
        for basis, hankel in zip(bases, hankels, strict=True)
    ]
    return LDTP.from_blocks(
        A,
        [*B[1:], B[0]],
        [output_unit[:, None] * c for c in C],
        list(markov[:, 0]),
        inputs,
        outputs,
    )


def given_dims(dims: Any, N: int, name: str = "dims") -> list[int] | None:
    """Return one dimension for each section; None if none are given.

    **Raises:** `DefinitionError` for another number of dimensions.
    """
    if dims is None:
        return None
    require_axes(f"`{name}`", dims, {}, {"sections": N})
    return np.broadcast_to(dims, N).tolist()


def ranges(
    matrices: Matrices, dims: Sequence[int] | None, order: int, edge: float, ny: int
) -> Matrices:
    """Return O[n], orthonormal bases of the ranges of each section's matrix.

    **Arguments:** `edge`: the singular value that states must exceed.

    **Raises:** `DefinitionError` for more dimensions than the matrices have.
    """
    rows, columns = matrices[0].shape
    most = min(rows - ny, columns)
    bases = []
    for n, matrix in enumerate(matrices):
        left, size, _ = np.linalg.svd(matrix, full_matrices=False)
        smallest = max(edge, ROUNDING * size[0])
        rank = int((size > smallest).sum())
        d = max(order, rank, 1) if dims is None else dims[n]
        if d > most:
            raise DefinitionError(
                f"section {n} would have {d} dimensions, but the data show {most} at most: give "
                "more lags or frequencies, or fewer dimensions."
            )
        bases.append(left[:, :d])
    return bases


def shifted(bases: Matrices, ny: int) -> tuple[Matrices, Matrices]:
    """Return A and C from O[n]: the first rows of O[n] are C[n], and the other rows are O[n+1]
    A[n]."""
    A = []
    for now, later in zip(bases, [*bases[1:], bases[0]], strict=True):
        step, *_ = np.linalg.lstsq(later[:-ny], now[ny:])
        A.append(step)
    return A, [basis[:ny] for basis in bases]
