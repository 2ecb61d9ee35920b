"""Where the sections of a family lie on a limit cycle."""

import collections
import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.compilation import at_ease, host_first, quick_jit
from .._core.executor import Array, is_traced, namespace, on_host, put, scan, stop_gradient, to_host
from .._core.lanes import by_lane
from .._core.precision import require_x64
from .._core.results import Result
from ..engine import kernels
from ..engine.cubic import interpolate
from ..engine.lanes import Lanes, for_each_chart, only
from ..engine.move import record
from ..engine.search.search import Moved
from ..engine.tape import IDLE, Tape
from ..engine.target import AbstractLevels, Target
from ..engine.watch import slopes
from ..errors import ComputationError, DefinitionError
from ..orbits.crossing import Crossing, ListLevels
from ..orbits.cycle import LimitCycle
from ..systems.structure import Structure
from .abstract import AbstractSections, BoundSections, CyclePoint
from .families import FamilyLike, as_family
from .placed import PlacedSections, SectionsLike


# Steps that the flow from one section to the next may take, unless the cycle's settings allow more.
# Doubled: cycles with more events between two sections are placed; nothing else changes.
PATIENCE = 1024
# The flow to a section gives up after so many periods. Doubled: a section that is missed is noticed
# later.
_LONGEST_WAY = 1.5
# Rounding of the clock's phase, in periods: a clock section that lies this close before the anchor
# is on it. Doubled: so is one twice as far.
_SAME_PHASE = 1e-9

# Sections that were placed last, since the same family on the same cycle is asked for again and
# again (by `linearize`, then by `run_experiments`). Twice as many: twice the memory.
_recent: collections.deque[PlacedSections] = collections.deque(maxlen=4)


@checked
def place_sections(cycle: LimitCycle, sections: FamilyLike) -> PlacedSections:
    """Find a family's sections on a cycle, and check them.

    **Arguments:** `sections`, a family (`ClockPhase`, `KinematicPhase`, `SectionList`), or a list
    of `Crossing` and `AtEvent`. The way from each section to the next may take as many steps as the
    cycle's `settings` allow, and 1024 at least.

    **Raises:** `DefinitionError` for a family that does not fit the system; `ComputationError` that
    names the first section that the cycle does not cross, crosses more than once, touches
    tangentially, or meets out of order.
    """
    family = as_family(sections)
    require_x64(cycle, family)
    for known in list(_recent):
        if known.cycle is cycle and known.family is family:
            return known
    family.check(Structure(cycle.system))
    placed, first = _place(cycle, family)
    if not is_traced((cycle, family)):
        refuse_unsound(placed, int(first))
        # The program has made copies of what it was given.
        placed = dataclasses.replace(placed, cycle=cycle, family=family)
        _recent.append(placed)
    return placed


def as_placed(cycle: LimitCycle, sections: SectionsLike) -> PlacedSections:
    """`sections` placed on `cycle`: a family is placed, sections that were placed on it are kept.

    **Raises:** `DefinitionError` for sections that were placed on another one; otherwise as
    `place_sections`.
    """
    if not isinstance(sections, PlacedSections):
        return place_sections(cycle, sections)
    require_x64(cycle)
    other = sections.cycle
    if other is cycle:
        return sections
    mine, theirs = ((c.system, c.anchor, c.period) for c in (cycle, other))
    if is_traced((mine, theirs)):
        return place_sections(cycle, sections.family)
    if not eqx.tree_equal(*jax.device_get((mine, theirs))):
        raise DefinitionError(
            "these sections were placed on another cycle: pass the family itself, e.g. "
            "`placed.family`, and it is placed on this one."
        )
    return sections


@host_first
def _place(cycle: LimitCycle, family: AbstractSections) -> tuple[PlacedSections, Int[Array, ""]]:
    """The sections on the cycle, and the `Result` of the way to section 0."""
    s, xp, N = Structure(cycle.system), namespace(cycle.period), family.n_sections
    first, visits, bound = _visit(s, cycle, family)
    # From an axis of visits and one of a single lane to one of lanes.
    visits = jax.tree_util.tree_map(lambda x: xp.moveaxis(x[..., 0], 0, -1), visits)
    lanes = jax.tree_util.tree_map(
        lambda x, y: xp.concatenate([x, y[..., :-1]], axis=-1), first.lanes, visits.lanes
    )
    normal = _normals(s, bound, lanes)
    f = slopes(s, lanes.t, lanes.chart, lanes.q, xp.zeros((s.nu, N)))
    share = xp.abs(normal.T * xp.concatenate([xp.ones((1, N)), f]))
    flat = xp.max(share, axis=0) == 0
    with_time = xp.isinf(bound.time) & (cycle.system.period() is not None)
    placed = PlacedSections(
        cycle=cycle,
        family=family,
        bound=bound,
        lanes=lanes,
        tape=visits.tape,
        duration=visits.lanes.t - lanes.t,
        result=visits.result,
        drop=xp.where(flat, -1, xp.argmax(share, axis=0)),
        dims=xp.asarray(s.dims)[lanes.chart] + with_time - ~flat,
        normal=normal,
    )
    return placed, first.result[0]


class _Visits(NamedTuple):
    """Arrivals at N sections, one after the other, with the way to each."""

    lanes: Lanes
    result: Int[Array, "N 1"]
    tape: Tape


def _visit(
    s: Structure, cycle: LimitCycle, family: AbstractSections
) -> tuple[Moved, _Visits, BoundSections]:
    """Flow to section 0, which lies at the anchor if that is a crossing; and from there to each of
    the others, and back to section 0."""
    N, period, xp = family.n_sections, cycle.period, namespace(cycle.period)
    patience = max(cycle.settings.max_steps, PATIENCE)
    settings = dataclasses.replace(cycle.settings, max_steps=patience)
    u = xp.zeros((s.nu, 1))

    def go(lanes, h, result, time, index, event, levels):
        limit = lanes.t + _LONGEST_WAY * period
        target = Target(
            time[None], index[None], event[None], limit, None, levels, Result.SECTION_MISSED
        )
        return record(s, lanes, u, target, settings, h, result, tangents=True)

    begin = cycle.anchor, (0.1 * period / N)[None], xp.zeros(1, xp.int32)
    zero = xp.zeros(1, xp.int32)[0]
    if isinstance(family.anchor, Crossing):
        never = xp.full_like(period, np.inf)
        first, _ = go(*begin, never, zero, zero - 1, ListLevels((family.anchor,)))
        bound = _bind(s, cycle, family, first.lanes)
    else:
        bound = _bind(s, cycle, family, cycle.anchor)
        first, _ = go(*begin, bound.time[0], zero, bound.event[0], bound.levels)

    def step(carry, k):
        i = k % N
        time = bound.time[i] + (k // N) * period
        moved, tape = go(*carry, time, i, bound.event[i], bound.levels)
        return (moved.lanes, moved.h, moved.result), _Visits(moved.lanes, moved.result, tape)

    _, visits = scan(step, (first.lanes, first.h, first.result), xp.arange(1, N + 1))
    return first, visits, bound


def _bind(
    s: Structure, cycle: LimitCycle, family: AbstractSections, anchor: Lanes
) -> BoundSections:
    """The family with its numbers filled in; clock sections in the period that begins at the
    anchor."""
    period, t, xp = cycle.period, anchor.t[0], namespace(cycle.period)
    f = slopes(s, anchor.t, anchor.chart, anchor.q, xp.zeros((s.nu, 1)))
    point = CyclePoint(period, anchor.chart[0], t, anchor.q[:, 0], f[:, 0])
    if on_host(period):
        bound = to_host(_bind_program(cycle.system, family, point))
    else:
        bound = family.bind(s, point)
    late = xp.ceil((t - bound.time[0]) / period - _SAME_PHASE)
    late = xp.where(xp.isfinite(bound.time[0]), stop_gradient(late), 0.0)
    return dataclasses.replace(bound, time=bound.time + late * period)


@quick_jit
def _bind_program(system, family, point):
    return family.bind(Structure(system), point)


def _normals(s: Structure, bound: BoundSections, lanes: Lanes) -> Float[Array, "N n"]:
    """Gradients of the levels with respect to (t, q)."""
    xp, N, levels = namespace(lanes.t), lanes.t.shape[0], bound.levels
    out = xp.zeros((1 + s.d, N))
    if levels is None:
        return out.T
    state_based = xp.isinf(bound.time) & (bound.event < 0)

    def work(a, here, out):
        n = s.dims[a]
        point = only(here, xp.arange(N)), only(here, lanes.t), only(here, lanes.q[:n])
        own = put(out, slice(1 + n), _level_gradients(s, a, levels, *point))
        return xp.where(here, own, out) if levels.present(s, a) else out

    return for_each_chart(s, lanes.chart, state_based, work, out).T


def _level_gradients(s: Structure, a: int, levels: AbstractLevels, i, t, q) -> Float[Array, "n N"]:
    """Gradients of levels i with respect to (t, q) in chart a."""
    if on_host(t):
        u = np.zeros((s.nu, 1))
        return kernels.watched(s, a, levels, t, q, u, i)[-1, 1 : 2 + len(q)]

    def gradient(i, t, q):
        g = jax.grad(lambda t, q: levels.level(s, a, i, t, q), argnums=(0, 1))(t, q)
        return jnp.concatenate([g[0][None], g[1]])

    return by_lane(gradient)(i, t, q)


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
