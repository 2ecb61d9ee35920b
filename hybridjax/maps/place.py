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
from .._core.compilation.compile import host_first, quick_jit
from .._core.executor import Array, namespace, on_host, put, scan, stop_gradient, to_host
from .._core.lanes.per_lane import by_lane
from .._core.precision import require_x64
from .._core.results import Result
from .._core.tracing import is_traced
from ..engine import kernels
from ..engine.lanes import Lanes, for_each_chart, only
from ..engine.move import record
from ..engine.search.search import Moved
from ..engine.tape import Tape
from ..engine.target import AbstractLevels, Target
from ..engine.watch import slopes
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.abstract import AbstractSections, BoundSections, CyclePoint
from ..sections.crossing import Crossing
from ..sections.section_list import FamilyLike, ListLevels, as_family
from ..systems.structure import Structure
from .placed import PlacedSections, SectionsLike
from .soundness import refuse_unsound


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
