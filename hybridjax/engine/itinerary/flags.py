"""Flags: whether a trajectory still follows its itinerary.

A program cannot search again. It compares the trajectory with the recorded one, and reports in
`Flags.left` if one of these tests was ever true:

| where | the itinerary is left if | tested in |
|---|---|---|
| first row of a leg | a function is not positive that was | `_differs_at_begin` |
| | another guard is due at once than before, or none | `_differs_at_once` |
| later rows | a function has fallen through zero, even if it came back | `_falls_within` |
| last rows of a leg | its guard or level does not fall through zero | `_misses_target` |
| event | another event may come first | `has_rival` |
| | its predicate does not hold | `Bodies._jumping` |
| any | a leg ends before it begins, or a scheduled event was due | `_arrived`, `_has_tick` |

(The last three are in `bodies.py`.) A guard is *due at once* if its event happens at the time of
the event before: see `engine.events.rearm`, which is the same rule in a search. If a trajectory
leaves without need, find out which test is true; `Plan.code` in `orbits/repeat.py` turns the flags
into a `Result`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ...systems.structure import Structure
from ...systems.transition import SAME_TIME, TOGETHER
from ..arrays import Array
from ..cubic import dips
from ..events import Entry
from ..settings import ROUNDING
from ..target import AbstractLevels
from .rows import Form
from .table import Row
from .watched import Watched, watched_values


class Flags(NamedTuple):
    """How well a trajectory follows its itinerary. Flags have no derivatives."""

    before: Watched
    """Watched functions where the last row began."""
    entry: Entry
    """Guards of the chart that the last jump has entered, compared with the chart before."""
    error: Float[Array, ""]
    """Largest estimated error of a step so far, relative to what is allowed."""
    last: Float[Array, ""]
    """Largest last correction of the time of an event."""
    left: Bool[Array, ""]
    """Whether the itinerary was left."""


class Jumping(NamedTuple):
    """Notes of a jump while it happens."""

    due: Bool[Array, " G"]
    """Guards that are due at once where the last jump has led."""
    entry: Entry
    disabled: Bool[Array, ""]
    """Whether the event's predicate does not hold."""


# Where a row begins.


def flags_at_row(
    form: Form, s: Structure, row: Row, flags: Flags, now: Watched, duration
) -> tuple[Flags, Bool[Array, " G"]]:
    """The flags after a comparison with the recorded signs of a row, and the guards that are due at
    once.

    **Arguments:** `now`: watched functions where the row begins. `duration`: of the leg.
    """
    due = _is_due(flags, now, duration)
    due = due & _is_guard(form, s, row)
    has_left = (
        _differs_at_begin(row, flags.before, now)
        | _differs_at_once(form, s, row, due)
        | _falls_within(row, flags.before, now)
        | _misses_target(row, flags.before, now)
    )
    # (Where a reset puts the state on a guard, rounding gives this guard a sign. It does not fall
    # through its zero there, as it did not on the recorded trajectory.)
    at_zero = jnp.abs(now.value) <= _rounding(now, duration)
    on_guard = (row.signs == 0) & at_zero
    before = now._replace(value=jnp.where(on_guard, 0.0, now.value))
    return flags._replace(before=before, left=flags.left | has_left), due


def _is_guard(form: Form, s: Structure, row: Row) -> Bool[Array, " G"]:
    """Whether watched functions are guards of the row's chart."""
    counts = [len(s.guards(a)) for a in form.charts]
    return jnp.arange(form.watched) < jnp.asarray(counts)[row.chart]


def _rounding(now: Watched, duration) -> Float[Array, " G"]:
    """Changes of watched functions during the rounding error of a time."""
    return SAME_TIME * duration * jnp.abs(now.rate)


def _is_due(flags: Flags, now: Watched, duration) -> Bool[Array, " G"]:
    """Test whether guards below zero are due at once where a jump has led: those that fall and are
    new in this chart, or that were still to fall in the chart before."""
    entry = flags.entry
    begins = flags.before.is_unknown
    falls = now.rate < 0
    beyond = now.value < -_rounding(now, duration)
    is_new = falls & ~entry.known
    was_to_fall = entry.armed & (falls | beyond)
    crossed = is_new | was_to_fall
    return begins & (now.value < 0) & crossed & now.enabled


def _differs_at_once(
    form: Form, s: Structure, row: Row, due: Bool[Array, " G"]
) -> Bool[Array, ""]:
    """Test whether a guard is due at once in a row that is no jump at once, or the guard of such a
    row is not. (Scheduled events have no guard.)"""
    is_new = due.any() & ~row.at_once
    if not due.size:
        return is_new
    is_lost = row.at_once & ~row.scheduled & ~due[_place_of_guard(form, s, row)]
    return is_new | is_lost


def _place_of_guard(form: Form, s: Structure, row: Row) -> Int[Array, ""]:
    """The place of a jump's guard among the watched functions of its chart."""
    places = []
    for kind in form.kinds:
        source = s.transitions[kind[0]].source
        guards = s.guards(s.chart_index(source))
        places.append([guards.index(g) if g in guards else 0 for g in kind])
    # (The last line is for rows that are no jump.)
    places.append([0])
    longest = max(map(len, places))
    table = [x + [0] * (longest - len(x)) for x in places]
    return jnp.asarray(table)[row.kind, row.place]


def _compared(row: Row) -> Bool[Array, " G"]:
    """Whether watched functions have a recorded sign, and do not end the leg."""
    is_target = jnp.arange(len(row.signs)) == row.target
    return (row.signs != 0) & ~is_target


def _differs_at_begin(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether a leg begins where functions have other signs than recorded. One that was
    negative may have risen sooner, except at an event at once."""
    must_agree = _compared(row) & ((row.signs > 0) | row.at_once)
    # (Comparisons with NaN are false.)
    agrees = jnp.sign(now.value) * row.signs > 0
    return (before.is_unknown & must_agree & ~agrees).any()


def _falls_within(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether a function has fallen through zero since the row before, even if it came back.
    It may rise sooner or later than recorded, and a fall is no event where its predicate does not
    hold."""
    h = now.t - before.t
    is_positive = now.value > 0
    falls = (before.value > 0) & ~is_positive
    enabled = before.enabled | now.enabled | now.enabled_at_zero
    sign = jnp.sign(now.value)
    values = sign * before.value, sign * now.value
    slopes = h * sign * before.rate, h * sign * now.rate
    comes_back = dips(*values, *slopes)
    is_lost = ~jnp.isfinite(now.value)
    left = (falls & enabled) | comes_back | is_lost
    return (_compared(row) & ~before.is_unknown & left).any()


def _misses_target(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether the function at whose zero a leg ends was not positive, or does not fall. (The
    row of its first correction has its sign in the row before.)"""
    if not now.value.size:
        return jnp.asarray(False)
    ends_at_zero = row.target >= 0
    was_positive = (before.value[row.target] > 0) | (row.signs[row.target] <= 0)
    falls = now.rate[row.target] < 0
    return ends_at_zero & ~(was_positive & falls)


# Events.


def has_rival(row: Row, begin, now: Watched) -> Bool[Array, ""]:
    """Test whether another function falls to zero where an event happens, so that it may come first
    (see `Tape.rival`).

    **Arguments:** `begin`: time at which the leg began.
    """
    is_target = jnp.arange(len(row.signs)) == row.target
    other = (row.signs > 0) & ~is_target
    duration = now.t - begin
    close = TOGETHER * duration * jnp.abs(now.rate)
    falls = (now.rate < 0) & (now.value <= close)
    return (other & falls & now.enabled).any()


def entry_at_departure(width: int) -> Entry:
    """The guards where a trajectory begins: as if all had been known and had fallen, so that none
    is due at once."""
    none = jnp.zeros(width, bool)
    return Entry(known=~none, armed=none)


def entry_of_jump(
    s: Structure,
    a: int,
    b: int,
    levels: AbstractLevels | None,
    row: Row,
    t,
    q: Float[Array, " n"],
    pending: Bool[Array, " G"],
) -> Entry:
    """The guards of chart b, from where a jump of chart a leads there. A guard of b is known if one
    of a has the same value before the jump, but for rounding.

    **Arguments:** `q`: the state before the jump. `pending`: guards of chart a that were still to
    fall, besides that of the jump.
    """
    width = len(pending)
    if a == b:
        return Entry(known=jnp.ones(width, bool), armed=pending)
    have_guards = s.guards(a) and s.guards(b)
    if s.dims[a] != s.dims[b] or not have_guards:
        none = jnp.zeros(width, bool)
        return Entry(known=none, armed=none)

    def guards(chart, q):
        no_input = jnp.zeros(s.nu)
        values = watched_values(s, chart, levels, row, t, q, no_input)
        return values[: len(s.guards(chart))]

    of_a = guards(a, q)
    of_b = guards(b, q)
    slopes = jax.jacfwd(guards, 1)(b, q)
    terms = jnp.abs(slopes) @ jnp.abs(q)
    noise = ROUNDING * (terms + jnp.abs(of_b))
    apart = jnp.abs(of_b[:, None] - of_a)
    equal = apart <= noise[:, None]
    known = equal.any(axis=1)
    armed = (equal & pending[: len(of_a)]).any(axis=1)
    more = (0, width - len(of_b))
    return Entry(known=jnp.pad(known, more), armed=jnp.pad(armed, more))


def without_level(row: Row, before: Watched) -> Watched:
    """Watched functions on a section: nothing is known of the level of the next section. (Charts
    without a level have no such row: nothing is set.)"""
    value = before.value
    if value.size:
        value = value.at[row.target].set(jnp.inf, mode="drop")
    return before._replace(value=value)
