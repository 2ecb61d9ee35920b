"""Flags: how well a trajectory follows its itinerary, by its watched functions."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from ...systems.structure import Structure
from ...systems.transition import SAME_TIME, TOGETHER
from ..arrays import Array
from ..settings import ROUNDING
from ..target import AbstractLevels
from .rows import Form
from .table import Row


class Flags(NamedTuple):
    """How well a trajectory follows its itinerary. Flags have no derivatives."""

    before: "Watched"
    """Watched functions where the last row began, and since then."""
    entry: "Entry"
    """Guards of the chart that the last jump has entered, in the chart before."""
    error: Float[Array, ""]
    """Largest estimated error of a step so far, relative to what is allowed."""
    last: Float[Array, ""]
    """Largest last correction of the time of an event."""
    left: Bool[Array, ""]
    """Whether the itinerary was left: a watched function has passed zero where it should not."""


class Watched(NamedTuple):
    """The watched functions of a chart, and their rates along the flow, at a time."""

    t: Float[Array, ""]
    value: Float[Array, " G"]
    rate: Float[Array, " G"]
    enabled: Bool[Array, " G"] | bool = True
    """Whether their events are enabled."""
    enabled_at_zero: Bool[Array, " G"] | bool = False
    """Whether they were where the functions fell through zero, since the time before."""
    q: Float[Array, " d"] | None = None
    """The state."""

    @classmethod
    def unknown(
        cls, t: Float[Array, ""], width: int, q: Float[Array, " d"]
    ) -> "Watched":
        """Watched functions of which nothing is known, of a state."""
        far = jnp.full(width, jnp.inf)
        enabled = jnp.ones(width, bool)
        return cls(t, far, jnp.ones(width), enabled, ~enabled, q)


class Entry(NamedTuple):
    """Guards of a chart that a jump enters, as far as the chart before has them, too."""

    known: Bool[Array, " G"]
    """Whether it has this guard: it is the same chart, or has one of the same value."""
    armed: Bool[Array, " G"]
    """Whether that guard was still to fall."""

    @classmethod
    def departure(cls, width: int) -> "Entry":
        """That of the beginning of a trajectory: no guard is due there."""
        nothing = jnp.zeros(width, bool)
        return cls(known=~nothing, armed=nothing)

    @classmethod
    def unknown(cls, width: int) -> "Entry":
        """That of a chart whose guards the chart before has not."""
        nothing = jnp.zeros(width, bool)
        return cls(known=nothing, armed=nothing)


class Jumping(NamedTuple):
    """What is noted of a jump while it happens."""

    due: Bool[Array, " G"]
    """Guards whose events happen at once where the last jump has led."""
    entry: Entry
    disabled: Bool[Array, ""]
    """Whether the event's predicate does not hold."""


def watched(
    s: Structure, a: int, levels: AbstractLevels | None, row: Row, t, q, u
) -> Float[Array, " g"]:
    """The watched functions of chart a: its guards, and the level of the row's section."""
    from ..kernels import watched_at

    kinds = s.guard_kinds(a)
    return watched_at(a, kinds, s, levels, t, q, u, row.section)


def count_watched(s: Structure, a: int, levels: AbstractLevels | None) -> int:
    has_level = levels is not None and levels.present(s, a)
    return len(s.guards(a)) + has_level


def noted(
    form: Form, s: Structure, row: Row, flags: Flags, now: Watched, duration
) -> tuple[Flags, Bool[Array, " G"]]:
    """The flags at a row, where watched functions have these values, and the guards that are due
    there. `duration`: of the leg."""
    counts = [len(s.guards(a)) for a in form.charts]
    guards = jnp.asarray(counts)[row.chart]
    is_guard = jnp.arange(form.watched) < guards
    due = is_guard & _is_due(flags, now, duration)
    is_new = due.any() & ~row.at_once
    lost = row.at_once & ~row.scheduled
    if due.size:
        lost = lost & ~due[_fired(form, s, row)]
    has_left = _has_left(row, flags.before, now)
    left = flags.left | is_new | lost | has_left
    # (Where a reset puts the state on a guard, rounding gives this guard a sign. It does not fall
    # through its zero there, as it did not on the recorded trajectory.)
    zero = SAME_TIME * duration * jnp.abs(now.rate)
    at_zero = jnp.abs(now.value) <= zero
    on_guard = (row.signs == 0) & at_zero
    value = jnp.where(on_guard, 0.0, now.value)
    before = now._replace(value=value)
    return flags._replace(before=before, left=left), due


def _is_due(flags: Flags, now: Watched, duration) -> Bool[Array, " G"]:
    """Test whether events of guards happen at once where a jump has led (see
    `engine.events.rearm`): of those beyond zero that fall and are new, or were still to fall."""
    entry = flags.entry
    begins = jnp.isinf(flags.before.value)
    falls = now.rate < 0
    beyond = now.value < -SAME_TIME * duration * jnp.abs(now.rate)
    is_new = falls & ~entry.known
    was_to_fall = entry.armed & (falls | beyond)
    crossed = is_new | was_to_fall
    return begins & (now.value < 0) & crossed & now.enabled


def _fired(form: Form, s: Structure, row: Row) -> Int[Array, ""]:
    """The place of the guard of a jump among those of its chart."""
    places = []
    for kind in form.kinds:
        source = s.transitions[kind[0]].source
        guards = s.guards(s.chart_index(source))
        places.append([guards.index(g) if g in guards else 0 for g in kind])
    most = max(map(len, places), default=1)
    table = [x + [0] * (most - len(x)) for x in places]
    # (The last row is for rows that are no jump.)
    table.append([0] * most)
    return jnp.asarray(table)[row.kind, row.place]


def _has_left(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether the itinerary is left between the row before and this one.

    - Where a leg begins, functions that were positive must be positive. One that was negative may
      have risen sooner, except at an event at once.
    - Within a leg, none may fall through zero, also if it comes back; one may rise sooner or later
      than recorded. (A fall is no event where its predicate does not hold.)
    - The one at whose zero the leg ends must have been positive, and must fall.
    """
    places = jnp.arange(len(row.signs))
    known = (row.signs != 0) & (places != row.target)
    begins = jnp.isinf(before.value)
    within = known & ~begins
    signs = jnp.sign(now.value)
    # (Comparisons with NaN are false.)
    as_recorded = signs * row.signs > 0
    compared = known & ((row.signs > 0) | row.at_once)
    other = begins & compared & ~as_recorded
    unknown = within & ~jnp.isfinite(now.value)
    returns = within & dips(before, now, signs)
    was_positive = before.value > 0
    falls = within & was_positive & ~(now.value > 0)
    enabled = before.enabled | now.enabled | now.enabled_at_zero
    happens = falls & enabled
    left = (other | unknown | returns | happens).any()
    return left | _misses(row, before, now)


def _misses(row: Row, before: Watched, now: Watched) -> Bool[Array, ""]:
    """Test whether the function at whose zero a leg ends does not fall to it. (The row of its first
    correction has its sign in the row before.)"""
    if not now.value.size:
        return jnp.asarray(False)
    ends_at_zero = row.target >= 0
    value = before.value[row.target]
    sign = row.signs[row.target]
    was_positive = (value > 0) | (sign <= 0)
    falls = now.rate[row.target] < 0
    return ends_at_zero & ~(was_positive & falls)


def has_rival(row: Row, begin, now: Watched) -> Bool[Array, ""]:
    """Test whether another function falls to zero where an event happens, so that it may come first
    (see `Tape.rival`)."""
    places = jnp.arange(len(row.signs))
    other = (row.signs > 0) & (places != row.target)
    duration = now.t - begin
    close = TOGETHER * duration * jnp.abs(now.rate)
    falls = (now.rate < 0) & (now.value <= close)
    return (other & falls & now.enabled).any()


def entered(
    s: Structure,
    a: int,
    b: int,
    levels: AbstractLevels | None,
    row: Row,
    t,
    q: Float[Array, " n"],
    pending: Bool[Array, " G"],
) -> Entry:
    """The guards of chart b, from where a jump of chart a leads there. `pending`: guards of chart a
    that were still to fall, besides that of the jump.

    A guard of b is known if one of a has the same value before the jump, but for rounding.
    """
    width = len(pending)
    if a == b:
        return Entry(jnp.ones(width, bool), pending)
    have_guards = s.guards(a) and s.guards(b)
    if s.dims[a] != s.dims[b] or not have_guards:
        return Entry.unknown(width)

    def values(chart, q):
        no_input = jnp.zeros(s.nu)
        functions = watched(s, chart, levels, row, t, q, no_input)
        return functions[: len(s.guards(chart))]

    own = values(a, q)
    others = values(b, q)
    slopes = jax.jacfwd(values, 1)(b, q)
    terms = jnp.abs(slopes) @ jnp.abs(q)
    noise = ROUNDING * (terms + jnp.abs(others))
    apart = jnp.abs(others[:, None] - own)
    equal = apart <= noise[:, None]
    still_to_fall = pending[: len(own)]
    known = equal.any(axis=1)
    armed = (equal & still_to_fall).any(axis=1)
    more = (0, width - len(others))
    return Entry(known=jnp.pad(known, more), armed=jnp.pad(armed, more))


def leveled(row: Row, flags: Flags) -> Flags:
    """Flags on a section: of the level of the next one nothing is known. (Charts without a level
    have no such row: nothing is set.)"""
    value = flags.before.value
    if value.size:
        value = value.at[row.target].set(jnp.inf, mode="drop")
    return flags._replace(before=flags.before._replace(value=value))


def still(tree: Any) -> Any:
    return jax.lax.stop_gradient(tree)


def dips(before: Watched, now: Watched, signs) -> Bool[Array, " G"]:
    """Test whether functions with these signs at two times have had the other one in between:
    whether the cubic polynomials with their values and rates have."""
    h = now.t - before.t
    first = signs * before.value
    last = signs * now.value
    slope0 = h * signs * before.rate
    slope1 = h * signs * now.rate
    # The polynomial first + slope0 x + second x^2 + third x^3 of the part x of the time.
    rise = last - first
    third = slope0 + slope1 - 2 * rise
    second = 3 * rise - 2 * slope0 - slope1
    # Its minimum is at the larger root of its derivative.
    discriminant = second**2 - 3 * third * slope0
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    place = -slope0 / (second + root)
    within = (place > 0) & (place < 1)
    bend = second + place * third
    lowest = first + place * (slope0 + place * bend)
    positive = (first > 0) & (last > 0)
    return jax.lax.stop_gradient(positive & within & (lowest < 0))
