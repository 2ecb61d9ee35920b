"""How a computation on many lanes is run."""

import dataclasses
from typing import Literal, get_args

from ..errors import DefinitionError
from .threads import thread_count


Precision = Literal["double", "single"]


@dataclasses.dataclass(frozen=True)
class Execution:
    """How many experiments, or many systems, are run. It changes no result beyond rounding.

    **Fields:**

    - `batch`: experiments or systems per compiled call, by default what is fastest. Another size
      compiles another program.
    - `workers`: threads that run such calls at the same time; by default all cores on CPU, and one
      on an accelerator.
    - `precision`: "double" or "single". Single precision computes experiments in 32 bits, while the
      cycle, the sections and the plan remain in 64. What rounding costs is measured on the cycle
      and is part of `ExperimentData.error`.

    **Raises:** `DefinitionError` for numbers below one, or another precision.
    """

    batch: int | None = None
    workers: int | None = None
    precision: Precision = "double"

    def __post_init__(self):
        if self.batch is not None and self.batch < 1:
            raise DefinitionError(
                f"batch is the number of lanes of one compiled call, not {self.batch}."
            )
        if self.workers is not None and self.workers < 1:
            raise DefinitionError(f"workers is the number of threads, not {self.workers}.")
        if self.precision not in get_args(Precision):
            raise DefinitionError(f"precision is 'double' or 'single', not {self.precision!r}.")

    @property
    def threads(self) -> int:
        """The number of threads that `workers` stands for on this machine."""
        return thread_count(self.workers)
