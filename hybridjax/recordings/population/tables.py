"""Tables of a study as data frames: the subjects with their groups and conditions.

`Population` and `PopulationMaps` call `table_of` to check a table, `cells_of` and `rows_with` to
select rows, and `signed` for the sentences of a methods section. A *factor* is the column `group`
or `condition`, and a *cell* is one group and condition, by its labels. The names `subject`, `group`
and `condition` must stay, since users write them. From `table_of` on, labels are strings.

If a table is refused without need, look at `table_of`; if labels are, at `rows_with`; if subjects
are said to be too few, at `require` and its callers.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ... import __version__
from ..._core.arguments import package, require_axes
from ...errors import DefinitionError


@runtime_checkable
class Columns(Protocol):
    """A mapping of columns by name, or a data frame."""

    def items(self) -> Any: ...


def table_of(table: Columns, rows: int) -> Any:
    """Return a data frame whose subjects, groups and conditions are strings.

    **Raises:** `DefinitionError` for a table without subjects or of another length, for a label
    that is missing, and for a subject in two groups.
    """
    columns = {str(name): np.asarray(values) for name, values in table.items()}
    if "subject" not in columns:
        raise DefinitionError(
            "`table` has no column 'subject': add one, with a name in each row."
        )
    for name, values in columns.items():
        require_axes(f"column '{name}' of `table`", values, {"estimates": rows})
    frame = package("pandas").DataFrame(columns)
    labels = ["subject", *factors_of(frame)]
    incomplete = np.flatnonzero(frame[labels].isna().any(axis=1))
    if len(incomplete):
        missing = " or no ".join(labels)
        raise DefinitionError(
            f"row {incomplete[0]} of `table` has no {missing}: name it, or leave the row out."
        )
    frame = frame.astype(dict.fromkeys(labels, str))
    if "group" in frame:
        for subject, groups in frame.groupby("subject")["group"].unique().items():
            if len(groups) > 1:
                names = " and ".join(map(repr, groups))
                raise DefinitionError(
                    f"subject '{subject}' is in the groups {names}: conditions may differ, not "
                    "groups."
                )
    return frame


def factors_of(table: Any) -> list[str]:
    return [name for name in ("group", "condition") if name in table]


def cells_of(table: Any) -> Any:
    """Return the group and condition of each row, joined by a comma, or "all"."""
    factors = factors_of(table)
    return table[factors].agg(", ".join, axis=1) if factors else "all"


def rows_with(table: Any, *labels: str) -> tuple[str, Any]:
    """Return the factor (group or condition) to which the labels belong, and for each row whether
    it has one of the labels.

    **Raises:** `DefinitionError` if no factor has all of them.
    """
    factors = factors_of(table)
    for factor in factors:
        are_different = len(set(labels)) == len(labels)
        if are_different and set(labels) <= set(table[factor]):
            return factor, table[factor].isin(labels)
    given = " and ".join(map(repr, labels))
    existing = [repr(x) for factor in factors for x in table[factor].unique()]
    raise DefinitionError(
        f"{given} are no two conditions or groups of `table`, which has "
        f"{', '.join(existing) or 'neither'}."
    )


def require(subjects: Mapping[str, Iterable[str]], needed: int) -> None:
    """**Raises:** `DefinitionError` if a group or condition has fewer subjects."""
    for cell, names in subjects.items():
        count = len(set(names))
        if count < needed:
            raise DefinitionError(
                f"'{cell}' has too few subjects: {count} of {needed} needed."
            )


def signed(text: str) -> str:
    """Return sentences for a methods section with the version of the software."""
    return f"{text} Computed by hybridjax {__version__}."
