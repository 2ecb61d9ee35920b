"""Tables of a study: who was recorded, in which group and condition."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ...errors import DefinitionError


@runtime_checkable
class Columns(Protocol):
    """A mapping of columns by name, or a data frame."""

    def items(self) -> Any: ...


FACTORS = ("group", "condition")


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
    groups = columns.get("group", np.full(rows, ""))
    for subject in dict.fromkeys(columns["subject"]):
        of = sorted(set(groups[columns["subject"] == subject]))
        if len(of) > 1:
            raise DefinitionError(
                f"subject '{subject}' is in the groups '{of[0]}' and '{of[1]}': give one group, or "
                "call the column 'condition' if subjects were recorded in both."
            )
    return columns


def cells_of(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return the group and condition of each row, joined by a comma."""
    names = [columns[name] for name in FACTORS if name in columns]
    return np.array([", ".join(x) for x in zip(*names, strict=True)] or ["all"] * len(
        columns["subject"]))  # fmt: skip


def rows_with(columns: dict[str, np.ndarray], labels: Sequence[str]) -> tuple[str, np.ndarray]:
    """Return the factor to which some labels belong, and its rows with one of them.

    **Raises:** `DefinitionError` if no factor has all of them.
    """
    for factor in FACTORS:
        different = len(set(labels)) == len(labels)
        if different and factor in columns and set(labels) <= set(columns[factor]):
            return factor, np.isin(columns[factor], labels)
    listed = ", ".join(f"'{x}'" for f in FACTORS for x in dict.fromkeys(columns.get(f, ())))
    raise DefinitionError(
        f"{' and '.join(map(repr, labels))} are no two conditions or groups of `table`, which has "
        f"{listed or 'neither'}."
    )


def require_subjects(cells: np.ndarray, subjects: np.ndarray, needed: int = 2) -> None:
    """**Raises:** `DefinitionError` for a cell with fewer subjects."""
    for cell in dict.fromkeys(cells):
        names = sorted(set(subjects[cells == cell]))
        if len(names) < needed:
            where = "the table" if cell == "all" else f"'{cell}'"
            text = "one subject" if len(names) == 1 else f"{len(names)} subjects"
            raise DefinitionError(
                f"{where} has {text} ({', '.join(names)}): {needed} or more are needed."
            )
