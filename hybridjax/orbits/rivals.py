"""Find events of a *turn* (the flow once around the cycle) that happen at the same time.

For each event, `rivals_of` returns a *rival*: a transition that nearby trajectories may meet before
this event, or instead of it. All code that asks whether events coincide uses this rule: searches,
sweeps and programs. Outside of programs, `coincidence.commutes` then compares the orders in which
rivals may happen. A further cause of a rival is added in `rivals_of`, which must not ask for values
of its arrays, since JAX traces it, too.

If a cycle is refused because events coincide, and they do not, look at `rivals_of` (its three
causes) and at `at_one_time`; if an event at the beginning of the turn is overlooked, at
`_after_beginning`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, namespace, on_host, stop_gradient, to_host
from ..engine.lanes import Tape
from ..systems.structure import Structure
from ..systems.transition import Scheduled, at_one_time
from .return_map import ReturnMap, Turn


class Events(NamedTuple):
    """The events of a turn in the order of their times. For many turns side by side, the last axis
    has the turns."""

    codes: Int[Array, "E *S"]
    """Transitions, by index; negative for none, as after the last event."""
    times: Float[Array, "E *S"]
    at_once: Bool[Array, "E *S"]
    rivals: Int[Array, "E *S"]
    """Rivals on the `Tape`. (`at_once` is also as on the `Tape`.)"""


def events_on(map: ReturnMap, tape: Tape) -> Events:
    """The events on the tape of a turn (or of turns side by side), without the event with which the
    turn begins."""

    def by_row(x):
        return stop_gradient(x.reshape(-1, *map.expected.shape))

    rows = Events(
        codes=by_row(tape.code),
        times=by_row(tape.t),
        at_once=by_row(tape.at_once),
        rivals=by_row(tape.rival),
    )
    if on_host(rows.codes):  # (most rows are moves without an event)
        codes = rows.codes.reshape(len(rows.codes), -1)
        happens = (codes >= 0).any(axis=1)
        rows = Events(*(x[happens] for x in rows))
    xp = namespace(rows.codes)
    last = xp.where(rows.codes >= 0, rows.times, xp.inf)
    order = xp.argsort(last, axis=0, stable=True)
    in_order = Events(*(xp.take_along_axis(x, order, axis=0) for x in rows))
    return _after_beginning(map, in_order, map.each(map.anchor.t))


def _after_beginning(map: ReturnMap, events: Events, begin) -> Events:
    """The events of a turn, preceded by the event with which it begins, if there is one. `begin`:
    times of beginnings."""
    if map.event < 0:
        return events
    xp = namespace(events.times)
    first = map.event, begin, False, -1
    columns = []
    for value, column in zip(first, events, strict=True):
        head = xp.full_like(column[:1], value)
        columns.append(xp.concatenate([head, column]))
    return Events(*columns)


def rivals_of(s: Structure, events: Events, period: Array) -> Int[Array, "E *S"]:
    """For each event of turns, a transition that a trajectory near the turn may meet before this
    event, or instead; -1 for none.

    The rival of an event is the event before it, if that happens at the same time; or a guard that
    is zero at the event, too (see `Tape.rival`); or a scheduled event that is due and does not
    happen. Two scheduled events are no rivals: they happen in the same order on all trajectories.
    """
    xp = namespace(events.times)
    codes = events.codes
    happens = codes >= 0
    times = xp.where(happens, events.times, 0.0)
    is_schedule = np.append(s.clocks >= 0, False)  # (the last one is for no event)
    event_or_none = xp.maximum(codes, -1)
    by_clock = xp.asarray(is_schedule)[event_or_none]

    both_happen = happens[1:] & happens[:-1]
    both_by_clock = by_clock[1:] & by_clock[:-1]
    close = at_one_time(times[1:], times[:-1], period)
    close = close & both_happen & ~both_by_clock
    first_follows_none = xp.zeros_like(happens[:1])
    follows = xp.concatenate([first_follows_none, close])
    before = xp.concatenate([codes[:1], codes[:-1]])
    recorded = xp.maximum(events.rivals, -1)
    rivals = xp.where(follows, before, recorded)

    for g in np.flatnonzero(s.clocks >= 0).tolist():
        missed = ~by_clock & is_due(s, g, codes, times, period)
        has_none = rivals < 0
        rivals = xp.where(missed & has_none, np.int32(g), rivals)
    return xp.where(happens, rivals, -1)


def is_due(s: Structure, g: int, codes, times, period) -> Bool[Array, "E *S"]:
    """Test whether a scheduled event is due at an event that leaves or enters its chart."""
    schedule = s.transitions[g].guard
    assert isinstance(schedule, Scheduled)
    source = s.transitions[g].source
    touches = [source in (x.source, x.target) for x in s.transitions]
    touches = np.array([*touches, False])  # (the last one is for no event)
    xp = namespace(times)
    within = xp.asarray(touches)[xp.maximum(codes, -1)]
    due = at_one_time(schedule.nearest(times), times, period)
    return within & due


def coincide(s: Structure, events: Events, period: Array) -> Bool[Array, "*S"]:
    """Test whether events of turns coincide, so that nearby trajectories may meet them in another
    order."""
    return (rivals_of(s, events, period) >= 0).any(axis=0)


def coincide_on(
    map: ReturnMap, sequence: tuple[int, ...], ends: Float[Array, "L *S"], begin, end
) -> Bool[Array, "E *S"]:
    """Test which events have a rival, for turns that follow an itinerary.

    **Arguments:** `ends`: of legs, in the order of the events. `begin`, `end`: times of the turns.
    """
    xp = namespace(ends)
    times = ends[: len(sequence)]
    codes = np.array(sequence, np.int32)
    each_turn = (1,) * (times.ndim - 1)
    codes = codes.reshape(-1, *each_turn)
    codes = xp.broadcast_to(codes, times.shape)
    no = xp.zeros_like(times, bool)
    events = Events(
        codes=codes,
        times=times,
        at_once=no,
        rivals=xp.full_like(codes, -1),
    )
    events = _after_beginning(map, events, begin)
    return rivals_of(map.structure, events, end - begin) >= 0


def coincident(map: ReturnMap, turn: Turn) -> tuple[int, int] | None:
    """Two transitions of a turn, by index, that are due at the same time: one that happens, and
    another one, which may not happen. None if there are none."""
    # (JAX would compile a program for each operation.)
    map, tapes, period = to_host((map, turn.tapes, turn.period))
    events = events_on(map, tapes)
    rivals = rivals_of(map.structure, events, period)
    before = None
    for code, rival in zip(events.codes.tolist(), rivals.tolist(), strict=True):
        if rival >= 0:
            return (rival, code) if rival == before else (code, rival)
        before = code
    return None


def meet(map: ReturnMap, tape: Tape, period: Array) -> Bool[Array, ""]:
    """Test whether two events of a turn coincide, in programs, where orders are not compared. (An
    event at once is no rival: it follows the event before it on all trajectories.)"""
    events = events_on(map, tape)
    rivals = rivals_of(map.structure, events, stop_gradient(period))
    return ((rivals >= 0) & ~events.at_once).any()
