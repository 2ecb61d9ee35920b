"""Checks of a limit cycle that was found: `verdict`.

Newton's method shows only that a computed return map has a fixed point. The verdict integrates
along the cycle once more, by another method with other steps. This second integration is called the
*walk* (`walk.py`). It begins at each recorded point of the first integration, and ends at the next
one. Searches, sweeps and branches call `verdict`; its `findings` refuse a cycle, or warn. *Sizes*
of states are their magnitudes, and a *visit* is the stay in one chart between two events.

The verdict notices pieces of the cycle that are not trajectories of the vector field; events at
which the guard is not zero, or is not crossed in its direction; guards that the cycle crosses
without an event, or below which it always lies; scheduled events that were left out; a period that
is a multiple of the shortest one; multipliers that differ from those of the walk, or that are
rounding errors. It does not notice a guard that dips below zero and back between two points of the
walk (eight in each step), wrong multipliers of systems with more than `_MANY` states, or functions
that do not mean what their author meant.

Each finding has a function that makes it, called in `_verdict`, or in `_jump` for an event: a
further check is added there. If a good cycle is refused or a fault passes, look at that function
and at the constants, which say what counts as a difference. The walk must keep a method and steps
of its own: otherwise both integrations have the same faults.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.findings import Finding
from .._core.memo import Memory
from .._core.results import Result
from ..engine import kernels
from ..engine.events import SAME_TIME
from ..engine.replay import recorded_moves
from ..engine.saltation import jump
from ..errors import DefinitionError
from ..systems.structure import Structure
from ..systems.system import name_of
from ..systems.transition import Scheduled
from .linear_flow import hosted, last_turn
from .periodic import has_period
from .return_map import turn_product
from .walk import ROUGH, Stretch, Walked, walk


# Largest allowed distance between the walk and a point of the cycle, in sizes of the states. (If
# the cycle was computed with larger errors: `_STEPS` times the error of a step.) Larger: wrong
# cycles pass. Smaller: errors of steps that add up are taken for faults.
_APART = 1e-6
_STEPS = 1e4
# Largest allowed difference between sums of powers of the multipliers of the two integrations,
# relative to these sums. Larger: a wrong multiplier passes. Smaller: errors of the walk are taken
# for faults.
_DIFFERENT = 1e-4
# Largest allowed relative difference between the product of all multipliers and the product of the
# determinants of all moves. (If the cycle was computed with larger errors: `_STEPS` times the error
# of a step.) Larger: multipliers that are only rounding pass. Smaller: errors of the walk are taken
# for faults.
_OTHER_PRODUCT = 1e-6
# Products of multipliers are compared if they are at least this. Smaller: products that are nearly
# zero, of which only the magnitude is known, count as faults. Larger: fewer cycles are compared.
_LEAST_PRODUCT = 1e-6
# A guard counts as negative if a change of each state by this part of its size could not make the
# guard positive. Larger: shallow excursions pass. Smaller: errors of the walk count.
_BEYOND = 1e-6
# An event may be this part of the period away from the zero of its guard. Larger: an event near its
# guard passes. Smaller: rounding errors of times count as faults.
_LATE = 1e-10
# The shortest visit of a chart, in periods, in which guards are tested. Shorter: between events
# that nearly coincide, the signs of guards are decided by rounding.
_SHORT = 1e-9
# A cycle that runs several times around closes after a part 1/p of its period, with p one of these
# primes. More: the verdict takes longer.
_PRIMES = 2, 3, 5, 7
# Largest number of states with which multipliers are compared. Larger: derivatives of the walk take
# longer than the search.
_MANY = 24
# The cause of the finding on a cycle that lies beyond a guard.
BEYOND = "beyond a guard"
LONG_CLOCK = "a long clock"


class Verdict(NamedTuple):
    """The result of the checks of a cycle."""

    distance: float
    """Largest distance between the walk and the cycle, in sizes of the states; NaN if the walk did
    not reach its accuracy."""
    multipliers: float
    """Difference from the multipliers of the walk, relative to their size or to 1; NaN if they were
    not compared."""
    not_reached: tuple[str, ...]
    """Transitions out of charts of the cycle that do not happen on it."""
    sooner: float | None
    """The time after which the cycle closes, if that is less than its period."""
    findings: tuple[Finding, ...]
    """Faults (`refused`) and limits (`warned`)."""

    @property
    def refused(self) -> tuple[Finding, ...]:
        """The faults."""
        return tuple(x for x in self.findings if x.action == "refused")

    @property
    def result(self) -> Result:
        """The code of the first fault."""
        if not self.refused:
            return Result.OK
        if self.sooner is not None:
            return Result.EXTRA_TURNS
        beyond = any(finding.cause == BEYOND for finding in self.refused)
        return Result.GUARD_BEYOND if beyond else Result.NOT_VERIFIED

    def __str__(self) -> str:
        if np.isnan(self.distance):
            return "guards and events (a second integration did not reach its accuracy)"
        # (Smaller numbers are only rounding.)
        distance = np.maximum(self.distance, 1e-15)
        multipliers = np.maximum(self.multipliers, 1e-15)
        text = f"second integration: closes to {distance:.1g}, events"
        if all(finding.cause != LONG_CLOCK for finding in self.findings):
            text += ", shortest period"
        if np.isnan(multipliers):
            return text
        return f"{text}, multipliers to {multipliers:.1g}"


def require_sound(cycle: Any) -> None:
    """**Raises:** `DefinitionError` for a cycle with a fault, before other cycles are computed from
    it."""
    for finding in verdict(cycle).refused:
        raise DefinitionError(f"the cycle that is the guess is none: {finding.text}")


class _Path(NamedTuple):
    """The walk along a cycle, in moves. A move leads from one recorded point of the first
    integration to the next, without an event in between."""

    t: Float[np.ndarray, " M+1"]
    """Times of the beginnings of moves, and of the end of the turn."""
    chart: Int[np.ndarray, " M"]
    event: Int[np.ndarray, " M"]
    """Transitions at the ends of moves, by index; -1 for none."""
    begin: Float[np.ndarray, "d M"]
    walked: Walked
    distance: float
    """Largest distance to the cycle, in sizes of the states."""
    monodromy: Float[np.ndarray, "d d"]
    volume: float
    """Product of the determinants of all moves; 0 if the number of states differs between
    charts."""
    findings: list[Finding]
    """Faults at events."""

    @property
    def error(self) -> float:
        """Largest error of the walk, in sizes of the states."""
        return float(self.walked.error.max())


class Visit(NamedTuple):
    """The stay in a chart between two events, or a whole period without events."""

    chart: int
    t: Float[np.ndarray, " P"]
    q: Float[np.ndarray, "n P"]
    event: int
    """The transition at the end of the visit, by index; -1 for none."""


_verdicts = Memory()


def verdict(cycle) -> Verdict:
    """Check a cycle (see the module). The result is remembered with the cycle."""
    cycle = hosted(cycle)
    return _verdicts.recall(cycle, None, lambda: _verdict(cycle))


def keep_verdict(cycle, other) -> None:
    """Remember with a cycle what is known of `other`, which is the same cycle."""
    known = _verdicts.get(hosted(other), None)
    if known is not None:
        _verdicts.recall(hosted(cycle), None, lambda: known)


def visits_of(cycle) -> list[Visit]:
    """The visits of charts on a cycle."""
    cycle = hosted(cycle)
    return _visits(cycle.structure, _walk_along(cycle))


def _verdict(cycle) -> Verdict:
    """All checks: of events, guards and schedules; then, if the walk is accurate, of its distance
    and of shorter periods; last, of multipliers, if nothing is refused."""
    s = cycle.structure
    period = float(cycle.period)
    scale = np.asarray(cycle.settings.scale)
    path = _walk_along(cycle)
    visits = _visits(s, path)
    long = []
    for visit in visits:
        duration = visit.t[-1] - visit.t[0]
        if duration > _SHORT * period:
            long.append(visit)
    never = set(range(len(s.transitions))) - set(cycle.event_sequence)
    findings = [*path.findings, *_beyond_guards(s, long, never, scale)]
    for visit in long:
        findings += _passed_guards(s, visit, scale)
        findings += _skipped_schedules(s, visit)
    accurate = path.error <= ROUGH
    sooner = None
    if accurate:
        findings += _departure(cycle, path)
        sooner = _closes_sooner(cycle, path)
        findings += _long_clock(cycle, path)
    else:
        findings.append(_not_walked(path))
    if sooner is not None:
        findings.append(_shorter(sooner, period))
    findings += _rest(s, path, scale)
    apart = np.nan
    refused = any(finding.action == "refused" for finding in findings)
    if accurate and s.d <= _MANY and not refused:
        apart = _apart(cycle, path.monodromy)
        findings += _other_multipliers(apart)
        findings += _unresolved_multipliers(cycle, path)
    return Verdict(
        path.distance if accurate else np.nan,
        apart,
        _not_reached(cycle, visits),
        sooner,
        tuple(findings),
    )


def _walk_along(cycle) -> _Path:
    """Walk along all moves of a cycle side by side, and through the events at their ends."""
    map = cycle.return_map
    s = map.structure
    scale = np.asarray(map.scale)
    moves = recorded_moves(*last_turn(cycle))
    t = np.append(moves.t, moves.t[0] + float(cycle.period))
    event = np.maximum(moves.code, -1)
    # (The length of a short move is known to more digits than the times of its ends.)
    between = np.diff(t)
    rounding = 1e-14 * np.abs(t[1:])
    same = np.abs(moves.h - between) <= rounding
    length = np.where(same, moves.h, between)
    walked = walk(
        s,
        Stretch(
            t=t[:-1],
            length=length,
            chart=moves.chart,
            q=moves.q,
        ),
        scale,
    )
    chart = moves.chart.copy()
    q = walked.q.copy()
    by_state = np.moveaxis(walked.by_state, -1, 0).copy()
    findings: list[Finding] = []
    delay = np.zeros(s.d)
    for k in np.flatnonzero(event >= 0):
        at_once = bool(moves.at_once[k])
        time = float(t[k + 1])
        at = time, int(chart[k]), q[:, k]
        span = float(cycle.period)
        jumped = _jump(s, int(event[k]), *at, scale, span, at_once)
        # (An event at once is caused by the event before it, and delayed by the same time.)
        before = k - 1 if at_once else k
        if not at_once:
            delay = jumped.delay @ by_state[k]
        by_state[before] = jumped.by_state @ by_state[before]
        by_state[before] += np.outer(jumped.slip, delay)
        findings += jumped.findings
        chart[k] = jumped.chart
        q[:, k] = jumped.q
    monodromy = np.eye(s.d)
    for of_move in by_state:
        monodromy = of_move @ monodromy
    points = np.column_stack([moves.q[:, 1:], map.anchor.q])
    charts = np.append(moves.chart[1:], map.anchor.chart)
    distance = _distance(s, scale, (chart, q), (charts, points))
    volume = float(np.prod(np.linalg.det(by_state)))
    linear = monodromy, volume
    return _Path(t, moves.chart, event, moves.q, walked, distance, *linear, findings)


def _distance(s: Structure, scale, ends: tuple, points: tuple) -> float:
    """Largest distance between the end of a move and the beginning of the next one."""
    chart, q = ends
    next_chart, begin = points
    if (chart != next_chart).any():
        return np.inf
    sizes = np.maximum(scale[chart].T, np.abs(begin))
    distance = np.abs(q - begin) / sizes
    return float(np.max(distance, where=_exists(s, chart), initial=0.0))


def _exists(s: Structure, chart: Int[np.ndarray, " P"]) -> Bool[np.ndarray, "d P"]:
    """Which of the padded states of points exist in their charts."""
    dims = np.array(s.dims)[chart]
    return np.arange(s.d)[:, None] < dims


class _Jump(NamedTuple):
    """An event on the way, padded. Scheduled events have no delay."""

    chart: int
    """Chart after the event; `q` is the state after it."""
    q: Float[np.ndarray, " d"]
    by_state: Float[np.ndarray, "d d"]
    """Derivative of the reset."""
    slip: Float[np.ndarray, " d"]
    """Change of the state after the event by the time of the event."""
    delay: Float[np.ndarray, " d"]
    """Derivative of the time of the event by the state before it."""
    findings: list[Finding]


def _jump(
    s: Structure, g: int, t: float, a: int, q, scale, span: float, at_once: bool = False
) -> _Jump:
    """Event g at a state of chart a. With `at_once`, another event has led to this state, and the
    guard of event g is zero or below zero there. `span`: the period."""
    transition = s.transitions[g]
    n = s.dims[a]
    u = np.zeros((s.nu, 1))
    time = np.array([t])
    state = q[None, :n]
    event = jump(s, g, time, state, u)
    delay = np.zeros(s.d)
    if isinstance(transition.guard, Scheduled):
        findings = [] if at_once else _off_schedule(transition, t)
    else:
        level = event.level[0]
        noise = float(_noise(event.gradient[0], scale[a, :n]))
        if at_once:
            findings = _not_due(transition, t, level, noise)
        else:
            delay[:n] = event.delay_by_state[0]
            rate = event.rate[0]
            # (A guard that depends on the time alone does not change with the states.)
            noise = noise + abs(rate) * _LATE * span
            findings = _off_guard(transition, t, level, rate, noise)
    m = event.after.shape[1]
    after = np.zeros(s.d)
    slip = np.zeros(s.d)
    by_state = np.zeros((s.d, s.d))
    after[:m] = event.after[0]
    slip[:m] = event.slip[0]
    by_state[:m, :n] = event.by_state[0]
    chart = s.chart_index(transition.target)
    return _Jump(
        chart=chart,
        q=after,
        by_state=by_state,
        slip=slip,
        delay=delay,
        findings=findings,
    )


def _noise(slope: Float[np.ndarray, "n ..."], sizes: Float[np.ndarray, " n"]):
    """The change of a guard by deviations of the relative size `_BEYOND`."""
    return _BEYOND * np.tensordot(sizes, np.abs(slope), axes=1)


def _off_guard(
    transition, t: float, level: float, rate: float, noise: float
) -> list[Finding]:
    """A finding on an event at which the guard is not zero, or is not crossed in its direction."""
    if abs(level) <= 10 * noise and rate < 0:
        return []
    return [_without_guard(transition, t, level, rate)]


def _not_due(transition, t: float, level: float, noise: float) -> list[Finding]:
    """A finding on an event at once, if the event before it has not led to zero or below zero of
    its guard."""
    if level > 10 * noise:
        return [_without_guard(transition, t, level, -1.0)]
    return []


def _without_guard(transition, t: float, level: float, rate: float) -> Finding:
    text = (
        f"the event '{transition.name}' happens at t = {t:.6g}, where its guard is "
        f"{transition.sign * level:.3g} and changes at a rate of {transition.sign * rate:.3g}: it "
        f"should be zero and {transition.direction}."
    )
    return Finding("an event without its guard", text, "refused")


def _off_schedule(transition, t: float) -> list[Finding]:
    """A finding on a scheduled event at another time."""
    nearest = transition.guard.nearest(np.array([t]))
    late = t - float(nearest[0])
    if abs(late) <= 10 * SAME_TIME * float(transition.guard.period):
        return []
    text = (
        f"the event '{transition.name}' happens at t = {t:.6g}, which is not one of the times of "
        "its schedule."
    )
    return [Finding("an event without its schedule", text, "refused")]


def _visits(s: Structure, path: _Path) -> list[Visit]:
    """The visits of charts on the cycle. A visit that the beginning of the turn would divide is
    kept whole."""
    M = len(path.event)
    period = path.t[-1] - path.t[0]
    visits = []
    for moves in _moves_of_visits(path.event):
        times = []
        states = []
        for k in moves:
            own = path.walked.lane == k % M
            later = period if k >= 0 else 0.0
            own_times = np.append(path.t[k % M], path.walked.t[own])
            times.append(later + own_times)
            begins = path.begin[:, k % M]
            points = begins, path.walked.points[:, own]
            states.append(np.column_stack(points))
        a = int(path.chart[moves[0]])
        q = np.concatenate(states, axis=1)[: s.dims[a]]
        event = int(path.event[moves[-1]])
        visits.append(
            Visit(
                chart=a,
                t=np.concatenate(times),
                q=q,
                event=event,
            )
        )
    return visits


def _moves_of_visits(event: Int[np.ndarray, " M"]) -> list[Int[np.ndarray, " m"]]:
    """The moves of each visit. The last one ends with the event of the visit. The first visit may
    begin before the turn, at negative indices."""
    ends = np.flatnonzero(event >= 0)
    if not len(ends):
        return [np.arange(len(event))]
    last = ends[-1] - len(event)
    before = np.append(last, ends[:-1])
    return [np.arange(a + 1, b + 1) for a, b in zip(before, ends, strict=True)]


def _levels(s: Structure, visit: Visit, scale) -> Float[np.ndarray, "G P"]:
    """Guards at the points of a visit. Values that may be errors of the walk are set to zero."""
    a = visit.chart
    n = len(visit.q)
    if not s.guards(a):
        return np.zeros((0, len(visit.t)))
    u = np.zeros((s.nu, 1))
    first = np.zeros(1, np.int32)
    rows = kernels.watched(s, a, None, visit.t, visit.q, u, first)
    derivative = rows[:, 2 : 2 + n]
    noise = _noise(np.moveaxis(derivative, 0, 1), scale[a, :n])
    level = rows[:, 0]
    return np.where(np.abs(level) > noise, level, 0.0)


def _beyond_guards(
    s: Structure, visits: list[Visit], never: set[int], scale
) -> Iterable[Finding]:
    """Guards that are below zero in all visits of the cycle, although their event never happens.

    (An event that happens may leave its guard below zero.)
    """
    for a in {visit.chart for visit in visits}:
        here = [visit for visit in visits if visit.chart == a]
        levels = [_levels(s, visit, scale) for visit in here]
        for k, g in enumerate(s.guards(a)):
            values = np.concatenate([level[k] for level in levels])
            if g not in never or values.max() > 0 or values.min() == 0:
                continue
            for visit, level in zip(here, levels, strict=True):
                beyond = np.flatnonzero(level[k] < 0)
                if len(beyond) and _may_happen(s, g, visit, beyond):
                    yield _beyond(s, s.transitions[g], a, values)
                    break


def _passed_guards(s: Structure, visit: Visit, scale) -> Iterable[Finding]:
    """Guards that fall through zero during a visit without an event."""
    levels = _levels(s, visit, scale)
    for k, g in enumerate(s.guards(visit.chart)):
        # (At the end of a visit, the guard of the event that ends it is zero up to errors.)
        level = levels[k, :-1] if g == visit.event else levels[k]
        for point in _crossings(level):
            if _may_happen(s, g, _at_zero(visit, level, point), np.array([0])):
                yield _passed(s.transitions[g], float(visit.t[point]))
                break


def _crossings(level: Float[np.ndarray, " P"]) -> Int[np.ndarray, " n"]:
    """Points at which a guard is below zero for the first time after it was above."""
    points = np.flatnonzero(level)
    at_points = level[points]
    falls = (at_points[1:] < 0) & (at_points[:-1] > 0)
    return points[1:][falls]


def _at_zero(visit: Visit, level: Float[np.ndarray, " P"], point: int) -> Visit:
    """The point of a visit at which a guard has passed zero, by linear interpolation between the
    point `point`, where it is negative, and the point before."""
    before = int(np.flatnonzero(level[:point])[-1])
    part = level[before] / (level[before] - level[point])
    step = visit.t[point] - visit.t[before]
    t = visit.t[before] + part * step
    begin = visit.q[:, before]
    end = visit.q[:, point]
    q = begin + part * (end - begin)
    return visit._replace(t=t[None], q=q[:, None])


def _may_happen(s: Structure, g: int, visit: Visit, points) -> bool:
    """True if the predicate of a transition holds at one of some points of a visit."""
    if s.transitions[g].enabled is None:
        return True
    u = np.zeros((s.nu, 1))
    t = visit.t[points]
    q = visit.q[:, points]
    holds = kernels.enabled(s, s.member(g), t, q, u)
    return bool(holds.any())


def _beyond(s: Structure, transition, a: int, level) -> Finding:
    extremes = np.array([level.min(), level.max()])
    low, high = sorted(transition.sign * extremes)
    text = (
        f"the cycle lies beyond the guard of '{transition.name}' all along its stay in chart "
        f"'{s.names[a]}' (values from {low:.3g} to {high:.3g}; the guard should be "
        f"{transition.direction}), so that this event can never happen. Begin with a guess on the "
        "other side of the guard, or let the transition that leads there end in another chart."
    )
    return Finding(BEYOND, text, "refused")


def _passed(transition, t: float) -> Finding:
    text = (
        f"the guard of '{transition.name}' passes zero ({transition.direction}) before "
        f"t = {t:.6g}, and the event does not happen. Take smaller steps, e.g. "
        "`settings=Settings(rtol=1e-13)`, or look for a guard that is not smooth."
    )
    return Finding("a guard was passed", text, "refused")


def _skipped_schedules(s: Structure, visit: Visit) -> Iterable[Finding]:
    """Scheduled events that were due in a visit, and did not happen."""
    for g in s.schedules(visit.chart):
        transition = s.transitions[g]
        guard = transition.guard
        assert isinstance(guard, Scheduled)
        period = float(guard.period)
        offset = float(guard.offset)
        since = (visit.t[0] - offset) / period
        until = (visit.t[-1] - offset) / period
        due = np.floor(since + 10 * SAME_TIME) + 1
        if due >= until - 10 * SAME_TIME:
            continue
        time = offset + due * period
        before = np.array([np.searchsorted(visit.t, time) - 1])
        if not _may_happen(s, g, visit, before):
            continue
        text = (
            f"the scheduled event '{transition.name}' is due at t = {time:.6g} in chart "
            f"'{s.names[visit.chart]}', and does not happen."
        )
        yield Finding("a scheduled event was left out", text, "refused")


def _departure(cycle, path: _Path) -> list[Finding]:
    errors_of_steps = _STEPS * float(np.max(np.asarray(cycle.settings.rtol)))
    if path.distance <= max(_APART, errors_of_steps):
        return []
    text = (
        f"a second integration of {name_of(cycle.system)}, by another method, leaves the "
        f"cycle by {path.distance:.1g} (relative to the magnitudes of the states). Take smaller "
        "steps, e.g. `settings=Settings(rtol=1e-13)`, or look for a function that is not smooth."
    )
    return [Finding("another integration", text, "refused")]


def _not_walked(path: _Path) -> Finding:
    text = (
        "a second integration along the cycle did not reach its accuracy (estimated error "
        f"{path.error:.1g}), so that only guards and events were checked."
    )
    return Finding("not checked", text)


def _rest(s: Structure, path: _Path, scale) -> list[Finding]:
    """A finding on a cycle on which nothing moves but the clock."""
    if (path.event >= 0).any():
        return []
    apart = np.abs(path.begin - path.begin[:, :1])
    apart = apart / scale[path.chart].T
    if np.max(apart, where=_exists(s, path.chart), initial=0.0) > _APART:
        return []
    text = (
        "no state moves on the cycle: it is an equilibrium, and only the clock goes on."
    )
    return [Finding("at rest", text)]


def _shorter(sooner: float, period: float) -> Finding:
    text = (
        f"the cycle closes after {sooner:.6g} already, a part of the period {period:.6g} that was "
        "found."
    )
    return Finding("a shorter period", text, "refused")


def _closes_sooner(cycle, path: _Path) -> float | None:
    """The time after which the cycle closes, if that is a part of its period."""
    is_free = cycle.return_map.base is not None
    parts = [p for p in _PRIMES if is_free or cycle.multiplicity % p == 0]
    closing = _closing_parts(cycle, path, parts)
    return float(cycle.period) / max(closing) if closing else None


def _long_clock(cycle, path: _Path) -> list[Finding]:
    """A doubt if a cycle closes after a part of the clock's period after which all functions of the
    system repeat, too."""
    is_clocked = cycle.return_map.base is None and cycle.multiplicity == 1
    if not is_clocked or not np.ptp(path.begin, axis=1).any():
        return []
    pieces = cycle.pieces
    for part in reversed(_closing_parts(cycle, path, list(_PRIMES))):
        shorter = float(cycle.period) / part
        where = pieces.t, pieces.chart, pieces.q
        if has_period(cycle.structure, jnp.asarray(shorter), *map(jnp.asarray, where)):
            text = (
                f"the cycle closes after {shorter:.6g} already, and all functions of the system "
                f"repeat then: its multipliers are those of {part} periods. If `period()` is to be "
                f"the period of the clock, let it return {shorter:.6g}."
            )
            return [Finding(LONG_CLOCK, text)]
    return []


def _closing_parts(cycle, path: _Path, parts: list[int]) -> list[int]:
    """The numbers p in `parts` for which the cycle closes after the part 1/p of its period."""
    if not parts:
        return []
    map = cycle.return_map
    scale = np.asarray(map.scale)
    times = path.t[0] + float(cycle.period) / np.array(parts)
    moves = np.searchsorted(path.t, times) - 1
    begins = path.t[moves]
    chart = path.chart[moves]
    stretch = Stretch(
        t=begins,
        length=times - begins,
        chart=chart,
        q=path.begin[:, moves],
    )
    reached = walk(map.structure, stretch, scale).q
    size = scale[path.chart[0]]
    apart = np.abs(reached - path.begin[:, :1])
    distance = apart / size[:, None]
    closed = (np.max(distance, axis=0) <= _APART) & (chart == path.chart[0])
    return [part for part, closes in zip(parts, closed, strict=True) if closes]


def _apart(cycle, monodromy: Float[np.ndarray, "d d"]) -> float:
    """Largest difference between the traces of powers of two monodromy matrices: of the cycle and
    of the walk. It is relative to the magnitude of the larger power, or to 1.

    Traces of powers are sums of powers of the multipliers, which need no matching.
    """
    first = turn_product(np.asarray(cycle.factors)[None])[0]
    # (In an autonomous system, the multiplier 1 of the direction of the flow is projected out of
    # the factors.)
    along = 0.0 if cycle.clocked else 1.0
    size = np.asarray(cycle.settings.scale)[int(cycle.anchor.chart[0])]
    units = size / size[:, None]
    power_of_cycle = np.eye(len(first))
    power_of_walk = np.eye(len(first))
    largest = 0.0
    for _ in range(len(first)):
        power_of_cycle = power_of_cycle @ first
        power_of_walk = power_of_walk @ monodromy
        powers = np.stack([power_of_cycle, power_of_walk])
        weight = max(np.abs(powers * units).max(), 1.0)
        difference = np.trace(power_of_cycle) + along - np.trace(power_of_walk)
        largest = max(largest, abs(difference) / weight)
    return float(largest)


def _other_multipliers(apart: float) -> list[Finding]:
    if apart <= _DIFFERENT:
        return []
    text = (
        f"multipliers of a second integration along the cycle differ by {apart:.2g} from those of "
        "the first."
    )
    return [Finding("other multipliers", text, "refused")]


def _unresolved_multipliers(cycle, path: _Path) -> list[Finding]:
    """A finding if the product of the multipliers differs from the product of the determinants of
    all moves.

    Each determinant is accurate to nearly all digits. Multipliers lose digits if deviations grow by
    many powers of ten within the period and shrink again, as near a separatrix.
    """
    if abs(path.volume) < _LEAST_PRODUCT:
        return []
    multipliers = np.asarray(cycle._multipliers)
    product = float(np.prod(multipliers).real)
    allowed = max(
        _OTHER_PRODUCT, _STEPS * float(np.max(np.asarray(cycle.settings.rtol)))
    )
    if abs(product / path.volume - 1) <= allowed:
        return []
    growth = np.abs(path.monodromy).max()
    text = (
        f"the product of the multipliers, {product:.9g}, differs from that of the determinants of "
        f"all steps, {path.volume:.9g}: deviations grow by up to {growth:.1g} within the period, "
        "so that rounding errors decide on the multipliers, and on the period. The cycle comes "
        "very close to an equilibrium, or to an unstable cycle: look for one elsewhere."
    )
    return [Finding("multipliers of rounding", text, "refused")]


def _not_reached(cycle, visits: list[Visit]) -> tuple[str, ...]:
    s = cycle.structure
    visited = {s.names[visit.chart] for visit in visits}
    return tuple(
        transition.name
        for g, transition in enumerate(s.transitions)
        if transition.source in visited and g not in cycle.event_sequence
    )
