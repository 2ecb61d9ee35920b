"""C3D files: markers, analog channels, events."""

import struct
from collections.abc import Mapping
from itertools import zip_longest
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
        file, declared = ezc3d.c3d(str(path)), _declared_frames(path)
    header, parameters, data = (
        file["header"]["points"],
        file["parameters"],
        file["data"],
    )
    first, frames = header["first_frame"], data["points"].shape[2]
    check_rows(path, frames, declared, "frames")
    tables = []
    for columns in (
        _points(parameters["POINT"], data),
        _analogs(parameters["ANALOG"], data),
    ):
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
        file.seek(
            512 * (head[0] - 1) + 3
        )  # the type of the processor, in the parameters
        order = ">" if file.read(1) == b"\x56" else "<"
    first, last = struct.unpack(f"{order}HH", head[-4:])
    return last - first + 1 if last < 2**16 - 1 else None


def _points(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    """Return markers; a negative residual marks a sample at which a marker was not visible."""
    visible = ~(data["meta_points"]["residuals"][0] < 0)
    usual = (_texts(parameters, "UNITS") or [""])[0]
    units = {  # modeled quantities stand among the markers, with units of their own
        label: (_texts(parameters, f"{kind}_UNITS") or [usual])[0]
        for kind in ("ANGLE", "FORCE", "MOMENT", "POWER", "SCALAR")
        for label in _texts(parameters, f"{kind}S")
    }
    points = np.moveaxis(np.where(visible, data["points"][:3], np.nan), 1, 0)
    return [
        (with_unit(f"{label}.{axis}", units.get(label, usual)), row)
        for label, rows in zip(_texts(parameters, "LABELS"), points, strict=False)
        for axis, row in zip("xyz", rows, strict=True)
        if label
    ]


def _analogs(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    labels, units = _texts(parameters, "LABELS"), _texts(parameters, "UNITS")
    names = (
        with_unit(*x) if x[0] else "" for x in zip_longest(labels, units, fillvalue="")
    )
    return [
        (name, row)
        for name, row in zip(names, data["analogs"][0], strict=False)
        if name
    ]


def _texts(parameters: Mapping[str, Any], name: str) -> list[str]:
    """Return the texts of a parameter, which continues in another one beyond 255 texts."""
    texts, k = [], 1
    while (key := f"{name}{k if k > 1 else ''}") in parameters:
        texts += [str(x).strip() for x in parameters[key]["value"]]
        k += 1
    return texts


def _events(parameters: Mapping[str, Any]) -> dict[str, Float[np.ndarray, " _"]]:
    """Return times in s by context and label; the file holds minutes and seconds."""
    contexts, labels = (
        iter(_texts(parameters, "CONTEXTS")),
        _texts(parameters, "LABELS"),
    )
    times = (
        np.reshape(parameters["TIMES"]["value"], (2, -1))
        if labels
        else np.zeros((2, 0))
    )
    events: dict[str, list[float]] = {}
    for label, (minutes, seconds) in zip(labels, times.T, strict=False):
        name = f"{next(contexts, '')} {label}".strip()
        events.setdefault(name, []).append(60.0 * minutes + seconds)
    return {name: np.array(at) for name, at in events.items()}
