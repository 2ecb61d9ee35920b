"""Tables of a study: who was recorded, and the results, as real columns for CSV, pandas and R."""

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ... import __version__
from ..._core.boundary.checked import checked_methods
from ..._core.boundary.kinds import FilePath
from ..._core.text import columns as aligned
from ..._core.writing import replacing
from ...errors import DefinitionError


@runtime_checkable
class Columns(Protocol):
    """A mapping of columns by name, or a data frame."""

    def items(self) -> Any: ...


FACTORS = ("group", "condition")


@checked_methods
@dataclasses.dataclass(frozen=True, repr=False)
class PopulationTable:
    """A table of results.

    **Fields:** `columns`, arrays by name (NaN where a column does not apply; empty in files);
    `methods`: sentences for the methods section of a paper.
    """

    columns: dict[str, np.ndarray]
    methods: str = ""

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
        rows = [*zip(*[(k, *v) for k, v in shown.items() if any(v)], strict=True)]
        return f"PopulationTable({len(rows) - 1} rows)" + aligned(rows)


def _cell(x, digits: int | None = None) -> str:
    if isinstance(x, float | np.floating):
        return "" if np.isnan(x) else f"{x:.{digits}g}" if digits else repr(float(x))
    return str(x)


def table_of(rows: list[dict], methods: str) -> PopulationTable:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return PopulationTable(columns, f"{methods} Computed by hybridjax {__version__}.")


def as_columns(table: Columns, rows: int) -> dict[str, np.ndarray]:
    """Return the columns of a mapping, or of a data frame, by name.

    **Raises:** `DefinitionError` for a table without subjects or of another length, and for a
    subject in two groups.
    """
    columns = {str(name): np.asarray(values) for name, values in table.items()}
    if "subject" not in columns:
        raise DefinitionError("`table` has no column 'subject': add one, with a name in each row.")
    for name, values in columns.items():
        if values.shape != (rows,):
            raise DefinitionError(
                f"column '{name}' of `table` must have one value for each of the {rows} estimates, "
                f"but has shape {values.shape}."
            )
        if name in ("subject", *FACTORS) or values.dtype.kind == "O":
            columns[name] = values.astype(str)
    groups: dict[str, str] = {}
    for subject, group in zip(columns["subject"], columns.get("group", ()), strict=False):
        if groups.setdefault(subject, group) != group:
            raise DefinitionError(
                f"subject '{subject}' is in the groups '{groups[subject]}' and '{group}': give one "
                "group, or call the column 'condition' if subjects were recorded in both."
            )
    return columns


def cells_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return the group and condition of each row, joined by a comma."""
    names = [columns[name] for name in FACTORS if name in columns]
    joined = [", ".join(x) for x in zip(*names, strict=True)]
    return np.array(joined or ["all"] * len(columns["subject"]))


def rows_with(columns: dict[str, np.ndarray], labels: Sequence[str]) -> tuple[str, np.ndarray]:
    """Return the factor to which some labels belong, and its rows with one of them.

    **Raises:** `DefinitionError` if no factor has all of them.
    """
    for factor in FACTORS:
        if len(set(labels)) == len(labels) and set(labels) <= set(columns.get(factor, ())):
            return factor, np.isin(columns[factor], labels)
    listed = ", ".join(f"'{x}'" for f in FACTORS for x in dict.fromkeys(columns.get(f, ())))
    raise DefinitionError(
        f"{' and '.join(map(repr, labels))} are no two conditions or groups of `table`, which has "
        f"{listed or 'neither'}."
    )


def require(cells: np.ndarray, subjects: np.ndarray, needed: int = 2) -> None:
    """**Raises:** `DefinitionError` for a cell with fewer subjects."""
    for cell in dict.fromkeys(cells):
        names = sorted(set(subjects[cells == cell]))
        if len(names) < needed:
            raise DefinitionError(
                f"'{cell}' has too few subjects ({', '.join(names)}): at least {needed} are needed."
            )
