"""Delays and filters of series that lie on a `CycleGrid`."""

import numpy as np
from jaxtyping import Float, Int
from scipy.signal import lfilter


def lagged_inputs(
    u: Float[np.ndarray, "S T N nu"], section: int, lags: int, lead: int
) -> Float[np.ndarray, "S T columns"]:
    """The inputs r samples before a section, in all cycles, for r = -lead, ..., lags - 1 - lead.

    Zero where there is no record. Columns are ordered by r, then by input.
    """
    S, T, N, nu = u.shape
    before, after = np.zeros((S, lags - 1 - lead, nu)), np.zeros((S, lead, nu))
    row = np.concatenate([before, u.reshape(S, T * N, nu), after], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(row, lags, axis=1)[:, section::N]
    return windows[..., ::-1].swapaxes(2, 3).reshape(S, T, lags * nu)


def delay_cycles(x: np.ndarray, cycles: int, fill: float | bool = 0) -> np.ndarray:
    """x (S, T, ...) so many cycles later; `fill` before its start."""
    T = x.shape[1]
    cycles = min(cycles, T)
    return np.concatenate([np.full_like(x[:, :cycles], fill), x[:, : T - cycles]], axis=1)


def divide_by_chi(c: Float[np.ndarray, " d"], x: np.ndarray, delay: int = 0) -> np.ndarray:
    """x (S, T, ...) filtered by 1 / chi from cycle to cycle, `delay` cycles later."""
    if delay >= x.shape[1]:
        return np.zeros_like(x)
    out = lfilter([1.0], np.concatenate([[1.0], c]), x, axis=1)
    return np.concatenate([np.zeros_like(out[:, :delay]), out[:, : x.shape[1] - delay]], axis=1)


def start_responses(
    c: Float[np.ndarray, " d"], first: Int[np.ndarray, " S"], T: int, K: int
) -> Float[np.ndarray, "S T K"]:
    """What an impulse in the first, second, ..., K-th cycle of a record leads to in T cycles.

    **Arguments:** `first`: the cycle in which each record first meets the section looked at.
    """
    place = first[:, None] + np.arange(K)
    impulses = (np.arange(T)[:, None] == place[:, None]).astype(float)
    return divide_by_chi(c, impulses)
