"""A first periodic model of time series: regression on the past, then a common state."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ...errors import DefinitionError
from ..denominator import SLOWEST
from .model import PeriodicModel
from .prediction import SeriesPart
from .realization import default_horizon


# Samples of a section for each coefficient of the regression on its past. Larger: a short past,
# which states outlast; smaller: noise.
_ROWS = 3
# Part by which the squared length of every regressor is enlarged. Larger: bias; smaller: noise in
# combinations that are hardly excited.
_SHRINKAGE = 1e-6


def subspace_model(
    parts: Sequence[SeriesPart], dims: Sequence[int], innovations: bool
) -> PeriodicModel:
    """Return a model with these dimensions, with or without K.

    Each output is regressed on its past and that of the inputs, section by section. The effect of
    the past of a section on the outputs from there on is a matrix whose rank is the dimension of
    the state (Chiuso 2007, "PBSID", for each section of the period). Samples before a record count
    as zero: many short records that begin anywhere give a worse model.

    **Raises:** `DefinitionError` for too few cycles for a past as long as the states need.
    """
    z, y, inside = _signals(parts)
    N, ny, most = len(dims), y.shape[2], int(max(dims))
    columns = z.shape[2]
    sections = [_Section(z, y, inside, n, N) for n in range(N)]
    samples = min(len(section.y) for section in sections)
    past = min(samples // (_ROWS * columns), default_horizon(N))
    needed = -(-most // columns) + 1
    if past < needed:
        raise DefinitionError(
            f"{samples} cycles are too few to begin with {most} dimensions of the state: "
            f"about {_ROWS * columns * needed} are needed. Give a model as `guess`, as of "
            "`hj.identify.realize(hj.fit_series(...))`."
        )
    rules = [section.regression(past) for section in sections]
    horizon = max(-(-most // ny) + 1, min(past, N, default_horizon(0)))
    to_state = []
    for n, section in enumerate(sections):
        # The effect of rows that are older by i samples.
        ahead = np.zeros((past * columns, horizon, ny))
        for i in range(min(horizon, past)):
            ahead[: (past - i) * columns, i] = rules[(n + i) % N][i * columns :]
        ahead = ahead.reshape(len(ahead), -1)
        root = np.linalg.qr(section.past(past), mode="r")
        _, s, vh = np.linalg.svd(root @ ahead, full_matrices=False)
        if dims[n] > len(s):
            raise DefinitionError(
                f"the past shows {len(s)} dimensions of the state, not {dims[n]}."
            )
        kept = np.maximum(s[: dims[n]], _SHRINKAGE * s[0])
        to_state.append(ahead @ (vh[: dims[n]].T / kept * np.sqrt(len(section.y))))
    return _from_states(sections, to_state, past, innovations)


class _Section:
    """The samples of a section of all records, where all outputs were sampled."""

    def __init__(
        self,
        z: Float[np.ndarray, "R n columns"],
        y: Float[np.ndarray, "R n ny"],
        inside: Bool[np.ndarray, "R n"],
        section: int,
        N: int,
    ):
        at_section = np.arange(y.shape[1]) % N == section
        self._z = z
        self.record, self.time = np.nonzero(inside & np.isfinite(y).all(axis=2) & at_section)
        self.y = y[self.record, self.time]
        self.u = z[self.record, self.time, : z.shape[2] - y.shape[2]]

    def past(self, length: int, later: int = 0) -> Float[np.ndarray, "samples columns"]:
        """Return the `length` samples before, `later` samples later: newest first, zero before a
        record."""
        back = self.time[:, None] + later - 1 - np.arange(length)
        rows = self._z[self.record[:, None], np.maximum(back, 0)]
        return np.where((back >= 0)[..., None], rows, 0.0).reshape(len(back), -1)

    def regression(self, length: int) -> Float[np.ndarray, "columns ny"]:
        """Return the effect of the past on the output."""
        rows = np.concatenate([self.u, self.past(length)], axis=1)
        return _regress(rows, self.y)[self.u.shape[1] :]


def _signals(
    parts: Sequence[SeriesPart],
) -> tuple[Float[np.ndarray, "R n columns"], Float[np.ndarray, "R n ny"], Bool[np.ndarray, "R n"]]:
    """Return inputs and outputs of all records side by side, with zeros for missing samples; the
    outputs, with NaN there; and whether a sample lies inside of a record."""
    longest = max(part.shape[1] for part in parts)

    def flat(name: str) -> np.ndarray:  # (N R T k) -> (R, T N, k)
        out = []
        for part in parts:
            x = getattr(part, name)
            x = np.pad(x, [(0, 0), (0, 0), (0, longest - x.shape[2]), (0, 0)])
            out.append(np.moveaxis(x, 0, 2).reshape(x.shape[1], -1, x.shape[3]))
        return np.concatenate(out)

    u, y, sampled, lost = map(flat, ("u", "y", "sampled", "lost"))
    inside = np.asarray((sampled | lost).any(axis=2))
    return np.concatenate([u, y], axis=2), np.where(sampled, y, np.nan), inside


def _regress(rows: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return a least-squares solution, shrunk slightly: regressors without power get zero."""
    size = np.sqrt(np.square(rows).sum(axis=0))
    rows = rows / np.where(size > 0, size, 1.0)
    x = np.linalg.solve(rows.T @ rows + _SHRINKAGE * np.eye(len(size)), rows.T @ target)
    return x / np.where(size > 0, size, 1.0)[:, None]


def _from_states(
    sections: list[_Section], to_state: list[np.ndarray], past: int, innovations: bool
) -> PeriodicModel:
    N, nu = len(sections), sections[0].u.shape[1]
    C, D, A, B, K = [], [], [], [], []
    for n, section in enumerate(sections):
        x = section.past(past) @ to_state[n]
        rows = np.concatenate([x, section.u], axis=1)
        output = _regress(rows, section.y)
        rows = np.concatenate([rows, section.y - rows @ output], axis=1)
        later = _regress(rows, section.past(past, 1) @ to_state[(n + 1) % N])
        d = x.shape[1]
        C.append(output[:d].T)
        D.append(output[d:].T)
        A.append(later[:d].T)
        B.append(later[d : d + nu].T)
        K.append(later[d + nu :].T if innovations else np.zeros((later.shape[1], 0)))
    model = PeriodicModel(A, B, C, D, K)
    size = np.abs(np.linalg.eigvals(model.monodromy())).max()
    shrunk = (SLOWEST / max(size, SLOWEST)) ** (1 / N)
    model = model._replace(A=[a * shrunk for a in A])
    while innovations and _slowest_error(model) > SLOWEST:
        model = model._replace(K=[k / 2 for k in model.K])
    return model


def _slowest_error(model: PeriodicModel) -> float:
    """Return the largest modulus of a multiplier of A - K C, for errors of predictions."""
    A = [A - K @ C for A, K, C in zip(model.A, model.K, model.C, strict=True)]
    return float(np.abs(np.linalg.eigvals(model._replace(A=A).monodromy())).max())
