"""Marker files (`.trc`) of Motion Analysis and OpenSim."""

from pathlib import Path

from ....errors import FileFormatError
from ..columns import Columns, with_unit
from .table import Table, read_table, split_line, split_names


# Lines before the numbers: what the file is, names of facts, facts, markers, components.
_HEADER = 5
_FIRST = "pathfiletype"
_FRAME, _TIME = "frame#", "time"
_COMPONENTS = 3


def is_trc(lines: list[str]) -> bool:
    return lines[0].lower().startswith(_FIRST)


def read_trc(path: Path, lines: list[str]) -> Columns:
    """Columns `MARKER.x`, `MARKER.y` and `MARKER.z`; empty fields are missing samples.

    **Raises:** `FileFormatError` for a header that is none, or says another number of frames, and
    as `read_table`.
    """
    head = [split_line(x, "\t") for x in lines[:_HEADER]]
    names = split_names(lines[3], "\t") if len(head) == _HEADER else []
    if [x.lower() for x in names[:2]] != [_FRAME, _TIME]:
        raise FileFormatError(f"'{path}' does not name 'Frame#', 'Time' and its markers in line 4.")
    facts = dict(zip((x.lower() for x in head[1]), head[2], strict=False))
    markers = names[2::_COMPONENTS]
    columns = [
        with_unit(f"{marker}.{axis}", facts.get("units", ""))
        for marker in markers
        for axis in "xyz"
    ]
    body = [x.rstrip("\r\n") for x in lines[_HEADER:]]
    found = read_table(Table(path, [_FRAME, "time (s)", *columns], body, _HEADER, "\t"))
    rows = len(found.values.pop(_FRAME))
    if facts.get("numframes", str(rows)) != str(rows):
        raise FileFormatError(
            f"'{path}' has {rows} frames, but its header says {facts['numframes']}: it is damaged."
        )
    return found
