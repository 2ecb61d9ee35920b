"""A periodic model of series to begin a fit with: regression on the past, then a common state."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from .periodic_model import PeriodicModel
from .series_part import SeriesPart


# Samples of a section for each coefficient of the regression on its past, and periods of the past at
# most. Doubled: half the past, less noise; twice the past and four times the work.
_ROWS, _PERIODS = 3, 2
# Sections that a state is seen through, at least. Doubled: more averaging.
_SHORTEST_HORIZON = 8
# Part of the rms that every regressor is shrunk by. Doubled: twice the bias, next to nothing.
_SHRINKAGE = 1e-6
# Largest modulus of a multiplier of the predictor in a start. Doubled: not possible.
_LARGEST_MODULUS = 0.95


def subspace_model(
    parts: Iterable[SeriesPart], dims: Int[np.ndarray, " N"], innovations: bool
) -> PeriodicModel:
    """A model with these dimensions, with or without K.

    Each output is regressed on its own past and that of the inputs, section by section. What the
    past of a section adds to the outputs from there on is a matrix whose rank is the dimension of
    the state (Chiuso 2007, "PBSID", for each section of the period).

    **Raises:** `DefinitionError` for too few cycles for a past as long as the states need.
    """
    u, y = _rows(parts)
    N, ny, nu = len(dims), y[0].shape[-1], u[0].shape[-1]
    samples = min(_known(u, y, n, 1, N)[0].shape[0] for n in range(N))
    past = min(samples // (_ROWS * (ny + nu)), max(_PERIODS * N, _SHORTEST_HORIZON))
    needed = -(-int(max(dims)) // (ny + nu)) + 1
    if past < needed:
        raise DefinitionError(
            f"{samples} cycles are too few to begin with {max(dims)} dimensions of the state: "
            f"{_ROWS * (ny + nu) * needed} are needed. Give a model as `guess`, of "
            "`hj.identify.realize(hj.fit_series(...))`."
        )
    rules = [_regression(*_known(u, y, n, past, N)) for n in range(N)]
    # Predictions at section n + i from the past of n alone, newest first.
    states = []
    horizon = max(-(-int(max(dims)) // ny) + 1, min(past, N))
    for n in range(N):
        blocks = []
        for i in range(horizon):
            rule = rules[(n + i) % N][nu:]  # (past (nu + ny), ny), newest sample first
            shifted = np.zeros_like(rule)
            shifted[: len(rule) - i * (nu + ny)] = rule[i * (nu + ny) :]
            blocks.append(shifted)
        states.append(np.concatenate(blocks, axis=1))  # (past (nu + ny), horizon ny)
    to_state = []
    for n in range(N):
        rows = _known(u, y, n, past, N)[0][:, nu:]
        root = np.linalg.qr(rows, mode="r")
        _, s, vh = np.linalg.svd(root @ states[n], full_matrices=False)
        if dims[n] > len(s):
            raise DefinitionError(f"the past shows {len(s)} dimensions of the state, not {dims[n]}.")
        to_state.append(states[n] @ vh[: dims[n]].T / s[: dims[n]] * np.sqrt(len(rows)))
    return _from_states(u, y, to_state, past, innovations)
