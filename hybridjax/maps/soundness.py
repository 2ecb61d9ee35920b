"""Whether sections that were placed on a limit cycle are sound: each met once, across it, and in
order."""

import jax
import jax.numpy as jnp
import numpy as np

from .._core.compilation.compile import quick_jit
from .._core.results import Result
from ..engine.hermite import interpolate
from ..engine.tape import IDLE
from ..engine.target import Target
from ..engine.watch import slopes, watch
from ..errors import ComputationError
from ..sections.crossing import Crossing
from .placed import PlacedSections


# None of these has a unit of the model's: all are numbers, or relative to the cycle itself.
# Further crossings of a section are looked for in this many parts of every step that the flow took.
# Doubled: two crossings half as far apart are still told apart, at twice the cost.
_PARTS_OF_A_STEP = 16
# The number of steps is rounded up to a multiple of this. Doubled: other cycles are compiled anew
# half as often, and short ones are searched for longer.
_STEPS_AT_ONCE = 256
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
                f"{Result(first).message}."
            )
        raise ComputationError(
            f"{describe(0)} is not reached on the cycle: {Result(first).message}."
        )
    for i, code in enumerate(np.asarray(placed.result)):
        if code != Result.OK:
            reason = Result(int(code)).message
            hint = ""
            if code == Result.SECTION_MISSED:
                hint = " Does it lie on an event of the cycle? Then move it a little."
            raise ComputationError(
                f"{describe((i + 1) % N)} is not reached from section {i} on the cycle: "
                f"{reason}.{hint}"
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


def _crossings(placed: PlacedSections) -> tuple[np.ndarray, np.ndarray]:
    """How often one period of the cycle crosses each section, and how steeply: the rate of a
    level on its section as a fraction of its fastest rate on the cycle."""
    event = np.asarray(placed.bound.event)
    counts = np.array([placed.cycle.event_sequence.count(g) if g >= 0 else 1 for g in event])
    steepness = np.ones(placed.n_sections)
    if placed.bound.levels is None:
        return counts, steepness
    more, fastest, rate = jax.device_get(_levels_along(placed, *_steps(placed)))
    state_based = np.isinf(np.asarray(placed.bound.time)) & (event < 0)
    counts = np.where(state_based, 1 + more, counts)
    np.divide(np.abs(rate), fastest, out=steepness, where=state_based)
    return counts, steepness


def _steps(placed: PlacedSections):
    """The steps of one period, some of them of length zero: time, chart and state at their starts,
    length, state at their ends, and the section they start from or -1."""
    tape, lanes = jax.device_get((placed.tape, placed.lanes))
    section, row = np.nonzero(tape.code.T != IDLE)
    first = np.append(True, np.diff(section) > 0)

    def start(own, rows):
        before = np.concatenate([rows[:1], rows[:-1]])
        return np.where(first.reshape(-1, *[1] * (rows.ndim - 1)), own[section], before)

    end = tape.t[row, section]
    t = start(lanes.t, end)
    chart = start(lanes.chart, tape.chart[row, section])
    q = start(lanes.q.T, tape.after[row, :, section])
    parts = t, chart, q, end - t, tape.before[row, :, section], np.where(first, section, -1)
    idle = np.zeros(-len(section) % _STEPS_AT_ONCE, int)
    t, chart, q, h, after, section = (np.concatenate([x, x[idle]]) for x in parts)
    h[len(row) :] = 0
    return t, chart, q, h, after, section


@quick_jit
def _levels_along(placed: PlacedSections, t, chart, q, h, after, section):
    """How often the cycle's steps cross each section (N,) but for where it lies, the fastest rate
    of its level (N,), and the rate there (N,)."""
    s, N = placed.structure(), placed.n_sections
    points = len(t) * (_PARTS_OF_A_STEP + 1)
    still = jnp.zeros((s.nu, len(t)))
    f0, f1 = slopes(s, t, chart, q.T, still), slopes(s, t + h, chart, after.T, still)
    x = jnp.linspace(0.0, 1.0, _PARTS_OF_A_STEP + 1)[:, None]
    q = interpolate(x, h, q.T[:, None], after.T[:, None], f0[:, None], f1[:, None])
    t, chart, q = (t + h * x).ravel(), jnp.tile(chart, _PARTS_OF_A_STEP + 1), q.reshape(s.d, points)
    far, u, everywhere = (
        jnp.full(points, jnp.inf),
        jnp.zeros((s.nu, points)),
        jnp.ones(points, bool),
    )

    def one(i):
        index, never = jnp.full(points, i), jnp.full(points, -1)
        target = Target(far, index, never, far, None, placed.bound.levels, Result.OK)
        seen = watch(s, t, chart, q, u, target, everywhere)
        level = seen.value[-1].reshape(_PARTS_OF_A_STEP + 1, -1)
        falls = (level[:-1] > 0) & (level[1:] <= 0) & (h > 0)
        # Around the section itself, rounding decides the signs.
        falls = falls.at[0].set(falls[0] & (section != i))
        falls = falls.at[-1].set(falls[-1] & (jnp.roll(section, -1) != i))
        return jnp.sum(falls), jnp.max(jnp.abs(seen.rate[-1]))

    more, fastest = jax.lax.map(one, jnp.arange(N))
    lanes = placed.lanes
    f = slopes(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, N)))
    return more, fastest, placed.normal[:, 0] + jnp.sum(placed.normal[:, 1:] * f.T, axis=1)
