"""Events: arming of guards, resets, schedules, and the accumulation of events (Zeno).

A guard is *armed* if its next fall through zero is an event. The search calls these functions:
`arm` at the start of a flow, `rearm` and `apply_resets` at an event, `next_schedule` before each
step and `keep_pace` after it. All take lanes (trajectories side by side), and return arrays of the
same lanes. An event that happens twice, or not at all after a reset, has its cause in `rearm` (a
scheduled one in `await_schedules` or `_over`); Zeno that is reported without need, in `keep_pace`.
`itinerary/flags.py` repeats the rule of `rearm`: both must stay the same. Derivatives across an
event (saltation) are computed in `watch.ChartFlow.locate` and `replay.py`.
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


# An instant, as a part of the time allowed for the flow. Events within an instant are simultaneous.
# A watched function counts as zero if it would reach zero in an instant at its present rate.
# Higher: separate events are taken for simultaneous ones. Lower: simultaneous ones for separate
# ones.
INSTANT = 1e-12
# Events accumulate (Zeno) if `_ZENO_STREAK` intervals between events in a row shrink, and if the
# sum of the intervals to come (as a geometric series) is at most the part `_ZENO_REST` of the sum
# so far. A longer streak or a smaller part: Zeno is reported after more events. A shorter streak or
# a larger part: a transient may be taken for Zeno.
_ZENO_STREAK = 10
_ZENO_REST = 1e-3
# A crossing at a vanishing speed counts as Zeno after this many shrinking intervals, and as a
# grazing before. Higher: Zeno is called grazing. Lower: a grazing is called Zeno.
_ZENO_SLOW = 3


def width(
    t: Float[Array, " #L"], span: Times, rate: Float[Array, "W L"]
) -> Float[Array, "W L"]:
    """The magnitude below which the value of a watched function counts as zero: its change during
    the rounding error of a time."""
    xp = namespace(rate)
    return (INSTANT * span + ROUNDING * xp.abs(t)) * xp.abs(rate)


def arm(s: Structure, lanes: Lanes, watched: Watch, span: Times) -> Lanes:
    """Arm the guards that are positive at the beginning of a piece of flow.

    If a jump of the input makes a guard negative, no motion has crossed it. This is no event, and
    the guard is not armed until it is positive again.
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
    """The flags `armed` in every chart: those of guards as they are, those of scheduled events from
    `scheduled`."""
    by_clock = (s.clocks >= 0)[:, None]
    return namespace(armed).where(by_clock, scheduled, armed)


def await_schedules(
    s: Structure, armed: Bool[Array, "G L"], before: Times, t: Times
) -> Bool[Array, "G L"]:
    """The flags `armed` after a step from `before` to t, with all scheduled events armed but those
    that are due both at `before` and at t.

    A scheduled event that has happened is not armed again until its time is over, so that it
    happens once. Another event that is due at the same time is still to come.
    """
    xp = namespace(t)
    for g, transition in enumerate(s.transitions):
        if isinstance(transition.guard, Scheduled):
            due = transition.guard.nearest(before)
            _, period = transition.guard.numbers(t)
            away = xp.maximum(xp.abs(due - before), xp.abs(due - t))
            armed = put(armed, g, armed[g] | (away > SAME_TIME * period))
    return armed


def falls_within(value: Array, rate: Array, time: Array) -> Array:
    """Test whether watched functions fall, and are closer to zero than they move in `time`."""
    return (abs(value) <= time * abs(rate)) & (rate < 0)


def overdue(watched: Watch, t: Times, span: Times) -> Bool[Array, "G L"]:
    """Guards that are below zero at t by more than they move during rounding errors of times.

    Between two events at the same time `span` is zero; the rounding error of t itself is still
    allowed.
    """
    late = SAME_TIME * span + ROUNDING * abs(t)
    value = watched.value[:-1]
    rate = watched.rate[:-1]
    return value < -late * abs(rate)


def rival_of(
    s: Structure, lanes: Lanes, watched: Watch, u: Inputs, fired: Index, span: Times
) -> Index:
    """The guards (by index; -1: none) that come to zero where the events `fired` happen, too.

    If the reset of one event moves the other guard away from zero, only one of the two events
    happens, and rounding decides which one.

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
    """The transitions (by index; -1: none) whose events are due at once at the present states of
    lanes. These are armed guards below zero, armed guards that fall at zero, and scheduled events
    that are due and have not happened yet.

    A flow that begins at these states would miss these events: `arm` supposes that a guard below
    zero was made negative by the input.
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
    """Test whether rows of a `Watch` belong to the chart of each lane. The target's row always
    does."""
    sources = [s.chart_index(transition.source) for transition in s.transitions]
    source = np.array([*sources, -1])[:, None]
    return (source == chart) | (source == -1)


class Entry(NamedTuple):
    """Guards of the charts that lanes enter, compared with the guards of the charts that they
    leave."""

    known: Bool[Array, "G *L"]
    """Whether the chart before has the same guard: it is the same chart, or its guard has the same
    value."""
    armed: Bool[Array, "G *L"]
    """Whether the guard was armed in the chart before."""


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

    A guard that is zero right after the reset (up to rounding and the `residue` of the guard that
    fired) is not armed if it rises, or if it was crossed before (see `Entry`): it waits until it
    has left zero. Otherwise the reset has put it at zero, or it came to zero together with the
    guard that fired: it is due at once if it falls.

    A guard that is below zero right after the reset (see `overdue`) is due at once in two cases: it
    was armed in the old chart, so that the reset has led across it; or the old chart does not have
    it, and it falls.
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
    """Scheduled events that are over once the transitions `fired` have happened at t: those of the
    same clock, and, of clocks with the same period, those that belong to an earlier period."""
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
    """Test whether the transitions g (-1: none) are of a kind (see `Structure`), and return their
    indices within the kind (0 for others)."""
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

    Times that differ by rounding count as equal. An event that is due at t happens at once if it is
    `armed`, that is, if it has not happened at t. An event that is due at `end` happens at `end`.
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
        # (If several events are due now, the event of an earlier period comes first.)
        rank = xp.where(now, k, xp.inf)
        is_before = (time == best) & (rank < first)
        sooner = (time < best) | is_before
        sooner = sooner & (chart == s.chart_index(transition.source))
        best = xp.where(sooner, time, best)
        which = xp.where(sooner, g, which)
        first = xp.where(sooner, rank, first)
    return best, which


def scheduled_time(s: Structure, fired: Index, t: Times) -> Times:
    """Time of the scheduled event `fired`, which is t up to rounding, as a differentiable function
    of the period and offset of its schedule. For other events, t itself."""
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

    **Arguments:** `slow`: events whose guard is crossed at a vanishing speed. `transitions`: number
    of different transitions, which may all happen at one time without accumulating.
    """
    xp = namespace(pace)
    since, gap, streak, total = pace
    since = since + moved
    # (Different events at one time differ by rounding errors only.)
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
