"""`place_sections`: the sections of a family on a limit cycle, with derivatives.

It returns `PlacedSections`. The sections are located in `locate.py`; inside of programs of JAX,
they are located along the recorded itinerary of a known cycle if there is one (`walk.py`).
`place_along` computes derivatives of placed sections on the host, for `linearize`. `observed_at`
gives only the times of sections and the outputs, for fits.

All of these ways must agree. A `turn` is the recorded steps of the last period of the cycle
(`last_turn`).

If sections lie at wrong places, look at `locate.py`; if only their derivatives are wrong, at
`place_along` (host) or `walk.py` (programs); if sections of another cycle are accepted or refused,
at `as_placed`.
"""

import dataclasses
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.boundary.checked import checked
from .._core.compilation import quick_jit
from .._core.executor import (
    Array,
    is_inside_program,
    is_traced,
    to_host,
)
from .._core.host_derivatives import NotOnHostError, by_columns, require_program
from .._core.precision import require_x64
from ..engine import kernels
from ..engine.lanes import side_by_side
from ..engine.replay import Variation
from ..errors import DefinitionError
from ..orbits.checks import check_outputs
from ..orbits.crossing import Crossing, ListLevels
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import beginning, of_flow
from ..systems.structure import Structure
from .families import AbstractSections, FamilyLike, Orbit, as_family
from .locate import normals, place_by_turn, place_in_order, place_in_program
from .placed import PlacedSections, SectionsLike, observe
from .walk import walk_beside, walked


@checked
def place_sections(cycle: LimitCycle, sections: FamilyLike) -> PlacedSections:
    """Locate a family's sections on a cycle, and check them.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `sections`: a family (`ClockPhase`, `ArcLength`, `KinematicPhase`, `SectionList`), the number
      of sections of a clock, or a list of `Crossing` and `AtEvent`, which is sorted: section 0 is
      the first one, and the others follow in the order in which the cycle meets them
      (`placed.family.items`). Under transformations of JAX a list must be in order. The flow from
      each section to the next may take as many steps as the cycle's `settings` allow, and at least
      1024.

    **Returns:** `PlacedSections`, which every function takes in place of a family: `lanes`, the N
    states on the cycle, and `duration` (N,), the times from section to section.

    **Raises:** `DefinitionError` for a family that does not fit the system; `ComputationError` that
    names the first section that the cycle does not cross, crosses more than once, touches
    tangentially, or crosses out of order.

    **Example:**

    ```python
    placed = hj.sections.place_sections(cycle, sections)
    print(placed.duration)
    ```

    **Before:** `hj.find_limit_cycle`, `hj.ClockPhase`. **After:** `hj.linearize`,
    `hj.run_experiments`.
    """
    family = as_family(sections)
    require_x64(cycle, family)
    cycle.require_found()
    if not is_traced((cycle, family)):
        return place_in_order(cycle, family)
    family.check(cycle.structure)
    require_program()
    walk = walk_beside(cycle, family) if is_inside_program() else None
    if walk is not None:
        return walked(cycle, family, walk)[0]
    return place_in_program(cycle, family)


def as_placed(cycle: LimitCycle, sections: SectionsLike) -> PlacedSections:
    """Place `sections` on `cycle`. Sections that were already placed on it are returned as they
    are.

    **Raises:** `DefinitionError` for sections that were placed on another cycle; otherwise as
    `place_sections`.
    """
    if not isinstance(sections, PlacedSections):
        return place_sections(cycle, sections)
    require_x64(cycle)
    cycle.require_found()
    if sections.cycle is cycle:
        return sections
    both = [(c.system, c.anchor, c.period) for c in (cycle, sections.cycle)]
    if is_traced(both):
        return place_sections(cycle, sections.family)
    if not eqx.tree_equal(*jax.device_get(both)):
        raise DefinitionError(
            "these sections were placed on another cycle: pass the family itself, e.g. "
            "`placed.family`, and it is placed on this one."
        )
    return sections


def place_along(
    cycle: LimitCycle,
    family: AbstractSections,
    turn: Any,
    by_cycle: LimitCycle,
    by_family: AbstractSections,
) -> tuple[PlacedSections, kernels.Tangents, np.ndarray]:
    """Derivatives of placed sections in P directions, on the host. Returns N P sections as complex
    numbers, whose imaginary parts are derivatives (see `kernels.Tangents`); the structure; and the
    Jacobians (N, P, n, m) of the flow from section to section.

    **Arguments:** `by_cycle`, `by_family`: the directions, as derivatives of the cycle and of the
    family, with an axis of length P in front.

    **Raises:** `NotOnHostError` if the flow does not reach a section.
    """
    placed, flows = place_by_turn(cycle, family, turn)
    N = family.n_sections
    if np.any(placed.result):
        raise NotOnHostError
    P = len(jax.tree_util.tree_leaves((by_cycle, by_family))[0])
    s = cycle.structure
    bound = placed.bound
    x, longer = beginning(by_cycle, s.d, P)

    def follow(flow, by_levels, times, twice=False):
        starts, target, tapes = flow
        lanes, tape = side_by_side((starts, tapes))
        along = kernels.Tangents(s, by_cycle.structure, target.levels, by_levels, P)
        variation = Variation(along, lanes, target, tape, times, twice)
        return variation, variation.tangents(x), along

    if isinstance(family.anchor, Crossing):
        levels = ListLevels((cast(Crossing, by_family.anchor),))
        no_times = np.zeros((P, 1))
        _, tangents, _ = follow(flows.pop(0), levels, no_times)
        x = tangents[-1]
    # The points of the orbit that the family needs.
    M = family.points
    points = side_by_side(flows[0][0])
    moved_points = x[None]
    orbit = Orbit(
        period=cycle.period,
        t=points.t[:M],
        chart=points.chart[:M],
        q=points.q.T[:M],
    )
    if M > 1:
        share = np.arange(1, M + 1) / M
        along_period = longer[:, None] * share
        times = x[0][:, None] + along_period
        variation, tangents, _ = follow(flows.pop(0), None, times)
        moved_points = tangents[variation.first]
    by_time = np.moveaxis(moved_points[:, 0], 1, 0)
    by_state = np.moveaxis(moved_points[:, 1:], 2, 0)
    directions = by_cycle.structure, by_family, (longer, by_time, by_state)
    raw, by_bound = to_host(_bind_along(s, family, orbit, directions))
    # The flow from section to section, with the times of the sections.
    is_clock = np.isfinite(bound.time)
    by_time = np.zeros((P, N)) if by_bound.time is None else by_bound.time
    late = 0.0
    if is_clock[0]:
        shift = bound.time[0] - raw.time[0]
        late = np.rint(shift / cycle.period)
    last = np.arange(N + 1)[-len(flows[0][1].time) :]
    times = _moved_times(is_clock, by_time, longer, late, last)
    variation, tangents, along = follow(flows[0], by_bound.levels, times, True)
    t, chart, q, u = variation.points(tangents, variation.first[-N:])

    def many(y):
        return np.repeat(y, P)

    lanes = placed.lanes._replace(t=t, chart=chart, q=q)
    bound = dataclasses.replace(bound, time=many(bound.time), event=many(bound.event))
    normal = normals(along, bound, lanes, many(np.arange(N)), u)
    rows = dict(drop=many(placed.drop), dims=many(placed.dims), normal=normal)
    moved = dataclasses.replace(placed, bound=bound, lanes=lanes, **rows)
    return moved, along, variation.jacobians(tangents, placed.across)[-N:]


def _moved_times(
    is_clock: Bool[np.ndarray, " N"],
    by_time: Float[np.ndarray, "P N"],
    longer: Float[np.ndarray, " P"],
    late: float,
    ends: Int[np.ndarray, " k"],
) -> Float[np.ndarray, "P k"]:
    """Derivatives of the times of sections in P directions; zero for sections that depend on the
    state.

    **Arguments:** `by_time`: derivatives of the times within the first period. `longer`:
    derivatives of the period. `late`: number of periods by which all sections are later. `ends`:
    the sections; section N is section 0 one period later.
    """
    N = len(is_clock)
    section = ends % N
    periods = late + ends // N
    later = periods * longer[:, None]
    moved = by_time[:, section] + later
    return is_clock[section] * moved


def _observed(
    cycle: LimitCycle, family: AbstractSections, outputs: tuple[str, ...], _: Any
):
    """`observed_at` by `place_sections`."""
    placed = place_sections(cycle, family)
    return placed.lanes.t, placed.observe(outputs) if outputs else None


def _observed_along(arguments: tuple, directions: tuple) -> tuple[tuple, tuple]:
    """`_observed` on the host, and its derivatives."""
    (cycle, family, outputs, turn), (by_cycle, by_family, *_) = arguments, directions
    placed, s, _ = place_along(cycle, family, turn, by_cycle, by_family)
    lanes = placed.lanes
    P = s.directions
    u = s.pushed(np.arange(len(lanes.t)) % P)
    y = observe(s, check_outputs(cycle, outputs), lanes, u).T if outputs else None

    def split(x):
        return x.reshape(-1, P, *x.shape[1:])

    return kernels.parted(jax.tree_util.tree_map(split, (lanes.t, y)))


_observed_by_columns = by_columns(_observed, _observed_along, of_flow)


def observed_at(
    cycle: LimitCycle, family: AbstractSections, outputs: tuple[str, ...], turn: Any
) -> tuple[Array, Array | None]:
    """Times (N,) at which a cycle crosses a family's sections, and outputs (N, ny) there."""
    arguments = cycle, family, outputs, turn
    in_program = is_inside_program() and is_traced(cycle)
    if in_program and walk_beside(cycle, family) is not None:
        return _observed(*arguments)
    return _observed_by_columns(*arguments)


@quick_jit
def _bind_along(
    s: Structure, family: AbstractSections, orbit: Orbit, directions: tuple
):
    def bind(s, family, moving):
        period, t, q = moving
        return family.bind(
            s,
            Orbit(
                period=period,
                t=t,
                chart=orbit.chart,
                q=q,
            ),
        )

    begin = s, family, (orbit.period, orbit.t, orbit.q)

    def push(tangents):
        return eqx.filter_jvp(bind, begin, tangents)

    return eqx.filter_vmap(push, out_axes=(None, 0))(directions)
