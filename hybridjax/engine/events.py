"""Events: arming of guards, resets, schedules, and the accumulation of events (Zeno).

Derivatives across an event (saltation) come from `watch.ChartFlow.locate` and `replay.py`.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import cond, namespace, put, some
from .._core.lanes import put_rows
from ..systems.structure import Kind, Member, Structure
from ..systems.transition import SAME_TIME, TOGETHER, Scheduled
from . import kernels
from .arrays import Array, Index, Inputs, Mask, Padded, Times
from .lanes import Lanes, for_each_chart, needed, only
from .settings import ROUNDING
from .watch import Watch


# An instant, as a part of the time allowed: shorter steps are not taken, and a watched function
# counts as zero if its rate would have made its value in an instant. Higher: separate events are
# taken for simultaneous ones. Lower: simultaneous ones for separate ones.
INSTANT = 1e-12
# Events accumulate (Zeno) if this many intervals between them in a row shrink, and the sum of the
# intervals to come (as a geometric series) is at most this part of the sum so far. Higher and
# lower: it is reported later, after more events. Lower and higher: a transient may be taken for it.
_ZENO_STREAK = 10
_ZENO_REST = 1e-3
# A guard that is crossed at a vanishing speed after this many shrinking intervals is Zeno, too.
# Higher: it is called grazing instead. Lower: a grazing is called Zeno.
_ZENO_SLOW = 3


def width(
    t: Float[Array, " #L"], span: Times, rate: Float[Array, "W L"]
) -> Float[Array, "W L"]:
    """Values of watched functions that count as zero: their change in a time of rounding errors."""
    xp = namespace(rate)
    return (INSTANT * span + ROUNDING * xp.abs(t)) * xp.abs(rate)


def arm(s: Structure, lanes: Lanes, watched: Watch, span: Times) -> Lanes:
    """Arm the guards that are positive at the beginning of a piece of flow.

    A guard that its input, which may have jumped, makes negative is crossed by no motion: it is
    no event, and not armed until it is positive again.
    """
    zero = width(lanes.t, span, watched.rate)
    is_above = (watched.value > zero)[:-1]
    is_not_below = (watched.value >= -zero)[:-1]
    armed = (lanes.armed & is_not_below) | is_above
    armed = armed & belongs(s, lanes.chart)[:-1]
    waiting = await_schedules(s, lanes.armed, lanes.t, lanes.t)
    return lanes._replace(armed=with_schedules(s, armed, waiting))


def with_schedules(
    s: Structure, armed: Bool[Array, "G L"], scheduled: Bool[Array, "G L"]
) -> Bool[Array, "G L"]:
    """`armed` of guards, and of `scheduled` events, in every chart."""
    by_clock = (s.clocks >= 0)[:, None]
    return namespace(armed).where(by_clock, scheduled, armed)


def await_schedules(
    s: Structure, armed: Bool[Array, "G L"], before: Times, t: Times
) -> Bool[Array, "G L"]:
    """`armed` after a step from `before` to t, with all scheduled events but those that are due at
    both times: an event that has happened is not armed until its time is over, so that it happens
    once; another one that is due at the same time is still to come."""
    xp = namespace(t)
    for g, transition in enumerate(s.transitions):
        if isinstance(transition.guard, Scheduled):
            due = transition.guard.nearest(before)
            _, period = transition.guard.numbers(t)
            away = xp.maximum(xp.abs(due - before), xp.abs(due - t))
            armed = put(armed, g, armed[g] | (away > SAME_TIME * period))
    return armed


def falls_within(value: Array, rate: Array, time: Array) -> Array:
    """Test whether watched functions are at zero, up to their change in a time, and fall."""
    return (abs(value) <= time * abs(rate)) & (rate < 0)


def overdue(watched: Watch, t: Times, span: Times) -> Bool[Array, "G L"]:
    """Guards that are beyond zero at t, by more than rounding errors of times.

    A piece of flow between two events at the same time has no `span`: that of its clock is left.
    """
    late = SAME_TIME * span + ROUNDING * abs(t)
    value = watched.value[:-1]
    rate = watched.rate[:-1]
    return value < -late * abs(rate)


def rival_of(
    s: Structure, lanes: Lanes, watched: Watch, u: Inputs, fired: Index, span: Times
) -> Index:
    """The guards (by index; -1: none) that come to zero where the events `fired` happen, too.

    If the reset of an event puts the other guard away from zero, only one of the two happens, and
    rounding has decided which.

    **Arguments:** `lanes`, `watched`: before the resets.
    """
    index = np.arange(len(s.transitions))[:, None]
    other = (index != fired) & (fired >= 0)
    by_guard = (s.clocks < 0)[:, None]
    value = watched.value[:-1]
    rate = watched.rate[:-1]
    falls = falls_within(value, rate, TOGETHER * span)
    due = lanes.armed & other & by_guard & falls

    return _first_enabled(s, lanes, u, due)


def due_at_once(
    s: Structure, lanes: Lanes, watched: Watch, u: Inputs, span: Times
) -> Index:
    """The transitions (by index; -1: none) whose events are due at once where lanes are: armed
    guards that are beyond zero, or at it and fall, and scheduled events that have not happened yet.

    A flow that begins there does not know of them: `arm` takes a guard beyond zero for one that the
    input has led there.
    """
    t = lanes.t
    clock = s.clocks[:, None]
    value = watched.value[:-1]
    rate = watched.rate[:-1]
    falls = falls_within(value, rate, TOGETHER * span)
    by_guard = (clock < 0) & (falls | overdue(watched, t, span))
    none = namespace(t).zeros_like(lanes.armed)
    is_over = await_schedules(s, none, t, t)
    by_clock = (clock >= 0) & ~is_over
    in_chart = belongs(s, lanes.chart)[:-1]
    due = lanes.armed & (by_guard | by_clock) & in_chart
    return _first_enabled(s, lanes, u, due)


def _first_enabled(
    s: Structure, lanes: Lanes, u: Inputs, due: Bool[Array, "G L"]
) -> Index:
    """The first transition of each lane that is `due` and whose predicate holds; -1 for none."""
    xp = namespace(lanes.t)
    none = xp.full_like(lanes.chart, -1)

    def first():
        which = none
        for g in range(len(s.transitions)):
            is_first = due[g] & (which < 0)
            candidate = xp.where(is_first, np.int32(g), np.int32(-1))
            holds = enabled(s, lanes.t, lanes.q, u, candidate)
            happens = holds & (candidate >= 0)
            which = xp.where(happens, candidate, which)
        return which

    return cond(due.any(), first, lambda: none)


def belongs(s: Structure, chart: Index) -> Bool[Array, "W L"]:
    """Test whether rows of a `Watch` belong to the chart of each lane (the target's row does)."""
    sources = [s.chart_index(transition.source) for transition in s.transitions]
    source = np.array([*sources, -1])[:, None]
    return (source == chart) | (source == -1)


class Entry(NamedTuple):
    """The guards of the charts that lanes enter, as far as the charts before had them, too."""

    known: Bool[Array, "G L"]
    """Whether the chart before has this guard: in the same chart, or with the same value."""
    armed: Bool[Array, "G L"]
    """Whether that guard was armed."""


def rearm(
    s: Structure,
    lanes: Lanes,
    watched: Watch,
    fired: Index,
    span: Times,
    u: Inputs,
    residue: Times,
    entry: Entry,
) -> Lanes:
    """Arm the guards of the charts that lanes have just entered through the transitions `fired`.

    A guard that is zero there, up to rounding and to the `residue` of the guard that fired, waits
    until it has left zero, if it rises, or if it was crossed before (see `Entry`). Otherwise the
    reset has put it there, or it has come to zero together with the guard that fired, and it is due
    at once if it falls.

    A guard that is beyond zero is due at once (see `overdue`) if it was armed in the old chart, so
    that the reset has led across it, or if it falls, and the old chart does not have it.
    """
    xp = namespace(fired)
    value = watched.value[:-1]
    rate = watched.rate[:-1]
    other = np.arange(len(s.transitions))[:, None] != fired
    zero = width(lanes.t, span, rate) + guard_noise(s, lanes, u, fired >= 0)
    zero = xp.maximum(zero, xp.where(other, 0.0, 4 * residue))
    falls = rate < 0
    is_new = ~entry.known
    late = overdue(watched, lanes.t, span) & (value < -zero)
    was_not_crossed = entry.armed | is_new
    put = other & falls & (value <= zero) & ~late & was_not_crossed
    late = late & (entry.armed | (falls & is_new))
    armed = (value > zero) | put | late
    armed = armed & belongs(s, lanes.chart)[:-1]
    still_waiting = lanes.armed & ~_over(s, lanes.t, fired)
    armed = with_schedules(s, armed, still_waiting)
    return lanes._replace(armed=xp.where(fired >= 0, armed, lanes.armed))


def _over(s: Structure, t: Times, fired: Index) -> Bool[Array, "G L"]:
    """Scheduled events that are over after the transitions `fired` at t: those of the same clock,
    and of clocks of the same period, those that belong to an earlier period."""
    xp = namespace(t)
    G = len(s.transitions)
    over = xp.zeros((G, t.shape[0]), bool)
    clocks = [g for g in range(G) if s.clocks[g] >= 0]
    for g, h in itertools.product(clocks, clocks):
        own = s.transitions[g].guard
        others = s.transitions[h].guard
        assert isinstance(own, Scheduled) and isinstance(others, Scheduled)
        offset, period = own.numbers(t)
        offset_of_others, period_of_others = others.numbers(t)
        number = xp.round((t - offset) / period)
        number_of_others = xp.round((t - offset_of_others) / period_of_others)
        is_earlier = (period == period_of_others) & (number < number_of_others)
        same_clock = s.clocks[g] == s.clocks[h]
        ends = (fired == h) & (same_clock | is_earlier)
        over = put(over, g, over[g] | ends)
    return over


def guard_noise(
    s: Structure, lanes: Lanes, u: Inputs, mask: Mask
) -> Float[Array, "G L"]:
    """A bound on the rounding errors of the guards of the charts that lanes are in."""

    def work(a, here, out):
        rows = s.guards(a)
        if not rows:
            return out

        t = only(here, lanes.t)
        q = only(here, lanes.q[: s.dims[a]])
        first = xp.asarray(np.zeros(1, np.int32))
        expanded = kernels.watched(s, a, None, t, q, only(here, u), first)
        by_point = expanded[:, 1 : 2 + len(q)]
        point = xp.concatenate([t[None], q])
        size = xp.sum(xp.abs(by_point * point), axis=1)
        return put_rows(out, rows, here, ROUNDING * size)

    xp = namespace(lanes.t)
    nothing = xp.zeros((len(s.transitions), lanes.t.shape[0]))
    return for_each_chart(s, lanes.chart, mask, work, nothing)


def apply_resets(
    s: Structure, t: Times, chart: Index, q: Padded, u: Inputs, fired: Index
) -> tuple[Padded, Index]:
    """States and charts after the transitions `fired` (-1: none)."""
    for kind in s.kinds:
        transition = s.transitions[kind[0]]
        chosen, place = _within(kind, fired)
        n = s.dims[s.chart_index(transition.source)]
        b = s.chart_index(transition.target)

        def work(carry, kind=kind, n=n, b=b, here=chosen, place=place):
            q, chart = carry
            xp = namespace(q)
            point = (only(here, t), only(here, q[:n]), only(here, u))
            system, point = needed(here, (s, point))
            member = Member(kind, place)
            expanded = kernels.reset(system, member, *point, some=here)
            after = put(xp.zeros_like(q), slice(s.dims[b]), expanded[:, 0])
            return xp.where(here, after, q), xp.where(here, b, chart)

        q, chart = cond(some(chosen), work, lambda carry: carry, (q, chart))
    return q, chart


def enabled(s: Structure, t: Times, q: Padded, u: Inputs, which: Index) -> Mask:
    """Test whether the predicates of the transitions `which` hold; True where there is none."""
    xp = namespace(t)
    out = xp.ones(t.shape, bool)
    for kind in s.kinds:
        transition = s.transitions[kind[0]]
        if transition.enabled is not None:
            chosen, place = _within(kind, which)
            n = s.dims[s.chart_index(transition.source)]
            point = only(chosen, t), only(chosen, q[:n]), only(chosen, u)
            holds = kernels.enabled(s, Member(kind, place), *point)
            out = xp.where(chosen, holds, out)
    return out


def _within(kind: Kind, g: Index) -> tuple[Mask, Int[Array, " #L"]]:
    """Test whether the transitions g (-1: none) are of a kind, and their indices there (else 0)."""
    xp = namespace(g)
    if len(kind) == 1:
        first = xp.asarray(np.zeros(1, np.int32))
        return g == kind[0], first
    places = np.full(max(kind) + 2, -1, np.int32)  # the last for -1
    places[list(kind)] = np.arange(len(kind))
    last = len(places) - 1
    place = xp.asarray(places)[xp.minimum(g, last)]
    return place >= 0, xp.maximum(place, 0)


def next_schedule(
    s: Structure, t: Times, chart: Index, end: Times, armed: Bool[Array, "G L"]
) -> tuple[Times, Index]:
    """Time of the next scheduled event (infinity if there is none), and its transition.

    Times that differ by rounding are one: an event that is due at t comes at once if it is `armed`
    (it has not happened at t), and one that is due at `end` happens at `end`.
    """
    xp = namespace(t)
    best = xp.full_like(t, xp.inf)
    which = xp.full_like(chart, -1)
    first = xp.full_like(t, xp.inf)
    for g, transition in enumerate(s.transitions):
        if not isinstance(transition.guard, Scheduled):
            continue
        offset, period = transition.guard.numbers(t)
        same_time = SAME_TIME * period
        k = xp.floor((t - offset) / period + SAME_TIME)
        past = offset + k * period
        later = offset + (k + 1) * period
        now = armed[g] & (xp.abs(t - past) <= same_time)
        time = xp.where(now, xp.maximum(past, t), later)
        at_end = xp.abs(time - end) <= same_time
        time = xp.where(at_end, end, time)
        # (Of several that are due now, the one of an earlier period is first.)
        rank = xp.where(now, k, xp.inf)
        is_before = (time == best) & (rank < first)
        sooner = (time < best) | is_before
        sooner = sooner & (chart == s.chart_index(transition.source))
        best = xp.where(sooner, time, best)
        which = xp.where(sooner, g, which)
        first = xp.where(sooner, rank, first)
    return best, which


def scheduled_time(s: Structure, fired: Index, t: Times) -> Times:
    """Time of the scheduled event `fired` that lies at t up to rounding, as a smooth function of
    its period and offset; t itself for other events."""
    xp = namespace(t)
    time = t
    for g, transition in enumerate(s.transitions):
        if isinstance(transition.guard, Scheduled):
            time = xp.where(fired == g, transition.guard.nearest(t), time)
    return time


def keep_pace(
    pace: Float[Array, "4 L"],
    moved: Times,
    event: Mask,
    slow: Mask,
    span: Times,
    transitions: int,
) -> tuple[Float[Array, "4 L"], Mask]:
    """Intervals between events (see `Lanes.pace`), and whether events accumulate: the intervals
    shrink with a sum that converges.

    `slow` marks events whose guard is crossed at a vanishing speed. So many different `transitions`
    may coincide without accumulating.
    """
    xp = namespace(pace)
    since, gap, streak, total = pace
    since = since + moved
    # (Events at one time, which take each other's place, are apart by rounding.)
    at_one_time = event & (since <= INSTANT * span)
    since = xp.where(at_one_time, 0.0, since)
    ratio = since / xp.where(gap > 0, gap, 1.0)
    # (Not the first interval after events at one time.)
    shrinks = (since < gap) | (since == 0)
    longer_streak = xp.where(shrinks, streak + 1, 0.0)
    streak = xp.where(event, longer_streak, streak)
    larger_total = xp.where(shrinks, total + since, 0.0)
    total = xp.where(event, larger_total, total)
    # The sum of the intervals to come, as a geometric series.
    series = since * ratio / xp.where(shrinks, 1 - ratio, 1.0)
    to_come = xp.where(shrinks, series, xp.inf)
    enough = _ZENO_STREAK + xp.where(since == 0, transitions, 0)
    converges = (streak >= enough) & (to_come <= _ZENO_REST * total)
    stops = slow & (streak >= _ZENO_SLOW)
    zeno = event & (converges | stops)
    gap = xp.where(event, since, gap)
    since = xp.where(event, 0.0, since)
    return xp.stack([since, gap, streak, total]), zeno
