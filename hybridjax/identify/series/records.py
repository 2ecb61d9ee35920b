"""Records in the form in which fits to time series use them: grids of records, cycles and sections.

A `CycleGrid` has S records of T cycles with N sections each. `PreparedRecords(data)` checks records
and sorts them into grids of similar length. The functions at the end delay and filter signals from
cycle to cycle (`lagged_inputs`, `divide_by_chi`). Missing samples are zero in a grid, and marked.
"""

import copy
import dataclasses
from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.signal import lfilter

from ..._core.findings import Finding
from ...errors import DefinitionError
from ...experiments.record import (
    RecordedData,
    SectionSeries,
    require_deviations,
    uninterrupted_records,
)
from ..descent import Coefficients


# Shortest wavelength, in cycles, of the drift that fits try, to see whether it changes their
# multipliers. Longer: faster drifts look like multipliers. Shorter: drifts explain so much that
# multipliers become uncertain.
SLOW = 20.0
MAY_DRIFT = Finding(
    "drift",
    f"outputs may drift: `with_drift({SLOW:g})`, or `SectionSeries(drift=)`, changes multipliers.",
)
# A drift matters if it moves multipliers out of confidence regions of this level. (Drift moves them
# further than a missing multiplier does.) Lower: right fits get a finding. Higher: drifts pass.
OF_DRIFT = 0.999


Signals = Float[np.ndarray, "S T N ny"]
"""Signals of S records in T cycles, by section."""
Columns = Shaped[np.ndarray, "S T *columns"]
"""Columns of S records, one row for each of T cycles."""


class CycleGrid(NamedTuple):
    """S records of T cycles. Samples are missing outside of a record and in its gaps."""

    u: Float[np.ndarray, "S T N nu"]
    """Inputs; zero outside of a record."""
    y: Float[np.ndarray, "S T N ny"]
    """Outputs; zero where there is no sample."""
    sampled: Bool[np.ndarray, "S T N ny"]
    inside: Bool[np.ndarray, "S T N"]
    """Whether a sample lies between the first and the last of its record."""
    drift: Float[np.ndarray, "S T K"]
    """Basis of the drift of each section's outputs; zero outside of a record."""

    @classmethod
    def from_records(cls, records: Sequence[SectionSeries]) -> "CycleGrid":
        """Put records of one kind, without unknown inputs, on one grid."""
        S = len(records)
        T = max(map(count_cycles, records))
        N = records[0].n_sections
        inputs = len(records[0].inputs)
        u = np.zeros((S, T * N, inputs))
        shape = (S, T * N, len(records[0].outputs))
        y = np.full(shape, np.nan)
        inside = np.zeros((S, T * N), bool)
        waves = [drift_waves(record) for record in records]
        widest = max(wave.shape[1] for wave in waves)
        drift = np.zeros((S, T, widest))
        for s, (record, wave) in enumerate(zip(records, waves, strict=True)):
            first = record.first_section
            rows = slice(first, first + len(record.u))
            u[s, rows] = record.u
            y[s, rows] = record.y
            inside[s, rows] = True
            columns = wave.shape[1]
            drift[s, : len(wave), :columns] = wave
        sampled = np.isfinite(y)
        return cls(
            u=u.reshape(S, T, N, u.shape[2]),
            y=np.where(sampled, y, 0.0).reshape(S, T, N, y.shape[2]),
            sampled=sampled.reshape(S, T, N, y.shape[2]),
            inside=inside.reshape(S, T, N),
            drift=drift,
        )

    def where(self, kept: Bool[np.ndarray, "S T"]) -> "CycleGrid":
        """Return the grid without the outputs of other cycles than these."""
        sampled = self.sampled & kept[:, :, None, None]
        return self._replace(y=np.where(sampled, self.y, 0.0), sampled=sampled)

    @property
    def first(self) -> Int[np.ndarray, "S N"]:
        """The cycle in which each record first crosses a section."""
        return np.argmax(self.inside, axis=1)

    @property
    def age(self) -> Int[np.ndarray, "S T N"]:
        """The number of samples from the start of each record up to and including each sample."""
        return np.cumsum(self.inside.reshape(len(self.u), -1), axis=1).reshape(
            self.inside.shape
        )


def count_cycles(record: SectionSeries) -> int:
    """Return the number of cycles that a record touches, counted from section 0 of its first."""
    return -(-(record.first_section + len(record.u)) // record.n_sections)


def drift_waves(record: SectionSeries) -> Float[np.ndarray, "T K"]:
    """Return the basis of a drift: cosines in the cycles, down to a wavelength of `record.drift`.

    The first is a constant. Records without a declared drift have no basis.
    """
    T = count_cycles(record)
    if record.drift is None:
        return np.zeros((T, 0))
    number = int(2 * T / record.drift) + 1
    waves = np.arange(number)
    middle = np.arange(T)[:, None] + 0.5
    return np.cos(np.pi / T * middle * waves)


class PreparedRecords:
    """Records as grids of similar lengths.

    **Fields:** `records`, without unknown inputs. `n_sections`, `lead`, `inputs`, `outputs`: as in
    `SectionSeries`; `about`: by name. `grids`: the grids. `begins`: for each grid, (S,): the number
    of cycles of all records before each record of the grid. `cycles`: number of cycles of the
    longest record. `sampled` (N, ny): number of samples. `scale` (ny,): rms of the outputs.

    **Arguments:** `free_start`: whether the states at the starts are unknown. Records with drift
    are then cut into pieces, each with its own start and drift, because the time of a fit grows
    with the third power of their length. Default: False.
    """

    def __init__(self, data: RecordedData, free_start: bool = False):
        """**Raises:** `DefinitionError` in the cases of `uninterrupted_records`, for inputs that
        are zero, and for outputs that are constant at every sample, missing, or no deviations."""
        records = uninterrupted_records(data)
        if free_start:
            records = list(chain.from_iterable(map(_pieces, records)))
        self.records = uninterrupted_records(records)
        first = self.records[0]
        self.n_sections = first.n_sections
        self.lead = first.lead
        self.inputs = first.inputs
        self.outputs = first.outputs
        self.grids, self.begins = _grids(self.records)
        self.cycles = max(map(count_cycles, self.records))
        counts = [grid.sampled.sum(axis=(0, 1)) for grid in self.grids]
        self.sampled = np.sum(counts, axis=0)
        u = np.concatenate([record.u for record in self.records])
        y = np.concatenate([record.y for record in self.records])
        _require_signals(self.inputs, np.any(u != 0, axis=0), "zero")
        varies = np.fmax.reduce(y) > np.fmin.reduce(y)  # (without NaN)
        _require_signals(self.outputs, varies, "constant")
        require_deviations(self.records)
        square = np.nansum(y**2, axis=0)
        power = square / self.sampled.sum(axis=0)
        self.scale = np.sqrt(power)

    @property
    def about(self) -> dict[str, Any]:
        """The fields that fits take from the records."""
        names = "n_sections", "lead", "inputs", "outputs"
        return {name: getattr(self, name) for name in names}

    def on(self, grids: list[CycleGrid]) -> "PreparedRecords":
        """Return these records with other grids, in the same order."""
        out = copy.copy(self)
        out.grids = grids
        return out

    def whole(self) -> CycleGrid:
        """Return all records on one grid."""
        return CycleGrid.from_records(self.records)


def _require_signals(
    names: tuple[str, ...], varies: Bool[np.ndarray, " signals"], what: str
) -> None:
    """**Raises:** `DefinitionError` for a signal that does not vary."""
    if not varies.all():
        name = names[int(np.argmin(varies))]
        raise DefinitionError(
            f"{name} is {what} or missing: leave it out, or record more."
        )


def with_drift(records: Sequence[SectionSeries]) -> list[SectionSeries]:
    """Return the first 1000 cycles of records, with unknown drifts slower than `SLOW` cycles.

    Records with a drift that is declared as fast already are left out.
    """
    n = 1000 * records[0].n_sections
    slower = [record for record in records if (record.drift or np.inf) > SLOW]
    return [dataclasses.replace(record.part(0, n), drift=SLOW) for record in slower]


def _pieces(record: SectionSeries) -> list[SectionSeries]:
    """Cut a record into pieces of 50 times its drift, or less."""
    longest = 50 * (record.drift or np.inf) * record.n_sections
    samples = len(record.u)
    pieces = max(int(np.ceil(samples / longest)), 1)
    n = -(-samples // pieces)
    return [record.part(k, k + n) for k in range(0, samples, n)]


def _grids(
    records: Sequence[SectionSeries],
) -> tuple[list[CycleGrid], list[Int[np.ndarray, " S"]]]:
    """Put records on grids, such that each record is at least half as long as the longest one of
    its grid.

    **Returns:** the grids, and for each of their records the number of cycles of all records before
    it.
    """
    cycles = np.array([count_cycles(record) for record in records])
    before = np.cumsum(cycles) - cycles
    left = np.argsort(-cycles, kind="stable")
    grids = []
    begins = []
    while len(left):
        length = cycles[left[0]]
        alike = left[2 * cycles[left] >= length]
        grids.append(CycleGrid.from_records([records[k] for k in alike]))
        begins.append(before[alike])
        left = left[len(alike) :]
    return grids, begins


def lagged_inputs(
    u: Float[np.ndarray, "S T N nu"], section: int, lags: int, lead: int
) -> Float[np.ndarray, "S T columns"]:
    """Return the inputs r samples before a section in all cycles, r = -lead, ..., lags - 1 - lead.

    Inputs outside of the grid are zero. Columns are ordered by r, then by input.
    """
    S, T, N, nu = u.shape
    before = lags - 1 - lead
    margins = ((0, 0), (before, lead), (0, 0))
    in_order = u.reshape(S, T * N, nu)
    row = np.pad(in_order, margins)
    windows = np.lib.stride_tricks.sliding_window_view(row, lags, axis=1)
    newest_first = windows[:, section::N, :, ::-1]
    return newest_first.mT.reshape(S, T, lags * nu)


def delay_cycles(x: Columns, cycles: int, fill: float | bool = 0) -> Columns:
    """Delay x by a number of cycles; the first cycles become `fill`."""
    T = x.shape[1]
    cycles = min(cycles, T)
    before = np.full_like(x[:, :cycles], fill)
    kept = x[:, : T - cycles]
    return np.concatenate([before, kept], axis=1)


def divide_by_chi(c: Coefficients, x: Columns) -> Columns:
    """Filter x by 1 / chi from cycle to cycle."""
    chi = np.append(1.0, c)
    return np.asarray(lfilter([1.0], chi, x, axis=1))


def start_responses(
    c: Float[np.ndarray, " d"], first: Int[np.ndarray, " S"], T: int, K: int
) -> Float[np.ndarray, "S T K"]:
    """Return the responses of T cycles to an impulse in the first, ..., K-th cycle of a record.

    **Arguments:** `first`: the cycle in which each record first crosses the section.
    """
    begins = first[:, None] + np.arange(K)
    cycle = np.arange(T)[:, None]
    impulse = cycle == begins[:, None]
    return divide_by_chi(c, impulse.astype(float))
