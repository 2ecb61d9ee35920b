"""A section family that was placed on a limit cycle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.results import Result
from ..engine.lanes import Lanes
from ..engine.tape import Tape
from ..engine.target import Target
from ..orbits.cycle import LimitCycle
from ..sections.families import AbstractSections, Bound
from ..systems.structure import Structure


class PlacedSections(eqx.Module):
    """N sections of a family on a limit cycle.

    **Fields:**

    - `cycle`, `family`: what was placed where.
    - `bound`: the family with its numbers filled in.
    - `lanes`: the cycle's state at each section (N lanes), in order, within one period from
        section 0.
    - `tape`: the way from each section to the next, step by step.
    - `duration` (N,): time from section i to the next.
    - `result` (N,): `Result` codes of the flow from section i to the next.
    - `drop` (N,): the coordinate of (t, states...) that is left out on section i, or -1.
    - `dims` (N,): number of coordinates on each section.
    - `normal` (N, 1+d): gradient of section i's level; zero on clock and event sections.
    """

    cycle: LimitCycle
    family: AbstractSections
    bound: Bound
    lanes: Lanes
    tape: Tape
    duration: Float[Array, " N"]
    result: Int[Array, " N"]
    drop: Int[Array, " N"]
    dims: Int[Array, " N"]
    normal: Float[Array, "N n"]

    @property
    def n_sections(self) -> int:
        return self.family.n_sections

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
        about = self.lanes.chart, self.drop, self.time_is_state
        for a, drop, timed in np.stack(about, axis=1):
            all_names = ("t", *s.charts[a].states)
            keep = [k for k in range(len(all_names)) if k != drop]
            names.append(tuple(all_names[k] for k in keep if k or timed))
        return tuple(names)

    def target(
        self, i: Int[Array, " #L"], t: Float[Array, " L"], turns: Int[Array, " #L"]
    ) -> Target:
        """The target of lanes that flow to section i, `turns` periods after the first turn.

        A lane gives up half a period after the cycle itself would have arrived.
        """
        arrival = self.lanes.t[i] + turns * self.cycle.period
        time = self.bound.time[i] + turns * self.cycle.period
        return Target(
            jnp.broadcast_to(time, t.shape),
            i,
            self.bound.event[i],
            jnp.maximum(arrival, t) + 0.5 * self.cycle.period,
            None,
            self.bound.levels,
            Result.SECTION_MISSED,
        )

    def onwards(self) -> tuple[Int[Array, " N"], Int[Array, " N"], Target]:
        """For each section, the one that follows, how many turns later, and the way to it."""
        following = (jnp.arange(self.n_sections) + 1) % self.n_sections
        turns = (following == 0).astype(jnp.int32)
        return following, turns, self.target(following, self.lanes.t, turns)


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
