"""The maps P_{i->j} between Poincaré sections, for any state near the cycle (paper eq. 3).

`section_map` returns a `SectionMap`, which users call with a state on section i. It flows to
section j (`_arrivals`) and returns an `Arrival`. `plot/returns.py` calls `arrivals` for many states
at once. A state that does not arrive, or arrives otherwise than the cycle, has a `Result` code and
NaN: `SectionMap.__call__` turns the code into an error, and programs of JAX get both. This must
stay so.

If a map is wrong, compare it with `linearize` at the cycle; if a state does not arrive, look at
`_PATIENCE` and at the search; if `EVENT_ORDER` is reported without need, at the last lines of
`_arrivals`.
"""

import dataclasses
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from .._core.arguments import require_axes, require_index
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Index, Numbers, Scalar
from .._core.boundary.members import leading_on
from .._core.boundary.values import Reals
from .._core.compilation import host_first, on_the_host
from .._core.executor import is_traced, namespace, put
from .._core.precision import require_x64
from .._core.results import Result, update_result
from .._core.showable import Showable
from .._core.text import folded, how_many
from ..engine.lanes import nan_where
from ..engine.move import move
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle
from ..systems.system import name_of
from .place import as_placed
from .placed import PlacedSections, SectionsLike, followed_at_once


# Number of periods after which a state is given up if it has not reached the section. Fewer: states
# far from the cycle do not arrive. More: states that never arrive take longer.
_PATIENCE = 100


@leading_on
class Arrival(NamedTuple):
    """The time and the state at which a trajectory arrives on the second section of a section map.
    If it does not arrive, time, state and their derivatives are NaN."""

    t: Float[Array, ""]
    """Time of arrival; the cycle itself arrives at `placed.lanes.t[j]`, plus a period if j <= i."""
    q: Float[Array, " n"]
    """State in the chart in which the cycle crosses section j."""
    result: Int[Array, ""]
    """`Result` code; `EVENT_ORDER` if section j is reached in another chart than the cycle's, or
    another event happens at once on one of the sections."""


@checked_methods
class SectionMap(Showable, eqx.Module):
    """P_{i->j}: from a state on section i, under a constant input, to section j.

    See `section_map`. Made under a JAX transformation, where charts are not known, it takes and
    returns states that are padded with zeros to the largest chart's dimension.

    **Raises** (outside of JAX transformations): `ComputationError` if section j is not reached,
    or is reached in another chart than the cycle's, and if another event happens at once on section
    i or j.
    """

    placed: PlacedSections
    i: int = eqx.field(static=True)
    j: int = eqx.field(static=True)
    dims: tuple[int, int] = eqx.field(static=True)
    """Dimensions n_i and n_j."""

    def __repr__(self):
        system = name_of(self.placed.cycle.system)
        states = how_many(self.dims[0], "state", "states")
        ends = " to ".join(map(self.placed.family.describe, (self.i, self.j)))
        return folded(f"SectionMap({system}: from {ends}; {states} to {self.dims[1]})")

    @property
    def fixed_point(self) -> Float[Array, " n"]:
        """The cycle's state at section i."""
        return self.placed.lanes.q[: self.dims[0], self.i]

    def __call__(
        self,
        q: Annotated[Numbers, Reals("n")],
        u: Annotated[Numbers, Reals()] | None = None,
        t: Scalar | None = None,
    ) -> Arrival:
        require_x64()
        if q.shape != self.dims[:1]:
            raise DefinitionError(
                f"`q` must be a state on {self.placed.family.describe(self.i)}, where the map "
                f"starts and states have the shape {self.dims[:1]}; got {q.shape}."
            )
        nu = self.placed.cycle.structure.nu
        held = np.zeros(nu) if u is None else u
        require_axes("`u`", held, {}, {"inputs": nu})
        arrival = _map(self, q, held, t)
        if is_traced(arrival):
            return arrival
        code = Result(int(arrival.result))
        if code != Result.OK:
            raise ComputationError(
                f"{self.placed.family.describe(self.j)} is not reached from section {self.i}: "
                f"{code.message}."
            )
        return arrival


@checked
def section_map(
    cycle: LimitCycle, sections: SectionsLike, i: Index, j: Index
) -> SectionMap:
    """Return the map P_{i->j} between two sections of a family on a cycle, for any i and j.

    For i = j it is the Poincaré return map.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `sections`: a family or `PlacedSections`.
    - `i`, `j`: indices of the first and the last section.

    **Returns:** a `SectionMap`. It is called with up to three arguments. `q` (n_i,): a state near
    section i of the cycle. `u` (nu,): a constant input. Default: 0. `t`: the time at section i.
    Default: that of the cycle. Its result has the time `t` and the state `q` (n_j,) at section j.
    The map can be differentiated, jitted and vmapped. It raises `ComputationError` if section j is
    not reached within 100 periods, or is reached in another chart than the cycle's. `fixed_point`
    is the cycle's state at section i, `dims` are n_i and n_j.

    **Raises:** `DefinitionError` for an index out of range; `ComputationError` as `place_sections`.

    **Example:**

    ```python
    returns = hj.sections.section_map(cycle, sections, 0, 0)
    arrival = returns(returns.fixed_point + 1e-3)
    print(arrival.t, arrival.q)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `jax.jacfwd`.
    """
    placed = as_placed(cycle, sections)
    for k in (i, j):
        require_index("section", k, placed.n_sections)
    s = placed.structure()
    chart = placed.lanes.chart
    dims = s.d, s.d
    if not is_traced(chart):
        first, last = np.asarray(chart)[[i, j]].tolist()
        dims = s.dims[first], s.dims[last]
    return SectionMap(placed, i, j, dims)


def arrivals(map: SectionMap, q: Float[np.ndarray, "n L"], patience: float) -> Arrival:
    """Return the arrivals of many states at once without input, NaN for those that do not arrive
    within `patience` periods. (On the host: a figure needs them once.)"""
    nu = map.placed.cycle.structure.nu
    count = q.shape[1]
    t = np.full(count, np.asarray(map.placed.lanes.t)[map.i])
    return _arrivals_on_host(map, q, np.zeros((nu, count)), t, patience)


@host_first
def _map(map: SectionMap, q, u, t) -> Arrival:
    xp = namespace(q)
    nu = map.placed.structure().nu
    t = map.placed.lanes.t[map.i] if t is None else t
    u = xp.broadcast_to(u, nu)[:, None]
    arrival = _arrivals(map, q[:, None], u, t[None], _PATIENCE)
    return Arrival(arrival.t[0], arrival.q[:, 0], arrival.result[0])


def _arrivals(map: SectionMap, q, u, t, patience) -> Arrival:
    """Arrivals of L lanes from states q (n_i, L) on section i at times t (L,), under inputs u
    (nu, L), within `patience` periods."""
    placed = map.placed
    i = map.i
    j = map.j
    s = placed.structure()
    xp = namespace(q)
    lanes = placed.lanes
    n, count = q.shape
    q = put(xp.zeros((s.d, count)), slice(n), q)
    # The chart and the armed guards are those of the cycle.
    start = jax.tree_util.tree_map(
        lambda x: xp.broadcast_to(x[..., i : i + 1], (*x.shape[:-1], count)), lanes
    )
    start = start._replace(t=t, q=q)
    turns = 1 if j <= i else 0
    # The flow to section j.
    target = placed.target(xp.full(count, j), t, xp.full(count, turns))
    late = target.limit + patience * placed.cycle.period
    # (The time of a clock section is the limit.)
    limit = xp.where(xp.isfinite(target.time), target.limit, late)
    target = dataclasses.replace(target, limit=limit)
    moved = move(s, start, u, target, placed.cycle.settings).moved
    end = moved.lanes
    # Tests: the chart at the end, and events that follow at once on section i or j.
    result = update_result(
        moved.result, end.chart != lanes.chart[j], Result.EVENT_ORDER
    )
    period = placed.cycle.period
    for k, on_section in ((i, start), (j, end)):
        at_event = (result == Result.OK) & (placed.bound.event[k] >= 0)
        missed = followed_at_once(s, on_section, u, at_event, period)
        result = update_result(result, missed >= 0, Result.EVENT_ORDER)
    failed = result != Result.OK
    n = map.dims[1]
    point = xp.concatenate([end.t[None], end.q[:n]])
    arrival = nan_where(failed, point)
    return Arrival(arrival[0], arrival[1:], result)


_arrivals_on_host = on_the_host(_arrivals)
