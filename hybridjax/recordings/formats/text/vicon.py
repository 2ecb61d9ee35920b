"""Text files of Vicon: blocks of devices and markers, with rates of their own."""

from pathlib import Path

import numpy as np

from ....errors import FileFormatError
from ..columns import Columns
from .table import Table, read_table, split_names, to_number


# Lines of a block: its title, its rate, names of devices, of components, and units.
_HEADER = 5
_FRAME, _SUBFRAME = "frame", "sub frame"


def is_vicon(lines: list[str]) -> bool:
    """Whether the first block begins as one does: a title, a rate, names below `Frame`."""
    return len(_blocks(lines[: 2 * _HEADER])) > 0


def read_vicon(path: Path, lines: list[str]) -> list[Columns]:
    """A table for each block; times count from the first frame.

    Columns are named by device, or marker, and component, such as `Plate 1.Fx`.

    **Raises:** `FileFormatError` for blocks whose frames do not have one rate, and as `read_table`.
    """
    blocks = []
    for start, stop in _blocks(lines):
        separator, names = _names(lines[start : start + _HEADER])
        table = Table(path, names, lines[start + _HEADER : stop], start + _HEADER, separator)
        found = read_table(table)
        columns = {name.lower(): name for name in found.values}
        frame = found.values.pop(columns[_FRAME])
        sub = found.values.pop(columns.get(_SUBFRAME, ""), np.zeros(len(frame)))
        parts = int(np.nan_to_num(sub).max()) + 1
        if not np.isfinite(frame + sub).all() or (np.diff(frame + sub / parts) <= 0).any():
            raise FileFormatError(f"'{path}' has frames that are missing, or not in order.")
        rate = float(lines[start + 1].strip(" ,;\t")) / parts
        time = ((frame - 1) * parts + sub) / (parts * rate)
        blocks.append((rate, Columns({"time (s)": time} | found.values, found.notes)))
    if len({rate for rate, _ in blocks}) > 1:
        raise FileFormatError(
            f"'{path}' has blocks whose frames differ in rate: export them one by one."
        )
    return [columns for _, columns in blocks]


def _blocks(lines: list[str]) -> list[tuple[int, int]]:
    """First line of each block, and the one after its last."""
    starts = [
        k
        for k in range(len(lines) - _HEADER + 1)
        if lines[k + 3].strip('" ').lower().startswith(_FRAME)
        and (to_number(lines[k + 1].strip(" ,;\t")) or 0) > 0
        and _names(lines[k : k + _HEADER])[1][0].lower() == _FRAME
    ]
    stops = []
    for start in starts:
        rest = range(start + _HEADER, len(lines))
        stops.append(next((k for k in rest if not lines[k].strip(" ,;\t")), len(lines)))
    return list(zip(starts, stops, strict=True))


def _names(head: list[str]) -> tuple[str, list[str]]:
    """The separator, and `device.component (unit)` for each column."""
    separator = max("\t;,", key=head[3].count)
    devices, components, units = (split_names(x, separator) for x in head[2:])
    device, names = "", []
    for k, component in enumerate(components):
        # A name stands above the first of its columns. `subject:marker`: the marker.
        device = devices[k].split(":")[-1] if k < len(devices) and devices[k] else device
        unit = f" ({units[k]})" if k < len(units) and units[k] else ""
        names.append(f"{device}.{component}{unit}" if device else component)
    return separator, names
