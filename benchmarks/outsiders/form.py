"""The form of the models: plain data, without hybridjax.

Every function takes an array module first, so that one text serves jax.numpy and numpy:
`field(xp, t, q, p)`, `guard(xp, t, q, p)`, `reset(xp, t, q, p)`, `enabled(xp, t, q, p)`. `q[k]` is
the k-th state, `p.name` a parameter.
"""

import dataclasses
from collections.abc import Callable


@dataclasses.dataclass(frozen=True)
class Event:
    """A transition from chart `source` to chart `target`.

    It has either a `guard` with a direction or a `schedule`, a function of the parameters that
    returns (period, offset). `domain` says that the chart ends at the guard: a motion in `source`
    that is beyond the guard all along is outside of the model.
    """

    name: str
    source: str
    target: str
    guard: Callable | None = None
    direction: str = "falling"
    reset: Callable | None = None
    enabled: Callable | None = None
    schedule: Callable | None = None
    domain: bool = True


@dataclasses.dataclass(frozen=True)
class Start:
    """A guess: a chart, a state, a time, and how good it is."""

    chart: str
    state: tuple
    time: float = 0.0
    kind: str = "good"


@dataclasses.dataclass(frozen=True)
class Model:
    """One model of the campaign.

    `charts` maps a name to (names of states, field). `clock` is a function of the parameters that
    returns the period of the drive, or None. `section` names the event at which the return map is
    taken, None leaves it to the package. `search` holds further arguments of the search. `stiff`
    asks the independent simulation for an implicit method. `truth` says in words what is there.
    """

    name: str
    source: str
    charts: dict
    guesses: tuple
    events: tuple = ()
    parameters: dict = dataclasses.field(default_factory=dict)
    clock: Callable | None = None
    section: str | None = None
    search: dict = dataclasses.field(default_factory=dict)
    stiff: bool = False
    truth: str = "one stable cycle"


def around(chart: str, state: tuple, time: float = 0.0) -> tuple:
    """Seven guesses from one good state: from good to far away."""
    factors = (
        (1.0, "good"),
        (1.1, "fair"),
        (0.5, "poor"),
        (3.0, "poor"),
        (-1.0, "mirrored"),
        (1e3, "1e3 times too large"),
        (1e-6, "close to zero"),
    )
    return tuple(
        Start(chart, tuple(factor * x for x in state), time, kind)
        for factor, kind in factors
    )
