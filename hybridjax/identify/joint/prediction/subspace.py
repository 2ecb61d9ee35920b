"""A periodic model of series to begin a fit with: regression on the past, then a common state."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ....errors import DefinitionError
from ..periodic_model import PeriodicModel
from .series_part import SeriesPart


# Samples of a section for each coefficient of the regression on its past, and periods of the past
# at most. Doubled: half the past, less noise; twice the past and four times the work.
_ROWS, _PERIODS = 3, 2
# Sections that a state is seen through, at least. Doubled: more averaging.
_SHORTEST_HORIZON = 8
# Part by which the squared length of every regressor is made larger. Doubled: twice the bias, next
# to nothing.
_SHRINKAGE = 1e-6
# Largest modulus of a multiplier of a start, and of the errors of its predictions. Doubled
# (1.98): predictions from it would overflow.
_LARGEST_MODULUS = 0.99
# Samples that are looked at, of data that are read part by part. Doubled: twice the memory.
_SAMPLES = 200_000


def subspace_model(
    parts: Iterable[SeriesPart], dims: Sequence[int], innovations: bool
) -> PeriodicModel:
    """A model with these dimensions, with or without K.

    Each output is regressed on its own past and that of the inputs, section by section. What the
    past of a section adds to the outputs from there on is a matrix whose rank is the dimension of
    the state (Chiuso 2007, "PBSID", for each section of the period). What came before a record
    counts as zero: many short records that begin anywhere make a worse model to begin with.

    **Raises:** `DefinitionError` for too few cycles for a past as long as the states need.
    """
    z, y, inside = _signals(parts)
    N, (nu, ny) = len(dims), (z.shape[2] - y.shape[2], y.shape[2])
    every = [_Section(z, y, inside, n, N) for n in range(N)]
    samples = min(len(one.times) for one in every)
    past = min(samples // (_ROWS * (ny + nu)), max(_PERIODS * N, _SHORTEST_HORIZON))
    needed = -(-int(max(dims)) // (ny + nu)) + 1
    if past < needed:
        raise DefinitionError(
            f"{samples} cycles are too few to begin with {max(dims)} dimensions of the state: "
            f"about {_ROWS * (ny + nu) * needed} are needed. Give a model as `guess`, as of "
            "`hj.identify.realize(hj.fit_series(...))`."
        )
    rules = [one.regression(past) for one in every]
    horizon = max(-(-int(max(dims)) // ny) + 1, min(past, N, _SHORTEST_HORIZON))
    to_state = []
    for n, one in enumerate(every):
        ahead = [_later(rules[(n + i) % N], i * (nu + ny)) for i in range(horizon)]
        root = np.linalg.qr(one.past(past), mode="r")
        _, s, vh = np.linalg.svd(root @ np.concatenate(ahead, axis=1), full_matrices=False)
        kept = np.maximum(s[: dims[n]], _SHRINKAGE * s[0])
        if dims[n] > len(s):
            raise DefinitionError(
                f"the past shows {len(s)} dimensions of the state, not {dims[n]}."
            )
        weights = vh[: dims[n]].T / kept * np.sqrt(len(one.times))
        to_state.append(np.concatenate(ahead, axis=1) @ weights)
    return _from_states(every, to_state, past, innovations)


class _Section:
    """The samples of a section of all records, where the output was seen."""

    def __init__(self, z, y, inside, n: int, N: int):
        self._z, self.n, self.nu = z, n, z.shape[2] - y.shape[2]
        here = np.arange(y.shape[1]) % N == n
        self.times = np.argwhere(inside & np.isfinite(y).all(axis=2) & here)
        self.y = y[tuple(self.times.T)]

    @property
    def u(self):
        return self._z[(*self.times.T, slice(0, self.nu))]

    def past(self, length: int, later: int = 0) -> Float[np.ndarray, "samples columns"]:
        """The `length` samples before (and `later` ones), newest first; zero before a record."""
        record, time = self.times.T
        back = time[:, None] + later - 1 - np.arange(length)
        rows = np.where((back >= 0)[..., None], self._z[record[:, None], np.maximum(back, 0)], 0.0)
        return rows.reshape(len(time), -1)

    def regression(self, length: int) -> Float[np.ndarray, "columns ny"]:
        """What the past adds to the output."""
        return _regress(np.concatenate([self.u, self.past(length)], axis=1), self.y)[self.nu :]


def _signals(parts: Iterable[SeriesPart]):
    """Inputs and outputs of some records side by side, (R, n, nu + ny), with zero where nothing is
    known; the outputs, with NaN there; and what lies inside of a record."""
    chosen, size = [], 0
    for part in parts:
        if size and size + part.y[..., 0].size > _SAMPLES:
            break
        chosen.append(part)
        size += part.y[..., 0].size
    longest = max(part.shape[1] for part in chosen)

    def flat(x):  # (N R T k) -> (R, T N, k)
        missing = longest - x.shape[2]
        x = np.pad(x, [(0, 0), (0, 0), (0, missing), (0, 0)])
        return np.moveaxis(x, 0, 2).reshape(x.shape[1], -1, x.shape[3])

    u, y, seen, lost = (
        np.concatenate([flat(getattr(part, name)) for part in chosen])
        for name in ("u", "y", "seen", "lost")
    )
    z = np.concatenate([u, y], axis=2)
    return z, np.where(seen, y, np.nan), (seen | lost).any(axis=2)


def _later(rule, rows: int):
    """The coefficients of what is so many rows older."""
    return np.concatenate([rule[rows:], np.zeros_like(rule[:rows])])[: len(rule)]


def _regress(rows, target):
    """Least squares, shrunk a little, so that what is not excited has no part."""
    size = np.sqrt(np.square(rows).sum(axis=0))
    rows = rows / np.where(size > 0, size, 1.0)
    found = np.linalg.solve(rows.T @ rows + _SHRINKAGE * np.eye(len(size)), rows.T @ target)
    return found / np.where(size > 0, size, 1.0)[:, None]


def _from_states(every, to_state, past: int, innovations: bool) -> PeriodicModel:
    N, nu = len(every), every[0].nu
    C, D, A, B, K = [], [], [], [], []
    for n, one in enumerate(every):
        x, later = one.past(past) @ to_state[n], one.past(past, 1) @ to_state[(n + 1) % N]
        rows = np.concatenate([x, one.u], axis=1)
        seen = _regress(rows, one.y).T
        C.append(seen[:, :-nu])
        D.append(seen[:, -nu:])
        moved = _regress(np.concatenate([rows, one.y - rows @ seen.T], axis=1), later).T
        d = x.shape[1]
        A.append(moved[:, :d])
        B.append(moved[:, d : d + nu])
        K.append(moved[:, d + nu :])
    model = PeriodicModel(A, B, C, D, K)
    size = np.abs(np.linalg.eigvals(model.monodromy())).max()
    shrunk = min(_LARGEST_MODULUS / max(size, 1e-300), 1.0) ** (1 / N)
    model = model._replace(A=[a * shrunk for a in A])
    if not innovations:
        return model._replace(K=[k[:, :0] for k in K])
    while np.abs(np.linalg.eigvals(model.error_model().monodromy())).max() > _LARGEST_MODULUS:
        model = model._replace(K=[k / 2 for k in model.K])
    return model
