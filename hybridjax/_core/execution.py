"""How a computation on many lanes is run."""

import dataclasses
from typing import Literal

from .boundary.checked import checked
from .boundary.kinds import ExperimentCount, WorkerCount
from .threads import thread_count


Precision = Literal["double", "single"]


@checked
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
    - `progress`: show a progress bar.
    """

    batch: ExperimentCount | None = None
    workers: WorkerCount | None = None
    precision: Precision = "double"
    progress: bool = False

    @property
    def threads(self) -> int:
        """The number of threads that `workers` stands for on this machine."""
        return thread_count(self.workers)
