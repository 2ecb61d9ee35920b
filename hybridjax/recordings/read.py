"""`read_recording`: recordings from files.

The suffix of a file selects a reader in `formats/` (`read_tables`), which returns tables of
columns. Here they become a `Recording` with one trial for each file. A reader for another format is
added in `formats/`, and to the readers here. It must not resample: tables of different rates are
put side by side by `Recording.beside`.

If a file gets the wrong reader, look at `_READERS`; if a signal or its times are wrong, at that
reader; if events are, at `parse_table` in `formats/columns.py`.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath, SignalNames
from ..errors import DefinitionError, FileFormatError
from .formats.arrays import (
    read_arrow,
    read_excel,
    read_hdf5,
    read_matlab,
    read_netcdf,
    read_npz,
)
from .formats.bag import read_bag
from .formats.c3d import read_c3d
from .formats.columns import Columns, Wanted, assumed, parse_table, time_unit
from .formats.layouts import read_text
from .recording import NamedColumns, Recording, check_events


@checked
def read_recording(
    *paths: FilePath | Sequence[FilePath],
    time: str = "time",
    signals: SignalNames | None = None,
    units: Mapping[str, str] | None = None,
) -> Recording:
    """Read a recording from files, given one by one or in a list, one trial in each.

    - *Text* (`.csv`, `.txt`, `.tsv`): a line with the names of the columns, separated by commas,
      semicolons, tabs or blanks, and numbers below. Lines above the names are left out if they have
      fewer fields. A unit may follow a name in parentheses or brackets, `force (N)`, or stand in a
      row below the names. Empty fields, `nan` and `NA` are missing samples. Decimal commas are read
      where another character separates; lines that begin with `#`, `%` or `//` are comments.
      Columns of text are left out, with a finding. UTF-8, UTF-16 or Latin-1.
    - *Excel* (`.xlsx`, `.xlsm`): the first sheet, in the same way.
    - *Parquet*, *Feather*, *NPZ*: an array for each column.
    - *MATLAB* (`.mat`, of all versions) and *HDF5* (`.h5`, `.hdf5`): arrays by their names in
      structs, `imu.gyro`, or their paths, `imu/gyro`; columns of matrices are `imu.gyro.0`, ... The
      times of an array are in its struct or group, or in the nearest enclosing one.
    - *NetCDF* (`.nc`): variables by their names, with their scale factors, offsets and marks of
      missing values.
    - *C3D*: markers `LASI.x`, `LASI.y`, `LASI.z`, analog channels, events with their contexts.
    - *OpenSim* (`.mot`, `.sto`), *Motion Analysis* (`.trc`) and *Vicon* (`.csv`, `.txt`).
    - *ROS* (`.bag`, `.db3`, folders of them) and *MCAP*: numbers of messages as `topic.field`, at
      the times in the messages' headers.

    Signals of different rates keep their own times: all share one time axis, and are missing (NaN)
    in between. Nothing is interpolated before sections are sampled.

    A column `event NAME` is not a signal: where it is not zero, an event NAME happened. Arrays
    `event NAME` of NPZ files, and those in a group `events` of MATLAB and HDF5 files, hold times
    of events. Events outside of the recording are left out.

    Times are converted to seconds from s, ms, us, ns, min or h; times without a unit are taken as
    seconds, with one of the recording's `findings`.

    **Arguments:**

    - `paths`: paths of the files, or lists of them.
    - `time`: name of the column with the times. Default: "time".
    - `signals`: names of the signals to be read, or of groups, structs, markers and topics; only
      these take memory. Default: all.
    - `units`: units by name of the signal, for all files. Default: those in the files.

    **Returns:** `hj.Recording` with one trial per file, in the order of the paths. Times are in
    seconds, signals in the units of the files.

    **Raises:** `DefinitionError` for files that do not exist, columns or signals that they do not
    have, unknown units of time, columns that differ between files, events that are all outside of
    the recording, packages that are not installed, and in the cases of `Recording`;
    `FileFormatError` for files that cannot be read, with the line.

    **Example:**

    ```python
    walk = np.array([[0, 0.0, 1.00], [10, 1.0, 1.01], [20, 0.0, 1.02]])
    header = "time (ms),force (N),hip (m)"
    np.savetxt("walk.csv", walk, delimiter=",", header=header, comments="")
    recording = hj.read_recording("walk.csv", signals=("force", "hip"))
    print(recording)
    ```

    **Before:** a measurement. **After:** `hj.recordings.check_recording`, `hj.identify_recording`.
    """
    files: list[str | os.PathLike[str]] = []
    for path in paths:
        files += [path] if isinstance(path, str | os.PathLike) else path
    if not files:
        raise DefinitionError("`read_recording` needs the name of one file or more.")
    wanted = Wanted(time, None if signals is None else tuple(signals))
    return Recording.join(
        [_recording(x, wanted, dict(units or {})) for x in map(Path, files)]
    )


RecordingLike: TypeAlias = Recording | FilePath | NamedColumns
"""A recording, the file or the table that it is made of."""


def as_recording(given: RecordingLike) -> Recording:
    """Return a recording: that of a file as `read_recording` reads it, that of a table as
    `Recording.from_frame` does.

    **Raises:** `DefinitionError` and `FileFormatError` as these.
    """
    if isinstance(given, Recording):
        return given
    if isinstance(given, str | os.PathLike):
        return read_recording(given)
    return Recording.from_frame(given)


_READERS = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".mot", ".sto", ".trc"), read_text),
    **dict.fromkeys((".xlsx", ".xlsm"), read_excel),
    **dict.fromkeys((".parquet", ".feather"), read_arrow),
    ".npz": read_npz,
    ".mat": read_matlab,
    **dict.fromkeys((".h5", ".hdf5"), read_hdf5),
    ".nc": read_netcdf,
    ".c3d": read_c3d,
    **dict.fromkeys((".bag", ".db3", ".mcap"), read_bag),
}


def read_tables(path: Path, wanted: Wanted) -> list[Columns]:
    """Return the tables of a file, with their columns by header.

    **Raises:** as `read_recording`.
    """
    try:
        reader = read_bag if path.is_dir() else _READERS.get(path.suffix.lower())
        if reader is None:
            kinds = ", ".join(_READERS)
            raise DefinitionError(
                f"'{path}' ends in '{path.suffix}'; formats are {kinds}."
            )
        if path.stat().st_size == 0:
            raise FileFormatError(f"'{path}' is empty: export it again.")
        return reader(path, wanted)
    except OSError as error:
        why = error.strerror or error
        raise DefinitionError(f"cannot read '{path}': {why}.") from error


def _recording(path: Path, wanted: Wanted, units: dict[str, str]) -> Recording:
    parts: list[Recording] = []
    names: list[str] = []
    events: dict[str, np.ndarray] = {}
    for columns in read_tables(path, wanted):
        table = parse_table(f"'{path}'", columns, wanted.time)
        events |= table.events
        names += table.signals
        signals = {x: y for x, y in table.signals.items() if wanted.includes(x)}
        if not signals:
            continue
        findings = list(columns.findings)
        if not time_unit(table.clock):
            text = f"the times in '{table.clock}' have no unit: taken as seconds."
            findings.append(assumed(text))
        part = Recording(
            table.time,
            signals,
            units={x: unit for x, unit in table.units.items() if x in signals},
            name=path.stem,
            findings=findings,
        )
        parts.append(part)
    wanted.require(path, names)
    if not parts:
        raise DefinitionError(f"'{path}' has no signals beside its times: export some.")
    whole = Recording.beside(parts)
    trial = whole.trials[0]
    findings = list(whole.findings)
    for name, at in events.items():
        events[name], outside = check_events(f"'{path}'", name, at, trial.time)
        findings += outside
    return Recording(
        trial.time,
        dict(zip(whole.signals, trial.values.T, strict=True)),
        events=events,
        units=dict(zip(whole.signals, whole.units, strict=True)) | units,
        name=path.stem,
        findings=findings,
    )
