"""Reader of C3D files: markers, analog channels, events.

`read.py` calls `read_c3d`, which returns two tables of `Columns`: markers and analog channels. The
bytes are decoded by ezc3d; the header is read here only to refuse files whose number of frames it
cannot hold.
"""

import itertools
import struct
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._core.arguments import package
from ..._core.signal import with_unit
from ...errors import FileFormatError
from .columns import Columns, Wanted, check_rows, reading, two_columns


Named = list[tuple[str, Float[np.ndarray, " n"]]]
"""Columns by their headers."""
Rows = Float[np.ndarray, "channels n"]


def read_c3d(path: Path, wanted: Wanted) -> list[Columns]:
    """Read markers as `LABEL.x`, `LABEL.y`, `LABEL.z` and analog channels as `LABEL`, each at its
    own rate, and events as `CONTEXT LABEL`.

    Times count from the first captured frame, as those of the events do.

    **Raises:** `FileFormatError` for a damaged or truncated file.
    """
    ezc3d = package("ezc3d")
    with reading(path, "C3D file"):
        file = ezc3d.c3d(str(path))
        declared = _declared_frames(path)
    data = file["data"]
    frames = data["points"].shape[2]
    if declared is None:
        _refuse_frames_beyond(path, frames, data)
    check_rows(path, frames, declared, "frames")
    header = file["header"]["points"]
    parameters = file["parameters"]
    tables = []
    for columns in (
        _points(parameters["POINT"], data),
        _analogs(parameters["ANALOG"], data["analogs"][0]),
    ):
        two_columns(path, [name for name, _ in columns])
        if columns:
            per_frame = len(columns[0][1]) // frames
            first = header["first_frame"] * per_frame
            rate = header["frame_rate"] * per_frame
            time = (np.arange(frames * per_frame) + first) / rate
            tables.append(Columns({"time (s)": time} | dict(columns)))
    if tables:
        events = _events(parameters.get("EVENT", {}))
        tables[0] = tables[0]._replace(events=events)
    return tables


def _declared_frames(path: Path) -> int | None:
    """Return the number of frames that the header states (ezc3d returns a corrected number); None
    if it needs more than 16 bits."""
    with open(path, "rb") as file:
        head = file.read(10)
        # The type of the processor, in the parameters.
        file.seek(512 * (head[0] - 1) + 3)
        order = ">" if file.read(1) == b"\x56" else "<"
    first, last = struct.unpack(f"{order}HH", head[-4:])
    return last - first + 1 if last < 2**16 - 1 else None


def _refuse_frames_beyond(path: Path, frames: int, data: Mapping[str, Any]) -> None:
    """**Raises:** `FileFormatError` if the file is so long that it holds more than these frames.

    The header counts frames with 16 bits, and ezc3d reads no more.
    """
    with open(path, "rb") as file:
        head = file.read(20)
        file.seek(512 * (head[0] - 1) + 3)
        order = ">" if file.read(1) == b"\x56" else "<"
    (scale,) = struct.unpack(f"{order}f", head[12:16])
    (first_block,) = struct.unpack(f"{order}H", head[16:18])
    channels, samples = data["analogs"].shape[1:]
    values = 4 * data["points"].shape[1] + channels * (samples // frames)
    # Negative scales mark numbers of four bytes.
    size = values * (4 if scale < 0 else 2)
    written = (path.stat().st_size - 512 * (first_block - 1)) // size
    # The last block of 512 bytes is filled up.
    if written - frames > 512 // size:
        raise FileFormatError(
            f"'{path}' holds about {written} frames, of which only {frames} can be read: export "
            f"parts of at most {2**16 - 1} frames."
        )


def _points(
    parameters: Mapping[str, Any],
    data: Mapping[str, Any],
) -> Named:
    """Return markers; a negative residual marks a sample at which a marker was not visible."""
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
