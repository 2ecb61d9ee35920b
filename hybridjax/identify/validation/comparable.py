"""Records that say more of a model than where they started, and how many samples they have."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from ..._core.arguments import require_same
from ...errors import DefinitionError
from ...experiments.record import HasRecords, Record, RecordedData, each_uninterrupted_record
from ...linear.ldtp import LDTP
from ..joint.noise import Predictor
from ..series.fit import SeriesFit
from ..series.records import in_groups
from .residual_tests import sections_of
from .simulation import can_be_compared


class Comparable:
    """Records with more than three samples for each unknown of their start and drift, which can be
    gone through again and again. Data other than sequences are read anew each time.

    **Fields:** `counts`; `longest`, one of them; `left_out`, how many others there are.
    """

    def __init__(
        self,
        model: LDTP | SeriesFit | Predictor,
        data: RecordedData,
        free_start: bool,
        lags: int | None,
    ):
        """**Arguments:** `lags` that will be looked at, at most; None: N.

        **Raises:** `DefinitionError` if there are none, or model and data do not belong
        together."""
        again = isinstance(data, HasRecords) or iter(data) is not data
        self._model, self._data, self._free_start = model, data if again else list(data), free_start
        self.left_out, longest = 0, 0
        self.longest: Record | None = None
        first = None
        for record in each_uninterrupted_record(self._data):
            if first is None:
                require_same("model and data", model, record)
                first, N = record, record.n_sections
                self.counts = Counts(lags or N, N, record.y.shape[1])
            longest = max(longest, len(record.u))
            if not can_be_compared(model, record, free_start):
                self.left_out += 1
                continue
            self.counts.add(record)
            if self.longest is None or len(record.u) > len(self.longest.u):
                self.longest = record
        self.n_sections, self.inputs, self.outputs = first.n_sections, first.inputs, first.outputs
        if self.longest is None:
            raise DefinitionError(
                f"the longest of {self.left_out} uninterrupted records has "
                f"{longest / self.n_sections:.3g} cycles: too few to tell the model from an "
                "unknown start."
            )

    def groups(self) -> Iterator[list[Record]]:
        """All of them, in lists of bounded size."""
        every = each_uninterrupted_record(self._data)
        return in_groups(r for r in every if can_be_compared(self._model, r, self._free_start))


class Counts:
    """Of the samples of records, section by section."""

    def __init__(self, lags: int, N: int, ny: int):
        """**Arguments:** `lags`, the most that `with_past` is asked for."""
        self._lags, self._late = lags, np.zeros((lags + 1, N, ny), int)
        self._count, self._mean, self._square = np.zeros(ny, int), np.zeros(ny), np.zeros(ny)

    def add(self, record: Record) -> None:
        seen = np.isfinite(record.y)
        before = np.minimum(np.arange(len(seen)), self._lags)
        np.add.at(self._late, (before, sections_of([record])), seen)
        count = seen.sum(axis=0)
        total = self._count + count
        y = np.where(seen, record.y, 0.0)
        mean = y.sum(axis=0) / np.maximum(count, 1)
        # Means and squares of two sets as one (Chan, Golub and LeVeque 1983).
        away, part = mean - self._mean, count / np.maximum(total, 1)
        self._square += ((y - mean) ** 2 * seen).sum(axis=0) + away**2 * self._count * part
        self._mean += away * part
        self._count = total

    @property
    def sampled(self) -> Int[np.ndarray, "N ny"]:
        """How often each output was sampled at each section."""
        return self.with_past(0)

    def with_past(self, lags: int) -> Int[np.ndarray, "N ny"]:
        """How often with so many samples before it in its record."""
        return self._late[lags:].sum(axis=0)

    @property
    def spread(self) -> Float[np.ndarray, " ny"]:
        """Standard deviation of each output."""
        return np.sqrt(self._square / np.maximum(self._count, 1))
