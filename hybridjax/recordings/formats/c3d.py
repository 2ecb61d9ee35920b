"""C3D files: markers, analog channels, events."""

import itertools
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._core.arguments import package
from ..._core.signal import with_unit
from .columns import Columns, Wanted, check_rows, reading, two_columns


Named = list[tuple[str, Float[np.ndarray, " n"]]]


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
    header = file["header"]["points"]
    parameters = file["parameters"]
    data = file["data"]
    first = header["first_frame"]
    frames = data["points"].shape[2]
    check_rows(path, frames, declared, "frames")
    tables = []
    points = _points(parameters["POINT"], data)
    analogs = _analogs(parameters["ANALOG"], data)
    for columns in (points, analogs):
        two_columns(path, [name for name, _ in columns])
        if columns:
            per_frame = len(columns[0][1]) // frames
            ticks = np.arange(first * per_frame, (first + frames) * per_frame)
            time = ticks / (header["frame_rate"] * per_frame)
            tables.append(Columns({"time (s)": time} | dict(columns)))
    if tables:
        tables[0] = tables[0]._replace(events=_events(parameters.get("EVENT", {})))
    return tables


def _declared_frames(path: Path) -> int | None:
    """Return the number of frames in the header, which ezc3d corrects; None beyond 16 bits."""
    with open(path, "rb") as file:
        head = file.read(10)
        # The type of the processor, in the parameters.
        file.seek(512 * (head[0] - 1) + 3)
        order = ">" if file.read(1) == b"\x56" else "<"
    first, last = struct.unpack(f"{order}HH", head[-4:])
    return last - first + 1 if last < 2**16 - 1 else None


def _points(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    """Return markers; a negative residual marks a sample at which a marker was not visible."""
    residuals = data["meta_points"]["residuals"][0]
    points = np.where(residuals < 0, np.nan, data["points"][:3])
    labels = _texts(parameters, "LABELS")
    usual = _unit(parameters, "UNITS", "")
    units = dict.fromkeys(labels, usual)
    # Modeled quantities stand among the markers, with units of their own.
    for kind in ("ANGLE", "FORCE", "MOMENT", "POWER", "SCALAR"):
        for label in _texts(parameters, f"{kind}S"):
            units[label] = _unit(parameters, f"{kind}_UNITS", usual)
    columns = []
    for label, rows in zip(labels, np.moveaxis(points, 1, 0), strict=False):
        if label:
            for axis, row in zip("xyz", rows, strict=True):
                columns.append((with_unit(f"{label}.{axis}", units[label]), row))
    return columns


def _unit(parameters: Mapping[str, Any], name: str, otherwise: str) -> str:
    texts = _texts(parameters, name)
    return texts[0] if texts else otherwise


def _analogs(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    units = _texts(parameters, "UNITS")
    columns = []
    labels = _texts(parameters, "LABELS")
    for k, (label, row) in enumerate(zip(labels, data["analogs"][0], strict=False)):
        if label:
            unit = units[k] if k < len(units) else ""
            columns.append((with_unit(label, unit), row))
    return columns


def _texts(parameters: Mapping[str, Any], name: str) -> list[str]:
    """Return the texts of a parameter, which continues in another one beyond 255 texts."""
    texts = []
    keys = itertools.chain([name], (f"{name}{k}" for k in itertools.count(2)))
    for key in itertools.takewhile(parameters.__contains__, keys):
        texts += [str(x).strip() for x in parameters[key]["value"]]
    return texts


def _events(parameters: Mapping[str, Any]) -> dict[str, Float[np.ndarray, " _"]]:
    """Return times in s by context and label; the file holds minutes and seconds."""
    labels = _texts(parameters, "LABELS")
    if not labels:
        return {}
    contexts = _texts(parameters, "CONTEXTS")
    times = np.reshape(parameters["TIMES"]["value"], (2, -1))
    events: dict[str, list[float]] = {}
    for k, (label, (minutes, seconds)) in enumerate(zip(labels, times.T, strict=False)):
        context = contexts[k] if k < len(contexts) else ""
        name = f"{context} {label}".strip()
        events.setdefault(name, []).append(60.0 * minutes + seconds)
    return {name: np.array(at) for name, at in events.items()}
