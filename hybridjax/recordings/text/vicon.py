"""Text files of Vicon: blocks of devices and markers, with rates of their own."""

from pathlib import Path

import numpy as np

from ...errors import FileFormatError
from .table import Columns, Table, read_table, split_names, to_number


# Lines of a block: its title, its rate, names of devices, of components, and units.
_HEADER = 5
_FRAME, _SUBFRAME = "frame", "sub frame"


def is_vicon(lines: list[str]) -> bool:
    """Whether the first block begins as one does: a title, a rate, names below `Frame`."""
    return len(_blocks(lines[: 2 * _HEADER])) > 0


def read_vicon(path: Path, lines: list[str]) -> Columns:
    """All blocks on one axis of time; of the slower ones samples are missing in between.

    Columns are named by device, or marker, and component, such as `Plate 1.Fx`.

    **Raises:** `FileFormatError` for blocks whose frames do not have one rate, and as `read_table`.
    """
    values, notes, clocks = {}, [], []
    for start, stop in _blocks(lines):
        separator, names = _names(lines[start : start + _HEADER])
        table = Table(path, names, lines[start + _HEADER : stop], start + _HEADER, separator)
        found = read_table(table)
        columns = {name.lower(): name for name in found.values}
        frame = found.values.pop(columns[_FRAME])
        sub = found.values.pop(columns.get(_SUBFRAME, ""), np.zeros(len(frame)))
        if (
            not np.isfinite(frame + sub).all()
            or (np.diff(frame + sub / (sub.max() + 1)) <= 0).any()
        ):
            raise FileFormatError(f"'{path}' has frames that are missing, or not in order.")
        parts = int(sub.max()) + 1
        clocks.append((frame, sub, parts, float(lines[start + 1].strip(" ,;\t")) / parts))
        notes += found.notes
        twice = found.values.keys() & values.keys()
        if twice:
            raise FileFormatError(f"'{path}' has two columns '{min(twice)}'.")
        values |= {name: (len(clocks) - 1, column) for name, column in found.values.items()}
    finest = max(parts for _, _, parts, _ in clocks)
    rate = clocks[0][3]
    if any(finest % parts or other != rate for _, _, parts, other in clocks):
        raise FileFormatError(
            f"'{path}' has blocks whose frames differ in rate: export them one by one."
        )
    ticks = [np.rint((f - 1) * finest + s * (finest // n)).astype(int) for f, s, n, _ in clocks]
    every = np.unique(np.concatenate(ticks))
    out = {"time (s)": every / (finest * rate)}
    for name, (block, column) in values.items():
        out[name] = np.full(len(every), np.nan)
        out[name][np.searchsorted(every, ticks[block])] = column
    if len(set(map(len, ticks))) > 1:
        notes.append("signals have different rates: those of the slower are missing in between")
    return Columns(out, tuple(dict.fromkeys(notes)))


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
