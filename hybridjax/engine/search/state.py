"""What a search is about, and what it carries from one iteration to the next."""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from ..._core.executor import Array, namespace
from ..._core.results import Result
from ..lanes import Lanes
from ..settings import Settings
from ..target import Target
from ..watch import Watch
from .stride import Stride


class Task(NamedTuple):
    """What the lanes of a search are to do: the same in all of its iterations."""

    u: Float[Array, "nu L"]
    """The constant input of each lane."""
    target: Target
    span: Float[Array, " L"]
    """Time from the start to the limit. Times that are a matter of rounding are judged by it."""
    stride: Stride
    settings: Settings


class Approach(NamedTuple):
    """Lanes that have seen a crossing in a step and are about to land on it."""

    on: Bool[Array, " L"]
    which: Int[Array, " L"]
    """The watched function that crosses."""
    tau: Float[Array, " L"]
    """Where the crossing is thought to be, as a time from where the lane is."""
    reach: Float[Array, " L"]
    """Length of the step in which it was seen."""
    rate: Float[Array, " L"]
    """The largest rate of that function at the ends of that step."""
    tries: Int[Array, " L"]


class State(NamedTuple):
    """Where the lanes of a search stand."""

    lanes: Lanes
    seen: Watch
    """The watched functions where the lanes are."""
    aimed: Bool[Array, " L"]
    """Whether the target's level would end the flow at its next falling zero."""
    approach: Approach
    h: Float[Array, " L"]
    """The next step, if nothing comes in between."""
    along: Float[Array, "d L"] | None
    """What has become of a deviation since the last event, in charts with implicit methods; `None`
    where derivatives do not matter."""
    error: Float[Array, " L"]
    """Sum of the error estimates of the steps so far, relative to the tolerance."""
    result: Int[Array, " L"]
    arrived: Bool[Array, " L"]
    i: Int[Array, ""]
    """Number of iterations so far."""

    @property
    def active(self) -> Bool[Array, " L"]:
        """Lanes that are still on their way."""
        return ~self.arrived & (self.result == Result.OK)

    @property
    def ready(self) -> Bool[Array, "W L"]:
        """Watched functions whose next falling zero counts."""
        return namespace(self.aimed).concatenate([self.lanes.armed, self.aimed[None]])
