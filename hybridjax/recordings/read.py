"""Recordings from files: text, NPZ and Parquet."""

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import DefinitionError, FileFormatError
from .headers import seconds, split_header, time_unit
from .recording import Recording
from .text.layouts import read_text
from .text.table import Columns


# What the names of columns with events begin with.
_EVENT = "event "


def read_recording(
    *paths: str | os.PathLike, time: str = "time", units: Mapping[str, str] | None = None
) -> Recording:
    """A recording from files, one trial in each.

    - *Text* (`.csv`, `.txt`, `.tsv`): a first line with the names of the columns, separated by
      commas, semicolons, tabs or blanks, and numbers below. A unit may follow a name in parentheses
      or brackets, `force (N)`, or stand in a row below the names. Empty fields, `nan` and `NA` are
      missing samples. Decimal commas are read where another character separates; lines that begin
      with `#`, `%` or `//` are comments. UTF-8, UTF-16 or Latin-1.
    - *OpenSim* (`.mot`, `.sto`) and *Vicon* (`.csv`, `.txt`; blocks of several rates share one axis
      of time, columns are named `device.component`, `marker.X`).
    - *NPZ*: an array for each column.
    - *Parquet*: needs the package pyarrow.

    A column `event NAME` is not a signal: where it is not zero, an event NAME happened. In NPZ
    files an array `event NAME` holds the times of the events.

    Times become seconds, from s, ms, us, ns, min or h; without a unit they are taken as seconds,
    which the recording's `notes` say.

    **Arguments:** `time`: the name of the column with the times. `units`: by name of the signal,
    for all files.

    **Raises:** `DefinitionError` for files that are not there, have no such column, another unit of
    time or columns that differ, and as `Recording`; `FileFormatError` for files that cannot be
    read, with the line.
    """
    if not paths:
        raise DefinitionError("there is no file to read.")
    found = [_recording(path, time, dict(units or {})) for path in map(Path, paths)]
    return Recording.join(found)


def read_columns(path: Path) -> Columns:
    """The columns of a file by their headers, and what was assumed to read them.

    **Raises:** as `read_recording`.
    """
    readers = dict.fromkeys((".csv", ".txt", ".tsv", ".mot", ".sto"), read_text)
    readers |= {".npz": _npz, ".parquet": _parquet}
    if path.suffix.lower() not in readers:
        raise DefinitionError(
            f"'{path}' ends in '{path.suffix}'; recordings are read from "
            f"{', '.join(readers)} files: export it as one of these."
        )
    try:
        empty = path.stat().st_size == 0
        if empty:
            raise FileFormatError(f"'{path}' is empty.")
        return readers[path.suffix.lower()](path)
    except OSError as error:
        raise DefinitionError(f"cannot read '{path}': {error.strerror}.") from error


def _recording(path: Path, time: str, units: dict[str, str]) -> Recording:
    columns, notes = read_columns(path)
    clock = _column_of_times(path, list(columns), time)
    unit = time_unit(clock)
    scale = seconds(f"'{path}'", clock, unit)
    t = columns[clock] * scale
    if not unit:
        notes += (f"the times in '{clock}' have no unit: taken as seconds",)
    plain, own, events = {}, {}, {}
    for header, values in columns.items():
        name, unit = split_header(header)
        if name in plain:
            raise FileFormatError(f"'{path}' has two columns '{name}'.")
        if header == clock:
            continue
        if name.startswith(_EVENT):
            marks = path.suffix.lower() != ".npz"
            at = t[np.nan_to_num(values) != 0] if marks else values * scale
            events[name.removeprefix(_EVENT)] = at
            continue
        plain[name] = values
        if unit:
            own[name] = unit
    return Recording(t, plain, events=events, units=own | units, name=path.stem, notes=notes)


def _column_of_times(path: Path, headers: list[str], time: str) -> str:
    """The header with this name; capitals matter only where there are several."""
    names = {x: split_header(x)[0] for x in headers}
    exact = [x for x, name in names.items() if time in (x, name)]
    alike = exact or [x for x, name in names.items() if name.lower() == time.lower()]
    if len(alike) > 1:
        raise FileFormatError(f"'{path}' has two columns '{time}'.")
    if not alike:
        raise DefinitionError(
            f"'{path}' has no column '{time}'; its columns are {', '.join(names.values())}."
        )
    return alike[0]


def _npz(path: Path) -> Columns:
    try:
        with np.load(path, allow_pickle=False) as file:
            return Columns(dict(file))
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise FileFormatError(f"'{path}' is not an NPZ file of numbers, or damaged.") from error


def _parquet(path: Path) -> Columns:
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
    return Columns({name: table[name].to_numpy() for name in table.column_names})
