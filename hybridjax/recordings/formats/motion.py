"""Text files with or without the layouts of OpenSim, Motion Analysis and Vicon."""

from pathlib import Path

import numpy as np

from ...errors import FileFormatError
from .columns import Columns, Wanted, with_unit
from .text import read_lines, read_plain, read_table, split_line, split_names, to_number


# Lines of a header before the numbers, of `.trc` files and of a block of Vicon's.
_HEADER = 5


def read_text(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the columns of a text file, whatever program wrote it.

    **Raises:** `FileFormatError` if it holds no table, with the line.
    """
    lines = read_lines(path)
    head = [x.strip().lower() for x in lines[:100]]
    if "endheader" in head:
        return [_opensim(path, lines, head.index("endheader"))]
    if head[0].startswith("pathfiletype"):
        return [_trc(path, lines)]
    if _blocks(lines[: 2 * _HEADER]):
        return _vicon(path, lines)
    return [read_plain(path, lines)]


def _check_rows(path: Path, rows: int, declared: str | None, what: str) -> None:
    if declared not in (None, str(rows)):
        raise FileFormatError(
            f"'{path}' has {rows} {what}, but its header says {declared}: it is damaged."
        )


def _opensim(path: Path, lines: list[str], end: int) -> Columns:
    """Read a motion or storage file: `key=value` up to `endheader`, then names, then numbers."""
    facts = dict(x.replace(" ", "").lower().split("=", 1) for x in lines[:end] if "=" in x)
    start = next((k for k in range(end + 1, len(lines)) if lines[k].strip()), None)
    if start is None:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    separator = "\t" if "\t" in lines[start] else ""
    names = split_names(lines[start], separator)
    names = ["time (s)" if x == "time" else x for x in names]  # times of OpenSim are seconds
    table = read_table(path, names, lines, start + 1, separator)
    _check_rows(path, len(next(iter(table.values.values()))), facts.get("nrows"), "rows")
    degrees = ("angles are in degrees",) if facts.get("indegrees") == "yes" else ()
    return Columns(table.values, table.notes + degrees)


def _trc(path: Path, lines: list[str]) -> Columns:
    """Read columns `MARKER.x`, `MARKER.y` and `MARKER.z`; empty fields are missing samples."""
    head = [split_line(x, "\t") for x in lines[:_HEADER]]
    names = split_names(lines[3], "\t") if len(head) == _HEADER else []
    if [x.lower() for x in names[:2]] != ["frame#", "time"]:
        raise FileFormatError(f"'{path}' does not name 'Frame#', 'Time' and its markers in line 4.")
    facts = dict(zip((x.lower() for x in head[1]), head[2], strict=False))
    unit = facts.get("units", "")
    columns = [with_unit(f"{marker}.{axis}", unit) for marker in names[2::3] for axis in "xyz"]
    table = read_table(path, ["frame#", "time (s)", *columns], lines, _HEADER, "\t")
    _check_rows(path, len(table.values.pop("frame#")), facts.get("numframes"), "frames")
    return table


def _vicon(path: Path, lines: list[str]) -> list[Columns]:
    """Read a table for each block of devices or markers; times count from the first frame.

    Columns are named by device, or marker, and component, such as `Plate 1.Fx`.
    """
    rates, tables = set(), []
    for start, stop in _blocks(lines):
        separator, names = _names(lines[start : start + _HEADER])
        table = read_table(path, names, lines[:stop], start + _HEADER, separator)
        columns = {name.lower(): name for name in table.values}
        frame = table.values.pop(columns["frame"])
        sub = table.values.pop(columns.get("sub frame", ""), np.zeros(len(frame)))
        parts = int(np.nan_to_num(sub).max()) + 1
        if not np.isfinite(frame + sub).all() or (np.diff(frame + sub / parts) <= 0).any():
            raise FileFormatError(f"'{path}' has frames that are missing, or not in order.")
        rate = float(lines[start + 1].strip(" ,;\t")) / parts
        rates.add(rate)
        time = ((frame - 1) * parts + sub) / (parts * rate)
        tables.append(Columns({"time (s)": time} | table.values, table.notes))
    if len(rates) > 1:
        raise FileFormatError(
            f"'{path}' has blocks whose frames differ in rate: export them one by one."
        )
    return tables


def _blocks(lines: list[str]) -> list[tuple[int, int]]:
    """Return the first line of each block (a title, a rate, devices, components, units) and the
    line after its last."""
    starts = [
        k
        for k in range(len(lines) - _HEADER + 1)
        if lines[k + 3].strip('" ').lower().startswith("frame")
        and (to_number(lines[k + 1].strip(" ,;\t")) or 0) > 0
        and _names(lines[k : k + _HEADER])[1][0].lower() == "frame"
    ]
    ends = [k for k in range(len(lines)) if not lines[k].strip(" ,;\t")] + [len(lines)]
    return [(start, next(k for k in ends if k >= start + _HEADER)) for start in starts]


def _names(head: list[str]) -> tuple[str, list[str]]:
    """Return the separator, and `device.component (unit)` for each column."""
    separator = max("\t;,", key=head[3].count)
    devices, components, units = (split_names(x, separator) for x in head[2:])
    device, names = "", []
    for k, component in enumerate(components):
        # A name stands above the first of its columns; of `subject:marker` the marker counts.
        device = devices[k].split(":")[-1] if k < len(devices) and devices[k] else device
        name = f"{device}.{component}" if device else component
        names.append(with_unit(name, units[k] if k < len(units) else ""))
    return separator, names
