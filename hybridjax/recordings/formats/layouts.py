"""Text files with or without the layouts of OpenSim, Motion Analysis and Vicon.

`read_text` recognizes a layout by its first lines; those of other makers (Noraxon) belong here.
"""

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import Columns, Wanted, check_rows
from .text import read_lines, read_plain, read_table, split_line, split_names, to_number


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
    blocks = any(x.startswith(("frame", '"frame')) for x in head) and list(
        _vicon(path, lines)
    )
    return blocks or [read_plain(path, lines)]


def _opensim(path: Path, lines: list[str], end: int) -> Columns:
    """Read a motion or storage file: `key=value` up to `endheader`, then names, then numbers."""
    facts = dict(
        x.replace(" ", "").lower().split("=", 1) for x in lines[:end] if "=" in x
    )
    if (
        start := next((k for k in range(end + 1, len(lines)) if lines[k].strip()), None)
    ) is None:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    separator = "\t" if "\t" in lines[start] else ""
    names = split_names(lines[start], separator)
    names = [
        "time (s)" if x == "time" else x for x in names
    ]  # times of OpenSim are seconds
    table = read_table(path, names, lines, start + 1, separator)
    check_rows(path, len(next(iter(table.values.values()))), facts.get("nrows"), "rows")
    degrees = ("angles are in degrees",) if facts.get("indegrees") == "yes" else ()
    return Columns(table.values, table.notes + degrees)


def _trc(path: Path, lines: list[str]) -> Columns:
    """Read columns `MARKER.x`, `MARKER.y` and `MARKER.z`; empty fields are missing samples."""
    head = [split_line(x, "\t") for x in lines[:5]]
    names = split_names(lines[3], "\t") if len(head) == 5 else []
    if [x.lower() for x in names[:2]] != ["frame#", "time"]:
        raise FileFormatError(
            f"'{path}' does not name 'Frame#', 'Time' and its markers in line 4."
        )
    facts = dict(zip((x.lower() for x in head[1]), head[2], strict=False))
    unit = facts.get("units", "")
    columns = [
        with_unit(f"{marker}.{axis}", unit) for marker in names[2::3] for axis in "xyz"
    ]
    table = read_table(path, ["frame#", "time (s)", *columns], lines, 5, "\t")
    check_rows(path, len(table.values.pop("frame#")), facts.get("numframes"), "frames")
    return table


def _vicon(path: Path, lines: list[str]) -> Iterator[Columns]:
    """Read a table for each block of devices or markers; times count from the first frame.

    A block has a title, a rate, the devices, their components, units, and then a row for each
    sample. Columns are named by device, or marker, and component, such as `Plate 1.Fx`.
    """
    ends = [k for k in range(len(lines)) if not lines[k].strip(" ,;\t")] + [len(lines)]
    rates = set()
    for start in range(len(lines) - 4):
        separator = max("\t;,", key=lines[start + 3].count)
        names = _names(
            *(split_names(x, separator) for x in lines[start + 2 : start + 5])
        )
        rate = to_number(lines[start + 1].strip(" ,;\t")) or 0
        if not (rate > 0 and names and names[0].lower() == "frame"):
            continue
        stop = next(k for k in ends if k >= start + 5)
        table = read_table(path, names, lines[:stop], start + 5, separator)
        columns = {name.lower(): name for name in table.values}
        frame = table.values.pop(columns["frame"])
        sub = table.values.pop(columns.get("sub frame", ""), np.zeros(len(frame)))
        parts = int(np.nan_to_num(sub).max()) + 1
        if (
            not np.isfinite(frame + sub).all()
            or (np.diff(frame + sub / parts) <= 0).any()
        ):
            raise FileFormatError(
                f"'{path}' has frames that are missing, or not in order."
            )
        yield Columns(
            {"time (s)": ((frame - 1) * parts + sub) / rate} | table.values, table.notes
        )
        rates.add(rate / parts)
    if len(rates) > 1:
        raise FileFormatError(
            f"'{path}' has blocks of different rates: export them one by one."
        )


def _names(devices: list[str], components: list[str], units: list[str]) -> list[str]:
    """Return `device.component (unit)` for each column."""
    device, names = "", []
    for above, component, unit in zip_longest(devices, components, units, fillvalue=""):
        # A name stands above the first of its columns; of `subject:marker` the marker counts.
        device = above.split(":")[-1] if above else device
        names.append(with_unit(f"{device}.{component}" if device else component, unit))
    return names[: len(components)]
