"""The maps P_{i->j} between Poincaré sections (paper eq. 3)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.compile import quick_jit
from .._core.errors import ComputationError, DefinitionError
from .._core.results import Result
from .._core.tracing import is_traced
from ..flow.move import move
from ..systems.structure import Structure
from .cycle import LimitCycle
from .place import PlacedSections, as_placed


class Arrival(NamedTuple):
    """Where a section map arrives."""

    t: Float[Array, ""]
    """Time of arrival; the cycle itself arrives at `placed.lanes.t[j]`, plus a period if j <= i."""
    q: Float[Array, " n"]
    """State in the chart in which the cycle crosses section j."""
    result: Int[Array, ""]
    """`Result` code."""


class SectionMap(eqx.Module):
    """P_{i->j}: from a state on section i, under a constant input, to section j.

    Call it with `q` (n_i,), a state near section i of the cycle, `u` (nu,), zero by default, and
    `t`, the time there (by default the cycle's). It returns an `Arrival` and can be
    differentiated, jitted and vmapped.

    **Raises** (outside of JAX transformations): `ComputationError` if section j is not reached,
    or is reached in another chart than the cycle's.
    """

    placed: PlacedSections
    i: int = eqx.field(static=True)
    j: int = eqx.field(static=True)

    @property
    def fixed_point(self) -> Float[Array, " n"]:
        """The cycle's state at section i."""
        return self.placed.lanes.q[: self._dim(self.i), self.i]

    def _dim(self, k: int) -> int:
        return Structure(self.placed.cycle.system).dims[int(self.placed.lanes.chart[k])]

    def __call__(self, q, u=None, t=None) -> Arrival:
        q = jnp.asarray(q, float)
        if q.shape != self.fixed_point.shape:
            raise DefinitionError(
                f"the map starts on {self.placed.sections.describe(self.i)}, where the state has "
                f"shape {self.fixed_point.shape}; got {q.shape}."
            )
        nu = len(self.placed.cycle.system.inputs)
        u = jnp.broadcast_to(jnp.asarray(0.0 if u is None else u, float), (nu,))
        t = self.placed.lanes.t[self.i] if t is None else jnp.asarray(t, float)
        arrival, chart = _map(self.placed, self.i, self.j, q, u, t)
        if not is_traced((arrival, chart)):
            code = Result(int(arrival.result))
            if code == Result.OK and int(chart) != int(self.placed.lanes.chart[self.j]):
                raise ComputationError(
                    f"{self.placed.sections.describe(self.j)} is reached in another chart than on "
                    "the cycle: the start is too far from it."
                )
            if code != Result.OK:
                raise ComputationError(
                    f"{self.placed.sections.describe(self.j)} is not reached from section "
                    f"{self.i}: {code.message}."
                )
        return Arrival(arrival.t, arrival.q[: self._dim(self.j)], arrival.result)


def section_map(cycle: LimitCycle, sections, i: int, j: int) -> SectionMap:
    """The map P_{i->j} between two sections of a family on a cycle, for any i and j.

    For i = j it is the Poincaré return map. **Raises:** `DefinitionError` for an index out of
    range; `ComputationError` as `place_sections`.
    """
    placed = as_placed(cycle, sections)
    for k in (i, j):
        if not 0 <= k < placed.count:
            raise DefinitionError(
                f"section {k} does not exist; sections are 0..{placed.count - 1}."
            )
    return SectionMap(placed, int(i), int(j))


@quick_jit
def _map(placed, i, j, q, u, t):
    system = placed.cycle.system
    s = Structure(system)
    pick = slice(i, i + 1)
    lanes = placed.lanes
    q = jnp.zeros((s.d, 1)).at[: q.shape[0], 0].set(q)
    start = eqx.tree_at(
        lambda x: (x.t, x.q, x.chart, x.armed, x.events, x.pace),
        lanes,
        (t[None], q, lanes.chart[pick], lanes.armed[:, pick], lanes.events[pick],
         lanes.pace[:, pick]),
    )  # fmt: skip
    target = placed.target(jnp.array([j]), t[None], jnp.array([1 if j <= i else 0]))
    moved = move(system, start, u[:, None], target, placed.cycle.settings)
    end = moved.lanes
    return Arrival(end.t[0], end.q[:, 0], moved.result[0]), end.chart[0]
