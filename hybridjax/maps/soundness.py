"""Whether sections that were placed on a limit cycle are sound: each met once, across it, and in
order."""

import numpy as np

from .._core.compilation.compile import at_ease
from .._core.executor import to_host
from .._core.results import Result
from ..engine import kernels
from ..engine.cubic import interpolate
from ..engine.tape import IDLE
from ..engine.watch import slopes
from ..errors import ComputationError
from ..sections.crossing import Crossing
from .placed import PlacedSections


# None of these has a unit of the model's: all are numbers, or relative to the cycle itself.
# Further crossings of a section are looked for in this many parts of every step that the flow took.
# Doubled: two crossings half as far apart are still told apart, at twice the cost.
_PARTS_OF_A_STEP = 16
# A section is tangent to the cycle if its level changes there at less than this fraction of its
# fastest rate on the cycle. Doubled: sections crossed at twice the angle are refused.
_LEAST_STEEPNESS = 1e-4
# The ways from section to section make one period, up to this fraction of it: less or more is a
# section crossed twice, or out of order. Doubled: nothing changes, these are off by whole ways.
_ROUND = 1e-6
# Sections less than this fraction of a period apart are one. Doubled: so are those twice as far.
_SAME = 1e-9


def refuse_unsound(placed: PlacedSections, first: int) -> None:
    """Raise for the first section that is missed, tangent, out of order, or crossed twice."""
    N = placed.n_sections
    describe = placed.family.describe
    if first != Result.OK:
        if isinstance(placed.family.anchor, Crossing):
            raise ComputationError(
                f"the cycle has no point where {placed.family.anchor} (the anchor of section 0): "
                f"{_reason(first)}"
            )
        raise ComputationError(f"{describe(0)} is not reached on the cycle: {_reason(first)}")
    for i, code in enumerate(np.asarray(placed.result)):
        if code != Result.OK:
            hint = ""
            if code == Result.SECTION_MISSED:
                hint = " Does it lie on an event of the cycle? Then move it a little."
            raise ComputationError(
                f"{describe((i + 1) % N)} is not reached from section {i} on the cycle: "
                f"{_reason(int(code))}{hint}"
            )
    moving = np.flatnonzero(np.asarray(placed.normal)[:, 0])
    if not placed.cycle.clocked and len(moving):
        raise ComputationError(
            f"{describe(int(moving[0]))} depends on time, which has no meaning on the cycle of an "
            "autonomous system: use a function of the state, or ClockPhase."
        )
    period, duration = float(placed.cycle.period), np.asarray(placed.duration)
    total = float(duration.sum())
    if total < (1 - _ROUND) * period:
        raise ComputationError(
            f"{describe(0)} is crossed more than once in one period; a section must be crossed "
            "once. Restrict it to a chart, or choose another phase."
        )
    if total > (1 + _ROUND) * period:
        late = int(np.argmax(duration))
        raise ComputationError(
            f"the sections are out of order: {describe((late + 1) % N)} comes before section "
            f"{late} on the cycle, so that one round of all sections takes {total / period:.3g} "
            "periods."
        )
    short = int(np.argmin(duration))
    if duration[short] <= _SAME * period:
        raise ComputationError(
            f"{describe((short + 1) % N)} coincides with section {short} on the cycle; sections "
            "must be distinct."
        )
    counts, steepness = _crossings(placed)
    for i in range(N):
        if steepness[i] < _LEAST_STEEPNESS:
            raise ComputationError(
                f"{describe(i)} is tangent to the cycle: its level changes there at "
                f"{steepness[i]:.1g} of its fastest rate. Choose another level."
            )
        if counts[i] > 1:
            raise ComputationError(
                f"{describe(i)} is crossed {counts[i]} times in one period; a section must be "
                "crossed once. Restrict it to a chart, or choose another phase."
            )


def _reason(code: int) -> str:
    hint = " Give them to the search for the cycle, or place more sections."
    return f"{Result(code).message}.{hint if code == Result.STEP_LIMIT else ''}"


def _crossings(placed: PlacedSections) -> tuple[np.ndarray, np.ndarray]:
    """How often one period of the cycle crosses each section, and how steeply: the rate of a
    level on its section as a fraction of its fastest rate on the cycle."""
    event = np.asarray(placed.bound.event)
    counts = np.array([placed.cycle.event_sequence.count(g) if g >= 0 else 1 for g in event])
    steepness = np.ones(placed.n_sections)
    if placed.bound.levels is None:
        return counts, steepness
    with at_ease():
        more, fastest, rate = _levels_along(to_host(placed))
    state_based = np.isinf(np.asarray(placed.bound.time)) & (event < 0)
    counts = np.where(state_based, 1 + more, counts)
    np.divide(np.abs(rate), fastest, out=steepness, where=state_based)
    return counts, steepness


def _levels_along(placed: PlacedSections):
    """How often the cycle's steps cross each section (N,) but for where it lies, the fastest rate
    of its level (N,), and the rate there (N,)."""
    s, N, levels = placed.structure(), placed.n_sections, placed.bound.levels
    t, chart, q, h, after, section = _steps(placed)
    still = np.zeros((s.nu, 1))
    f0, f1 = slopes(s, t, chart, q.T, still), slopes(s, t + h, chart, after.T, still)
    x = np.linspace(0.0, 1.0, _PARTS_OF_A_STEP + 1)[:, None]
    q = interpolate(x, h, q.T[:, None], after.T[:, None], f0[:, None], f1[:, None])
    t, chart, q = (t + h * x).ravel(), np.tile(chart, len(x)), q.reshape(s.d, -1)
    value, rate = np.ones((N, len(t))), np.zeros((N, len(t)))
    for a in np.unique(chart):
        if levels.present(s, int(a)):
            here = np.flatnonzero(chart == a)
            seen = kernels.levels(s, int(a), levels, N, t[here], q[: s.dims[a], here])
            value[:, here], rate[:, here] = seen[:, 0], seen[:, 1]
    level = value.reshape(N, len(x), -1)
    falls = (level[:, :-1] > 0) & (level[:, 1:] <= 0) & (h > 0)
    # Around the section itself, rounding decides the signs.
    own = np.arange(N)[:, None] == section
    falls[:, 0] &= ~own
    falls[:, -1] &= ~np.roll(own, -1, axis=1)
    lanes = placed.lanes
    f = slopes(s, lanes.t, lanes.chart, lanes.q, still)
    there = placed.normal[:, 0] + np.sum(placed.normal[:, 1:] * f.T, axis=1)
    return np.sum(falls, axis=(1, 2)), np.max(np.abs(rate), axis=1), there


def _steps(placed: PlacedSections):
    """The steps of one period: time, chart and state at their starts, length, state at their ends,
    and the section they start from or -1."""
    tape, lanes = placed.tape, placed.lanes
    section, row = np.nonzero(tape.code.T != IDLE)
    first = np.append(True, np.diff(section) > 0)

    def start(own, rows):
        before = np.concatenate([rows[:1], rows[:-1]])
        return np.where(first.reshape(-1, *[1] * (rows.ndim - 1)), own[section], before)

    end = tape.t[row, section]
    t = start(lanes.t, end)
    chart = start(lanes.chart, tape.chart[row, section])
    q = start(lanes.q.T, tape.after[row, :, section])
    return t, chart, q, end - t, tape.before[row, :, section], np.where(first, section, -1)
