"""What a fit to series says of other series."""

import numpy as np
from jaxtyping import Float

from .fit import SeriesFit
from .layout import Piece, slow_waves
from .regression import along_cycles, lagged, responses_to_starts


def predict(fit: SeriesFit, piece: Piece, free: bool) -> Float[np.ndarray, "n ny"]:
    """Outputs simulated from the inputs, with the drift that fits the piece best, and from the
    start that does, or from rest."""
    N, R, ny, nu = fit.numerators.shape
    d, n = len(fit.coefficients), len(piece.u)
    T = -(-(piece.start + n) // N)
    u, y = np.zeros((1, T * N, nu)), np.full((T * N, ny), np.nan)
    rows = slice(piece.start, piece.start + n)
    u[0, rows], y[rows] = piece.u, piece.y
    v = along_cycles(fit.coefficients, u.reshape(1, T, N, nu))
    y, out = y.reshape(T, N, ny), np.zeros((T, N, ny))
    # As in the fit: what came before acts on so many cycles on its own.
    count = d + -(-(R - 1 - fit.lead - d * N) // N) if free else 0
    slow = slow_waves(piece, N, piece.drift)
    for k in range(N):
        b = fit.numerators[k].transpose(0, 2, 1).reshape(R * nu, ny)
        out[:, k] = lagged(v, k, R, fit.lead)[0] @ b
        first = np.array([int(k < piece.start)])
        E = responses_to_starts(fit.coefficients, first, T, min(count, T))[0]
        E = np.concatenate([E, slow], axis=1)
        for i in range(ny):
            seen = np.isfinite(y[:, k, i])
            if E.shape[1] and seen.any():
                start = np.linalg.lstsq(E[seen], (y[:, k, i] - out[:, k, i])[seen])[0]
                out[:, k, i] += E @ start
    return out.reshape(T * N, ny)[rows]
