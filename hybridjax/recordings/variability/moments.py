r"""The return map of each section by regression, and by instruments that noise does not enter.

With $x_k$ the state at a section in cycle k, $x_{k+1} = J x_k + w_k$. What is measured is
$z_k = x_k + v_k$. Least squares on $z_k$ gives $J \Sigma_x (\Sigma_x + \Sigma_v)^{-1}$: noise
biases towards fast decay. States $q_k$ at earlier sections of the same cycle depend on $x_k$, but
not on its noise, and not on what happens after it; so

$$J = E[z_{k+1} q_k^T] \, E[z_k q_k^T]^{+}$$

has no such bias (instrumental variables, two-stage least squares: Söderström and Stoica 1983).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from ..data import SectionData


# Sections between those of a state and those of its instruments, and how many there are of each.
# Smoothing correlates the noise of neighbors. Doubled: weaker instruments.
_APART, _STATE, _INSTRUMENTS = 2, 2, 3
# Combinations of the instruments: for each number of the state, and besides. Doubled: the first
# stage follows more of the noise.
_PER_STATE, _MORE = 2, 2
# Of the largest singular value: below it, a combination is rounding. Doubled: nothing changes.
_RANK = 1e-9


class Moments(NamedTuple):
    """Products of what belongs to one cycle, for every section."""

    state: Float[np.ndarray, "N K d d"]
    """x x' of each cycle: of the state with itself,"""
    forward: Float[np.ndarray, "N K d d"]
    """of the next state with it,"""
    square: Float[np.ndarray, "N K r r"]
    """of the instruments with themselves,"""
    seen: Float[np.ndarray, "N K d r"]
    """of the state with them,"""
    ahead: Float[np.ndarray, "N K d r"]
    """and of the next state with them; zero where anything is missing."""
    records: Int[np.ndarray, " K"]
    """The record of each cycle."""

    def plain(self, weights: Float[np.ndarray, "B K"]) -> Float[np.ndarray, "B N d d"]:
        """J of each section by least squares; `weights`: how often each cycle counts."""
        state, forward = (_summed(weights, x) for x in (self.state, self.forward))
        return forward @ np.linalg.inv(state)

    def by_instruments(self, weights: Float[np.ndarray, "B K"]) -> Float[np.ndarray, "B N d d"]:
        """J of each section by two-stage least squares."""
        square, seen, ahead = (_summed(weights, x) for x in (self.square, self.seen, self.ahead))
        first = np.linalg.pinv(square, hermitian=True) @ np.swapaxes(seen, 2, 3)
        return ahead @ first @ np.linalg.pinv(seen @ first)

    def strength(self) -> float:
        """The share of the states' variance that instruments explain, the mean over sections."""
        square, seen, state = (x.sum(axis=1) for x in (self.square, self.seen, self.state))
        explained = seen @ np.linalg.solve(square, np.swapaxes(seen, 1, 2))
        shares = np.trace(explained, axis1=1, axis2=2) / np.trace(state, axis1=1, axis2=2)
        return float(shares.mean())


def moments_of(data: SectionData, order: int) -> Moments:
    """For the `order` combinations of signals that vary most at each section.

    **Raises:** `DefinitionError` for too few cycles, or signals, for so many.
    """
    N = data.n_sections
    y = [r.y / np.nanstd(np.concatenate([x.y for x in data.records]), axis=0) for r in data.records]
    before = _STATE + _APART + _INSTRUMENTS
    width = y[0].shape[1]
    if order > _STATE * width:
        raise DefinitionError(
            f"`order` is {order}, but the state at a section has {_STATE * width} numbers."
        )
    rows = []  # (record, cycle, section, sample)
    for s, (r, values) in enumerate(zip(data.records, y, strict=True)):
        at = np.arange(before - 1, len(values) - N)
        place = r.first_section + at
        rows.append(np.stack([np.full(len(at), s), place // N, place % N, at], axis=1))
    found = np.concatenate(rows)
    names, cycle = np.unique(found[:, :2], axis=0, return_inverse=True)
    K = len(names)
    if K < 2 * (_PER_STATE * order + 2):
        raise DefinitionError(
            f"{K} cycles that are followed by another one are too few for {order} multipliers: "
            f"{2 * (_PER_STATE * order + 2)} are needed at least."
        )

    def values(shift: int, count: int):
        stacked = [y[s][at - shift - np.arange(count)].ravel() for s, _, _, at in found]
        return np.array(stacked)

    state, after = values(0, _STATE), values(-N, _STATE)
    instruments = values(_STATE - 1 + _APART, _INSTRUMENTS)
    known = np.isfinite(np.concatenate([state, after, instruments], axis=1)).all(axis=1)
    r = min(_PER_STATE * order + _MORE, instruments.shape[1])
    shapes = ((order, order), (order, order), (r, r), (order, r), (order, r))
    parts = [np.zeros((N, K, *shape)) for shape in shapes]
    for n in range(N):
        own = np.flatnonzero(known & (found[:, 2] == n))
        if len(own) <= r + 1:
            raise DefinitionError(f"section {n} was seen in {len(own)} cycles only: too few.")
        x, z = _principal(state[own], after[own], order)
        q, _ = _principal(instruments[own], instruments[own], r)
        for part, (a, b) in zip(parts, ((x, x), (z, x), (q, q), (x, q), (z, q)), strict=True):
            part[n, cycle[own]] = a[:, :, None] * b[:, None, :]
    return Moments(*parts, records=names[:, 0])


def _summed(
    weights: Float[np.ndarray, "B K"], products: Float[np.ndarray, "N K a b"]
) -> Float[np.ndarray, "B N a b"]:
    N, K, a, b = products.shape
    return (weights @ np.swapaxes(products, 0, 1).reshape(K, -1)).reshape(-1, N, a, b)


def _principal(
    x: Float[np.ndarray, "k p"], other: Float[np.ndarray, "k p"], count: int
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "k d"]]:
    """Both in the combinations along which the first varies most, with variance 1 of the first."""
    mean = x.mean(axis=0)
    _, s, axes = np.linalg.svd(x - mean, full_matrices=False)
    size = np.maximum(s[:count], _RANK * s[0]) / np.sqrt(len(x))
    onto = axes[:count].T / size
    return (x - mean) @ onto, (other - other.mean(axis=0)) @ onto
