"""Reader of C3D files: markers, analog channels, events.

`read.py` calls `read_c3d`, which returns two tables of `Columns`: markers and analog channels. The
bytes are decoded by ezc3d. The header is read here again (`_read_header`), as ezc3d does not report
files that are truncated, or that have more frames than a header can count. The numbers in
`_read_header` are those of the file format (c3d.org), not settings.

If a marker is missing or has a wrong unit, look at `_points`; if times are wrong, at `_with_times`
and at the first frame of the file; if events are wrong, at `_events`; if a file is refused without
need, at `_read_header` and `_refuse_frames_beyond`.
"""

import itertools
import struct
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core.arguments import package
from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import Columns, Wanted, check_rows, reading, two_columns


Named = list[tuple[str, Float[np.ndarray, " n"]]]
"""Columns by their headers."""
Rows = Float[np.ndarray, "channels n"]


# Numbers are stored in the form of a processor, which the parameters name: Intel, DEC or MIPS. For
# each: the order of bytes in integers, and the byte of the header with the sign of the scale.
_PROCESSORS = {84: ("<", 15), 85: ("<", 13), 86: (">", 12)}
_BLOCK = 512


def read_c3d(path: Path, wanted: Wanted) -> list[Columns]:
    """Read markers as `LABEL.x`, `LABEL.y`, `LABEL.z` and analog channels as `LABEL`, each at its
    own rate, and events as `CONTEXT LABEL`. Rows without a label are left out.

    Times count from the first frame of the capture, as those of events do: a trimmed file begins
    later than 0.

    **Raises:** `FileFormatError` for a damaged or truncated file, and for one without frames.
    """
    ezc3d = package("ezc3d")
    with reading(path, "C3D file"):
        file = ezc3d.c3d(str(path))
        header = _read_header(path)
    data = file["data"]
    frames = data["points"].shape[2]
    if not frames:
        raise FileFormatError(f"'{path}' has no frames: export the capture again.")
    if header.frames is None:
        _refuse_frames_beyond(path, frames, data, header)
    check_rows(path, frames, header.frames, "frames")
    parameters = file["parameters"]
    markers = _points(parameters["POINT"], data)
    channels = _analogs(parameters["ANALOG"], data["analogs"][0])
    tables = []
    for columns in (markers, channels):
        two_columns(path, [name for name, _ in columns])
        if columns:
            tables.append(_with_times(columns, frames, file["header"]["points"]))
    if tables:
        events = _events(parameters.get("EVENT", {}))
        tables[0] = tables[0]._replace(events=events)
    return tables


def _with_times(columns: Named, frames: int, points: Mapping[str, Any]) -> Columns:
    """Return columns of one rate with their times, from the header of the points."""
    _, first_column = columns[0]
    per_frame = len(first_column) // frames
    first = points["first_frame"] * per_frame
    rate = points["frame_rate"] * per_frame
    time = (np.arange(frames * per_frame) + first) / rate
    return Columns({"time (s)": time} | dict(columns))


class _Header(NamedTuple):
    frames: int | None
    """The number of frames that the header states (ezc3d returns a corrected number); None if it
    needs more than 16 bits."""
    first_block: int
    """The block at which the data begin, counted from 1."""
    bytes_of_number: int
    """4 for floating-point numbers, which a negative scale marks, or 2 for integers."""


def _read_header(path: Path) -> _Header:
    """Read the first 18 bytes of a file, in the order of bytes that its parameters state."""
    with open(path, "rb") as file:
        head = file.read(18)
        first_block_of_parameters = head[0]
        file.seek(_BLOCK * (first_block_of_parameters - 1) + 3)
        (processor,) = file.read(1)
    order, sign = _PROCESSORS.get(processor, _PROCESSORS[84])
    first, last = struct.unpack(f"{order}HH", head[6:10])
    (first_block,) = struct.unpack(f"{order}H", head[16:18])
    return _Header(
        frames=last - first + 1 if last < 2**16 - 1 else None,
        first_block=first_block,
        bytes_of_number=4 if head[sign] & 0x80 else 2,
    )


def _refuse_frames_beyond(
    path: Path, frames: int, data: Mapping[str, Any], header: _Header
) -> None:
    """**Raises:** `FileFormatError` if the file is so long that it holds more than these frames.

    The header counts frames with 16 bits, and ezc3d reads no more.
    """
    channels, samples = data["analogs"].shape[1:]
    numbers = 4 * data["points"].shape[1] + channels * (samples // frames)
    size = numbers * header.bytes_of_number
    written = (path.stat().st_size - _BLOCK * (header.first_block - 1)) // size
    # (The last block is filled up.)
    if written - frames > _BLOCK // size:
        raise FileFormatError(
            f"'{path}' holds about {written} frames, of which only {frames} can be read: export "
            f"parts of at most {2**16 - 1} frames."
        )


def _points(
    parameters: Mapping[str, Any],
    data: Mapping[str, Any],
) -> Named:
    """Return the coordinates of markers, NaN where a negative residual says that a marker was not
    visible."""
    residuals = data["meta_points"]["residuals"][0]
    points = np.where(residuals < 0, np.nan, data["points"][:3])
    markers = np.moveaxis(points, 1, 0)
    labels = _texts(parameters, "LABELS")
    usual = (_texts(parameters, "UNITS") or [""])[0]
    units = dict.fromkeys(labels, usual)
    # (Modeled quantities are stored among the markers, with units of their own.)
    for kind in ("ANGLE", "FORCE", "MOMENT", "POWER", "SCALAR"):
        unit = (_texts(parameters, f"{kind}_UNITS") or [usual])[0]
        units |= dict.fromkeys(_texts(parameters, f"{kind}S"), unit)
    columns = []
    for label, marker in zip(labels, markers, strict=False):
        if not label:
            continue
        for axis, row in zip("xyz", marker, strict=True):
            header = with_unit(f"{label}.{axis}", units[label])
            columns.append((header, row))
    return columns


def _analogs(parameters: Mapping[str, Any], channels: Rows) -> Named:
    """Return the analog channels that have a label, with their units."""
    labels = _texts(parameters, "LABELS")
    units = _texts(parameters, "UNITS")
    names = zip_longest(labels, units[: len(labels)], fillvalue="")
    columns = []
    for (label, unit), row in zip(names, channels, strict=False):
        if label:
            columns.append((with_unit(label, unit), row))
    return columns


def _texts(parameters: Mapping[str, Any], name: str) -> list[str]:
    """Return the texts of a parameter, which continues in another one beyond 255 texts."""
    texts: list[str] = []
    for number in itertools.count(1):
        key = name if number == 1 else f"{name}{number}"
        if key not in parameters:
            break
        texts += [str(x).strip() for x in parameters[key]["value"]]
    return texts


def _events(parameters: Mapping[str, Any]) -> dict[str, Float[np.ndarray, " _"]]:
    """Return times in s by context and label; the file holds minutes and seconds."""
    labels = _texts(parameters, "LABELS")
    if not labels:
        return {}
    contexts = _texts(parameters, "CONTEXTS")
    names = zip_longest(contexts[: len(labels)], labels, fillvalue="")
    times = np.reshape(parameters["TIMES"]["value"], (2, -1))
    events: dict[str, list[float]] = {}
    for (context, label), (minutes, seconds) in zip(names, times.T, strict=False):
        at = events.setdefault(f"{context} {label}".strip(), [])
        at.append(60.0 * minutes + seconds)
    return {name: np.array(at) for name, at in events.items()}
