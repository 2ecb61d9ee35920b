"""Recorded inputs and outputs, with gaps, laid out by record, cycle and section."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..._core.arguments import names
from ...errors import DefinitionError
from ...experiments.data import ExperimentData


class Record(eqx.Module):
    """One stretch of recorded inputs and outputs, of any length, with any input.

    **Fields**, on the host:

    - `u` (n, nu): inputs, held from sample i to i + 1. NaN where not known: the record is then
      cut there, and the state after it is unknown.
    - `y` (n, ny): outputs minus those on the limit cycle, sampled before `u[i]` acts. NaN where a
      sample is missing or bad.
    - `n_sections`: N. `start`: the section of sample 0. `inputs`, `outputs`: names.
    - `lead`: y[i] may depend on inputs up to `u[i + lead]`: smoothing, or sections that were placed
      by what came later.
    - `drift`: the outputs at each section also hold an unknown part that changes more slowly than
      in so many cycles; infinite: a constant, as where an average cycle was subtracted. None: they
      hold nothing but the response.
    """

    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"]
    n_sections: int = eqx.field(static=True)
    start: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    lead: int = eqx.field(static=True, default=0)
    drift: float | None = eqx.field(static=True, default=None)

    def __init__(
        self,
        u: Any,
        y: Any,
        *,
        n_sections: int,
        start: int = 0,
        inputs: str | Sequence[str] | None = None,
        outputs: str | Sequence[str] | None = None,
        lead: int = 0,
        drift: int | float | None = None,
    ):
        """**Raises:** `DefinitionError` for shapes that do not fit together, or infinite values."""
        self.u, self.y = _columns("u", u), _columns("y", y)
        if len(self.u) != len(self.y) or 0 in self.u.shape + self.y.shape:
            raise DefinitionError(
                "u must have the shape (samples, inputs) and y (samples, outputs), not "
                f"{self.u.shape} and {self.y.shape}."
            )
        if n_sections < 1 or not 0 <= start < n_sections:
            raise DefinitionError(
                "a record needs n_sections >= 1 and a start from 0 to n_sections - 1, not "
                f"{n_sections} and {start}."
            )
        if lead < 0:
            raise DefinitionError(f"lead must not be negative, but is {lead}.")
        if drift is not None and not drift > 0:
            raise DefinitionError(f"drift must be a positive number of cycles, not {drift}.")
        self.n_sections, self.start, self.lead = n_sections, start, lead
        self.drift = None if drift is None else float(drift)
        self.inputs = names("inputs", inputs, self.u.shape[1])
        self.outputs = names("outputs", outputs, self.y.shape[1])

    def __repr__(self) -> str:
        missing = int(np.isnan(self.y).any(axis=1).sum())
        gaps = f", {missing} with gaps" if missing else ""
        return (
            f"Record({len(self.u)} samples from section {self.start}{gaps}; N = {self.n_sections}; "
            f"{', '.join(self.inputs)} -> {', '.join(self.outputs)})"
        )


Recorded = ExperimentData | Record | Sequence[ExperimentData | Record]


def _columns(name: str, values: Any) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "fiu" or values.ndim != 2:
        raise DefinitionError(
            f"{name} must hold real numbers on two axes, not {values.dtype} of shape "
            f"{values.shape}."
        )
    bad = np.argwhere(np.isinf(values))
    if len(bad):
        raise DefinitionError(
            f"{name} is infinite at sample {bad[0][0]}; put NaN where a sample is bad."
        )
    return values.astype(float)


class Piece(NamedTuple):
    """A stretch of known inputs, from some section on; y is NaN where there is no sample."""

    start: int
    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"]
    drift: float | None = None


class Pieces(NamedTuple):
    """All stretches of some data, and what they have in common."""

    pieces: list[Piece]
    n_sections: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    lead: int
    drift: float | None


def pieces_of(data: Recorded) -> Pieces:
    """All records, cut where an input is unknown. Experiments that failed are left out.

    The output just at an unknown input is not used, since it may feel it directly, nor are those
    `lead` samples earlier.

    **Raises:** `DefinitionError` if nothing is left, or records differ in N or names.
    """
    records = [r for part in _parts(data) for r in _records(part)]
    if not records:
        raise DefinitionError("there is no experiment that ran to its end.")
    kinds = {(r.n_sections, r.inputs, r.outputs, r.lead, r.drift) for r in records}
    if len(kinds) > 1:
        a, b = sorted(kinds, key=str)[:2]
        raise DefinitionError(f"these records do not belong together: some have {a}, others {b}.")
    pieces = [piece for record in records for piece in _cut(record)]
    if not pieces:
        raise DefinitionError("the input is NaN at every sample.")
    return Pieces(pieces, *kinds.pop())


class Layout(NamedTuple):
    """S records of T cycles: samples before the start, after the end and in gaps do not count."""

    u: Float[np.ndarray, "S T N nu"]
    """Zero where there is no record."""
    y: Float[np.ndarray, "S T N ny"]
    """NaN where there is no sample."""
    inside: Bool[np.ndarray, "S T N"]
    """From the first sample of a record to its last."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    lead: int
    slow: Float[np.ndarray, "S T K"]
    """What an unknown drift of each section's outputs is composed of; zero outside a record."""


def lay_out(data: Recorded) -> Layout:
    """All records as one array.

    **Raises:** `DefinitionError` as `pieces_of`.
    """
    pieces, N, inputs, outputs, lead, drift = pieces_of(data)
    T = max(-(-(p.start + len(p.u)) // N) for p in pieces)
    U = np.zeros((len(pieces), T * N, len(inputs)))
    Y = np.full((len(pieces), T * N, len(outputs)), np.nan)
    inside = np.zeros((len(pieces), T * N), bool)
    for s, p in enumerate(pieces):
        place = slice(p.start, p.start + len(p.u))
        U[s, place], Y[s, place], inside[s, place] = p.u, p.y, True
    waves = [slow_waves(p, N, drift) for p in pieces]
    slow = np.zeros((len(pieces), T, max(w.shape[1] for w in waves)))
    for s, w in enumerate(waves):
        slow[s, : len(w), : w.shape[1]] = w

    def cycles(x):
        return x.reshape(len(pieces), T, N, *x.shape[2:])

    return Layout(cycles(U), cycles(Y), cycles(inside), inputs, outputs, lead, slow)


def slow_waves(piece: Piece, n_sections: int, drift: float | None) -> Float[np.ndarray, "T K"]:
    """A constant and cosines in the cycles of a piece, down to a wavelength of `drift`."""
    T = -(-(piece.start + len(piece.u)) // n_sections)
    if drift is None:
        return np.zeros((T, 0))
    waves = np.arange(int(2 * T / drift) + 1)
    return np.cos(np.pi / T * (np.arange(T)[:, None] + 0.5) * waves)


def _parts(data: Recorded) -> list[ExperimentData | Record]:
    return [data] if isinstance(data, ExperimentData | Record) else list(data)


def _records(part: ExperimentData | Record) -> list[Record]:
    if isinstance(part, Record):
        return [part]
    about = {"n_sections": part.n_sections, "inputs": part.inputs, "outputs": part.outputs}
    return [Record(part.u[s], part.y[s], **about) for s in np.flatnonzero(part.ok)]


def _cut(record: Record):
    known = np.isfinite(record.u).all(axis=1)
    edges = np.flatnonzero(np.diff(known.astype(int), prepend=0, append=0))
    for first, last in edges.reshape(-1, 2):
        start = int(record.start + first) % record.n_sections
        y = record.y[first:last].copy()
        y[max(len(y) - record.lead, 0) :] = np.nan
        yield Piece(start, record.u[first:last], y, record.drift)
