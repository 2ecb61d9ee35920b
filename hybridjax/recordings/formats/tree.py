"""Arrays in groups, as in MATLAB's and HDF5 files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError, FileFormatError
from ..headers import split_header
from .columns import Columns, Wanted, belongs, no_such_signal, with_unit


Place = tuple[str, ...]
"""Names of groups, from the outermost on, and of an array."""

# The group whose arrays are times of events.
_EVENTS = "events"


class Leaf(NamedTuple):
    """An array of numbers, which may be read when it is asked for."""

    array: Any
    """With a shape, and its values at `[()]`."""
    unit: str = ""


def read_tree(
    path: Path, leaves: Mapping[Place, Leaf], separator: str, wanted: Wanted
) -> list[Columns]:
    """A table for each array of times.

    The times of an array are those in its own group, or else in the nearest group around it. The
    columns of a matrix are called `name.0`, `name.1`, ... Arrays in a group `events` are times of
    events. Single numbers, which are settings, are left out.

    **Raises:** `DefinitionError` where there are no times for a signal; `FileFormatError` for an
    array that is not as long as its times.
    """
    names = [separator.join(place) for place in leaves]
    for name in wanted.signals or ():
        if not any(belongs(x, name) or belongs(name, x) for x in names):
            raise no_such_signal(path, name, names)
    clocks = {}
    for place, leaf in leaves.items():
        if separator.join(place) == wanted.time:
            clocks[()] = leaf
        elif wanted.is_time(place[-1]):
            clocks[place[:-1]] = leaf
    tables: dict[Place, Columns] = {}
    for place, leaf in leaves.items():
        name = separator.join(place)
        is_event = place[-2:-1] == (_EVENTS,)
        if any(leaf is clock for clock in clocks.values()) or not (
            is_event or (np.prod(leaf.array.shape) > 1 and wanted.reaches(name))
        ):
            continue
        around = next((place[:k] for k in range(len(place), -1, -1) if place[:k] in clocks), None)
        if around is None:
            raise DefinitionError(
                f"'{path}' has no times '{wanted.time}' for '{name}' in its group or one around "
                "it: name the array that holds them by `time`, or choose `signals`."
            )
        if around not in tables:
            clock = clocks[around]
            times = np.atleast_1d(np.squeeze(clock.array[()]))
            tables[around] = Columns({with_unit(wanted.time, clock.unit): times}, events={})
        if is_event:
            tables[around].events[place[-1]] = np.ravel(leaf.array[()])
        else:
            tables[around].values.update(_columns(path, name, leaf, tables[around]))
    return list(tables.values())


def _columns(
    path: Path, name: str, leaf: Leaf, table: Columns
) -> dict[str, Float[np.ndarray, " n"]]:
    """The columns of one array, which must be as long as the times."""
    clock, times = next(iter(table.values.items()))
    values = np.atleast_1d(np.squeeze(leaf.array[()]))
    if values.ndim == 2 and len(values) != len(times):
        values = values.T
    if values.ndim > 2 or len(values) != len(times):
        raise FileFormatError(
            f"'{path}': '{name}' has {' x '.join(map(str, leaf.array.shape))} numbers, but its "
            f"times '{split_header(clock)[0]}' {times.size}: put signals of another rate into a "
            "group with times of their own, or choose `signals`."
        )
    if values.ndim == 1:
        return {with_unit(name, leaf.unit): values}
    return {with_unit(f"{name}.{k}", leaf.unit): x for k, x in enumerate(values.T)}


def refuse_structs(path: Path, name: str, wanted: Wanted) -> None:
    """**Raises:** `FileFormatError` if an array of structs is wanted."""
    if wanted.reaches(name):
        raise FileFormatError(
            f"'{path}': '{name}' is an array of structs: save each of them in a file of its own, "
            "or choose other `signals`."
        )
