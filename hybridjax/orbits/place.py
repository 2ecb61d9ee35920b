"""A section family evaluated on a limit cycle: where each section lies, and that it is sound."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.compile import quick_jit
from .._core.errors import ComputationError, DefinitionError
from .._core.lanewise import by_lane
from .._core.results import Result
from .._core.tracing import is_traced
from ..flow.lanes import Lanes, only
from ..flow.move import Settings, move
from ..flow.sections import AbstractSections, Bound, Crossing, ListLevels, as_sections
from ..flow.target import Target
from ..flow.watch import slopes, watch
from ..systems.structure import Structure
from .cycle import LimitCycle


# Crossings are counted over one period from this fraction of it on.
_OFF = 0.1234567
# A section is tangent to the cycle if its level changes slower than this fraction of its fastest
# rate.
_STEEP = 1e-4


# Steps that the flow from one section to the next may take.
PATIENCE = 1024


class PlacedSections(eqx.Module):
    """N sections of a family on a limit cycle.

    **Fields:**

    - `cycle`, `sections`: what was placed where.
    - `bound`: the family with its numbers filled in.
    - `lanes`: the cycle's state at each section (N lanes), in order, within one period from
        section 0.
    - `duration` (N,): time from section i to the next.
    - `result` (N,): `Result` codes of the flow from section i to the next.
    - `drop` (N,): the coordinate of (t, states...) that is left out on section i, or -1.
    - `dims` (N,): number of coordinates on each section.
    - `normal` (N, 1+d): gradient of section i's level; zero on clock and event sections.
    """

    cycle: LimitCycle
    sections: AbstractSections
    bound: Bound
    lanes: Lanes
    duration: Float[Array, " N"]
    result: Int[Array, " N"]
    drop: Int[Array, " N"]
    dims: Int[Array, " N"]
    normal: Float[Array, "N n"]

    @property
    def count(self) -> int:
        return self.sections.count

    @property
    def time_is_state(self) -> Bool[Array, " N"]:
        """Whether the time of crossing is a coordinate: on state-based sections of a clocked
        system."""
        return jnp.isinf(self.bound.time) & self.cycle.clocked

    def frames(self) -> tuple[Float[Array, "N n c"], Float[Array, "N c n"]]:
        """Matrices from the coordinates on each section to deviations of (t, q), and back."""
        return jax.vmap(_frames)(self.normal, self.drop, self.dims, self.time_is_state)

    def coordinates(self) -> tuple[tuple[str, ...], ...]:
        """Names of the coordinates on each section: deviations of the time of crossing (`t`) and
        of the chart's states, less the one that the section determines."""
        s = Structure(self.cycle.system)
        names = []
        for i in range(self.count):
            all_names = ("t", *s.charts[int(self.lanes.chart[i])].states)
            keep = [k for k in range(len(all_names)) if k != int(self.drop[i])]
            names.append(tuple(all_names[k] for k in keep if k or self.time_is_state[i]))
        return tuple(names)

    def target(self, i: Int[Array, " L"], t: Float[Array, " L"], turns: Int[Array, " L"]) -> Target:
        """The target of lanes that flow to section i, `turns` periods after the first turn.

        A lane gives up half a period after the cycle itself would have arrived.
        """
        arrival = self.lanes.t[i] + turns * self.cycle.period
        return Target(
            self.bound.time[i] + turns * self.cycle.period,
            i,
            self.bound.event[i],
            jnp.maximum(arrival, t) + 0.5 * self.cycle.period,
            None,
            self.bound.levels,
            Result.SECTION_MISSED,
        )


def place_sections(cycle: LimitCycle, sections) -> PlacedSections:
    """Find a family's sections on a cycle, and check them.

    **Arguments:** `sections`, a family (`ClockPhase`, `KinematicPhase`, `Sections`), or a list of
    `Crossing` and `AtEvent`.

    **Raises:** `ComputationError` that names the first section that the cycle does not cross,
    crosses more than once, touches tangentially, or meets out of order.
    """
    sections = as_sections(sections)
    s = Structure(cycle.system)
    sections.check(s)
    anchor, result = cycle.start, jnp.zeros(1, jnp.int32)
    if isinstance(sections.start, Crossing):
        anchor, result = find_on_cycle(cycle, sections.start)
    traced = is_traced((cycle, sections))
    if not traced:
        if int(result[0]) != Result.OK:
            raise ComputationError(
                f"the cycle has no point where {sections.start} (the anchor of section 0): "
                f"{Result(int(result[0])).message}."
            )
    placed, first = _place(cycle, sections, anchor, cycle.settings)
    if not traced:
        _check(placed, int(first))
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
    mine, theirs = ((c.system, c.start, c.period) for c in (cycle, other))
    if is_traced((mine, theirs)):
        return place_sections(cycle, sections.sections)
    if not eqx.tree_equal(mine, theirs):
        raise DefinitionError(
            "these sections were placed on another cycle: pass the family itself, e.g. "
            "`placed.sections`, and it is placed on this one."
        )
    return sections


def _patient(settings: Settings) -> Settings:
    return dataclasses.replace(settings, max_steps=max(settings.max_steps, PATIENCE))


@quick_jit
def find_on_cycle(cycle: LimitCycle, crossing: Crossing) -> tuple[Lanes, Array]:
    """The first point of the cycle, from its start on, where `crossing` happens."""
    s = Structure(cycle.system)
    start = cycle.start
    one = jnp.zeros(1, jnp.int32)
    target = Target(
        jnp.full(1, jnp.inf), one, one - 1, start.t + 1.5 * cycle.period,
        None, ListLevels((crossing,)), Result.SECTION_MISSED,
    )  # fmt: skip
    settings = dataclasses.replace(
        cycle.settings, max_steps=max(cycle.settings.max_steps, PATIENCE)
    )
    moved = move(cycle.system, start, jnp.zeros((s.nu, 1)), target, settings)
    return moved.lanes, moved.result


@quick_jit
def _place(
    cycle, sections, anchor: Lanes, settings: Settings
) -> tuple[PlacedSections, Int[Array, ""]]:
    """The sections on the cycle, and the `Result` of the way to section 0."""
    system, period = cycle.system, cycle.period
    s = Structure(system)
    N = sections.count
    settings = _patient(settings)
    u = jnp.zeros((s.nu, 1))
    f = slopes(s, anchor.t, anchor.chart, anchor.q, u)
    bound = sections.bind(s, period, anchor.chart[0], anchor.t[0], anchor.q[:, 0], f[:, 0])
    # Clock sections of the turn that begins at the anchor.
    turns = jnp.ceil((anchor.t[0] - bound.time[0]) / period - 1e-9)
    turns = jnp.where(jnp.isfinite(bound.time[0]), jax.lax.stop_gradient(turns), 0.0)
    bound = dataclasses.replace(bound, time=bound.time + turns * period)

    def to_section(carry, i):
        lanes, h, result, first = carry
        stay = first & isinstance(sections.start, Crossing)  # the anchor lies on section 0
        again = jnp.where((i == 0) & ~first, 1, 0)
        target = Target(
            jnp.where(stay, lanes.t, bound.time[i] + again * period),
            jnp.where(stay, -1, i)[None],
            bound.event[i][None],
            lanes.t + 1.5 * period,
            None,
            bound.levels,
            Result.SECTION_MISSED,
        )
        moved = move(system, lanes, u, target, settings, h, result)
        return (moved.lanes, moved.h, moved.result, jnp.zeros((), bool)), (
            moved.lanes,
            moved.result,
        )

    begin = (anchor, (0.1 * period / N)[None], jnp.zeros(1, jnp.int32), jnp.ones((), bool))
    order = jnp.concatenate([jnp.arange(N), jnp.zeros(1, int)])
    _, (visited, result) = jax.lax.scan(to_section, begin, order)
    visited = jax.tree_util.tree_map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), visited)
    lanes = jax.tree_util.tree_map(lambda x: x[..., :-1], visited)
    normal = _normals(s, bound, lanes)
    f = slopes(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, N)))
    speed = jnp.concatenate([jnp.ones((1, N)), f]).T
    share = jnp.abs(normal * speed)
    flat = jnp.max(share, axis=1) == 0
    drop = jnp.where(flat, -1, jnp.argmax(share, axis=1))
    with_time = jnp.isinf(bound.time) & (system.period() is not None)
    dims = jnp.array(s.dims)[lanes.chart] + with_time - ~flat
    placed = PlacedSections(
        cycle, sections, bound, lanes, jnp.diff(visited.t), result[1:, 0], drop, dims, normal
    )
    return placed, result[0, 0]


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


def _frames(
    normal: Float[Array, " n"], drop, dim, with_time
) -> tuple[Float[Array, "n c"], Float[Array, "c n"]]:
    """From section coordinates to (t, q), and back.

    Coordinate j is entry k(j) of (t, q), skipping t on clock sections and on autonomous systems,
    and skipping `drop`. A move in coordinate j takes the dropped entry along the section:
    -normal_k / normal_drop.
    """
    n = normal.shape[0]
    k = jnp.arange(n)
    kept = (k != drop) & ((k > 0) | with_time)
    order = jnp.argsort(~kept, stable=True)
    # One column more than a chart has states is never needed: (t, q) less the dropped entry.
    valid = jnp.arange(n) < dim
    select = jnp.where(valid[:, None], jnp.eye(n)[order], 0.0)
    slope = -normal / jnp.where(drop >= 0, normal[drop], 1.0)
    along = jnp.where((k == drop)[:, None], slope[None, :], 0.0)
    embed = (jnp.eye(n) + jnp.where(drop >= 0, along, 0.0)) @ select.T
    return embed, select


def _check(placed: PlacedSections, first: int) -> None:
    """Raise for the first section that is missed, tangent, out of order, or crossed twice."""
    N = placed.count
    describe = placed.sections.describe
    if first != Result.OK:
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
    counts, steepness = _crossings(placed)
    for i in range(N):
        if steepness[i] < _STEEP:
            raise ComputationError(
                f"{describe(i)} is tangent to the cycle: its level changes there at "
                f"{steepness[i]:.1g} of its fastest rate. Choose another level."
            )
        if counts[i] > 1:
            raise ComputationError(
                f"{describe(i)} is crossed {counts[i]} times in one period; a section must be "
                "crossed once. Restrict it to a chart, or choose another phase."
            )
    period = float(placed.cycle.period)
    total = float(np.sum(placed.duration))
    if abs(total - period) > 1e-6 * period:
        late = int(np.argmax(np.asarray(placed.duration)))
        raise ComputationError(
            f"the sections are out of order: {describe((late + 1) % N)} comes before section "
            f"{late} on the cycle, so that one round of all sections takes {total / period:.3g} "
            "periods."
        )
    short = int(np.argmin(np.asarray(placed.duration)))
    if float(placed.duration[short]) <= 1e-9 * period:
        raise ComputationError(
            f"{describe((short + 1) % N)} coincides with section {short} on the cycle; sections "
            "must be distinct."
        )


def _crossings(placed: PlacedSections) -> tuple[np.ndarray, np.ndarray]:
    """How often one period of the cycle crosses each section, and how steeply: the rate of a
    level on its section as a fraction of its fastest rate on the cycle."""
    event = np.asarray(placed.bound.event)
    counts = np.array([placed.cycle.order.count(g) if g >= 0 else 1 for g in event])
    steepness = np.ones(placed.count)
    if placed.bound.levels is None:
        return counts, steepness
    t, chart, q = placed.cycle.trajectory(1.25).dense(per_step=16)
    level, fastest, rate = (np.asarray(x) for x in _levels_along(placed, t, chart, q))
    same = (np.diff(t) > 0) & (np.diff(chart) == 0)
    falls = (level[:, :-1] > 0) & (level[:, 1:] <= 0) & same
    # One period of them, from a time at which no section is likely to lie.
    part = np.where(falls, level[:, :-1] / np.where(falls, level[:, :-1] - level[:, 1:], 1.0), 0.0)
    when = (t[:-1] + part * np.diff(t) - t[0]) / float(placed.cycle.period)
    falls &= (when > _OFF) & (when <= 1 + _OFF)
    state_based = np.isinf(np.asarray(placed.bound.time)) & (event < 0)
    counts = np.where(state_based, falls.sum(axis=1), counts)
    np.divide(np.abs(rate), fastest, out=steepness, where=state_based)
    return counts, steepness


@quick_jit
def _levels_along(placed: PlacedSections, t, chart, q):
    """Levels of all sections along a trajectory (N, p), their fastest rates (N,), and the rates
    on the sections themselves (N,)."""
    s = Structure(placed.cycle.system)
    zeros, p = jnp.zeros((s.nu, t.shape[0])), t.shape[0]
    far = jnp.full(p, jnp.inf)

    def one(i):
        target = Target(
            far, jnp.full(p, i), jnp.full(p, -1), far, None, placed.bound.levels, Result.OK
        )
        seen = watch(s, t, chart, q.T, zeros, target, jnp.ones(p, bool))
        return seen.value[-1], jnp.max(jnp.abs(seen.rate[-1]))

    level, fastest = jax.lax.map(one, jnp.arange(placed.count))
    lanes = placed.lanes
    f = slopes(s, lanes.t, lanes.chart, lanes.q, jnp.zeros((s.nu, placed.count)))
    rate = placed.normal[:, 0] + jnp.sum(placed.normal[:, 1:] * f.T, axis=1)
    return level, fastest, rate
