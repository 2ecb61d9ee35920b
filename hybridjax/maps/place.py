"""Where the sections of a family lie on a limit cycle."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.boundary.checked import checked
from .._core.compilation.compile import quick_jit
from .._core.lanes.per_lane import by_lane
from .._core.results import Result
from .._core.tracing import is_traced
from ..engine.lanes import Lanes, only
from ..engine.move import record
from ..engine.tape import Tape
from ..engine.target import AbstractLevels, Target
from ..engine.watch import slopes
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.abstract import AbstractSections, BoundSections, CyclePoint
from ..sections.crossing import Crossing
from ..sections.section_list import FamilyLike, as_family
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


@checked
def place_sections(cycle: LimitCycle, sections: FamilyLike) -> PlacedSections:
    """Find a family's sections on a cycle, and check them.

    **Arguments:** `sections`, a family (`ClockPhase`, `KinematicPhase`, `SectionList`), or a list
    of `Crossing` and `AtEvent`.

    **Raises:** `DefinitionError` for a family that does not fit the system; `ComputationError` that
    names the first section that the cycle does not cross, crosses more than once, touches
    tangentially, or meets out of order.
    """
    family = as_family(sections)
    family.check(Structure(cycle.system))
    placed, first = _place(cycle, family)
    if not is_traced((cycle, family)):
        refuse_unsound(placed, int(first))
    return placed


def as_placed(cycle: LimitCycle, sections: SectionsLike) -> PlacedSections:
    """`sections` placed on `cycle`: a family is placed, sections that were placed on it are kept.

    **Raises:** `DefinitionError` for sections that were placed on another one; otherwise as
    `place_sections`.
    """
    if not isinstance(sections, PlacedSections):
        return place_sections(cycle, sections)
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


@quick_jit
def _place(cycle: LimitCycle, family: AbstractSections) -> tuple[PlacedSections, Int[Array, ""]]:
    """The sections on the cycle, and the `Result` of the way to section 0."""
    s = Structure(cycle.system)
    visits, bound = _visit(s, cycle, family)
    lanes = jax.tree_util.tree_map(lambda x: x[..., :-1], visits.lanes)
    normal = _normals(s, bound, lanes)
    f = slopes(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, family.n_sections)))
    share = jnp.abs(normal.T * jnp.concatenate([jnp.ones((1, family.n_sections)), f]))
    flat = jnp.max(share, axis=0) == 0
    with_time = jnp.isinf(bound.time) & (cycle.system.period() is not None)
    placed = PlacedSections(
        cycle=cycle,
        family=family,
        bound=bound,
        lanes=lanes,
        tape=jax.tree_util.tree_map(lambda x: x[..., 1:], visits.tape),
        duration=jnp.diff(visits.lanes.t),
        result=visits.result[1:],
        drop=jnp.where(flat, -1, jnp.argmax(share, axis=0)),
        dims=jnp.array(s.dims)[lanes.chart] + with_time - ~flat,
        normal=normal,
    )
    return placed, visits.result[0]


class _Visits(NamedTuple):
    """One round of N sections and the return to section 0: arrivals on the last axis (N + 1), with
    the way to each."""

    lanes: Lanes
    result: Int[Array, " N1"]
    tape: Tape


def _visit(
    s: Structure, cycle: LimitCycle, family: AbstractSections
) -> tuple[_Visits, BoundSections]:
    """Flow to the anchor, if there is one, which then is section 0, or else to section 0; and from
    there to each of the others."""
    N, period = family.n_sections, cycle.period
    patience = max(cycle.settings.max_steps, PATIENCE)
    settings = dataclasses.replace(cycle.settings, max_steps=patience)
    u = jnp.zeros((s.nu, 1))
    crossing = family.anchor if isinstance(family.anchor, Crossing) else None

    def step(carry, k):
        lanes, h, result, anchor = carry
        bound, i, first = _bind(s, cycle, family, anchor), k % N, k == 0
        time, event, levels = bound.time[i] + (k // N) * period, bound.event[i], bound.levels
        if crossing is not None:
            time, event = jnp.where(first, jnp.inf, time), jnp.where(first, -1, event)
            i, levels = jnp.where(first, N, i), _WithAnchor(levels, crossing, N)
        limit = lanes.t + _LONGEST_WAY * period
        target = Target(
            time[None], i[None], event[None], limit, None, levels, Result.SECTION_MISSED
        )
        moved, tape = record(s, lanes, u, target, settings, h, result, tangents=True)
        end = moved.lanes
        if crossing is not None:
            anchor = jax.tree_util.tree_map(lambda x, y: jnp.where(first, x, y), end, anchor)
        return (end, moved.h, moved.result, anchor), _Visits(end, moved.result, tape)

    begin = (cycle.anchor, (0.1 * period / N)[None], jnp.zeros(1, jnp.int32), cycle.anchor)
    (*_, anchor), visits = jax.lax.scan(step, begin, jnp.arange(N + 1))
    # From an axis of visits and one of a single lane to one of lanes.
    visits = jax.tree_util.tree_map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), visits)
    return visits, _bind(s, cycle, family, anchor)


def _bind(
    s: Structure, cycle: LimitCycle, family: AbstractSections, anchor: Lanes
) -> BoundSections:
    """The family with its numbers filled in; clock sections in the period that begins at the
    anchor."""
    period, t = cycle.period, anchor.t[0]
    f = slopes(s, anchor.t, anchor.chart, anchor.q, jnp.zeros((s.nu, 1)))
    bound = family.bind(s, CyclePoint(period, anchor.chart[0], t, anchor.q[:, 0], f[:, 0]))
    late = jnp.ceil((t - bound.time[0]) / period - _SAME_PHASE)
    late = jnp.where(jnp.isfinite(bound.time[0]), jax.lax.stop_gradient(late), 0.0)
    return dataclasses.replace(bound, time=bound.time + late * period)


class _WithAnchor(AbstractLevels):
    """The levels of N sections, and after them that of the crossing that section 0 lies on."""

    levels: AbstractLevels | None
    anchor: Crossing
    n_sections: int = eqx.field(static=True)

    def present(self, s, a):
        own = self.levels is not None and self.levels.present(s, a)
        return own or self.anchor.in_chart(s, a)

    def level(self, s, a, i, t, q):
        own = anchor = jnp.ones(())
        if self.levels is not None and self.levels.present(s, a):
            own = self.levels.level(s, a, jnp.minimum(i, self.n_sections - 1), t, q)
        if self.anchor.in_chart(s, a):
            anchor = self.anchor.level(s, a, t, q)
        return jnp.where(i == self.n_sections, anchor, own)


def _normals(s: Structure, bound: BoundSections, lanes: Lanes) -> Float[Array, "N n"]:
    """Gradients of the levels with respect to (t, q)."""
    N = lanes.t.shape[0]
    out = jnp.zeros((1 + s.d, N))
    levels = bound.levels
    if levels is None:
        return out.T
    state_based = jnp.isinf(bound.time) & (bound.event < 0)
    for a in range(len(s.charts)):
        if not levels.present(s, a):
            continue
        n = s.dims[a]
        here = state_based & (lanes.chart == a)

        def gradient(i, t, q, a=a):
            g = jax.grad(lambda t, q: levels.level(s, a, i, t, q), argnums=(0, 1))(t, q)
            return jnp.concatenate([g[0][None], g[1]])

        def work(out, n=n, here=here, gradient=gradient):
            point = only(here, jnp.arange(N)), only(here, lanes.t), only(here, lanes.q[:n])
            return out.at[: 1 + n].set(jnp.where(here, by_lane(gradient)(*point), out[: 1 + n]))

        out = jax.lax.cond(here.any(), work, lambda out: out, out)
    return out.T
