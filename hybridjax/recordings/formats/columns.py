"""The interface of all readers of files: which columns are wanted (`Wanted`), and which were read
(`Columns`).

A reader gets a path and a `Wanted`, and returns a list of `Columns`: one for each table whose
signals share their times. `parse_table` then separates times, events and signals, and finds units
in headers. `reading` turns errors of libraries into a `FileFormatError`.

If a unit is not found in a header, look at `split_header`, and for a row of units at `is_unit`; if
times have a wrong unit, at `time_unit`; if a broken file raises an error of a library, at
`reading`.
"""

import errno
import functools as ft
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core import limits
from ..._core.boundary.values import unmasked
from ..._core.findings import Finding
from ..._core.signal import SECONDS
from ...errors import DefinitionError, FileFormatError, HybridJaxError


# Prefix of the names of columns that mark events.
EVENT = "event "
# `force (N)`, `force [N]`.
_BRACKETED = re.compile(r"(.*?)\s*[(\[]([^)\]]*)[)\]]")
# `time_ms`, `t / ms`: units of time only.
_TRAILING = re.compile(rf"(.+?)(?:\s*/\s*|[\s_]+)({'|'.join(SECONDS)})")
# `N`, `m/s^2`, `kg·m²`, `-`, and anything in brackets.
_FACTOR = (
    r"(?:[nuµμmckMG]?(?:s|m|g|N|V|A|Pa|W|J|Hz|K|T|L|l|bar|rad)|sec|min|h|deg|°C?|%|in|ft|lb|BW|1)"
    r"\^?[-⁻]?[0-9²³¹]*"
)
_UNIT = re.compile(rf"[(\[].*[)\]]|-|{_FACTOR}(?:[ */·.]?{_FACTOR})*")


def assumed(text: str) -> Finding:
    """Return a finding about an assumption that a reader makes."""
    return Finding("assumption", text)


class Columns(NamedTuple):
    """Columns of one table by their headers: signals, and the times at which all were sampled."""

    values: dict[str, Float[np.ndarray, " n"]]
    findings: tuple[Finding, ...] = ()
    """Assumptions made while reading."""
    events: dict[str, Float[np.ndarray, " _"]] = {}
    """Times of events by name, in the unit of the table's times."""

    def with_finding(self, finding: Finding) -> "Columns":
        """Return the columns with one finding more."""
        return self._replace(findings=(*self.findings, finding))


class Table(NamedTuple):
    """The columns of a table by their plain names."""

    time: Float[np.ndarray, " n"]
    """Times in s."""
    signals: dict[str, Float[np.ndarray, " n"]]
    units: dict[str, str]
    """Units of the signals that have one."""
    events: dict[str, Float[np.ndarray, " _"]]
    """Times of events in s."""
    clock: str
    """The header of the times."""


def parse_table(where: str, columns: Columns, time: str) -> Table:
    """Separate the times, events and signals of a table, and names and units.

    Capitals in the name of the times matter only if there are several such columns.

    **Raises:** `DefinitionError` if there are no times, or their unit is unknown; `FileFormatError`
    if there are several, or a unit is NaN.
    """
    require_aligned(where, columns.values.values())
    headers = {x: split_header(x) for x in columns.values}
    clock = _clock(where, headers, time)
    unit = time_unit(clock) or "s"
    if unit not in SECONDS:
        raise DefinitionError(
            f"{where}: the times in '{clock}' are in '{unit}': convert them to s, ms, us, ns, min "
            "or h (divide frames by the sampling rate)."
        )
    scale = SECONDS[unit]
    times = scale * numbers(where, clock, columns.values[clock])
    events = {name: at * scale for name, at in columns.events.items()}
    signals: dict[str, Any] = {}
    units: dict[str, str] = {}
    for header, (name, unit) in headers.items():
        if header == clock:
            continue
        if name.startswith(EVENT):
            marks = numbers(where, name, columns.values[header])
            events[name.removeprefix(EVENT)] = times[np.nan_to_num(marks) != 0]
            continue
        if unit.lower() == "nan":
            raise FileFormatError(
                f"{where}: the unit of '{name}' is nan: write it, or nothing."
            )
        if name in signals:
            raise FileFormatError(f"{where} has two columns '{name}': rename one.")
        signals[name] = columns.values[header]
        if unit:
            units[name] = unit
    return Table(times, signals, units, events, clock)


def _clock(where: str, headers: dict[str, tuple[str, str]], time: str) -> str:
    """Return the header of the times."""
    exact = [x for x, (name, _) in headers.items() if time in (x, name)]
    alike = [x for x, (name, _) in headers.items() if name.lower() == time.lower()]
    clocks = exact or alike
    if len(clocks) > 1:
        raise FileFormatError(f"{where} has two columns '{time}': rename one.")
    if not clocks:
        names = [name for name, _ in headers.values()]
        example = names[0] if names else "t"
        raise DefinitionError(
            f"{where} has no column '{time}': choose `time` from {', '.join(names)}, or add a "
            "column of times. `hj.read_recording` and `hj.Recording.from_frame` take "
            f"`time='{example}'`, the command line `--time {example}`."
        )
    return clocks[0]


def require_aligned(where: str, columns: Iterable[Any]) -> None:
    """**Raises:** `DefinitionError` for series of pandas with different indices."""
    series = [x.index for x in columns if hasattr(x, "iloc")]
    if not all(index.equals(series[0]) for index in series):
        raise DefinitionError(
            f"{where}: series of pandas have different indices: align them."
        )


def numbers(where: str, name: str, values: Any) -> Float[np.ndarray, " n"]:
    """Return one axis of real numbers.

    **Raises:** `DefinitionError` for other values.
    """
    try:
        values = unmasked(values)
    except (ValueError, TypeError):  # rows of different lengths, a dataset
        values = np.empty((0, 0), object)
    if values.dtype.kind not in "fiub" or values.ndim != 1:
        given = f"{values.dtype}{values.shape}"
        raise DefinitionError(
            f"{where}: {name} must be real numbers on one axis, not {given}."
        )
    return values.astype(float)


class Wanted(NamedTuple):
    """The wanted part of a file."""

    time: str
    """The name of the column with the times."""
    signals: tuple[str, ...] | None = None
    """Names of signals and of groups of signals. None: all."""

    def includes(self, header: str) -> bool:
        """Return whether a column is a wanted signal, the times, or an event."""
        name, _ = split_header(header)
        if self.signals is None or name.startswith(EVENT) or self.is_time(header):
            return True
        return not _with_groups(name).isdisjoint(_set(self.signals))

    def reaches(self, group: str) -> bool:
        """Return whether a signal, a group that contains it, or a member of it is wanted: `imu` is
        reached if `imu.gyro.x` is wanted, and `imu.gyro.x` if `imu` is wanted."""
        if self.signals is None:
            return True
        within = not _with_groups(group).isdisjoint(_set(self.signals))
        return within or group in _set_with_groups(self.signals)

    def is_time(self, header: str) -> bool:
        """Return whether a column may hold the times."""
        name, _ = split_header(header)
        return header == self.time or name.lower() == self.time.lower()

    def require(self, path: Path, names: Sequence[str], groups: bool = False) -> None:
        """Check that each wanted signal exists; `groups`: `names` may be groups of signals.

        **Raises:** `DefinitionError` that lists up to 20 names.
        """
        known = _set(tuple(names))
        with_groups = _set_with_groups(tuple(names))
        for name in self.signals or ():
            within = groups and not _with_groups(name).isdisjoint(known)
            if not (within or name in with_groups):
                shown = [*names[:20], "..."] if len(names) > 20 else names
                raise DefinitionError(
                    f"'{path}' has no signal '{name}'; it has {', '.join(shown) or 'none'}."
                )


def _with_groups(name: str) -> set[str]:
    """The name of a signal, and the names of the groups that contain it: `imu.gyro.x`, `imu.gyro`
    and `imu`."""
    groups = {name[:k] for k, letter in enumerate(name) if letter in "./"}
    return {name, *groups}


# (As sets, since a file may have thousands of names.)
@ft.lru_cache(maxsize=8)
def _set(names: tuple[str, ...]) -> frozenset[str]:
    return frozenset(names)


@ft.lru_cache(maxsize=8)
def _set_with_groups(names: tuple[str, ...]) -> frozenset[str]:
    return frozenset().union(*map(_with_groups, names))


def split_header(header: str) -> tuple[str, str]:
    """Return name and unit of a header: `force (N)` -> `force`, `N`."""
    match = _BRACKETED.fullmatch(header.strip())
    if not match:
        return header.strip(), ""
    return match[1].strip(), match[2].strip()


def is_unit(text: str) -> bool:
    """Return whether a field below a name is its unit: `N`, `[m/s]`, `deg`."""
    return _UNIT.fullmatch(text.strip()) is not None


def time_unit(header: str) -> str:
    """Return the unit of times: `time (ms)`, `time_ms`, `t / ms` -> `ms`; "" if there is none."""
    _, unit = split_header(header)
    trailing = _TRAILING.fullmatch(header.strip())
    if not unit and trailing is not None:
        return trailing[2]
    return unit


def two_columns(path: Path, names: Sequence[str]) -> None:
    """**Raises:** `FileFormatError` if a name occurs twice."""
    if len(set(names)) < len(names):
        twice = next(x for x in names if names.count(x) > 1)
        raise FileFormatError(f"'{path}' has two columns '{twice}': rename one.")


def check_rows(path: Path, rows: int, declared: Any, what: str) -> None:
    """**Raises:** `FileFormatError` for another number of rows than the header declares."""
    if declared is not None and str(declared) != str(rows):
        raise FileFormatError(
            f"'{path}' is damaged: it has {rows} {what}, its header {declared}."
        )


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn errors of a library about broken bytes into a `FileFormatError` with the library's
    own text.

    Libraries raise errors of any kind for broken bytes. So every error that is raised in a library
    is taken to be about the file, unless it is about the computer (such as missing memory). Errors
    that this package raises are not changed.
    """
    try:
        yield
    except (HybridJaxError, MemoryError, Warning):
        raise
    except Exception as error:
        of_system = isinstance(error, OSError) and error.errno in _OF_SYSTEM
        if of_system or _raised_here(error):
            raise
        reason = textwrap.shorten(str(error) or type(error).__name__, 100)
        raise FileFormatError(
            f"'{path}' is no {kind}, or damaged ({reason})."
        ) from error


# Errors about the computer, not about the content of a file.
_OF_SYSTEM = (
    errno.EACCES,
    errno.EIO,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOENT,
    errno.ENOMEM,
    errno.ENOSPC,
    errno.EPERM,
    errno.ETIMEDOUT,
)


def _raised_here(error: Exception) -> bool:
    """Return whether a line of this package raised an error, and no library that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    package = __name__.partition(".")[0]
    module = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    return module.partition(".")[0] == package


def check_declared(path: Path, size: int) -> None:
    """**Raises:** `FileFormatError` if a file declares more than a file of its size can hold."""
    if size > limits.unpacked(path.stat().st_size):
        raise FileFormatError(
            f"'{path}' is damaged or almost empty: it declares arrays of {size} bytes or more, "
            "and is not that large; write it without compression, or without what is empty."
        )
