"""The data that the files of `search/` hand to each other; nothing is computed here.

`Task` has the constants of a search. `State` is the state of its iteration, `Aim` the step that is
to be attempted, and `Attempt` the step that was computed. `Options`, `Stride`, `Moved` and
`Recorded` are what callers of `move` give and get. Each array has lanes (trajectories side by side)
on its last axis. A *watched function* is a guard, or the level function of the target section; its
zeros end steps.

A new field gets its value where its tuple is made, and a wrong value comes from there: `State` from
`_begin` in `search.py` and from both functions of `outcome.py`, `Aim` from `take_aim` in
`search.py`, `Attempt` from `attempt.py`. Shapes and types must stay the same during a search, since
JAX compiles its loop.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from ..._core.executor import namespace
from ..._core.results import Result
from ...systems.structure import Structure
from ..arrays import Array, Index, Inputs, Mask, Padded, Times
from ..lanes import Lanes, Tape
from ..settings import Settings
from ..target import Target
from ..watch import Watch


# An extremum is a touch within this many times the error of a step, as a part of the watched
# function's largest magnitude, and within at least the part `_LEAST`, at most the part `_MOST`.
# Higher: crossings that steps resolve are called grazing. Lower: derivatives at a touch are made of
# errors of steps. (Those of `hj.flow`, 1e-12 in each step, are a tenth of `_LEAST`.)
_ERRORS = 0.1
_LEAST = 1e-11
_MOST = 1e-6


class Stride(NamedTuple):
    """What a caller knows of the way before the flow begins."""

    h: Times
    """The first step."""
    lead: Times
    """Expected time until the target's level is zero, as a multiple of Newton's guess at the start;
    0 if it is not known."""
    slack: Times
    """A step's error estimate may be this many times the tolerance."""
    along: Padded | None = None
    """Deviations that began before this flow (see `State.along`). Default: deviations begin with
    the flow."""


class Options(NamedTuple):
    """Further results and properties of a search."""

    tape: bool = False
    """Record a tape."""
    new_input: bool = True
    """Arm the guards for the input u, which may have jumped; otherwise they stay as they are."""
    tangents: bool = False
    """Make steps also short enough for the derivatives of a replay."""
    at_once: bool = False
    """On the host: one program for all pieces of a turn."""


class Moved(NamedTuple):
    """Lanes at the end of a piece of flow."""

    lanes: Lanes
    h: Times
    """Step size to go on with."""
    error: Times
    """Sum of the steps' error estimates, relative to the tolerance."""
    result: Index
    """`Result` codes. A lane that failed stays where it failed."""


class Recorded(NamedTuple):
    """Lanes at the end of a piece of flow, and the record of the way."""

    moved: Moved
    tape: Tape | None
    """`None` if it was not requested."""


class Task(NamedTuple):
    """The constants of a search."""

    s: Structure
    u: Inputs
    """The constant input of each lane."""
    target: Target
    span: Times
    """Time from the start to the limit, relative to which rounding errors of times are judged."""
    stride: Stride
    settings: Settings
    tangents: bool
    """Whether steps are also short enough for the derivatives of a replay."""


class Approach(NamedTuple):
    """Lanes that have met a crossing within a step and are about to land on it."""

    on: Mask
    which: Index
    """The watched function that crosses."""
    tau: Times
    """Expected time from the lane's time to the crossing."""
    reach: Times
    """Length of the step in which the crossing was met."""
    rate: Times
    """The largest rate of the watched function at the ends of the step in which the crossing was
    met."""
    tries: Index


class State(NamedTuple):
    """The state of the iteration."""

    lanes: Lanes
    watched: Watch
    """The watched functions at the lanes."""
    highest: Float[Array, "W L"]
    """Largest magnitude of each watched function at the ends of steps, since the start or the last
    event that changed its value or rate. Rounding and errors of steps are a part of it."""
    aimed: Mask
    """Whether the next fall of the target's level through zero ends the flow."""
    approach: Approach
    h: Times
    """The next step, if no event comes in between."""
    along: Padded | None
    """A deviation that began with the flow or at the last event, in charts with implicit methods;
    `None` where derivatives do not matter."""
    error: Times
    """Sum of the error estimates of the steps so far, relative to the tolerance."""
    result: Index
    arrived: Mask
    i: Int[Array, ""]
    """Number of iterations so far."""

    def touching(self, settings: Settings) -> Float[Array, "W L"]:
        """The magnitude of each watched function below which an extremum is a touch: errors of
        steps decide whether it crosses zero."""
        xp = namespace(self.aimed)
        assert settings.rtol is not None
        part = xp.clip(_ERRORS * xp.asarray(settings.rtol), _LEAST, _MOST)
        return part * self.highest

    @property
    def active(self) -> Mask:
        """Lanes that have neither arrived nor failed."""
        return ~self.arrived & (self.result == Result.OK)

    @property
    def ready(self) -> Bool[Array, "W L"]:
        """Watched functions whose next falling zero counts."""
        return namespace(self.aimed).concatenate([self.lanes.armed, self.aimed[None]])


class Aim(NamedTuple):
    """The step that lanes attempt."""

    which: Index
    """The watched function whose zero is the end of the step; -1 for none."""
    step: Times
    """Length of the step."""
    reach: Times
    """Length of the step in which that zero is expected."""
    due: Times
    """The next known time: the target's, or that of a scheduled event."""
    schedule: Index
    """The scheduled transition that is due at the end of this step; -1 for none."""
    last: Mask
    """Whether this step ends at the known time."""
    at_once: Mask
    """Whether `schedule` is a transition whose guard is below zero, instead of a scheduled one: it
    happens at once, and the step has no length."""


class Attempt(NamedTuple):
    """A step of every lane, before it is accepted."""

    q: Padded
    """The state at the end of the step; if the lane lands, at the zero at which it aims."""
    watched: Watch
    """The watched functions at the end."""
    margin: Float[Array, "W L"]
    """How far watched functions may be from their cubic interpolants over the step."""
    error: Times
    """Estimate of the step's error, relative to the tolerance."""
    past: Times
    """Estimated time from the end of the step that was aimed for to the zero."""
    lands: Mask
    slow: Mask
    """The zero on which the lane lands is not crossed in falling, or at a vanishing speed."""
    bent: Mask
    """A watched function is not resolved by its cubic interpolant over the step.

    The error estimate of a step is that of the states only. Where states change smoothly, a guard
    may still turn many times within a step."""
    along: Float[Array, "d L"] | None
    """The deviation at the end of the step (see `State.along`)."""
    calm: Mask
    """No watched function comes near zero, except for the one on whose zero the lane lands."""
