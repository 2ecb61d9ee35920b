"""Recordings from files: CSV, NPZ and Parquet."""

import csv
import os
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .._core.boundary.checked import checked
from ..errors import DefinitionError, FileFormatError
from .recording import Recording


# What stands for a missing sample in text files, in any case of letters.
_MISSING = {"", "nan", "na", "n/a", "null"}
# What the names of columns with events begin with.
_EVENT = "event "


@checked
def read_recording(
    *paths: str | os.PathLike, time: str = "time", units: Mapping[str, str] | None = None
) -> Recording:
    """A recording from files, one trial in each.

    - *CSV*: a first line with the names of the columns, separated by commas, semicolons or tabs,
      and numbers below. A unit may follow a name in parentheses or brackets: `force (N)`. Empty
      fields, `nan` and `NA` are missing samples.
    - *NPZ*: an array for each column.
    - *Parquet*: needs the package pyarrow.

    A column `event NAME` is not a signal: where it is not zero, an event NAME happened. In NPZ
    files an array `event NAME` holds the times of the events.

    **Arguments:** `time`: the name of the column with the times. `units`: by name of the signal,
    for all files.

    **Raises:** `DefinitionError` for files that are not there, have no such column or columns that
    differ, and as `Recording`; `FileFormatError` for files that cannot be read, with the line.
    """
    if not paths:
        raise DefinitionError("there is no file to read.")
    found = [_recording(path, time, dict(units or {})) for path in map(Path, paths)]
    return Recording.join(found)


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file by their headers.

    **Raises:** as `read_recording`.
    """
    readers = {".csv": _csv, ".txt": _csv, ".tsv": _csv, ".npz": _npz, ".parquet": _parquet}
    if path.suffix.lower() not in readers:
        raise DefinitionError(
            f"'{path}' ends in '{path.suffix}'; tables are read from .csv, .npz and .parquet files."
        )
    try:
        empty = path.stat().st_size == 0
        if empty:
            raise FileFormatError(f"'{path}' is empty.")
        return readers[path.suffix.lower()](path)
    except OSError as error:
        raise DefinitionError(f"cannot read '{path}': {error.strerror}.") from error


def _recording(path: Path, time: str, units: dict[str, str]) -> Recording:
    plain, own = {}, {}
    for header, values in read_columns(path).items():
        name, unit = _split(header)
        if name in plain:
            raise FileFormatError(f"'{path}' has two columns '{name}'.")
        plain[name] = values
        if unit and not name.startswith(_EVENT) and name != time:
            own[name] = unit
    if time not in plain:
        raise DefinitionError(
            f"'{path}' has no column '{time}'; its columns are {', '.join(plain)}."
        )
    t = plain.pop(time)
    events = {}
    for name in [x for x in plain if x.startswith(_EVENT)]:
        values = plain.pop(name)
        marks = path.suffix.lower() != ".npz"
        events[name.removeprefix(_EVENT)] = t[np.nan_to_num(values) != 0] if marks else values
    return Recording(t, plain, events=events, units=own | units, name=path.stem)


def _split(header: str) -> tuple[str, str]:
    """`force (N)` -> `force`, `N`."""
    match = re.fullmatch(r"(.*?)\s*[(\[]([^)\]]*)[)\]]", header.strip())
    return (match[1].strip(), match[2].strip()) if match else (header.strip(), "")


def _csv(path: Path) -> dict[str, np.ndarray]:
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            separator = max(",;\t", key=first.count)
            header = next(csv.reader([first], delimiter=separator), [])
            if not any(map(str.strip, header)):
                raise FileFormatError(f"'{path}' has no line with the names of its columns.")
            if all(_number(x) is not None for x in header):
                raise FileFormatError(
                    f"'{path}' begins with numbers: its first line must name the columns."
                )
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of no data, which is told below
                    values = np.loadtxt(file, delimiter=separator, ndmin=2, comments=None)
            except ValueError:
                values = None
        if values is None or values.shape[1] != len(header):
            values = _by_line(path, separator, header)
    except UnicodeDecodeError as error:
        raise FileFormatError(f"'{path}' is not a text file.") from error
    if not values.size:
        raise FileFormatError(f"'{path}' has a header, but no samples.")
    if len(set(header)) < len(header):
        twice = next(x for x in header if header.count(x) > 1)
        raise FileFormatError(f"'{path}' has two columns '{twice.strip()}'.")
    return dict(zip(header, values.T, strict=True))


def _by_line(path: Path, separator: str, header: list[str]) -> np.ndarray:
    """For files with missing fields, or with an error that needs a line number."""
    rows = []
    with open(path, encoding="utf-8-sig", newline="") as file:
        for number, fields in enumerate(csv.reader(file, delimiter=separator), 1):
            if number == 1 or not any(map(str.strip, fields)):
                continue
            if len(fields) != len(header):
                raise FileFormatError(
                    f"'{path}', line {number}: {len(fields)} fields, but the header names "
                    f"{len(header)} columns."
                )
            row = [_number(x) for x in fields]
            if None in row:
                k = row.index(None)
                raise FileFormatError(
                    f"'{path}', line {number}: column '{header[k].strip()}' holds "
                    f"'{fields[k].strip()}', which is not a number."
                )
            rows.append(row)
    return np.array(rows, float)


def _number(text: str) -> float | None:
    try:
        return np.nan if text.strip().lower() in _MISSING else float(text)
    except ValueError:
        return None


def _npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise FileFormatError(f"'{path}' is not an NPZ file of numbers, or damaged.") from error


def _parquet(path: Path) -> dict[str, np.ndarray]:
    try:
        from pyarrow import ArrowInvalid, parquet
    except ImportError as error:
        raise DefinitionError(
            "Parquet files are read with the package pyarrow, which is not installed: "
            "`pip install pyarrow`."
        ) from error
    try:
        table = parquet.read_table(path)
    except (ArrowInvalid, OSError) as error:
        raise FileFormatError(f"'{path}' is not a Parquet file, or damaged.") from error
    return {name: table[name].to_numpy() for name in table.column_names}
