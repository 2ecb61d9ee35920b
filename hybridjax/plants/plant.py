"""The protocol between this package and a simulator of another package."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable


@runtime_checkable
class Plant(Protocol):
    """A simulator that can be reset and stepped. Nothing of JAX is needed.

    **Fields:**

    - `inputs`: names of the inputs, or units by name.
    - `dt`: the longest time step. Sections are detected after each step.

    **Methods:**

    - `reset(seed)` begins at time 0 and returns an observation: the signals by name, always the
      same names in the same order. The seed determines everything that is random.
    - `step(u, duration)` holds the inputs `u` for a time and returns the observation at its end.

    A step raises any exception to end an experiment, for example where a walker falls.

    **Optional:**

    - `get_state()` and `set_state(x)`: the state, from which the plant continues exactly. For
      `perturbed_returns` it is an array of numbers, which can be changed by small amounts.
    - `states`: names of these numbers. `time` is the clock's.
    - `period`: period of the clock, on which the plant depends.
    - `fixed_step`: True if a step always lasts `dt`. Otherwise steps end on clock sections, and on
      others if the state can be set.
    - `units`: units of signals by name.
    """

    inputs: Sequence[str] | Mapping[str, str]
    dt: float

    def reset(self, seed: int) -> Mapping[str, float]: ...

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]: ...
