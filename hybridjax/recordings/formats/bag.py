"""Bags of ROS 1 and ROS 2, and MCAP files with messages of ROS."""

import dataclasses
import textwrap
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import FileFormatError, HybridJaxError
from .columns import Columns, Wanted, belongs, missing_library, no_such_signal


# The longest array in a message whose numbers become signals. Doubled: parts of scans and images
# may become signals.
_LONGEST = 64
_BILLION = 10**9
_HEADER = "std_msgs/msg/Header"


def read_bag(path: Path, wanted: Wanted) -> list[Columns]:
    """A table for each wanted topic, with columns `topic.field`; times are those in the headers of
    messages, else of their arrival, and count from the start of the bag. Only wanted topics are
    read.

    **Raises:** `DefinitionError` for a topic that is not there; `FileFormatError` for what is no
    such file, or damaged, and for arrays whose length changes.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_library("Bags of ROS and MCAP files", "rosbags", "ros") from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            topics = {x.topic.lstrip("/") for x in bag.connections}
            for name in wanted.signals or ():
                if not any(belongs(name, x) or belongs(x, name) for x in topics):
                    raise no_such_signal(path, name, sorted(topics))
            chosen = [x for x in bag.connections if wanted.reaches(x.topic.lstrip("/"))]
            found = {x.topic: _Topic(path, x.topic.lstrip("/"), wanted) for x in chosen}
            for connection, arrival, data in bag.messages(chosen) if chosen else ():
                message = bag.deserialize(data, connection.msgtype)
                found[connection.topic].add(message, arrival)
            return [x.columns(bag.start_time) for x in found.values() if x.names]
    except HybridJaxError:
        raise
    except Exception as error:  # whatever broken bytes make rosbags stumble over
        reason = textwrap.shorten(str(error) or type(error).__name__, 100)
        raise FileFormatError(f"'{path}' is no bag of ROS, or damaged ({reason}).") from error


class _Topic:
    """The numbers of one topic, message by message."""

    def __init__(self, path: Path, name: str, wanted: Wanted):
        self.path, self.name, self.wanted = path, name, wanted
        self.names: tuple[str, ...] = ()
        self.values, self.stamps, self.arrivals = array("d"), array("q"), array("q")

    def add(self, message: Any, arrival: int) -> None:
        pairs = [(x, v) for x, v in _numbers(message, self.name) if self.wanted.includes(x)]
        names = tuple(x for x, _ in pairs)
        if self.arrivals and names != self.names:
            other = min(set(names) ^ set(self.names))
            raise FileFormatError(
                f"'{self.path}': '{other}' is not in all messages of '{self.name}', whose arrays "
                "differ in length: choose other `signals`."
            )
        self.names = names
        self.values.extend(v for _, v in pairs)
        self.arrivals.append(arrival)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        self.stamps.append(0 if stamp is None else stamp.sec * _BILLION + stamp.nanosec)

    def columns(self, start: int) -> Columns:
        """In the order of their times, in s since the start of the bag, in ns."""
        stamps, notes = np.array(self.stamps), ()
        if not stamps.all():
            note = f"the times of {self.name} are those of arrival: its messages have no stamps"
            stamps, notes = np.array(self.arrivals), (note,)
        order = np.argsort(stamps, kind="stable")
        time = (stamps[order] - start) / _BILLION
        rows = np.array(self.values).reshape(len(order), -1)[order]
        values = dict(zip(self.names, rows.T, strict=True))
        return Columns({"time (s)": time} | values, notes)


def _numbers(message: Any, name: str) -> Iterator[tuple[str, float]]:
    """Numbers by the names of their fields; not those of headers, and of long arrays."""
    for field in dataclasses.fields(message):
        value, own = getattr(message, field.name), f"{name}.{field.name}"
        if isinstance(value, bool | int | float | np.number):
            yield own, float(value)
        elif isinstance(value, np.ndarray) and value.size <= _LONGEST:
            yield from ((f"{own}.{k}", float(x)) for k, x in enumerate(value))
        elif dataclasses.is_dataclass(value) and getattr(value, "__msgtype__", "") != _HEADER:
            yield from _numbers(value, own)
