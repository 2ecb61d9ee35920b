"""Bags of ROS 1 and ROS 2, and MCAP files with messages of ROS."""

import dataclasses
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..._core.arguments import package
from ...errors import FileFormatError
from .columns import Columns, Wanted, reading


# Longest array in a message whose numbers become signals. Longer: scans and images become thousands
# of signals. Shorter: joint positions of a humanoid are left out.
_LONGEST = 64


def read_bag(path: Path, wanted: Wanted) -> list[Columns]:
    """Read a table with columns `topic.field` for each wanted topic; other topics are not decoded.

    Times are the stamps in the headers of messages, or else the times of arrival. They count from
    the start of the bag.

    **Raises:** `DefinitionError` for a topic that does not exist; `FileFormatError` for a damaged
    file, and arrays whose length changes.
    """
    reader, typesys = package("rosbags.highlevel").AnyReader, package("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with reading(path, "bag of ROS"), reader([path], default_typestore=store) as bag:
        wanted.require(
            path, sorted({x.topic.lstrip("/") for x in bag.connections}), groups=True
        )
        chosen = [x for x in bag.connections if wanted.reaches(x.topic.lstrip("/"))]
        topics = {x.topic: _Topic(x.topic.lstrip("/")) for x in chosen}
        for connection, arrival, data in bag.messages(chosen) if chosen else ():
            message = bag.deserialize(data, connection.msgtype)
            topics[connection.topic].add(path, message, arrival, wanted)
        return [x.columns(bag.start_time) for x in topics.values() if x.names]


class _Topic:
    """The numbers of one topic, message by message."""

    def __init__(self, name: str):
        self.name, self.names = name, tuple[str, ...]()
        self.values, self.stamps, self.arrivals = array("d"), array("q"), array("q")

    def add(self, path: Path, message: Any, arrival: int, wanted: Wanted) -> None:
        numbers = {x: v for x, v in _numbers(message, self.name) if wanted.includes(x)}
        if self.arrivals and tuple(numbers) != self.names:
            text = f"arrays in messages of '{self.name}' differ in length: choose other `signals`."
            raise FileFormatError(f"'{path}': {text}")
        self.names = tuple(numbers)
        self.values.extend(numbers.values())
        self.arrivals.append(arrival)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        self.stamps.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)

    def columns(self, start: int) -> Columns:
        """Return the columns in the order of their times, in s since the start of the bag (ns)."""
        stamps, notes = np.array(self.stamps), ()
        if not stamps.all():
            note = f"the times of {self.name} are those of arrival: its messages have no stamps"
            stamps, notes = np.array(self.arrivals), (note,)
        order = np.argsort(stamps, kind="stable")
        rows = np.array(self.values).reshape(len(order), -1)[order]
        values = dict(zip(self.names, rows.T, strict=True))
        return Columns({"time (s)": (stamps[order] - start) / 10**9} | values, notes)


def _numbers(message: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield numbers by the names of their fields, without headers and long arrays."""
    for field in dataclasses.fields(message):
        value, path = getattr(message, field.name), f"{name}.{field.name}"
        if isinstance(value, bool | int | float | np.number):
            yield path, float(value)
        elif isinstance(value, np.ndarray) and value.size <= _LONGEST:
            yield from ((f"{path}.{k}", float(x)) for k, x in enumerate(value))
        elif dataclasses.is_dataclass(value) and field.name != "header":
            yield from _numbers(value, path)
