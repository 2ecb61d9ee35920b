"""The interface of all readers of files: which columns are wanted, and which were read."""

import importlib
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core import limits
from ..._core.archive import damaged
from ...errors import DefinitionError, FileFormatError, HybridJaxError


# Prefix of the names of columns that mark events.
EVENT = "event "
_SECONDS = {
    "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0,
    "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9,
    "min": 60.0, "h": 3600.0,
}  # fmt: skip
_BRACKETED = re.compile(r"(.*?)\s*[(\[]([^)\]]*)[)\]]")
_TRAILING = re.compile(rf"(.+?)(?:\s*/\s*|[\s_]+)({'|'.join(_SECONDS)})")
_FACTOR = (
    r"(?:[nuµμmckMG]?(?:s|m|g|N|V|A|Pa|W|J|Hz|K|T|L|l|bar|rad)|sec|min|h|deg|°C?|%|in|ft|lb|BW|1)"
    r"\^?[-⁻]?[0-9²³¹]*"
)
_UNIT = re.compile(rf"[(\[].*[)\]]|-|{_FACTOR}(?:[ */·.]?{_FACTOR})*")


class Columns(NamedTuple):
    """Columns of one table by their headers: signals, and the times at which all were sampled."""

    values: dict[str, Float[np.ndarray, " n"]]
    notes: tuple[str, ...] = ()
    """Assumptions made while reading."""
    events: dict[str, Float[np.ndarray, " _"]] = {}
    """Times of events by name, in the unit of the table's times."""


class Wanted(NamedTuple):
    """The wanted part of a file."""

    time: str
    """The name of the column with the times."""
    signals: tuple[str, ...] | None = None
    """Names of signals and of groups of signals. None: all."""

    def includes(self, header: str) -> bool:
        """Return whether a column is a wanted signal, the times, or an event."""
        name = split_header(header)[0]
        if self.signals is None or name.startswith(EVENT) or self.is_time(header):
            return True
        return any(belongs(name, x) for x in self.signals)

    def reaches(self, group: str) -> bool:
        """Return whether a signal, or a member of a group, is wanted."""
        return self.signals is None or any(
            belongs(group, x) or belongs(x, group) for x in self.signals
        )

    def is_time(self, header: str) -> bool:
        """Return whether a column may hold the times."""
        return header == self.time or split_header(header)[0].lower() == self.time.lower()

    def require(self, path: Path, names: Sequence[str], groups: bool = False) -> None:
        """Check that each wanted signal exists; `groups`: `names` may be groups of signals.

        **Raises:** `DefinitionError` that lists up to 20 names.
        """
        for name in self.signals or ():
            if not any(belongs(x, name) or (groups and belongs(name, x)) for x in names):
                more = ", ..." if len(names) > 20 else ""
                listed = ", ".join(names[:20]) or "none"
                raise DefinitionError(f"'{path}' has no signal '{name}'; it has {listed}{more}.")


def belongs(name: str, group: str) -> bool:
    """Return whether a signal has this name or is in the group of this name: `imu.gyro.x` belongs
    to `imu`."""
    return name == group or name.startswith((f"{group}.", f"{group}/"))


def with_unit(name: str, unit: str) -> str:
    """Return the header of a signal."""
    return f"{name} ({unit})" if unit else name


def split_header(header: str) -> tuple[str, str]:
    """Return name and unit of a header: `force (N)` -> `force`, `N`."""
    match = _BRACKETED.fullmatch(header.strip())
    return (match[1].strip(), match[2].strip()) if match else (header.strip(), "")


def is_unit(text: str) -> bool:
    """Return whether a field below a name is its unit: `N`, `[m/s]`, `deg`."""
    return _UNIT.fullmatch(text.strip()) is not None


def time_unit(header: str) -> str:
    """Return the unit of times: `time (ms)`, `time_ms`, `t / ms` -> `ms`; "" if there is none."""
    trailing = _TRAILING.fullmatch(header.strip())
    return split_header(header)[1] or (trailing[2] if trailing else "")


def seconds(where: str, column: str, unit: str) -> float:
    """Return a unit of time in seconds; no unit means seconds.

    **Raises:** `DefinitionError` for an unknown unit.
    """
    if unit and unit not in _SECONDS:
        raise DefinitionError(
            f"{where}: the times in '{column}' are in '{unit}', which is no known unit of time: "
            "convert them to s, ms, us, ns, min or h (divide frames by the sampling rate)."
        )
    return _SECONDS[unit] if unit else 1.0


def two_columns(path: Path, names: Sequence[str], what: str = "columns") -> None:
    """**Raises:** `FileFormatError` if a name occurs twice."""
    if len(set(names)) < len(names):
        twice = next(x for x in names if names.count(x) > 1)
        raise FileFormatError(f"'{path}' has two {what} '{twice}'.")


def library(module: str, what: str, extra: str) -> Any:
    """Import the package that reads a format.

    **Raises:** `DefinitionError` if it is not installed.
    """
    try:
        importlib.import_module(module.split(".")[0])
        return importlib.import_module(module)
    except ImportError as error:
        raise DefinitionError(
            f"{what} are read with the package {module.split('.')[0]}, which is not installed: "
            f"`pip install 'hybridjax[{extra}]'`."
        ) from error


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a library raises about broken bytes into a `FileFormatError`."""
    try:
        yield
    except HybridJaxError:
        raise
    except Exception as error:
        reason = textwrap.shorten(str(error) or type(error).__name__, 100)
        raise FileFormatError(f"'{path}' is no {kind}, or damaged ({reason}).") from error


def check_declared(path: Path, size: int, what: str) -> None:
    """**Raises:** `FileFormatError` if a file declares more than a file of its size can hold."""
    if size > limits.unpacked(path.stat().st_size):
        raise damaged(path, f"it declares {what}, and is not that large")
