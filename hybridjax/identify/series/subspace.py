"""First state-space models of time series by a subspace method, and a test for direct responses.

There are three functions. `subspace_model` makes the model from which `fit_ldtp` descends, and the
model that predicts the instruments of a loop (`in_loop.py`). If it is inaccurate, `fit_ldtp` needs
more iterations, and the fit in the loop loses efficiency. `answers_at_once` tests whether outputs
respond to inputs at the same section, so that `fit_ldtp` needs D. `without_drift` removes the drift
of signals. The first two regress the signals at a section on their past (`_sections`, `_regress`).

If a first model is far off, look at the length of the past (`past` in `subspace_model`), and at
`_from_states`, which shrinks models that are unstable. If D is fitted without need, or is missing,
look at `answers_at_once`. The newest sample must stay the first one in `_Section.past`, since
`subspace_model` shifts the past by whole samples.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from ...errors import DefinitionError
from ..denominator import SLOWEST
from ..descent import positive
from ..periodic import PeriodicModel
from ..realization import default_horizon
from .output_error import SectionRegression
from .records import CycleGrid, PreparedRecords, Signals
from .residuals import ANSWER


# Number of samples of a section for each coefficient of the regression on its past. Larger: the
# past is too short for slow states. Smaller: noise.
_ROWS = 3
# The squared length of every regressor is enlarged by this part (ridge regression). Larger: bias.
# Smaller: noise in combinations that are hardly excited.
_SHRINKAGE = 1e-6


def subspace_model(
    records: PreparedRecords,
    dims: Sequence[int],
    innovations: bool,
    direct: bool = True,
) -> PeriodicModel:
    """Return a model with these dimensions, with or without K and D.

    Section by section, each output is regressed on past outputs and past inputs. The matrix from
    the past of a section to the outputs from this section on has a rank that is the dimension of
    the state (Chiuso 2007, "PBSID", for each section of the period). Samples before a record count
    as zero: many short records that begin anywhere give a worse model.

    **Raises:** `DefinitionError` for too few cycles for a past as long as the states need.
    """
    N = len(dims)
    ny = len(records.outputs)
    columns = len(records.inputs) + ny
    most = int(max(dims))
    sections = _sections(records)
    samples = min(len(section.y) for section in sections)
    past = min(samples // (_ROWS * columns), default_horizon(N))
    needed = -(-most // columns) + 1
    if past < needed:
        raise DefinitionError(
            f"{samples} cycles are too few to begin with {most} dimensions: record about "
            f"{_ROWS * columns * needed}, or give a model as `initial`: `fit_series(...).model`."
        )
    # For each section, the matrix from its past to its outputs.
    rules = []
    for section in sections:
        known = [section.u * direct, section.past(past)]
        rows = np.concatenate(known, axis=1)
        rule = _regress(rows, section.y)
        rules.append(rule[section.u.shape[1] :])
    rows_of_outputs = -(-most // ny) + 1
    longest = min(past, N, default_horizon(0))
    horizon = max(rows_of_outputs, longest)
    to_state = []
    for n, section in enumerate(sections):
        # For outputs i samples later, the past begins i samples earlier.
        ahead = np.zeros((past * columns, horizon, ny))
        for i in range(min(horizon, past)):
            kept = (past - i) * columns
            older = rules[(n + i) % N]
            ahead[:kept, i] = older[i * columns :]
        ahead = ahead.reshape(len(ahead), -1)
        root = np.linalg.qr(section.past(past), mode="r")
        _, size, directions = np.linalg.svd(root @ ahead, full_matrices=False)
        d = dims[n]
        if d > len(size):
            raise DefinitionError(
                f"the data show {len(size)} dimensions of section {n}, not {d}: lower `dims`."
            )
        smallest = _SHRINKAGE * size[0]
        size = np.maximum(size[:d], smallest)
        scale = size / np.sqrt(len(section.y))
        to_state.append(ahead @ (directions[:d].T / scale))
    return _from_states(sections, to_state, past, innovations, direct)


def answers_at_once(records: PreparedRecords, drive: PreparedRecords) -> bool | None:
    """Test whether outputs in a loop respond to inputs at their own section.

    If they do, they also respond to a reference at once, given the past of all signals. This is
    tested section by section by a likelihood ratio (Anderson, *Multivariate Statistical Analysis*,
    2003, section 8.4), whatever the controller is.

    **Returns:** None if they seem not to respond, but the inputs follow from the reference and the
    past alone. The test then has no power, and two fits must be compared.

    **Raises:** `DefinitionError` if inputs and outputs respond to each other at once, which no
    model of the noise can separate.
    """
    N = records.n_sections
    ny = len(records.outputs)
    nr = len(drive.inputs)
    columns = nr + len(records.inputs) + ny
    statistic = 0.0
    left = 0.0
    whole = 0.0
    age = records.whole().age.reshape(len(records.records), -1)
    for section in _sections(records, without_drift(drive.whole()).u):
        by_samples = min(len(section.y) // (_ROWS * columns), default_horizon(N))
        length = max(by_samples, 1)
        # (Samples whose past reaches beyond the start of the record are left out: its zeros do not
        # determine inputs.)
        later = age[section.record, section.time] > length
        if later.sum() <= columns * length + nr:
            continue
        past = section.past(length)[later]
        y = section.y[later]
        inputs = section.u[later]
        r, u = np.split(inputs, [nr], axis=1)
        rows = np.concatenate([past, r], axis=1)
        floor = _SHRINKAGE * y.T @ y  # errors of the regressions, without noise
        gain = _log_size(past, y, floor) - _log_size(rows, y, floor)
        correction = (ny - nr + 1) / 2
        degrees = len(y) - rows.shape[1] - correction
        statistic += max(degrees, 0.0) * gain
        unexplained = u - rows @ _regress(rows, u)
        left += float((unexplained**2).sum())
        whole += float((u**2).sum())
    # (If the past predicts the reference, the statistic may be negative by rounding.)
    half = max(statistic, 0.0) / 2
    p = special.gammaincc(N * ny * nr / 2, half)
    answer = bool(p <= ANSWER)
    if left <= _SHRINKAGE * whole:
        return answer or None
    if answer:
        raise DefinitionError(
            "outputs answer inputs at the same section, where the inputs have a part that neither "
            "the reference nor the past explains: no model of the noise tells the two directions "
            "apart. Pass a model with D = 0 as `initial` if outputs do not respond at once."
        )
    return False


def _log_size(rows: np.ndarray, y: np.ndarray, floor: np.ndarray) -> float:
    """Return the log determinant of the errors of a regression."""
    error = y - rows @ _regress(rows, y)
    gram = error.T @ error + floor
    return float(np.linalg.slogdet(gram)[1])


def without_drift(grid: CycleGrid) -> CycleGrid:
    """Return records without the drift of each section, in outputs and inputs.

    Offsets of inputs cause a drift of outputs, to which a controller responds. Once the drift of
    all signals is removed, the remaining outputs are the response to the remaining inputs.
    """
    no_columns = grid.drift[..., :0]

    def left(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        out = np.zeros(x.shape)
        for n in range(x.shape[2]):
            regression = SectionRegression.make(
                no_columns, no_columns, grid.drift, weight[:, :, n]
            )
            z = x[:, :, n]
            reduced = regression.reduced(z)
            out[:, :, n] = reduced.reshape(z.shape)
        return out

    all_sampled = np.asarray(grid.sampled.all(axis=3))
    return grid._replace(
        u=left(grid.u, grid.inside),
        y=left(grid.y, all_sampled),
        drift=no_columns,
    )


def _sections(
    records: PreparedRecords, *more: Float[np.ndarray, "S T N k"]
) -> "list[_Section]":
    """Return the samples of further signals, inputs and outputs at each section."""
    grid = without_drift(records.whole())
    ny = len(records.outputs)
    scaled = grid.y / records.scale
    z = np.concatenate([*more, grid.u, scaled], axis=3)
    sampled = np.asarray(grid.sampled.all(axis=3))
    return [_Section(z, sampled, n, ny) for n in range(records.n_sections)]


class _Section:
    """The samples of a section of all records, where all outputs were sampled."""

    def __init__(
        self, z: Signals, sampled: Bool[np.ndarray, "S T N"], section: int, ny: int
    ):
        self.record, cycle = np.nonzero(sampled[:, :, section])
        self.time = cycle * z.shape[2] + section
        self._z = z.reshape(len(z), -1, z.shape[3])
        signals = self._z[self.record, self.time]
        self.u, self.y = np.split(signals, [-ny], axis=1)

    def past(self, length: int, later: int = 0) -> Float[np.ndarray, "samples columns"]:
        """Return the `length` samples before each sample that lies `later` samples later. The
        newest come first; before a record, they are zero."""
        first = self.time[:, None] + later - 1
        back = first - np.arange(length)
        is_inside = back >= 0
        places = np.maximum(back, 0)
        rows = self._z[self.record[:, None], places]
        rows = np.where(is_inside[..., None], rows, 0.0)
        return rows.reshape(len(back), -1)


def _regress(rows: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return a least-squares solution, shrunk slightly: regressors without power get zero."""
    square = np.square(rows).sum(axis=0)
    size = positive(np.sqrt(square))
    rows = rows / size
    gram = rows.T @ rows
    shrunk = gram + _SHRINKAGE * np.eye(len(size))
    x = np.linalg.solve(shrunk, rows.T @ target)
    return x / size[:, None]


def _from_states(
    sections: list[_Section],
    to_state: list[np.ndarray],
    past: int,
    innovations: bool,
    direct: bool,
) -> PeriodicModel:
    """Return the model whose state at a section is its past times `to_state`, made stable.

    C and D come from a regression of the outputs, A, B and K from one of the state at the next
    section.
    """
    N = len(sections)
    nu = sections[0].u.shape[1]
    blocks: list[tuple] = []
    for n, section in enumerate(sections):
        x = section.past(past) @ to_state[n]
        d = x.shape[1]
        seen = np.concatenate([x, section.u * direct], axis=1)
        output = _regress(seen, section.y)
        rows = np.concatenate([x, section.u], axis=1)
        error = section.y - rows @ output
        later = _regress(
            np.concatenate([rows, error], axis=1),
            section.past(past, 1) @ to_state[(n + 1) % N],
        )
        ends = [d, d + nu]
        A, B, K = np.split(later.T, ends, axis=1)
        blocks.append(
            (A, B, output[:d].T, output[d:].T, K if innovations else K[:, :0])
        )
    model = PeriodicModel(*map(list, zip(*blocks, strict=True)))
    shrunk = (SLOWEST / max(model.radius, SLOWEST)) ** (1 / N)
    model = model._replace(A=[shrunk * A for A in model.A])
    # (The largest modulus of A may be above SLOWEST by rounding, for any K.)
    most = max(SLOWEST, model.radius)
    while innovations and model.of_errors.radius > most:
        model = model._replace(K=[K / 2 for K in model.K])
    return model
