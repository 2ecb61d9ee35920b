"""Readers of files of named arrays (HDF5, NetCDF, MATLAB of all versions, NPZ), and of files of one
table (Parquet, Feather, Excel).

`read.py` calls a function `read_...` by the suffix of a file; each returns tables of `Columns`
(`columns.py`). In files with groups, `_read_tree` decides which array holds the times of a signal.
Where a reader calls `check_declared`, that must stay before values are read: a damaged file could
otherwise take all memory.

If a signal has wrong times, look at `_nearest`; if a number is scaled wrongly or not marked as
missing, at `Leaf.values` (packing and marks of NetCDF); if a matrix is read along the wrong axis,
at `_columns`.
"""

import csv
import io
import itertools
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core import limits
from ..._core.archive import read_arrays
from ..._core.arguments import package
from ..._core.signal import with_unit
from ...errors import DefinitionError, FileFormatError
from .columns import (
    EVENT,
    Columns,
    Wanted,
    assumed,
    check_declared,
    reading,
    split_header,
)
from .matlab_sizes import declared
from .text import read_plain


# Largest number of rows of a sheet of Excel. Smaller: long recordings are refused. Larger: a row
# with a wrong number takes memory for all rows before it.
_MOST_ROWS = 2**20
# Attributes of NetCDF that change stored numbers: marks of missing numbers, and a linear scale.
_MARKS = ("_FillValue", "missing_value")
_PACKING = (*_MARKS, "scale_factor", "add_offset")
Place = tuple[str, ...]
"""Names of groups, from the outermost on, and of an array."""


class Leaf(NamedTuple):
    """An array of numbers with a shape, whose values at `[()]` may be read later."""

    array: Any
    unit: str = ""
    packing: Mapping[str, Any] = {}
    """Attributes of NetCDF (`scale_factor`, `_FillValue`, ...) that change the stored numbers."""

    def values(self) -> np.ndarray:
        """Return the numbers after unpacking; NaN where the stored number is a mark of a missing
        one."""
        stored = np.asarray(self.array[()])
        if not self.packing:
            return stored
        marks = [np.ravel(self.packing[x]) for x in _MARKS if x in self.packing]
        missing = np.isin(stored, np.concatenate([np.zeros(0), *marks]))
        scale = float(np.ravel(self.packing.get("scale_factor", 1.0))[0])
        offset = float(np.ravel(self.packing.get("add_offset", 0.0))[0])
        return np.where(missing, np.nan, stored * scale + offset)


def read_hdf5(path: Path, wanted: Wanted, separator: str = "/") -> list[Columns]:
    """Read datasets by their paths, such as `imu/gyro`; an attribute `units` is their unit.

    Attributes of NetCDF 4 apply: scale factors, offsets, and marks of missing numbers.

    **Raises:** `FileFormatError` for a damaged file, one that declares more than it can hold, for
    arrays that lie in other files, for arrays of structs, and as `_read_tree`.
    """
    h5py = package("h5py")
    leaves: dict[Place, Leaf] = {}

    def visit(name: str, node: Any) -> None:
        place = tuple(name.split("/"))
        if len(place) > limits.NESTED:  # (opening one opens all groups around it)
            raise FileFormatError(
                f"'{path}' has groups in more than {limits.NESTED} others: copy their arrays into "
                "fewer."
            )
        is_of_matlab = name.startswith("#")  # MATLAB's own data
        if not isinstance(node, h5py.Dataset) or is_of_matlab:
            return
        kind = node.attrs.get("MATLAB_class")
        if h5py.check_ref_dtype(node.dtype) and kind is None:
            _refuse_structs(path, separator.join(place[:-1]), wanted)
        # Texts of MATLAB are stored as numbers, and an empty array as its shape.
        is_text = "MATLAB_empty" in node.attrs or kind == b"char"
        if node.dtype.kind not in "fiu" or is_text:
            return
        if node.external or node.is_virtual:
            raise FileFormatError(
                f"'{path}': '{name}' lies in other files: copy it into this."
            )
        packing = {x: node.attrs[x] for x in _PACKING if x in node.attrs}
        leaves[place] = Leaf(node, _unit_of(node.attrs.get("units", "")), packing)

    with reading(path, "HDF5 file"), h5py.File(path, "r") as file:
        file.visititems(visit)
        numbers = sum(math.prod(leaf.array.shape) for leaf in leaves.values())
        check_declared(path, 8 * numbers)
        return _read_tree(path, leaves, separator, wanted)


def _unit_of(attribute: Any) -> str:
    """Return the unit in an attribute; `seconds since 2026-01-01` of NetCDF is `seconds`."""
    unit = attribute.decode() if isinstance(attribute, bytes) else str(attribute)
    return unit.partition(" since ")[0]


def read_netcdf(path: Path, wanted: Wanted) -> list[Columns]:
    """Read a NetCDF file: version 4 is HDF5; of version 3, variables by their names.

    **Raises:** `FileFormatError` for a damaged file, and as `_read_tree`.
    """
    with open(path, "rb") as file:
        is_version_3 = file.read(3) == b"CDF"
    if not is_version_3:
        return read_hdf5(path, wanted)
    from scipy.io import netcdf_file

    leaves: dict[Place, Leaf] = {}
    with reading(path, "NetCDF file"), netcdf_file(path, "r", mmap=False) as file:
        for name, variable in file.variables.items():
            if variable.data.dtype.kind not in "fiu":
                continue
            attributes = vars(variable).get("_attributes", {})
            packing = {x: attributes[x] for x in _PACKING if x in attributes}
            unit = _unit_of(attributes.get("units", ""))
            leaves[(name,)] = Leaf(variable.data, unit, packing)
        return _read_tree(path, leaves, "/", wanted)


def read_matlab(path: Path, wanted: Wanted) -> list[Columns]:
    """Read variables and fields of structs, such as `imu.gyro`.

    **Raises:** `FileFormatError` for a damaged file, one that declares more than it can hold, for
    arrays of structs, and as `_read_tree`.
    """
    from scipy.io import loadmat, matlab, whosmat

    with reading(path, "MATLAB file"):
        version, _ = matlab.matfile_version(path)
        if version == 2:
            return read_hdf5(path, wanted, ".")
        # (`whosmat` of scipy unpacks whole arrays of version 5. Files of version 4 are not packed.)
        if version == 1:
            for size in itertools.accumulate(declared(path)):
                check_declared(path, size)
        shapes = {name: shape for name, shape, _ in whosmat(path)}
        if version == 0:
            check_declared(path, 8 * sum(map(math.prod, shapes.values())))
        chosen = _chosen(list(shapes), wanted)
        content = loadmat(path, simplify_cells=True, variable_names=chosen)
    variables = {
        name: value for name, value in content.items() if not name.startswith("__")
    }
    return _read_tree(path, dict(_leaves(path, (), variables, wanted)), ".", wanted)


def _chosen(names: Sequence[str], wanted: Wanted) -> list[str]:
    """Return the variables to be read; if a wanted name is wrong, all, for the message."""
    first_names = {name.split(".")[0] for name in wanted.signals or ()}
    if not first_names <= set(names):
        return list(names)
    return [name for name in names if wanted.includes(name) or wanted.reaches(name)]


def _leaves(
    path: Path,
    place: Place,
    value: Any,
    wanted: Wanted,
) -> Iterator[tuple[Place, Leaf]]:
    """Yield arrays of numbers in a struct (a dictionary); an array of structs is a list."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _leaves(path, (*place, name), part, wanted)
    elif isinstance(value, list) and any(isinstance(x, dict) for x in value):
        _refuse_structs(path, ".".join(place), wanted)
    elif np.asarray(value).dtype.kind in "fiu":
        yield place, Leaf(np.asarray(value))


def _read_tree(
    path: Path,
    leaves: Mapping[Place, Leaf],
    separator: str,
    wanted: Wanted,
) -> list[Columns]:
    """Return a table for each array of times.

    The times of an array are those in its own group, or else in the nearest group around it. The
    columns of a matrix are called `name.0`, `name.1`, ... Arrays in a group `events` are times of
    events. Single numbers are settings, and left out.

    **Raises:** `DefinitionError` where there are no times for a signal; `FileFormatError` for an
    array that is not as long as its times.
    """
    names = {place: separator.join(place) for place in leaves}
    wanted.require(path, list(names.values()), groups=True)
    clocks = {place[:-1]: place for place in leaves if wanted.is_time(place[-1])}
    for place, name in names.items():
        if name == wanted.time:
            clocks[()] = place
    tables: dict[Place, Columns] = {}
    for place, leaf in leaves.items():
        name = names[place]
        is_event = place[-2:-1] == ("events",)
        is_signal = np.prod(leaf.array.shape) > 1 and wanted.reaches(name)
        if place in clocks.values() or not (is_event or is_signal):
            continue
        group = _nearest(place, clocks)
        if group is None:
            raise DefinitionError(
                f"'{path}' has no times '{wanted.time}' for '{name}' in its group or one around "
                "it: add or name them (`time`), or choose `signals`."
            )
        if group not in tables:
            clock = leaves[clocks[group]]
            times = np.atleast_1d(np.squeeze(clock.values()))
            header = with_unit(wanted.time, clock.unit)
            tables[group] = Columns({header: times}, events={})
        table = tables[group]
        if is_event:
            table.events[place[-1]] = np.ravel(leaf.values())
        else:
            table.values.update(_columns(path, name, leaf, table))
    return list(tables.values())


def _nearest(place: Place, clocks: Mapping[Place, Place]) -> Place | None:
    """Return the innermost group around an array, or the array itself, that has times."""
    for depth in range(len(place), -1, -1):
        if place[:depth] in clocks:
            return place[:depth]
    return None


def _columns(
    path: Path,
    name: str,
    leaf: Leaf,
    table: Columns,
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return an array, or the columns of a matrix, with a row for each of the table's times."""
    times = next(iter(table.values.values()))
    values = np.atleast_1d(np.squeeze(leaf.values()))
    if values.ndim == 2 and len(values) != len(times):
        values = values.T
    if values.ndim > 2 or len(values) != len(times):
        raise FileFormatError(
            f"'{path}': '{name}' has the shape {leaf.array.shape}, but its group {times.size} "
            "times: add its own, or choose `signals`."
        )
    if values.ndim == 1:
        return {with_unit(name, leaf.unit): values}
    return {with_unit(f"{name}.{k}", leaf.unit): x for k, x in enumerate(values.T)}


def _refuse_structs(path: Path, name: str, wanted: Wanted) -> None:
    if wanted.reaches(name):
        raise FileFormatError(
            f"'{path}': '{name}' is an array of structs: save each in its own file, or choose "
            "other `signals`."
        )


def read_arrow(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the wanted columns of a Parquet or Feather file.

    **Raises:** `FileFormatError` for a damaged file, or one that declares more than it can hold.
    """
    dataset = package("pyarrow.dataset")
    kind = path.suffix.lower().removeprefix(".")
    with reading(path, f"{kind} file"):
        file = dataset.dataset(path, format=kind)
        names = file.schema.names
        check_declared(path, 8 * file.count_rows() * len(names))
        wanted.require(path, [split_header(x)[0] for x in names])
        kept = [x for x in names if wanted.includes(x)]
        table = file.to_table(columns=kept)
    return [Columns({name: table[name].to_numpy() for name in kept})]


def read_excel(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the first sheet as a text file with a line for each of its rows.

    **Raises:** `FileFormatError` for a damaged file, one that declares more than it can hold, and
    a first sheet without a table, with the row.
    """
    openpyxl = package("openpyxl")
    with reading(path, "Excel file"):
        with zipfile.ZipFile(path) as archive:
            check_declared(path, sum(x.file_size for x in archive.infolist()))
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        names = book.sheetnames
        rows = _rows(path, book.worksheets[0])
        book.close()
    width = max(map(len, rows), default=0)
    check_declared(path, width * sum(map(bool, rows)))
    table = read_plain(path, [_line(row, width) for row in rows], wanted)
    if len(names) > 1:
        text = f"of {len(names)} sheets the first one, '{names[0]}', was read."
        table = table.with_finding(assumed(text))
    return [table]


def _rows(path: Path, sheet: Any) -> list[list[str]]:
    """Return the texts of the cells of a sheet, without empty ones at the end of a row and without
    empty rows at the end.

    **Raises:** `FileFormatError` for a row that Excel does not have.
    """
    # A sheet states its number of cells, which may be a million rows for a single blank. After the
    # reset, rows end at their last cell.
    sheet.reset_dimensions()
    filled: dict[int, list[str]] = {}
    for number, row in enumerate(sheet.iter_rows(values_only=True)):
        if number >= _MOST_ROWS:
            raise FileFormatError(
                f"'{path}' is no Excel file, or damaged: it has rows after row {_MOST_ROWS}, the "
                "last of Excel."
            )
        cells = ["" if x is None else " ".join(str(x).split()) for x in row]
        while cells and not cells[-1]:
            cells.pop()
        if cells:
            filled[number] = cells
    return [filled.get(k, []) for k in range(1 + max(filled, default=-1))]


def _line(cells: list[str], width: int) -> str:
    """Join cells with tabs, in quotes where necessary. Rows that are not empty get `width`
    cells."""
    if not cells:
        return ""
    filled = [*cells, *[""] * (width - len(cells))]
    text = io.StringIO()
    csv.writer(text, delimiter="\t", lineterminator="").writerow(filled)
    return text.getvalue()


def read_npz(path: Path, wanted: Wanted) -> list[Columns]:
    """Read an array for each column; arrays `event NAME` hold times.

    **Raises:** as `read_arrays`.
    """
    values = {}
    events = {}
    for name, array in read_arrays(path).items():
        if name.startswith(EVENT):
            events[name.removeprefix(EVENT)] = array
        else:
            values[name] = array
    return [Columns(values, events=events)]
