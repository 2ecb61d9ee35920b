"""What the command line takes for an option: text into values, or a sentence that says why not."""

import argparse
import math
from typing import Literal, get_args

from .._core import limits
from .._core.writing import Format


def count(text: str) -> int:
    """A whole number, at least 1."""
    value = _whole(text)
    if not 1 <= value <= limits.DECLARED:
        raise argparse.ArgumentTypeError(f"{text} is not between 1 and {limits.DECLARED}")
    return value


def seed(text: str) -> int:
    """A whole number, at least 0."""
    value = _whole(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def positive(text: str) -> float:
    """A positive number."""
    value = _number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def names(text: str) -> tuple[str, ...]:
    """Different names with commas in between."""
    found = tuple(name.strip() for name in text.split(","))
    if "" in found or len(set(found)) < len(found):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of different names")
    return found


def model(text: str) -> tuple[str, str]:
    """A file of Python, and what it calls a model."""
    file, colon, name = text.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not FILE.py:NAME")
    return file, name


def axis(text: str) -> tuple[str, float, float, int]:
    """A parameter with its lowest and highest value, and how many."""
    name, _, values = text.partition("=")
    parts = values.split(":")
    if not name or len(parts) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=LOW:HIGH:COUNT")
    return name, _number(parts[0]), _number(parts[1]), count(parts[2])


def formats(text: str) -> tuple[str, ...]:
    """Formats of figures with commas in between."""
    found, known = names(text), get_args(Format)
    for name in found:
        if name not in known:
            raise argparse.ArgumentTypeError(f"{name!r} is not one of {', '.join(known)}")
    return found


def two_names(text: str) -> tuple[str, str]:
    """Two names with a comma in between."""
    found = names(text)
    if len(found) != 2:
        raise argparse.ArgumentTypeError(
            f"it needs two entries with a comma in between, not {text!r}"
        )
    return found


def two_numbers(text: str) -> tuple[float, float]:
    """Two numbers with a comma in between."""
    found = tuple(map(_number, text.split(",")))
    if len(found) != 2:
        raise argparse.ArgumentTypeError(
            f"it needs two entries with a comma in between, not {text!r}"
        )
    return found


def two_sizes(text: str) -> tuple[float, float]:
    """Two positive numbers with a comma in between."""
    found = two_numbers(text)
    if not min(found) > 0:
        raise argparse.ArgumentTypeError(f"{text!r} holds a number that is not positive")
    return found


def crossing(text: str) -> tuple[str, Literal["rising", "falling"], float]:
    """`signal:direction:value`, by default rising, and zero."""
    signal, *more = text.split(":")
    direction, value = (*more, *("rising", "0")[len(more) :])[:2]
    try:
        if len(more) > 2 or direction not in ("rising", "falling") or not signal.strip():
            raise ValueError
        return signal.strip(), direction, _number(value)
    except (ValueError, argparse.ArgumentTypeError):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a signal, a direction and a value, as in x:falling:0.2"
        ) from None


def assignment(text: str) -> tuple[str, float]:
    """`NAME=VALUE`."""
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number") from None


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return value
