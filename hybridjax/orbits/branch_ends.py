"""The reason for which a branch of limit cycles ends, read from its last cycle.

`branches.py` calls `explained` with the last cycle of a branch and the result of the turn that
failed beyond it, and gets an `End`: a `Result`, and a sentence. `explained` tries the causes one
after the other, and the first one that holds is the reason: a further cause is added there. Its
order must stay, since a cycle that has shrunk also seems to touch its section, and
`_missed_section` holds for every crossing that is missed. A *visit* is the stay of the cycle in one
chart between two events.

If a branch reports the wrong reason, look at the order in `explained`, and at the limit of the
function that gave it (`_SLOW`, `_CLOSE`, `_SMALL` or `_REST`); if it reports none, at `_UNCLEAR`.
"""

from typing import NamedTuple

import numpy as np

from .._core.executor import to_host
from .._core.results import Result
from ..engine import kernels
from ..engine.target import until
from ..systems.transition import Scheduled
from .crossing import AtEvent, Crossing, to_section
from .cycle import LimitCycle
from .guess import is_default
from .verdict import Visit, visits_of


# A guard or a section is touched if its rate is below this part of the largest rate that it could
# have at the speed of the cycle. Larger: transversal events are called grazing. Smaller: the last
# cycle of a branch, which ends a little before, is not recognized.
_SLOW = 0.02
# Two events are close if their times differ by less than this part of the period; a guard is close
# to zero if it is less than this part of its range. Larger: events that are merely near each other
# get this reason. Smaller: the last cycle of a branch, which ends a little before, is not
# recognized.
_CLOSE = 0.02

# A cycle has shrunk to a point if its states move by less than this part of their magnitudes on the
# first cycle. Larger: small cycles are called equilibria. Smaller: a branch whose section does not
# contain the equilibrium ends before.
_SMALL = 0.02
# The cycle passes an equilibrium if there is a point with rates so small that no state would move
# by more than this part of its magnitude in one period. Larger: slow cycles get this reason.
# Smaller: the branch ends before its points are this slow, and gets no reason.
_REST = 0.1

# Results of a failed turn for which a cause is looked for.
_UNCLEAR = (
    Result.GRAZING,
    Result.EVENT_ORDER,
    Result.NOT_CONVERGED,
    Result.SECTION_MISSED,
)


class End(NamedTuple):
    """The reason for an end. (Its fields are the last ones of a `BranchEnd`, in the same order.)"""

    result: Result
    message: str


def explained(cycle: LimitCycle, result: Result) -> End:
    """The cause of the end of a branch after a cycle, where the next turn had a result."""
    if result == Result.EQUILIBRIUM:
        return _shrunk(cycle) or End(result, result.message)
    if result not in _UNCLEAR:
        return End(result, result.message)
    visits = visits_of(cycle)
    return (
        _shrunk(cycle)
        or _touched_section(cycle)
        or _touched_guard(cycle, visits)
        or _change_of_order(cycle, visits)
        or _near_guard(cycle, visits)
        or _near_rest(cycle, visits, result)
        or _missed_section(cycle, result)
        or End(result, result.message)
    )


def _shrunk(cycle: LimitCycle) -> End | None:
    """An end at which an autonomous cycle without events becomes an equilibrium."""
    if cycle.clocked or cycle.event_sequence:
        return None
    path = cycle.trajectory()
    scale = np.asarray(cycle.settings.scale)
    a = int(path.chart[0])
    n = cycle.structure.dims[a]
    states = path.after[:, :n]
    ranges = np.ptp(states, axis=0) / scale[a, :n]
    if ranges.max() > _SMALL:
        return None
    text = "the cycle shrinks to an equilibrium, as it does at a Hopf point"
    return End(Result.EQUILIBRIUM, text)


def _touched_section(cycle: LimitCycle) -> End | None:
    """An end at which the cycle touches its section tangentially."""
    map = to_host(cycle.return_map)
    if not isinstance(map.base, Crossing):
        return None
    a = int(map.anchor.chart[0])
    n = map.structure.dims[a]
    target = to_section(until(map.anchor.t), map.base)
    s = map.structure
    t = map.anchor.t
    q = map.anchor.q[:n]
    u = np.zeros((s.nu, 1))
    first = np.zeros(1, np.int32)
    expanded = kernels.watched(s, a, target.levels, t, q, u, first)
    row = expanded[-1, :, 0]
    field = kernels.field(s, a, t, q, u)[:, 0, 0]
    period = float(cycle.period)
    if not _is_slow(row, field, map.scale[a, :n], period):
        return None
    text = (
        f"the cycle touches its section ({map.base}) tangentially, and does not cross it any more: "
        "find the first cycle with another `section=`"
    )
    return End(Result.GRAZING, text)


def _touched_guard(cycle: LimitCycle, visits: list[Visit]) -> End | None:
    """An end at which an event of the cycle is grazing."""
    s = cycle.structure
    scale = np.asarray(cycle.settings.scale)
    period = float(cycle.period)
    u = np.zeros((s.nu, 1))
    first = np.zeros(1, np.int32)
    for visit in visits:
        if visit.event < 0 or isinstance(s.transitions[visit.event].guard, Scheduled):
            continue
        a = visit.chart
        t = visit.t[-1:]
        q = visit.q[:, -1:]
        rows = kernels.watched(s, a, None, t, q, u, first)
        row = rows[s.guards(a).index(visit.event), :, 0]
        field = kernels.field(s, a, t, q, u)[:, 0, 0]
        if _is_slow(row, field, scale[a, : len(q)], period):
            name = s.transitions[visit.event].name
            text = f"the guard of '{name}' is touched tangentially (grazing)"
            return End(Result.GRAZING, text)
    return None


def _is_slow(row, field, sizes, period: float) -> bool:
    """True if a function changes slowly along the flow, given its derivatives in a row."""
    slope = row[2 : 2 + len(field)]
    fastest = np.maximum(np.abs(field), sizes / period)
    possible = abs(row[1]) + np.abs(slope) @ fastest
    rate = row[1] + slope @ field
    return bool(abs(rate) < _SLOW * possible)


def _change_of_order(cycle: LimitCycle, visits: list[Visit]) -> End | None:
    """An end at which two events of the cycle happen at the same time."""
    s = cycle.structure
    period = float(cycle.period)
    if len(visits) < 2:
        return None
    for before, visit in zip([visits[-1], *visits[:-1]], visits, strict=True):
        if visit.event < 0 or before.event < 0:
            continue
        if visit.t[-1] - visit.t[0] < _CLOSE * period:
            first, second = (s.transitions[x.event].name for x in (before, visit))
            text = (
                f"the events '{first}' and '{second}' come to the same time, beyond which one of "
                "them is lost or comes first"
            )
            return End(Result.EVENT_ORDER, text)
    return None


def _near_guard(cycle: LimitCycle, visits: list[Visit]) -> End | None:
    """An end at which the cycle reaches a guard where there was no event before."""
    s = cycle.structure
    for before, visit in zip([visits[-1], *visits[:-1]], visits, strict=True):
        guards = s.guards(visit.chart)
        if not guards:
            continue
        u = np.zeros((s.nu, 1))
        first = np.zeros(1, np.int32)
        expanded = kernels.watched(s, visit.chart, None, visit.t, visit.q, u, first)
        rows = expanded[:, 0]
        for g, level in zip(guards, rows, strict=True):
            near = _CLOSE * np.ptp(level)
            if len(level) < 3 or near == 0:
                continue
            name = s.transitions[g].name
            if _has_minimum(level, near):
                text = f"the guard of '{name}' is touched tangentially (grazing)"
                return End(Result.GRAZING, text)
            least_at_begin = np.argmin(level[:-1]) == 0 and level[0] <= near
            if before.event >= 0 and g != before.event and least_at_begin:
                earlier = s.transitions[before.event].name
                text = f"the event '{name}' begins to happen at once after '{earlier}'"
                return End(Result.EVENT_ORDER, text)
            least_at_end = np.argmin(level[1:]) == len(level) - 2
            if g != visit.event and least_at_end and level[-2] <= near:
                text = f"the event '{name}' begins to happen at the end of a stay"
                return End(Result.EVENT_ORDER, text)
    return None


def _has_minimum(level: np.ndarray, near: float) -> bool:
    """True if a guard has a minimum close to zero within a stay, after which it grows again."""
    inside = level[1:-1]
    below_last = inside < level[:-2]
    lowest = below_last & (inside <= level[2:])
    return bool(np.any(lowest & (np.abs(inside) <= near)))


def _near_rest(cycle: LimitCycle, visits: list[Visit], result: Result) -> End | None:
    """An end at which the period grows without bound, since the cycle passes an equilibrium."""
    if result != Result.SECTION_MISSED or cycle.clocked:
        return None
    s = cycle.structure
    scale = np.asarray(cycle.settings.scale)
    u = np.zeros((s.nu, 1))
    slowest = np.inf
    for visit in visits:
        rows = kernels.field(s, visit.chart, visit.t, visit.q, u)
        rates = rows[:, 0]
        sizes = scale[visit.chart, : len(rates), None]
        speeds = np.abs(rates) / sizes
        slowest = min(slowest, float(speeds.max(axis=0).min()))
    if slowest * float(cycle.period) > _REST:
        return None
    text = (
        f"the cycle comes close to an equilibrium, and its period ({float(cycle.period):.4g}) "
        "grows without bound"
    )
    return End(result, text)


def _missed_section(cycle: LimitCycle, result: Result) -> End | None:
    """An end at which the cycle does not meet its section any more."""
    if result != Result.SECTION_MISSED or isinstance(cycle.base, AtEvent):
        return None
    where = str(cycle.base)
    if is_default(cycle.base):
        where = "the plane through the first guess"
    text = (
        f"the cycle does not return to its section ({where}) within three periods: find the first "
        "cycle with another `section=`"
    )
    return End(result, text)
