"""Results about populations as tables: real columns, for CSV, pandas and R."""

import csv
import dataclasses
from pathlib import Path

import numpy as np

from ... import __version__
from ..._core.boundary.checked import checked_methods
from ..._core.boundary.kinds import FilePath
from ..._core.text import columns as aligned
from ..._core.writing import replacing


@checked_methods
@dataclasses.dataclass(frozen=True, repr=False)
class PopulationTable:
    """A table of results.

    **Fields:** `columns`, arrays by name (NaN where a column does not apply; empty in files);
    `methods`: sentences for the methods section of a paper.
    """

    columns: dict[str, np.ndarray]
    methods: str

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def write(self, path: FilePath) -> Path:
        """Write the table as CSV, with all digits, and return the path.

        **Raises:** `DefinitionError` if it cannot be written.
        """
        with replacing(Path(path)) as new, open(new, "w", newline="", encoding="utf-8") as file:
            rows = zip(*self.columns.values(), strict=True)
            csv.writer(file).writerows([self.columns, *([_cell(x) for x in row] for row in rows)])
        return Path(path)

    def __repr__(self) -> str:
        shown = {k: [_cell(x, 4) for x in v] for k, v in self.columns.items()}
        shown = {k: v for k, v in shown.items() if any(v)}
        rows = zip(*shown.values(), strict=True)
        return f"PopulationTable({len(next(iter(shown.values())))} rows)" + aligned(
            [tuple(shown), *rows]
        )


def _cell(x, digits: int | None = None) -> str:
    if isinstance(x, float | np.floating):
        return "" if np.isnan(x) else f"{x:.{digits}g}" if digits else repr(float(x))
    return str(x)


def table_of(rows: list[dict], methods: str) -> PopulationTable:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return PopulationTable(columns, f"{methods} Computed by hybridjax {__version__}.")
