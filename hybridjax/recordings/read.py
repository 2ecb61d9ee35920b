"""Recordings from files."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._core.archive import read_arrays
from .._core.boundary.checked import checked
from .._core.boundary.kinds import SignalNames
from ..errors import DefinitionError, FileFormatError
from .formats.arrow import read_arrow
from .formats.bag import read_bag
from .formats.c3d import read_c3d
from .formats.columns import EVENT, Columns, Wanted, belongs, no_such_signal
from .formats.excel import read_excel
from .formats.hdf5 import read_hdf5
from .formats.matlab import read_matlab
from .formats.text.layouts import read_text
from .headers import seconds, split_header, time_unit
from .recording import Recording, Trial


@checked
def read_recording(
    *paths: str | os.PathLike,
    time: str = "time",
    signals: SignalNames | None = None,
    units: Mapping[str, str] | None = None,
) -> Recording:
    """A recording from files, one trial in each.

    - *Text* (`.csv`, `.txt`, `.tsv`): a first line with the names of the columns, separated by
      commas, semicolons, tabs or blanks, and numbers below. A unit may follow a name in parentheses
      or brackets, `force (N)`, or stand in a row below the names. Empty fields, `nan` and `NA` are
      missing samples. Decimal commas are read where another character separates; lines that begin
      with `#`, `%` or `//` are comments. UTF-8, UTF-16 or Latin-1.
    - *Excel* (`.xlsx`, `.xlsm`): the first sheet, in the same way.
    - *Parquet*, *Feather*, *NPZ*: an array for each column.
    - *MATLAB* (`.mat`, of all versions) and *HDF5* (`.h5`, `.hdf5`): arrays by their names in
      structs, `imu.gyro`, or their paths, `imu/gyro`; columns of matrices are `imu.gyro.0`, ...
      The times of an array are those in its struct or group, or in the nearest around it.
    - *C3D*: markers `LASI.x`, `LASI.y`, `LASI.z`, analog channels, events with their contexts.
    - *OpenSim* (`.mot`, `.sto`), *Motion Analysis* (`.trc`) and *Vicon* (`.csv`, `.txt`).
    - *ROS* (`.bag`, `.db3`, folders of them) and *MCAP*: numbers of messages as `topic.field`, at
      the times in the messages' headers.

    Signals of different rates keep their own times: all share one axis of time, and are missing in
    between. Nothing is interpolated before sections are taken.

    A column `event NAME` is not a signal: where it is not zero, an event NAME happened. Arrays
    `event NAME` of NPZ files, and those in a group `events` of MATLAB's and HDF5 files, hold times
    of events. Events outside of the recording are left out.

    Times become seconds, from s, ms, us, ns, min or h; without a unit they are taken as seconds,
    which the recording's `notes` say.

    **Arguments:** `time`: the name of the column with the times. `signals`: names of those to be
    read, or of groups, structs, markers and topics; by default all. Of large files only these take
    memory. `units`: by name of the signal, for all files.

    **Raises:** `DefinitionError` for files that are not there, have no such column or signal,
    another unit of time or columns that differ, for packages that are not installed, and as
    `Recording`; `FileFormatError` for files that cannot be read, with the line, and for events that
    are all outside of the recording.
    """
    if not paths:
        raise DefinitionError("there is no file to read.")
    wanted = Wanted(time, signals)
    return Recording.join([_recording(x, wanted, dict(units or {})) for x in map(Path, paths)])


def read_tables(path: Path, wanted: Wanted) -> list[Columns]:
    """The tables of a file, with their columns by header.

    **Raises:** as `read_recording`.
    """
    suffix = path.suffix.lower()
    if suffix not in _READERS and not path.is_dir():
        raise DefinitionError(
            f"'{path}' ends in '{path.suffix}'; recordings are read from {', '.join(_READERS)} "
            "files: export it as one of these."
        )
    try:
        if path.is_dir():
            return read_bag(path, wanted)
        if path.stat().st_size == 0:
            raise FileFormatError(f"'{path}' is empty.")
        return _READERS[suffix](path, wanted)
    except OSError as error:
        raise DefinitionError(f"cannot read '{path}': {error.strerror}.") from error


class _Table(NamedTuple):
    """What the columns of a table are; times in s."""

    time: Float[np.ndarray, " n"]
    signals: dict[str, Float[np.ndarray, " n"]]
    units: dict[str, str]
    events: dict[str, Float[np.ndarray, " _"]]
    notes: tuple[str, ...]


def _recording(path: Path, wanted: Wanted, units: dict[str, str]) -> Recording:
    tables = [_table(path, columns, wanted) for columns in read_tables(path, wanted)]
    names = [name for table in tables for name in table.signals]
    if len(set(names)) < len(names):
        raise _two_columns(path, next(x for x in names if names.count(x) > 1))
    for name in wanted.signals or ():
        if not any(belongs(x, name) for x in names):
            raise no_such_signal(path, name, names)
    events = {name: at for table in tables for name, at in table.events.items()}
    parts = []
    for table in tables:
        chosen = {name: x for name, x in table.signals.items() if wanted.includes(name)}
        if chosen:
            own = {name: unit for name, unit in table.units.items() if name in chosen}
            part = Recording(table.time, chosen, units=own, name=path.stem, notes=table.notes)
            parts.append(part)
    if not parts:
        raise DefinitionError(f"'{path}' has no signals.")
    whole = Recording.beside(parts)
    (trial,) = whole.trials
    events, notes = _within(path, trial, events)
    own = {x: u for x, u in zip(whole.signals, whole.units, strict=True) if u}
    return Recording(
        trial.time,
        dict(zip(whole.signals, trial.values.T, strict=True)),
        events=events,
        units=own | units,
        name=path.stem,
        notes=whole.notes + notes,
    )


def _within(
    path: Path, trial: Trial, events: dict[str, Float[np.ndarray, " _"]]
) -> tuple[dict[str, Float[np.ndarray, " _"]], tuple[str, ...]]:
    """Events within a trial, up to one sample before and after it, and notes of others."""
    step = float(np.median(np.diff(trial.time)))
    kept, notes = {}, []
    for name, at in events.items():
        inside = (at >= trial.time[0] - step) & (at <= trial.time[-1] + step)
        kept[name] = at[inside | np.isnan(at)]
        lost = len(at) - len(kept[name])
        if lost and not inside.any():
            raise FileFormatError(
                f"'{path}': all events '{name}' ({at[0]:.6g} s, ...) are outside of the recording, "
                f"which is from {trial.time[0]:.6g} to {trial.time[-1]:.6g} s: their times have "
                "another zero or unit."
            )
        if lost:
            notes.append(f"{lost} events '{name}' outside of the recording were left out")
    return kept, tuple(notes)


def _table(path: Path, columns: Columns, wanted: Wanted) -> _Table:
    clock = _column_of_times(path, list(columns.values), wanted)
    unit = time_unit(clock)
    scale = seconds(f"'{path}'", clock, unit)
    t = columns.values[clock] * scale
    notes = () if unit else (f"the times in '{clock}' have no unit: taken as seconds",)
    signals, units = {}, {}
    events = {name: at * scale for name, at in columns.events.items()}
    for header, values in columns.values.items():
        name, unit = split_header(header)
        if name in signals:
            raise _two_columns(path, name)
        if header == clock:
            continue
        if name.startswith(EVENT):
            events[name.removeprefix(EVENT)] = t[np.nan_to_num(values) != 0]
            continue
        if unit.lower() == "nan":
            raise FileFormatError(f"'{path}': the unit of '{name}' is nan: write it, or nothing.")
        signals[name] = values
        if unit:
            units[name] = unit
    return _Table(t, signals, units, events, columns.notes + notes)


def _column_of_times(path: Path, headers: list[str], wanted: Wanted) -> str:
    """The header with this name; capitals matter only where there are several."""
    names = {x: split_header(x)[0] for x in headers}
    exact = [x for x, name in names.items() if wanted.time in (x, name)]
    alike = exact or [x for x in headers if wanted.is_time(x)]
    if len(alike) > 1:
        raise _two_columns(path, wanted.time)
    if not alike:
        raise DefinitionError(
            f"'{path}' has no column '{wanted.time}'; its columns are {', '.join(names.values())}."
        )
    return alike[0]


def _two_columns(path: Path, name: str) -> FileFormatError:
    return FileFormatError(f"'{path}' has two columns '{name}'.")


def _npz(path: Path, wanted: Wanted) -> list[Columns]:
    arrays = read_arrays(path)
    events = {name for name in arrays if name.startswith(EVENT)}
    values = {name: x for name, x in arrays.items() if name not in events}
    return [Columns(values, events={x.removeprefix(EVENT): arrays[x] for x in events})]


def _text(path: Path, wanted: Wanted) -> list[Columns]:
    return read_text(path)


_READERS = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".mot", ".sto", ".trc"), _text),
    **dict.fromkeys((".xlsx", ".xlsm"), read_excel),
    **dict.fromkeys((".parquet", ".feather"), read_arrow),
    ".npz": _npz,
    ".mat": read_matlab,
    **dict.fromkeys((".h5", ".hdf5"), read_hdf5),
    ".c3d": read_c3d,
    **dict.fromkeys((".bag", ".db3", ".mcap"), read_bag),
}
