"""Reader of bags of ROS 1 and ROS 2, and of MCAP files with messages of ROS.

`read.py` calls `read_bag`, which returns one table of `Columns` for each wanted topic. The package
rosbags decodes the messages, and only those of wanted topics: others, such as images, may be large.
All messages of a topic must give the same names, since each becomes one row.

If a field is missing, look at `_numbers`; if times are wrong, at `_Topic.columns`, which takes the
stamps in headers, or else the times of arrival; if a bag is refused without need, at `check_rows`
(`columns.py`), which compares the number of messages with the index, and at `_Topic.add`.
"""

import dataclasses
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..._core.arguments import package
from ...errors import FileFormatError
from .columns import Columns, Wanted, assumed, check_rows, reading


# Arrays in a message become signals up to this length. Longer: scans and images become thousands of
# signals. Shorter: joint positions of a humanoid are left out.
_LONGEST = 64


def read_bag(path: Path, wanted: Wanted) -> list[Columns]:
    """Read a table with columns `topic.field` for each wanted topic; other topics are not decoded.

    Times are the stamps in the headers of messages, or else the times of arrival. They count from
    the start of the bag.

    **Raises:** `DefinitionError` for a topic that does not exist; `FileFormatError` for a damaged
    file, one with fewer messages than its index counts, and arrays whose length changes.
    """
    highlevel = package("rosbags.highlevel")
    typesys = package("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with (
        reading(path, "bag of ROS"),
        highlevel.AnyReader([path], default_typestore=store) as bag,
    ):
        names = {x.topic: x.topic.lstrip("/") for x in bag.connections}
        wanted.require(path, sorted(names.values()), groups=True)
        chosen = [x for x in bag.connections if wanted.reaches(names[x.topic])]
        topics = {x.topic: _Topic(names[x.topic]) for x in chosen}
        if not chosen:
            return []
        counted = dict.fromkeys(topics, 0)
        for connection in chosen:
            counted[connection.topic] += connection.msgcount
        for connection, arrival, data in bag.messages(chosen):
            message = bag.deserialize(data, connection.msgtype)
            topics[connection.topic].add(path, message, arrival, wanted)
        for name, topic in topics.items():
            count = len(topic.arrivals)
            check_rows(path, count, counted[name], f"messages of '{topic.name}'")
        return [
            topic.columns(bag.start_time) for topic in topics.values() if topic.names
        ]


class _Topic:
    """The numbers of one topic, message by message."""

    def __init__(self, name: str):
        self.name = name
        self.names: tuple[str, ...] = ()
        self.values = array("d")
        self.stamps = array("q")
        self.arrivals = array("q")

    def add(self, path: Path, message: Any, arrival: int, wanted: Wanted) -> None:
        """Take the wanted numbers of a message, which arrived at this time (ns).

        **Raises:** `FileFormatError` if their names differ from those of earlier messages.
        """
        numbers = {
            name: value
            for name, value in _numbers(message, self.name)
            if wanted.includes(name)
        }
        if self.arrivals and tuple(numbers) != self.names:
            raise FileFormatError(
                f"'{path}': arrays in messages of '{self.name}' differ in length: choose other "
                "`signals`."
            )
        self.names = tuple(numbers)
        self.values.extend(numbers.values())
        self.arrivals.append(arrival)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        nanoseconds = 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec
        self.stamps.append(nanoseconds)

    def columns(self, start: int) -> Columns:
        """Return the columns in the order of their times, in s since the start of the bag (ns)."""
        stamps = np.array(self.stamps)
        findings = ()
        if not stamps.all():
            stamps = np.array(self.arrivals)
            findings = (
                assumed(
                    f"the times of {self.name} are those of arrival: its messages have no stamps."
                ),
            )
        order = np.argsort(stamps, kind="stable")
        rows = np.array(self.values).reshape(len(order), -1)[order]
        values = {"time (s)": (stamps[order] - start) / 10**9}
        values |= dict(zip(self.names, rows.T, strict=True))
        return Columns(values, findings)


def _numbers(message: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield numbers by the names of their fields, without headers and long arrays."""
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        path = f"{name}.{field.name}"
        if isinstance(value, bool | int | float | np.number):
            yield path, float(value)
        elif isinstance(value, np.ndarray) and value.size <= _LONGEST:
            for k, x in enumerate(value):
                yield f"{path}.{k}", float(x)
        elif dataclasses.is_dataclass(value) and field.name != "header":
            yield from _numbers(value, path)
