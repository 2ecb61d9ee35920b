"""Text files with or without the layouts of OpenSim, Motion Analysis and Vicon.

`read.py` calls `read_text`, which returns tables of `Columns`. It recognizes a layout by its first
lines; fields and numbers are read in `text.py`. To add a layout, write a function here that returns
its tables, and call it in `read_text`, before `read_plain`, which takes every other file. Numbers
of lines here are those of the layouts, not settings.

If a file is read in a wrong layout, look at `read_text`; if a column of Vicon has a wrong name or
unit, at `_names`; if its times are wrong, at `_place`. A file whose number of rows is not that in
its header is refused by `check_rows` (`columns.py`).
"""

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import Columns, Wanted, assumed, check_rows
from .text import read_lines, read_plain, read_table, split_line, split_names, to_number


def read_text(path: Path, wanted: Wanted) -> list[Columns]:
    """Read the columns of a text file, whatever program wrote it.

    **Raises:** `FileFormatError` if it holds no table, with the line.
    """
    lines = read_lines(path)
    head = [x.strip().lower() for x in lines[:100]]
    if "endheader" in head:
        return [_opensim(path, lines, head.index("endheader"), wanted)]
    if head[0].startswith("pathfiletype"):
        return [_trc(path, lines, wanted)]
    if any(x.startswith(("frame", '"frame')) for x in head):
        blocks = list(_vicon(path, lines, wanted))
        if blocks:
            return blocks
    return [read_plain(path, lines, wanted)]


def _opensim(path: Path, lines: list[str], end: int, wanted: Wanted) -> Columns:
    """Read a motion or storage file: `key=value` up to `endheader`, then names, then numbers."""
    facts = {}
    for line in lines[:end]:
        key, is_fact, value = line.replace(" ", "").lower().partition("=")
        if is_fact:
            facts[key] = value
    filled = [k for k in range(end + 1, len(lines)) if lines[k].strip()]
    if not filled:
        raise FileFormatError(f"'{path}' has no line with the names of its columns.")
    start = filled[0]
    separator = "\t" if "\t" in lines[start] else ""
    # Times of OpenSim are seconds.
    names = [
        "time (s)" if name == "time" else name
        for name in split_names(lines[start], separator)
    ]
    table = read_table(path, names, lines, start + 1, separator, wanted)
    first = next(iter(table.values.values()))
    check_rows(path, len(first), facts.get("nrows"), "rows")
    if facts.get("indegrees") == "yes":
        table = table.with_finding(assumed("angles are in degrees."))
    return table


def _trc(path: Path, lines: list[str], wanted: Wanted) -> Columns:
    """Read columns `MARKER.x`, `MARKER.y` and `MARKER.z`; empty fields are missing samples."""
    names = split_names(lines[3], "\t") if len(lines) >= 5 else []
    if [x.lower() for x in names[:2]] != ["frame#", "time"]:
        raise FileFormatError(
            f"'{path}' does not name 'Frame#', 'Time' and its markers in line 4."
        )
    keys = split_line(lines[1].lower(), "\t")
    values = split_line(lines[2], "\t")
    facts = dict(zip(keys, values, strict=False))
    unit = facts.get("units", "")
    columns = ["frame#", "time (s)"]
    for marker in names[2::3]:
        columns += [with_unit(f"{marker}.{axis}", unit) for axis in "xyz"]
    table = read_table(path, columns, lines, 5, "\t", wanted)
    frames = table.values.pop("frame#")
    check_rows(path, len(frames), facts.get("numframes"), "frames")
    return table


def _vicon(path: Path, lines: list[str], wanted: Wanted) -> Iterator[Columns]:
    """Read a table for each block of devices or markers; times count from the first frame.

    A block has a title, a rate, the devices, their components, units, and then a row for each
    sample. Columns are named by device, or marker, and component, such as `Plate 1.Fx`.
    """
    ends = [k for k, line in enumerate(lines) if not line.strip(" ,;\t")]
    ends.append(len(lines))
    rates = set()
    for start in range(len(lines) - 4):
        rate = to_number(lines[start + 1].strip(" ,;\t")) or 0
        header = lines[start + 2 : start + 5]
        separator = max("\t;,", key=header[1].count)
        names = _names(*(split_names(line, separator) for line in header))
        if not (rate > 0 and names and names[0].lower() == "frame"):
            continue
        stop = next(k for k in ends if k >= start + 5)
        table = read_table(path, names, lines[:stop], start + 5, separator, wanted)
        per_frame, sample = _place(path, table)
        time = {"time (s)": sample / rate}
        yield table._replace(values=time | table.values)
        rates.add(rate / per_frame)
    if len(rates) > 1:
        raise FileFormatError(
            f"'{path}' has blocks of different rates: export them one by one."
        )


def _place(path: Path, table: Columns) -> tuple[int, Float[np.ndarray, " n"]]:
    """Take the columns of frame numbers out of a table. Return the number of samples in a frame,
    and for each row the number of samples since the first."""
    columns = {name.lower(): name for name in table.values}
    frame = table.values.pop(columns["frame"])
    within = np.zeros(len(frame))
    if "sub frame" in columns:
        within = table.values.pop(columns["sub frame"])
    per_frame = int(np.nan_to_num(within).max()) + 1
    sample = (frame - 1) * per_frame + within
    if not np.isfinite(sample).all() or (np.diff(sample) <= 0).any():
        raise FileFormatError(f"'{path}' has frames that are missing, or not in order.")
    return per_frame, sample


def _names(devices: list[str], components: list[str], units: list[str]) -> list[str]:
    """Return `device.component (unit)` for each column."""
    device = ""
    names = []
    for above, component, unit in zip_longest(devices, components, units, fillvalue=""):
        # A name stands above the first of its columns. Of `subject:marker`, the part after the
        # colon is used.
        if above:
            device = above.split(":")[-1]
        name = f"{device}.{component}" if device else component
        names.append(with_unit(name, unit))
    return names[: len(components)]
