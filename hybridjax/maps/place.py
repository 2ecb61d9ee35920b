"""Where the sections of a family lie on a limit cycle."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.compile import quick_jit
from .._core.per_lane import by_lane
from .._core.results import Result
from .._core.tracing import is_traced
from ..engine.lanes import Lanes, only
from ..engine.move import record
from ..engine.target import AbstractLevels, Target
from ..engine.watch import slopes
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.families import Bound, Crossing, as_sections
from ..systems.structure import Structure
from .placed import PlacedSections
from .soundness import refuse_unsound


# Steps that the flow from one section to the next may take.
PATIENCE = 1024


def place_sections(cycle: LimitCycle, sections) -> PlacedSections:
    """Find a family's sections on a cycle, and check them.

    **Arguments:** `sections`, a family (`ClockPhase`, `KinematicPhase`, `SectionList`), or a list
    of `Crossing` and `AtEvent`.

    **Raises:** `ComputationError` that names the first section that the cycle does not cross,
    crosses more than once, touches tangentially, or meets out of order.
    """
    sections = as_sections(sections)
    s = Structure(cycle.system)
    sections.check(s)
    placed, first = _place(cycle, sections)
    if not is_traced((cycle, sections)):
        refuse_unsound(placed, int(first))
    return placed


def as_placed(cycle: LimitCycle, sections) -> PlacedSections:
    """`sections` placed on `cycle`: a family is placed, sections that were placed on it are kept.

    **Raises:** `DefinitionError` for something that is not a cycle, or sections that were placed
    on another one; otherwise as `place_sections`.
    """
    if not isinstance(cycle, LimitCycle):
        raise DefinitionError(
            f"expected a LimitCycle, got {type(cycle).__name__}: use find_limit_cycle first."
        )
    if not isinstance(sections, PlacedSections):
        return place_sections(cycle, sections)
    other = sections.cycle
    if other is cycle:
        return sections
    mine, theirs = ((c.system, c.start, c.period) for c in (cycle, other))
    if is_traced((mine, theirs)):
        return place_sections(cycle, sections.family)
    if not eqx.tree_equal(*jax.device_get((mine, theirs))):
        raise DefinitionError(
            "these sections were placed on another cycle: pass the family itself, e.g. "
            "`placed.family`, and it is placed on this one."
        )
    return sections


class _WithAnchor(AbstractLevels):
    """The levels of a family, and after them that of the crossing on which its section 0 lies."""

    levels: AbstractLevels | None
    anchor: Crossing
    count: int = eqx.field(static=True)

    def present(self, s, a):
        own = self.levels is not None and self.levels.present(s, a)
        return own or self.anchor.in_chart(s, a)

    def level(self, s, a, i, t, q):
        own = anchor = jnp.ones(())
        if self.levels is not None and self.levels.present(s, a):
            own = self.levels.level(s, a, jnp.minimum(i, self.count - 1), t, q)
        if self.anchor.in_chart(s, a):
            anchor = self.anchor.level(s, a, t, q)
        return jnp.where(i == self.count, anchor, own)


@quick_jit
def _place(cycle, sections) -> tuple[PlacedSections, Int[Array, ""]]:
    """The sections on the cycle, and the `Result` of the way to section 0."""
    system, period = cycle.system, cycle.period
    s = Structure(system)
    N = sections.n_sections
    patience = max(cycle.settings.max_steps, PATIENCE)
    settings = dataclasses.replace(cycle.settings, max_steps=patience)
    u = jnp.zeros((s.nu, 1))
    anchored = isinstance(sections.start, Crossing)

    def bind(anchor: Lanes) -> Bound:
        f = slopes(s, anchor.t, anchor.chart, anchor.q, u)
        point = anchor.chart[0], anchor.t[0], anchor.q[:, 0], f[:, 0]
        bound = sections.bind(s, period, *point)
        # Clock sections of the turn that begins at the anchor.
        turns = jnp.ceil((anchor.t[0] - bound.time[0]) / period - 1e-9)
        turns = jnp.where(jnp.isfinite(bound.time[0]), jax.lax.stop_gradient(turns), 0.0)
        return dataclasses.replace(bound, time=bound.time + turns * period)

    def to_section(carry, k):
        """To section 0 (which is the anchor, where there is one), then to each of the others."""
        lanes, h, result, anchor = carry
        bound, i, first = bind(anchor), k % N, k == 0
        time, event, levels = bound.time[i] + (k // N) * period, bound.event[i], bound.levels
        if anchored:
            time, event = jnp.where(first, jnp.inf, time), jnp.where(first, -1, event)
            i, levels = jnp.where(first, N, i), _WithAnchor(levels, sections.start, N)
        limit = lanes.t + 1.5 * period
        target = Target(
            time[None], i[None], event[None], limit, None, levels, Result.SECTION_MISSED
        )
        moved, tape = record(s, lanes, u, target, settings, h, result, tangents=True)
        end = moved.lanes
        if anchored:
            anchor = jax.tree_util.tree_map(lambda x, y: jnp.where(first, x, y), end, anchor)
        return (end, moved.h, moved.result, anchor), (end, moved.result, tape)

    begin = (cycle.start, (0.1 * period / N)[None], jnp.zeros(1, jnp.int32), cycle.start)
    (*_, anchor), visited = jax.lax.scan(to_section, begin, jnp.arange(N + 1))
    bound = bind(anchor)
    visited, result, tape = jax.tree_util.tree_map(
        lambda x: jnp.moveaxis(x[..., 0], 0, -1), visited
    )
    lanes = jax.tree_util.tree_map(lambda x: x[..., :-1], visited)
    tape = jax.tree_util.tree_map(lambda x: x[..., 1:], tape)
    normal = _normals(s, bound, lanes)
    f = slopes(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, N)))
    speed = jnp.concatenate([jnp.ones((1, N)), f]).T
    share = jnp.abs(normal * speed)
    flat = jnp.max(share, axis=1) == 0
    drop = jnp.where(flat, -1, jnp.argmax(share, axis=1))
    with_time = jnp.isinf(bound.time) & (system.period() is not None)
    dims = jnp.array(s.dims)[lanes.chart] + with_time - ~flat
    placed = PlacedSections(
        cycle, sections, bound, lanes, tape, jnp.diff(visited.t), result[1:], drop, dims, normal
    )
    return placed, result[0]


def _normals(s: Structure, bound: Bound, lanes: Lanes) -> Float[Array, "N n"]:
    """Gradients of the levels with respect to (t, q)."""
    N = lanes.t.shape[0]
    out = jnp.zeros((1 + s.d, N))
    if bound.levels is None:
        return out.T
    state_based = jnp.isinf(bound.time) & (bound.event < 0)
    for a in range(len(s.charts)):
        if not bound.levels.present(s, a):
            continue
        n = s.dims[a]
        here = state_based & (lanes.chart == a)

        def gradient(i, t, q, a=a):
            g = jax.grad(lambda t, q: bound.levels.level(s, a, i, t, q), argnums=(0, 1))(t, q)
            return jnp.concatenate([g[0][None], g[1]])

        def work(out, n=n, here=here, gradient=gradient):
            point = only(here, jnp.arange(N)), only(here, lanes.t), only(here, lanes.q[:n])
            return out.at[: 1 + n].set(jnp.where(here, by_lane(gradient)(*point), out[: 1 + n]))

        out = jax.lax.cond(here.any(), work, lambda out: out, out)
    return out.T
