"""Checks of sections that were located on a limit cycle.

`locate.py` calls `check_placed`, which raises a `ComputationError` for the first section that the
cycle misses, touches, crosses twice or meets in another order. The text of the error has the values
at which the section would be crossed once (`_remedy`). A *level* is a function that falls through
zero at its section.

The order of the tests must stay: later ones take for granted what earlier ones have tested. If a
good section is refused, look at the constants, and at the function that `check_placed` calls for
this error; if the remedy names wrong values, at `_met`; if a section that is crossed twice is
accepted, at `_levels_along`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._core.compilation import at_ease
from .._core.executor import (
    to_host,
)
from .._core.results import Result
from ..engine.cubic import interpolate
from ..engine.lanes import IDLE, Tape
from ..engine.replay import Moves, recorded_moves
from ..engine.target import AbstractLevels
from ..engine.watch import slopes
from ..errors import ComputationError
from ..orbits.coincidence import SAME
from ..orbits.crossing import Crossing, ListLevels
from ..orbits.cycle import LimitCycle
from ..systems.structure import Structure
from ..systems.transition import at_one_time
from . import families
from .along import levels_at
from .placed import PlacedSections, followed_at_once


# Number of parts of each step in which further crossings of a section are looked for. Fewer: two
# crossings that are close are missed. More: the check takes longer.
_PARTS_OF_A_STEP = 16


# A section is tangent to the cycle if the rate of its level at the crossing is below this part of
# its largest rate on the cycle. Smaller: crossings that a small perturbation removes are accepted.
# Larger: sections at a small angle are rejected.
_LEAST_STEEPNESS = 1e-4


_AGAIN = "is crossed more than once in one period"


class OutOfOrderError(ComputationError):
    """Raised for sections that the cycle meets in another order than the given one. `phases` (N,):
    time from section 0 to each section, within one period."""

    def __init__(self, text: str, phases: Float[np.ndarray, " N"]):
        super().__init__(text)
        self.phases = phases


def check_placed(placed: PlacedSections, first: int) -> None:
    """**Raises:** `ComputationError` for the first section that is missed, tangent, out of order,
    crossed twice, or by the clock at the time of an event. `first`: the `Result` of the flow to
    section 0."""
    _require_reached(placed, [first, *np.asarray(placed.result).tolist()])
    name = placed.family.describe
    anchor = placed.family.anchor
    if isinstance(anchor, Crossing) and len(_met(placed, 0).places) > 1:
        raise ComputationError(
            f"{name(0)} lies at {anchor}, which {_AGAIN}{_remedy(placed, 0)}"
        )
    moving = np.flatnonzero(np.asarray(placed.normal)[:, 0])
    if not placed.cycle.clocked and len(moving):
        raise ComputationError(
            f"{name(int(moving[0]))} depends on time, which has no meaning on the cycle of an "
            "autonomous system: use a function of the state, or ClockPhase."
        )
    _require_order(placed)
    assert placed.tape is not None
    events = np.sum(np.asarray(placed.tape.code) >= 0)
    # (If a section is an event, rounding decides whether this event counts twice or not at all in
    # one period.)
    if events != len(placed.cycle.event_sequence):
        raise ComputationError(
            "a section coincides with an event (move it, or use `AtEvent`), or there were too few "
            "steps (find the cycle with `settings=Settings(max_steps=...)`)."
        )
    for i, (count, steepness) in enumerate(zip(*_crossings(placed), strict=True)):
        if steepness < _LEAST_STEEPNESS:
            raise ComputationError(
                f"{name(i)} is tangent to the cycle: its level changes there at "
                f"{steepness:.1g} of its fastest rate. Choose another level."
            )
        if count > 1:
            raise ComputationError(f"{name(i)} {_AGAIN}{_remedy(placed, i)}")


def _require_reached(placed: PlacedSections, results: list[int]) -> None:
    """**Raises:** `ComputationError` for the first result that is not OK: of the flow to section 0,
    and from each section to the next."""
    N = placed.n_sections
    name = placed.family.describe
    anchor = placed.family.anchor
    if isinstance(placed.family, families.KinematicPhase) and any(results):
        _require_turns(placed.family, placed.cycle)
    for i, code in enumerate(results):
        if code == Result.OK:
            continue
        if code == Result.SIMULTANEOUS:
            raise ComputationError(
                f"{name(i - 1)} coincides with an event: move the sections, or use `AtEvent`."
            )
        if code == Result.EVENT_ORDER:
            raise ComputationError(_about_next_event(placed, i - 1))
        if i:
            what = f"{name(i % N)} is not reached from section {i - 1} on the cycle"
        else:
            place = f" at its anchor, {anchor}" if isinstance(anchor, Crossing) else ""
            what = f"the cycle does not reach {name(0)}{place}"
        hint = "."
        if code == Result.SECTION_MISSED:
            hint = _remedy(placed, i % N)
        if code == Result.STEP_LIMIT:
            hint = ". Give them to the search for the cycle, or place more sections."
        raise ComputationError(f"{what}: {Result(code).message}{hint}")


def _about_next_event(placed: PlacedSections, i: int) -> str:
    """A sentence for the error: section i lies at an event that another event follows at once."""
    cycle = to_host(placed.cycle)
    s = cycle.structure
    lanes, event = to_host((placed.lanes, placed.bound.event))
    still = np.zeros((s.nu, 1))
    missed = followed_at_once(s, lanes, still, event >= 0, cycle.period)
    name = s.transitions[int(missed[i])].name
    return (
        f"the event '{name}' coincides with {placed.family.describe(i)}, so that it may or may not "
        "belong to the flow from there: take a section after the last of these events."
    )


def _require_order(placed: PlacedSections) -> None:
    """**Raises:** `ComputationError` for sections that are met twice in a round, at the same time,
    or in another order."""
    N = placed.n_sections
    name = placed.family.describe
    period = float(placed.cycle.period)
    duration = np.asarray(placed.duration)
    rounds = float(duration.sum()) / period
    if rounds < 1 - SAME:
        raise ComputationError(f"{name(0)} {_AGAIN}{_remedy(placed, 0)}")
    whole = period * np.rint(duration / period)
    nearest = int(np.argmin(np.abs(duration - whole)))
    i, j = sorted((nearest, (nearest + 1) % N))
    if i < j and at_one_time(duration[nearest], whole[nearest], period):
        raise ComputationError(
            f"{name(j)} coincides with section {i} on the cycle: leave one out."
        )
    if rounds > 1 + SAME:
        late = int(np.argmax(duration))
        begins = np.concatenate([[0.0], np.cumsum(duration)[:-1]])
        raise OutOfOrderError(
            f"the sections are out of order: {name((late + 1) % N)} comes before section {late} on "
            f"the cycle, so that one round of all sections takes {rounds:.3g} periods.",
            begins % period,
        )


class _Met(NamedTuple):
    """Where the level of a section falls on its cycle, in parts of the steps."""

    section: Crossing | None
    """The section, if it is a `Crossing`."""
    high: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    """The level at the beginning and the end of each part."""
    places: list[str]
    """Times and charts of the parts in which the section is crossed."""


def _met(placed: PlacedSections, i: int) -> _Met:
    """Where the level of section i falls."""
    cycle = placed.cycle
    N = placed.n_sections
    levels = placed.bound.levels
    items = getattr(placed.family, "items", (placed.family.anchor,))
    item = items[i] if i < len(items) else None
    section = item if isinstance(item, Crossing) else None
    if section is not None:
        i = 0
        N = 1
        levels = ListLevels((section,))
    s = cycle.structure
    t, chart, q = cycle.trajectory().dense()
    level = levels_at(s, levels, N, t, chart, q.T)[0, i]
    level[-1] = level[0]  # (the same point, but for rounding)
    has_duration = np.diff(t) > 0
    falls = np.flatnonzero((np.diff(level) < 0) & has_duration)
    high = level[falls]
    low = level[falls + 1]
    crossed = falls[(high > 0) & (low <= 0)]
    places = [f"t = {t[k]:.3g} in {s.names[chart[k]]}" for k in crossed]
    return _Met(
        section=section,
        high=high,
        low=low,
        places=places,
    )


def _remedy(placed: PlacedSections, i: int) -> str:
    """Sentences for the error: where the cycle crosses section i, which values the function of a
    `Crossing` takes in the crossing's direction, and what to change."""
    section, high, low, places = _met(placed, i)
    hint = f", at {' and '.join(places)}" if places else ""
    if section is None:
        return (
            f"{hint}. Choose a phase that rises through each section once in a period."
        )
    span = "nowhere"
    if len(high):
        sign = 1 if section.direction == "falling" else -1
        first, last = (float(section.value) + sign * x for x in (high.max(), low.min()))
        span = f"from {first:.4g} to {last:.4g}"
    return (
        f"{hint}. Values of {section} on the cycle: {span}; choose another function, `value`, "
        "`direction` or `charts`, not at an event."
    )


def _require_turns(phase: families.KinematicPhase, cycle: LimitCycle) -> None:
    """**Raises:** `ComputationError` for an orbit that does not turn about the center."""
    names = phase.position, phase.velocity
    center = (0.0, 0.0) if phase.center is None else tuple(phase.center.tolist())
    p, v = (x[~np.isnan(x)] for x in cycle.trajectory()(*names)[1:])
    height = v - center[1]
    width = p - center[0]
    angle = np.unwrap(np.arctan2(height, width))
    if abs(angle[-1] - angle[0]) < np.pi:
        raise ComputationError(
            f"the orbit does not turn about the `center` {center} of the KinematicPhase: it has "
            f"{names[0]} from {p.min():.4g} to {p.max():.4g} and {names[1]} from {v.min():.4g} to "
            f"{v.max():.4g}. Give a `center` inside of it, or another `position` and `velocity`."
        )


def _crossings(placed: PlacedSections) -> tuple[np.ndarray, np.ndarray]:
    """The number of crossings of each section in one period, and their steepness: the rate of a
    level on its section as a fraction of its fastest rate on the cycle."""
    event = np.asarray(placed.bound.event)
    levels = placed.bound.levels
    counts = np.array(
        [placed.cycle.event_sequence.count(g) if g >= 0 else 1 for g in event]
    )
    steepness = np.ones(placed.n_sections)
    if levels is None:
        return counts, steepness
    with at_ease():
        more, fastest, rate = _levels_along(to_host(placed), levels)
    state_based = np.isinf(np.asarray(placed.bound.time)) & (event < 0)
    counts = np.where(state_based, 1 + more, counts)
    np.divide(np.abs(rate), fastest, out=steepness, where=state_based)
    return counts, steepness


def _levels_along(placed: PlacedSections, levels: AbstractLevels):
    """For each section: the number of further crossings by the steps of the cycle, the largest rate
    of its level, and the rate of its level on the section."""
    s = placed.structure()
    N = placed.n_sections
    lanes = placed.lanes
    assert placed.tape is not None
    moves = recorded_moves(lanes, placed.tape)
    value, rate = levels_at(s, levels, N, *_along_steps(s, moves, placed.tape))
    level = value.reshape(N, -1, len(moves.t))
    above = level[:, :-1] > 0
    at_or_below = level[:, 1:] <= 0
    crosses = above & at_or_below
    falls = crosses & (moves.h > 0)

    # At the section itself, signs are rounding errors.
    begins_at = np.where(moves.order == 0, moves.lane, -1)
    is_itself = np.arange(N)[:, None] == begins_at
    falls[:, 0] &= ~is_itself
    falls[:, -1] &= ~np.roll(is_itself, -1, axis=1)

    no_input = np.zeros((s.nu, 1))
    field = slopes(s, lanes.t, lanes.chart, lanes.q, no_input)
    by_time = placed.normal[:, 0]
    by_state = placed.normal[:, 1:]
    on_section = by_time + np.sum(by_state * field.T, axis=1)
    count = np.sum(falls, axis=(1, 2))
    fastest = np.max(np.nan_to_num(np.abs(rate)), axis=1)
    return count, fastest, on_section


def _along_steps(s: Structure, moves: Moves, tape: Tape):
    """Times, charts and states at several points of every step, by its cubic interpolant. The first
    point of each step is its beginning."""
    still = np.zeros((s.nu, 1))
    is_move = tape.code.T != IDLE
    end = tape.before.transpose(2, 0, 1)[is_move].T
    rate_at_start = slopes(s, moves.t, moves.chart, moves.q, still)
    rate_at_end = slopes(s, moves.t + moves.h, moves.chart, end, still)
    part = np.linspace(0.0, 1.0, _PARTS_OF_A_STEP + 1)[:, None]
    states = interpolate(
        part,
        moves.h,
        moves.q[:, None],
        end[:, None],
        rate_at_start[:, None],
        rate_at_end[:, None],
    )
    times = moves.t + moves.h * part
    charts = np.tile(moves.chart, len(part))
    return times.ravel(), charts, states.reshape(s.d, -1)
