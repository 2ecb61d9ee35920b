"""What all ways to run experiments take by name."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypedDict

from .._core.boundary.kinds import Index
from .._core.execution import Execution
from .noise import ProcessNoise
from .stepping.plan import Accuracy


# Experiments that are run together where not all are. Twice as many need twice the memory.
CHUNK = 640

StartName = Literal["cycle", "periodic", "steady"]


@dataclasses.dataclass(frozen=True)
class Options:
    """The arguments that `run_experiments` describes, with their defaults."""

    start: StartName = "cycle"
    discard: int | None = None
    process_noise: ProcessNoise | None = None
    accuracy: float | None = None
    record_events: bool = False
    execution: Execution | None = None


class OptionsByName(TypedDict, total=False):
    """`Options` for type checkers, where a function hands them on."""

    start: StartName
    discard: Index | None
    process_noise: ProcessNoise | None
    accuracy: Accuracy | None
    record_events: bool
    execution: Execution | None


def options_of(function: Callable[..., Any], given: Mapping[str, Any]) -> Options:
    """The options that `function`, which takes `OptionsByName` beside arguments of its own, was
    given.

    **Raises:** `TypeError` for a name that is none of them, as Python does for other functions.
    """
    known = [field.name for field in dataclasses.fields(Options)]
    for name in given:
        if name not in known:
            parameters = inspect.signature(function).parameters.values()
            own = [x.name for x in parameters if x.kind is x.KEYWORD_ONLY]
            raise TypeError(
                f"{function.__name__} has no argument {name!r}; by name it takes "
                f"{', '.join([*own, *known])}."
            )
    return Options(**given)
