"""What all ways to run experiments take by name."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypedDict, get_args

from .._core.execution import Execution
from ..errors import DefinitionError
from .noise import ProcessNoise


StartName = Literal["cycle", "periodic", "steady"]


@dataclasses.dataclass(frozen=True)
class Options:
    """The arguments that `run_experiments` describes, with their defaults.

    **Raises:** `DefinitionError` for another start.
    """

    start: str = "cycle"  # one of `StartName`, as is checked here
    discard: int | None = None
    process_noise: ProcessNoise | None = None
    accuracy: float | None = None
    record_events: bool = False
    execution: Execution | None = None

    def __post_init__(self):
        if self.start not in get_args(StartName):
            raise DefinitionError(f"start is 'cycle', 'periodic' or 'steady', not {self.start!r}.")


class OptionsByName(TypedDict, total=False):
    """`Options` for type checkers, where a function hands them on."""

    start: StartName
    discard: int | None
    process_noise: ProcessNoise | None
    accuracy: float | None
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
