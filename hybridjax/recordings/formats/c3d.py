"""C3D files: markers, analog channels, events."""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import FileFormatError
from .columns import Columns, Wanted, missing_library, with_unit


# Quantities that stand among the markers, with units of their own.
_MODELED = ("ANGLE", "FORCE", "MOMENT", "POWER", "SCALAR")
# Bytes of the header up to its first and last frame; blocks, of which one holds, at this byte, the
# kind of the processor; the one that writes numbers with the large end first.
_HEADER, _BLOCK, _PROCESSOR, _BIG_ENDIAN = 10, 512, 3, b"\x56"
# The header counts no more frames than this.
_COUNTED = 65535
_MINUTE = 60.0


def read_c3d(path: Path, wanted: Wanted) -> list[Columns]:
    """Markers as `LABEL.x`, `LABEL.y`, `LABEL.z`, analog channels as `LABEL`, each at its own rate;
    events as `CONTEXT LABEL`. Times count from the first frame that was captured, as those of the
    events do.

    **Raises:** `FileFormatError` for what is no such file, or is cut off.
    """
    try:
        from ezc3d import c3d
    except ImportError as error:
        raise missing_library("C3D files", "ezc3d", "c3d") from error
    try:
        file = c3d(str(path))
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        raise FileFormatError(f"'{path}' is no C3D file, or damaged.") from error
    header, parameters, data = file["header"]["points"], file["parameters"], file["data"]
    first, frames, told = header["first_frame"], data["points"].shape[2], _number_of_frames(path)
    if told not in (None, frames):
        raise FileFormatError(
            f"'{path}' has {frames} frames, but its header says {told}: it is damaged."
        )
    tables = []
    for columns in (_points(parameters["POINT"], data), _analogs(parameters["ANALOG"], data)):
        twice = {x for x, _ in columns if [name for name, _ in columns].count(x) > 1}
        if twice:
            raise FileFormatError(f"'{path}' has two signals '{min(twice)}'.")
        if columns:
            per_frame = len(columns[0][1]) // frames
            ticks = np.arange(first * per_frame, (first + frames) * per_frame)
            time = ticks / (header["frame_rate"] * per_frame)
            tables.append(Columns({"time (s)": time} | dict(columns)))
    if tables:
        tables[0] = tables[0]._replace(events=_events(parameters.get("EVENT", {})))
    return tables


def _number_of_frames(path: Path) -> int | None:
    """What the header says, which ezc3d corrects; None where it cannot count that far."""
    with open(path, "rb") as file:
        head = file.read(_HEADER)
        file.seek(_BLOCK * (head[0] - 1) + _PROCESSOR)
        order = ">" if file.read(1) == _BIG_ENDIAN else "<"
    first, last = struct.unpack(f"{order}HH", head[-4:])
    return last - first + 1 if last < _COUNTED else None


Named = list[tuple[str, Float[np.ndarray, " n"]]]


def _points(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    """A negative residual marks a sample at which a marker was not seen."""
    seen = ~(data["meta_points"]["residuals"][0] < 0)
    everywhere = (_texts(parameters, "UNITS") or [""])[0]
    units = {
        label: (_texts(parameters, f"{kind}_UNITS") or [everywhere])[0]
        for kind in _MODELED
        for label in _texts(parameters, f"{kind}S")
    }
    return [
        (with_unit(f"{label}.{axis}", units.get(label, everywhere)), np.where(own, row, np.nan))
        for label, rows, own in zip(
            _texts(parameters, "LABELS"), np.moveaxis(data["points"][:3], 1, 0), seen, strict=False
        )
        for axis, row in zip("xyz", rows, strict=True)
        if label
    ]


def _analogs(parameters: Mapping[str, Any], data: Mapping[str, Any]) -> Named:
    labels, units = _texts(parameters, "LABELS"), _texts(parameters, "UNITS")
    units += [""] * (len(labels) - len(units))
    return [
        (with_unit(label, unit), row)
        for label, unit, row in zip(labels, units, data["analogs"][0], strict=False)
        if label
    ]


def _texts(parameters: Mapping[str, Any], name: str) -> list[str]:
    """Texts of a parameter, which goes on in another one where there are more than 255."""
    found, k = [], 1
    while (key := f"{name}{k if k > 1 else ''}") in parameters:
        found += [str(x).strip() for x in parameters[key]["value"]]
        k += 1
    return found


def _events(parameters: Mapping[str, Any]) -> dict[str, Float[np.ndarray, " _"]]:
    """Times, in s, by context and label."""
    contexts, labels = _texts(parameters, "CONTEXTS"), _texts(parameters, "LABELS")
    contexts += [""] * (len(labels) - len(contexts))
    times = np.reshape(parameters["TIMES"]["value"], (2, -1)) if labels else np.zeros((2, 0))
    found: dict[str, list[float]] = {}
    for context, label, (minutes, seconds) in zip(contexts, labels, times.T, strict=False):
        found.setdefault(f"{context} {label}".strip(), []).append(_MINUTE * minutes + seconds)
    return {name: np.array(at) for name, at in found.items()}
