"""Sections on a cycle near a known cycle, along the recorded itinerary of the known one.

The *itinerary* of the known cycle is the sequence of charts, steps and events from section to
section, stored as a table (`engine/itinerary`); a `Walk` has it. Inside of a program of JAX, where
nothing searches, a neighboring cycle follows it: one run gives times and states on the sections,
and the derivatives of the flow from each section to the next. `place.py` and `linearization.py`
call `walk_beside` (is there a walk?) and `walked`; fits call `walk_with` (`fitting/beside.py`).
Sections that leave the walk have a result code,
which must not get lost: where it is not OK, `linearization.py` computes matrices anew, or they are
NaN (`PlacedSections.between`). A *leg* is a part between two events or sections.

If sections leave the walk without need, look at the flags (`engine/itinerary/flags.py`); if their
times are wrong, at `_known_ends` and `_bound`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.compilation import at_ease
from .._core.executor import is_traced, on_the_cpu, to_host
from .._core.jax_compat import is_tracer, outside
from .._core.lanes import JACOBIAN_COLUMNS, by_jacobian
from .._core.memo import Memory, Recent
from .._core.results import Result
from ..engine.arrays import Array
from ..engine.itinerary.course import Travelers
from ..engine.itinerary.recorded import recorded_walk
from ..engine.itinerary.turn import Passage, follow
from ..engine.lanes import Lanes, pace_of
from ..engine.target import AbstractLevels
from ..orbits.crossing import Crossing, ListLevels
from ..orbits.cycle import LimitCycle
from ..orbits.near import known_beside
from ..orbits.repeat import Plan, has_route, maps_of
from ..orbits.return_map import ReturnMap
from ..orbits.scale import has_implicit
from .families import AbstractSections, BoundSections
from .locate import bind_at, coordinates_on, place_on_host, recorded_flows
from .placed import PlacedSections


# Number of steps of a walk, relative to the recorded ones, which may be too long for a neighboring
# system. Fewer: neighbors leave the walk. More: the walk takes longer. (The second number is for
# implicit methods, whose steps differ much in length.)
_DENSITY, _IMPLICIT_DENSITY = 2.0, 6.0
# Number of times the walk is run. The first run finds the ends of legs; in the last one, steps are
# then placed as on the known cycle. Fewer: neighbors leave the walk. More: time.
_PASSES = 2


class Walk(eqx.Module):
    """The way from a cycle's beginning to each of its N sections, and to the first section
    again."""

    lead: Plan | None
    """The way to the anchor of the family, if the anchor is a `Crossing`."""
    path: Plan
    """The way from the anchor to all sections."""
    period: Float[Array, ""]
    """Period of the known cycle."""
    late: Float[Array, ""]
    """Number of periods by which clock sections come later than the family says."""
    chart_at_anchor: Int[Array, "1"]
    arrivals: Int[Array, " K"]
    """Numbers of the legs that end on sections: on all N sections, and on the first one again."""
    begins_on_section: bool = eqx.field(static=True)
    """Whether the anchor is section 0, on which no leg then ends."""
    forwards: bool = eqx.field(static=True)
    """Whether only forward mode differentiates the walk."""
    armed: Bool[Array, "G N"]
    events: Int[Array, " N"]
    """Transitions that are armed, and numbers of events before, on the sections."""


_walks = Memory()
_recorded = Recent(8)
"""Walks of known cycles, by family."""


def walk_of(cycle: LimitCycle, family: AbstractSections) -> Walk | None:
    """The walk of a known cycle. None if flags cannot tell whether a neighbor follows it (see
    `has_route`), or if the family needs more than one point of the cycle.

    **Raises:** as `place_sections`.
    """
    recorded: tuple[Walk | None] | None = _recorded.get(cycle, family)
    if recorded is None:
        recorded = _recorded.keep((_walk(cycle, family),), cycle, family)
    return recorded[0]


def _walk(cycle: LimitCycle, family: AbstractSections) -> Walk | None:
    if family.points > 1 or not has_route(cycle.return_map):
        return None
    with outside(), on_the_cpu(), at_ease():  # (also while a program is traced)
        placed = to_host(place_on_host(cycle, family))
        lead, flow = recorded_flows(placed)
        s = placed.cycle.structure
        N = family.n_sections
        density = _IMPLICIT_DENSITY if has_implicit(s) else _DENSITY
        begins_on_section = lead is not None and family.at_anchor
        to = np.arange(int(begins_on_section), N + 1) % N
        before = None
        if lead is not None:
            assert isinstance(family.anchor, Crossing)
            at_anchor = ListLevels((family.anchor,))
            nowhere = np.zeros(len(lead[0].t), np.int32)
            before, _ = recorded_walk(s, lead, at_anchor, nowhere, False, density)
            if not before.certain:
                return None
        path, arrivals = recorded_walk(
            s, flow, placed.bound.levels, to, begins_on_section, density
        )
        if not path.certain or len(arrivals) < len(to):
            return None
        begin = jax.tree_util.tree_map(lambda x: x[..., :1], flow[0])
        raw = bind_at(placed.cycle.return_map, family, begin)
    late = 0.0
    if np.isfinite(raw.time[0]):
        late = placed.bound.time[0] - raw.time[0]
        late = np.rint(late / placed.cycle.period)
    return Walk(
        lead=None if before is None else Plan.of(before),
        path=Plan.of(path),
        period=np.asarray(placed.cycle.period),
        late=np.asarray(late),
        chart_at_anchor=begin.chart,
        arrivals=arrivals,
        begins_on_section=begins_on_section,
        forwards=False,
        armed=path.armed,
        events=path.begins,
    )


def walk_beside(cycle: LimitCycle, family: AbstractSections) -> Walk | None:
    """The walk for a traced cycle that was found from a known cycle; None if there is none."""
    for other, walk in _walks.get(cycle, None) or []:
        if other is family:
            return walk
    known = known_beside(cycle)
    if known is None or is_traced(known, family):
        return None
    return walk_of(known, family)


def walk_with(cycle: LimitCycle, family: AbstractSections, walk: Walk | None) -> None:
    """Remember that a traced cycle follows a walk to the sections of a family."""
    if walk is not None:
        noted: list[tuple] = _walks.recall(cycle, None, list)
        noted.append((family, walk))


def walked(
    cycle: LimitCycle, family: AbstractSections, walk: Walk
) -> tuple[PlacedSections, Float[Array, "N n m"]]:
    """The sections of a family on a cycle, and the derivatives of (t, q) on the next section by (t,
    q) and the inputs on each section. Sections that leave the walk have a result code."""
    map = cycle.return_map
    traced = [x.size for x in jax.tree_util.tree_leaves((map, family)) if is_tracer(x)]
    few = sum(traced) <= JACOBIAN_COLUMNS

    def find(moving):
        return _passed(walk, *moving, reverse=not (few or walk.forwards))

    by_columns = few and not walk.forwards
    begin, passage, code = (by_jacobian(find) if by_columns else find)((map, family))
    bound = _bound(map, family, walk, begin)
    N = family.n_sections
    lanes = Lanes(
        t=passage.pieces_t,
        chart=jnp.asarray(walk.path.charts),
        q=passage.pieces_q.T,
        armed=jnp.asarray(walk.armed),
        events=jnp.asarray(walk.events),
        pace=pace_of(jnp.asarray(walk.events)),
    )
    duration = jnp.diff(passage.pieces_t, append=passage.t[None])
    fields = bound, lanes, None, duration, jnp.full(N, code)
    placed = PlacedSections(cycle, family, *fields, *coordinates_on(map, bound, lanes))
    return placed, passage.factors


def _passed(
    walk: Walk, map: ReturnMap, family: AbstractSections, reverse: bool
) -> tuple[tuple, Passage, Int[Array, ""]]:
    """The time and the state at the anchor, the passage from the anchor to all sections, and the
    result code of both ways.

    **Arguments:** `reverse`: whether reverse mode differentiates every row of the walk.
    """
    start = map.anchor.t[0], map.anchor.q[:, 0]
    begin = start
    code = jnp.zeros((), jnp.int32)
    options: Any = dict(reverse=reverse)
    if walk.lead is not None:
        assert isinstance(family.anchor, Crossing)
        levels = ListLevels((family.anchor,))
        free = jnp.full_like(walk.lead.ends, jnp.inf)
        lead = _followed(
            map, walk, walk.lead, levels, start, free, columns=False, **options
        )
        begin = lead.t, lead.q
        code = _code(map, walk.lead, lead, start[0])
    bound = _bound(map, family, walk, begin)
    known = _known_ends(map, walk, bound)
    path = _followed(
        map, walk, walk.path, bound.levels, begin, known, columns=True, **options
    )
    of_path = _code(map, walk.path, path, begin[0])
    return begin, path, jnp.where(code == Result.OK, of_path, code)


def _bound(
    map: ReturnMap, family: AbstractSections, walk: Walk, begin: tuple
) -> BoundSections:
    """The family evaluated from the time and the state at its anchor."""
    t, q = begin
    anchor = map.anchor._replace(t=t[None], q=q[:, None], chart=walk.chart_at_anchor)
    bound = bind_at(map, family, anchor)
    return dataclasses.replace(bound, time=bound.time + walk.late * map.expected)


def _known_ends(map: ReturnMap, walk: Walk, bound: BoundSections) -> Float[Array, " E"]:
    """Times at which legs end on clock sections; infinity for other legs."""
    N = len(bound.time)
    k = np.arange(int(walk.begins_on_section), N + 1)
    times = bound.time[k % N] + (k // N) * map.expected
    return jnp.full_like(walk.path.ends, jnp.inf).at[walk.arrivals].set(times)


def _followed(
    map: ReturnMap,
    walk: Walk,
    path: Plan,
    levels: AbstractLevels | None,
    begin: tuple,
    known: Float[Array, " E"],
    columns: bool,
    reverse: bool,
) -> Passage:
    """A trajectory of a system on a path of a walk.

    **Arguments:** `known`: known times of the ends of legs; infinity for others.
    """
    maps = maps_of(map)
    travelers = Travelers(
        of=lambda numbers: maps.of(numbers).structure,
        numbers=maps.numbers,
        many=False,
        structure=map.structure,
    )
    return follow(
        travelers,
        levels,
        jax.lax.stop_gradient(map.settings),
        path.form,
        path.rows,
        None if reverse else path.count,
        begin,
        begin[0] + path.ends * (map.expected / walk.period),
        columns=columns,
        known=known,
        passes=_PASSES,
    )


def _code(map: ReturnMap, path: Plan, passage: Passage, begin) -> Int[Array, ""]:
    """The code of a trajectory on a path of a walk."""
    return path.code(*jax.lax.stop_gradient((passage, begin, map.expected)))
