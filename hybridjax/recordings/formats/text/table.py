"""Numbers in columns of text."""

import csv
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ....errors import FileFormatError
from ..columns import Columns
from .lines import is_comment


# What stands for a missing sample, in any case of letters.
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none"}


# Characters of a field that a message shows. Doubled: longer messages.
_SHOWN = 40


class Table(NamedTuple):
    """Lines with one field for each header; `first`: the number of lines before them."""

    path: Path
    headers: Sequence[str]
    lines: list[str]
    first: int
    separator: str
    """A character, or "" for blanks."""


def split_line(line: str, separator: str) -> list[str]:
    """The fields of a line, without blanks around them. Blanks before a unit separate nothing."""
    if not separator:
        return re.split(r"\s+(?![(\[])", line.strip()) if line.strip() else []
    if '"' not in line:
        return [x.strip() for x in line.split(separator)] if line else []
    try:
        return [x.strip() for x in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a field of more than 100 kB, which is none
        return [line]


def split_names(line: str, separator: str) -> list[str]:
    """The fields of a line, without the empty ones after the last."""
    names = split_line(line, separator)
    while names and not names[-1]:
        names.pop()
    return names


def to_number(text: str) -> float | None:
    """None if it is none."""
    try:
        return np.nan if text.strip().lower() in _MISSING else float(text)
    except ValueError:
        return None


def read_table(table: Table) -> Columns:
    """The numbers of a table; decimal commas are read where commas separate nothing.

    Columns without a name are left out, as are empty fields after the last one.

    **Raises:** `FileFormatError` for two columns of one name, and what is no number, with its line.
    """
    named = [x for x in table.headers if x]
    if len(set(named)) < len(named):
        twice = next(x for x in named if named.count(x) > 1)
        raise FileFormatError(f"'{table.path}' has two columns '{twice}'.")
    notes = []
    lines = ["" if is_comment(x) else x for x in table.lines]
    if table.separator != "," and any("," in x for x in lines):
        notes.append("decimal commas were read as such")
        mixed = next((k for k, x in enumerate(lines) if "." in x), None)
        if mixed is not None:
            raise FileFormatError(
                f"'{table.path}', line {table.first + mixed + 1}: there are points beside decimal "
                "commas; export numbers with one of the two, and no separators of thousands."
            )
        lines = [x.replace(",", ".") for x in lines]
    values = _at_once(lines, table.separator)
    if values is None or values.shape[1] != len(table.headers):
        values = _by_line(table._replace(lines=lines))
    if not values.size:
        raise FileFormatError(f"'{table.path}' has a header, but no samples.")
    if len(named) < len(table.headers):
        notes.append("columns without a name were left out")
    found = zip(table.headers, values.T, strict=True)
    return Columns({name: column for name, column in found if name}, tuple(notes))


def _at_once(lines: list[str], separator: str) -> Float[np.ndarray, "n k"] | None:
    """For files with a number in every field."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no data, which is told later
            return np.loadtxt(
                lines, delimiter=separator or None, ndmin=2, comments=None, quotechar='"'
            )
    except ValueError:
        return None


def _by_line(table: Table) -> Float[np.ndarray, "n k"]:
    """For files with missing fields, or with an error that needs a line number."""
    rows, count = [], len(table.headers)
    for number, line in enumerate(table.lines, table.first + 1):
        fields = split_line(line, table.separator)
        if not any(fields):
            continue
        if len(fields) < count or any(fields[count:]):
            raise FileFormatError(
                f"'{table.path}', line {number}: {len(fields)} fields, but the header names "
                f"{count} columns."
                + " Decimal commas need another separator, such as semicolons."
                * (len(fields) > count and table.separator == ",")
            )
        row = [to_number(x) for x in fields[:count]]
        if None in row:
            k = row.index(None)
            raise FileFormatError(
                f"'{table.path}', line {number}: column '{table.headers[k]}' holds "
                f"'{fields[k][:_SHOWN]}', which is not a number."
            )
        rows.append(row)
    return np.array(rows, float).reshape(-1, count)
