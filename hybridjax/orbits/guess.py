"""Where the search for a limit cycle begins: from a guess to a state on the section."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.compilation import host_first
from .._core.executor import from_host, namespace, to_host
from .._core.precision import real
from .._core.progress import say
from .._core.results import Result
from ..engine.lanes import Lanes, start_lanes
from ..engine.move import move
from ..engine.settings import Settings
from ..engine.target import Target, toward, until
from ..engine.watch import slopes, watch
from ..errors import ComputationError, DefinitionError
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem
from .crossing import AtEvent, Crossing, ListLevels
from .scale import stiff_mode


# A guess lies on the section if it would meet it within this part of the time in which the states
# change by their sizes. Doubled, the search begins at guesses that are twice as far from it.
_ON_SECTION = 1e-6


class _Plane(eqx.Module):
    """The hyperplane through a point, across the flow (in sizes of the states)."""

    point: Array
    normal: Array

    def __call__(self, t, q):
        return jnp.dot(q - self.point, self.normal)


class Beginning(NamedTuple):
    """Where Newton's method begins."""

    anchor: Lanes
    """The lane there."""
    base: Crossing | AtEvent | None
    """The section on which it lies; `None` for a clocked system."""
    expected: Float[Array, ""]
    """The period to be expected."""


def own_guess(system: HybridSystem) -> Guess:
    """The guess that a model knows.

    **Raises:** `DefinitionError` if it knows none.
    """
    guess = system.guess()
    if guess is None:
        raise DefinitionError(
            f"{type(system).__name__} has no guess of its own: pass `guess=Guess(chart, state)`."
        )
    return guess


def guessed_lane(system: HybridSystem, guess: Guess) -> Lanes:
    """The lane at a guess.

    **Raises:** `DefinitionError` if it does not fit the system.
    """
    s = Structure(system)
    a = s.chart_index(guess.chart)
    if guess.state.shape != (s.dims[a],):
        raise DefinitionError(
            f"the guess must give values for the {s.dims[a]} states "
            f"{', '.join(s.charts[a].states)} of chart '{guess.chart}'; got {guess.state}."
        )
    if guess.after is not None:
        event = s.transitions[s.transition_index(guess.after)]
        if event.target != guess.chart:
            raise DefinitionError(
                f"the guess is in chart '{guess.chart}', but the event '{event.name}', after which "
                f"it is said to be, leads to chart '{event.target}'."
            )
    q = np.zeros((s.d, 1))
    q[: s.dims[a], 0] = guess.state
    return from_host(start_lanes(s, np.array([guess.time]), np.array([a], np.int32), q))


def check_section(s: Structure, section: Crossing | AtEvent | None) -> None:
    """**Raises:** `DefinitionError` for a section that the system does not have, or any section of
    a clocked system."""
    if section is None:
        return
    if s.system.period() is not None:
        raise DefinitionError(
            "a clocked system returns to itself after its clock's period: leave out `section` "
            "(sections of any kind are for linearize and run_experiments)."
        )
    section.check(s)


def begin(
    system: HybridSystem,
    lanes: Lanes,
    after: str | None,
    section: Crossing | AtEvent | None,
    multiplicity: int,
    settle: float,
    max_period: float,
    settings: Settings,
    time: float,
) -> Beginning:
    """From a guess to a state on the section, and the period to be expected. `after` is the event
    that led to the guess, if one did; `time` is that in which the states change by their sizes
    there.

    **Raises:** `ComputationError` where the flow does not lead there, or nothing moves.
    """
    s, period = Structure(system), system.period()
    if settle:
        say("settling")
        wait = float(settle) if period is None else np.ceil(settle / period) * float(period)
        end = np.asarray(lanes.t) + wait
        moved = _go(system, lanes, None, toward(end, -1, end), settings)
        _require(moved, "settling", s)
        lanes = moved.lanes
        if period is not None:
            back = real(np.asarray(lanes.t) - wait)
            lanes = eqx.tree_at(lambda x: x.t, lanes, back)
    if period is not None:
        return Beginning(lanes, None, real(multiplicity * float(period)))
    a = int(np.asarray(lanes.chart)[0])
    q = np.asarray(lanes.q)[: s.dims[a], 0]
    f, level, rate = jax.device_get(_at_start(system, lanes, section))
    f = f[: s.dims[a]]
    if not f.any():
        raise ComputationError(
            f"the search starts at an equilibrium of chart '{s.names[a]}', {q}, from where nothing "
            "moves: start elsewhere."
        )
    on_section = rate < 0 and abs(level) <= -_ON_SECTION * time * rate
    if section is None and after is not None:
        section, on_section = AtEvent(after), not settle
    by_default = section is None
    if section is None:
        sizes = np.asarray(settings.scale)[a, : s.dims[a]]
        plane = _Plane(real(q), real(f / sizes**2 / np.linalg.norm(f / sizes)))
        section, on_section = Crossing(plane, "rising", charts=(s.names[a],)), True
    event = s.transition_index(section.name) if isinstance(section, AtEvent) else -1

    def next_meeting(lanes, doing):
        say(doing)
        target = toward(np.full(1, np.inf), event, np.asarray(lanes.t) + max_period)
        moved = _go(system, lanes, section, target, settings)
        where = "through the guess, across the flow" if by_default else str(section)
        advice = _other_section(s) if by_default else ""
        if moved.result[0] == Result.SECTION_MISSED:
            advice += f"Allow more time than {max_period:.3g}, by `max_period`. "
            if rate := stiff_mode(s, a, float(np.asarray(lanes.t)[0]), q):
                advice += (
                    f"The system is stiff: a mode decays in a time of {1 / rate:.2g}; "
                    '`settings=Settings(solver="auto")` waits for the slow ones. '
                )
        _require(moved, f"{doing} ({where})", s, advice)
        return moved.lanes

    if not on_section:
        lanes = next_meeting(lanes, "looking for the section")
    back = lanes
    for _ in range(multiplicity):
        back = next_meeting(back, "looking for the return to the section")
    duration = np.asarray(back.t)[0] - np.asarray(lanes.t)[0]
    return Beginning(lanes, section, real(duration))


@host_first
def _at_start(system, lanes, section):
    """The field (d,), and the value and rate of the section's level, if it has one."""
    s, xp = Structure(system), namespace(lanes.t)
    u = xp.zeros((s.nu, 1))
    f = slopes(s, lanes.t, lanes.chart, lanes.q, u)[:, 0]
    target = _to_section(section, until(lanes.t))
    seen = watch(s, lanes.t, lanes.chart, lanes.q, u, target, xp.ones(1, bool))
    return f, seen.value[-1, 0], seen.rate[-1, 0]


def _other_section(s: Structure) -> str:
    """What to try where the flow does not come back to a section that was chosen by default."""
    events = [transition.name for transition in s.transitions]
    example = f"AtEvent({events[0]!r})" if events else f"Crossing({s.state_names()[0]!r}, 'rising')"
    return f"Say where the cycle is met once in each turn, e.g. `section={example}`. "


def _require(moved, doing: str, s: Structure, advice: str = "") -> None:
    result = Result(int(np.asarray(moved.result)[0]))
    if result != Result.OK:
        lanes = to_host(moved.lanes)
        raise ComputationError(
            f"{doing} failed at t = {float(lanes.t[0]):.6g} in chart "
            f"'{s.names[int(lanes.chart[0])]}': {result.message}. {advice}Check the guess and "
            "the guards with `simulate(..., throw=False)`."
        )


@host_first
def _go(system, lanes, section, target, settings):
    """One lane to a time, or to one section, however many steps it takes."""
    s = Structure(system)
    settings = dataclasses.replace(settings, max_steps=1_000_000)
    u = namespace(lanes.t).zeros((s.nu, 1))
    return move(s, lanes, u, _to_section(section, target), settings)


def _to_section(section, target: Target) -> Target:
    """The target with the section's level, if it has one."""
    if not isinstance(section, Crossing):
        return target
    return dataclasses.replace(target, levels=ListLevels((section,)))
