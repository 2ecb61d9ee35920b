"""Records of any number in parts that fit into memory, one after the other."""

from collections.abc import Iterable, Iterator, Sequence

from ...experiments.record import (
    HasRecords,
    Record,
    RecordedData,
    each_uninterrupted_record,
    uninterrupted_records,
)
from .cycle_grid import CycleGrid, count_cycles


# Samples of a part, unless a single record has more. Doubled: twice the memory.
_SAMPLES = 100_000
# Cycles of the shortest record in a part, relative to the longest. Doubled: all are of one length,
# and there are as many parts as lengths.
_ALIKE = 0.5


class Parts:
    """Records as grids of bounded size, which can be gone through again and again.

    Data that can be iterated over more than once, and are no sequence (`StoredExperiments`), are
    read anew each time; of others the grids are kept.
    """

    def __init__(self, data: RecordedData):
        """**Raises:** `DefinitionError` as `uninterrupted_records`."""
        self.in_memory = isinstance(data, HasRecords | Sequence) or iter(data) is data
        in_memory = self.in_memory and not isinstance(data, HasRecords)
        self._data = list(data) if in_memory else data
        self._grids = list(_grids(self._data)) if self.in_memory else None
        first = next(iter(self))
        self.n_sections, self.lead = first.n_sections, first.lead
        self.inputs, self.outputs = first.inputs, first.outputs

    def __iter__(self) -> Iterator[CycleGrid]:
        return _grids(self._data) if self._grids is None else iter(self._grids)

    def whole(self) -> CycleGrid:
        """All records on one grid."""
        return CycleGrid.from_records(uninterrupted_records(self._data))


def _grids(data: RecordedData) -> Iterator[CycleGrid]:
    for group in in_groups(each_uninterrupted_record(data)):
        left = sorted(group, key=count_cycles, reverse=True)
        while left:
            enough = _ALIKE * count_cycles(left[0])
            alike = [r for r in left if count_cycles(r) >= enough]
            yield CycleGrid.from_records(alike)
            left = left[len(alike) :]


def in_groups(records: Iterable[Record]) -> Iterator[list[Record]]:
    """Records in lists of bounded size."""
    group: list[Record] = []
    size = 0
    for record in records:
        if group and size + len(record.u) > _SAMPLES:
            yield group
            group, size = [], 0
        group.append(record)
        size += len(record.u)
    if group:
        yield group
