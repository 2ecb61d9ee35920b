"""What is measured: each module has `run(show, options)`, which shows its numbers by name."""

from typing import NamedTuple


# In the order in which they run.
NAMES = (
    "experiments",
    "honesty",
    "sizes",
    "size",
    "jacobians",
    "gradients",
    "grid",
    "steps",
    "solvers",
    "walkers",
    "cores",
    "compile",
)


class Options(NamedTuple):
    """The least time of `repeat` calls counts. `quick` does less of everything: for a test that
    all works, not for figures. `jaxonomy` is the interpreter of the environment that has it."""

    repeat: int = 5
    quick: bool = False
    jaxonomy: str | None = None
