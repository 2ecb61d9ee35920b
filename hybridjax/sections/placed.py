"""A section family that was placed on a limit cycle."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.boundary.checked import checked_methods
from .._core.compilation import host_first
from .._core.executor import Array, is_traced, namespace, on_host, to_host
from .._core.html import card, facts
from .._core.precision import require_x64
from .._core.results import Result
from .._core.text import number
from ..engine import kernels
from ..engine.lanes import Lanes, for_each_chart, needed, only
from ..engine.tape import Tape
from ..engine.target import Target
from ..orbits.cycle import LimitCycle, orbit_picture
from ..systems.output import Output, OutputNames
from ..systems.structure import Outputs, Structure
from .abstract import AbstractSections, BoundSections
from .families import FamilyLike


# A flow that does not arrive at its section gives up so many periods after the cycle itself would
# have arrived. Doubled: failures are noticed later, at the cost of a longer flow.
_GRACE = 0.5


@checked_methods
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
    bound: BoundSections
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
    def section_zero(self) -> Float[Array, " n"]:
        """Time and padded state at which the cycle meets section 0."""
        return jnp.append(self.lanes.t[0], self.lanes.q[:, 0])

    def __repr__(self):
        system, family = type(self.cycle.system).__name__, type(self.family).__name__
        head = f"PlacedSections({self.n_sections} sections of a {family} on a cycle of {system}"
        if is_traced(self):
            return f"{head}, traced)"
        placed = to_host(self)
        names, charts = self.structure().names, placed.lanes.chart
        inside = (f"{np.sum(charts == a)} in {names[a]}" for a in dict.fromkeys(charts.tolist()))
        start = number(placed.lanes.t[0], unit=self.cycle.system.time_unit)
        low, high = np.min(placed.dims), np.max(placed.dims)
        dimension = f"{low}" if low == high else f"{low} to {high}"
        return f"{head}: {', '.join(inside)}; dimension {dimension}; section 0 at t = {start})"

    def _repr_html_(self) -> str | None:
        if is_traced(self):
            return None
        placed, names = to_host(self), self.structure().names
        t, charts = placed.lanes.t, placed.lanes.chart
        ways, unit = np.asarray(self.duration), self.cycle.system.time_unit
        inside = (f"{np.sum(charts == a)} in {names[a]}" for a in dict.fromkeys(charts.tolist()))
        known = {
            "sections": ", ".join(inside),
            "dimension": f"{np.min(placed.dims)} to {np.max(placed.dims)}",
            "section 0 at t": number(t[0], unit=unit),
            "from one to the next": f"{np.min(ways):.4g} to {number(np.max(ways), 4, unit)}",
        }
        drawn = orbit_picture(self.cycle.trajectory(), (t, charts, placed.lanes.q.T))
        of = f"{self.n_sections} of a {type(self.family).__name__}"
        return card("PlacedSections", of, facts(known), drawn)

    def structure(self) -> Structure:
        """The system by the indices of its charts and transitions, made anew: where the sections
        are constants of compiled functions, it holds values of one trace that mean nothing in the
        next."""
        return Structure(self.cycle.system)

    def observe(self, outputs: OutputNames) -> Float[Array, "N ny"]:
        """Outputs of the cycle at the sections, without input; NaN where a chart does not define
        them.

        **Raises:** `DefinitionError` for a name that is no output.
        """
        require_x64()
        return _observe(self, tuple(self.structure().resolve_outputs(outputs).items))

    @property
    def time_is_state(self) -> Bool[Array, " N"]:
        """Whether the time of crossing is a coordinate: on state-based sections of a clocked
        system."""
        return namespace(self.bound.time).isinf(self.bound.time) & self.cycle.clocked

    def frames(self) -> tuple[Float[Array, "N n c"], Float[Array, "N c n"]]:
        """Matrices from the coordinates on each section to deviations of (t, q), and back."""
        return _frames(self.normal, self.drop, self.dims, self.time_is_state)

    def coordinates(self) -> tuple[tuple[str, ...], ...]:
        """Names of the coordinates on each section: deviations of the time of crossing (`t`) and
        of the chart's states, less the one that the section determines."""
        s = self.structure()
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

        Lanes that do not arrive give up in the end.
        """
        return section_target(self.bound, self.lanes, self.cycle.period, i, t, turns)

    def onwards(self) -> tuple[Int[Array, " N"], Int[Array, " N"], Target]:
        """For each section, the one that follows, how many turns later, and the way to it."""
        xp = namespace(self.lanes.t)
        following = (xp.arange(self.n_sections) + 1) % self.n_sections
        turns = (following == 0).astype(np.int32)
        return following, turns, self.target(following, self.lanes.t, turns)


def section_target(
    bound: BoundSections,
    lanes: Lanes,
    period: Float[Array, ""],
    i: Int[Array, " #L"],
    t: Float[Array, " L"],
    turns: Int[Array, " #L"],
) -> Target:
    """See `PlacedSections.target`."""
    xp, arrival = namespace(t), lanes.t[i] + turns * period
    return Target(
        xp.broadcast_to(bound.time[i] + turns * period, t.shape),
        i,
        bound.event[i],
        xp.maximum(arrival, t) + _GRACE * period,
        None,
        bound.levels,
        Result.SECTION_MISSED,
    )


SectionsLike = FamilyLike | PlacedSections
"""A family, a single section, a list of sections, or a family that was placed on the cycle."""


@host_first
def _observe(placed: PlacedSections, outputs: tuple[str | Output, ...]) -> Float[Array, "N ny"]:
    s = placed.structure()
    u = namespace(placed.lanes.t).zeros((s.nu, placed.n_sections))
    return observe(s, s.resolve_outputs(outputs), placed.lanes, u).T


def _frames(
    normal: Float[Array, "N n"],
    drop: Int[Array, " N"],
    dims: Int[Array, " N"],
    with_time: Bool[Array, " N"],
) -> tuple[Float[Array, "N n c"], Float[Array, "N c n"]]:
    """From section coordinates to (t, q), and back.

    Coordinate j is entry k(j) of (t, q), skipping t on clock sections and on autonomous systems,
    and skipping `drop`. A move in coordinate j takes the dropped entry along the section:
    -normal_k / normal_drop.
    """
    xp, n = namespace(normal), normal.shape[1]
    k, drop, drops = np.arange(n), drop[:, None], drop[:, None] >= 0
    kept = (k != drop) & ((k > 0) | with_time[:, None])
    kept_first = xp.argsort(~kept, axis=1, stable=True)
    # One column more than a chart has states is never needed: (t, q) less the dropped entry.
    valid = k < dims[:, None]
    select = xp.where(valid[:, :, None], xp.eye(n)[kept_first], 0.0)
    slope = -normal / xp.where(drops, xp.take_along_axis(normal, drop, axis=1), 1.0)
    along = xp.where((k == drop)[:, :, None] & drops[:, None], slope[:, None, :], 0.0)
    embed = (xp.eye(n) + along) @ xp.swapaxes(select, 1, 2)
    return embed, select


def observe(
    s: Structure, z: Outputs, lanes: Lanes, u: Float[Array, "nu L"]
) -> Float[Array, "ny L"]:
    """Outputs of every lane, NaN where its chart does not define them."""
    L = lanes.t.shape[0]

    def work(a, here, out):
        point = needed(here, [only(here, x) for x in (lanes.t, lanes.q[: s.dims[a]], u)])
        if on_host(here):
            values = kernels.outputs(s, a, tuple(z.items), *point)[:, 0]
        else:
            values = s.by_lane(lambda s, t, q, u: z(a, t, q, u))(*point)
        return xp.where(here, values, out)

    xp = namespace(lanes.t)
    nothing = xp.full((len(z.names), L), xp.nan)
    return for_each_chart(s, lanes.chart, xp.ones(L, bool), work, nothing)
