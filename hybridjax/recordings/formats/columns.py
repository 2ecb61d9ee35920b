"""What readers of files are asked for, and give."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from ..headers import split_header


# What the names of columns with events begin with.
EVENT = "event "
# Names of signals that a message lists. Doubled: longer messages.
_LISTED = 20


class Columns(NamedTuple):
    """Columns of one table, by their headers: signals, and the times at which all were sampled.

    A file is one table or several, each with its own times.
    """

    values: dict[str, Float[np.ndarray, " n"]]
    notes: tuple[str, ...] = ()
    """What was assumed to read them."""
    events: dict[str, Float[np.ndarray, " _"]] = {}
    """Times of events by name, in the unit of the table's times."""


class Wanted(NamedTuple):
    """What is wanted of a file."""

    time: str
    """The name of the column with the times."""
    signals: tuple[str, ...] | None = None
    """Names of signals, and of groups that hold some; None: all."""

    def includes(self, header: str) -> bool:
        """Whether a column is wanted: one of the signals, times, or events."""
        name = split_header(header)[0]
        if self.signals is None or name.startswith(EVENT) or self.is_time(header):
            return True
        return any(belongs(name, x) for x in self.signals)

    def reaches(self, group: str) -> bool:
        """Whether a signal, or one of a group, is wanted."""
        return self.signals is None or any(
            belongs(group, x) or belongs(x, group) for x in self.signals
        )

    def is_time(self, header: str) -> bool:
        """Whether a column may be the one with the times."""
        return header == self.time or split_header(header)[0].lower() == self.time.lower()


def belongs(name: str, group: str) -> bool:
    """Whether a signal has this name, or stands in the group of this name: `imu.gyro.x` belongs to
    `imu`."""
    return name == group or name.startswith((f"{group}.", f"{group}/"))


def with_unit(name: str, unit: str) -> str:
    """The header of a signal."""
    return f"{name} ({unit})" if unit else name


def missing_library(what: str, package: str, extra: str) -> DefinitionError:
    """What to say where a format needs a package that is not installed."""
    return DefinitionError(
        f"{what} are read with the package {package}, which is not installed: "
        f"`pip install 'hybridjax[{extra}]'`."
    )


def no_such_signal(path: Path, name: str, there: Sequence[str]) -> DefinitionError:
    """What to say where a signal is not there."""
    more = ", ..." if len(there) > _LISTED else ""
    listed = ", ".join(there[:_LISTED]) or "none"
    return DefinitionError(f"'{path}' has no signal '{name}'; it has {listed}{more}.")
