"""What all ways to run experiments take by name."""

import dataclasses
from typing import Literal, TypedDict, get_args

from .._core.execution import Execution
from ..errors import DefinitionError
from .noise import ProcessNoise


Start = Literal["cycle", "periodic", "steady"]


@dataclasses.dataclass(frozen=True)
class Options:
    """The arguments that `run_experiments` describes, with their defaults.

    **Raises:** `DefinitionError` for another start.
    """

    start: str = "cycle"  # one of `Start`, as is checked here
    discard: int | None = None
    process_noise: ProcessNoise | None = None
    accuracy: float | None = None
    record_events: bool = False
    execution: Execution | None = None

    def __post_init__(self):
        if self.start not in get_args(Start):
            raise DefinitionError(f"start is 'cycle', 'periodic' or 'steady', not {self.start!r}.")


class OptionsByName(TypedDict, total=False):
    """`Options` for type checkers, where a function hands them on."""

    start: Start
    discard: int | None
    process_noise: ProcessNoise | None
    accuracy: float | None
    record_events: bool
    execution: Execution | None
