"""`PlacedSections`: the sections of a family on a limit cycle, as `place_sections` returns them.

They have the time, chart and state of the cycle at each section, and the coordinates on it.
`linearize` asks for the Jacobians from section to section (`flow_jacobians`, `between`),
experiments for the targets of the flow (`onwards`) and for outputs (`observe`). Three things must
stay: the order of the fields, in which `locate.py` and `walk.py` pass them; the order (t, q, u) of
deviations; and that `lanes` lie in one period from section 0.

`frames` relates coordinates on a section to deviations of time and state: if matrices of
`linearize` are wrong and the flow is right, look there. If a flow stops before a section that it
would reach, look at the limit in `section_target`; if an event at a section is missed, at
`followed_at_once`.
"""

from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.boundary.checked import checked_methods
from .._core.call import once_in_call
from .._core.compilation import at_ease, host_first
from .._core.executor import (
    Array,
    cond,
    is_hidden,
    is_traced,
    namespace,
    on_host,
    to_host,
)
from .._core.html import card, facts
from .._core.meaning import require_as_made
from .._core.precision import require_x64
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import folded, how_many, number
from ..engine import kernels
from ..engine.events import due_at_once
from ..engine.lanes import Lanes, Tape, for_each_chart, needed, only
from ..engine.move import tape_jacobian
from ..engine.target import Target, until
from ..engine.watch import watch
from ..orbits.checks import check_outputs
from ..orbits.cycle import LimitCycle, orbit_picture
from ..systems.structure import Outputs, Structure
from ..systems.system import Output, OutputNames, name_of
from .families import AbstractSections, BoundSections, FamilyLike


@checked_methods
class PlacedSections(Showable, eqx.Module):
    """N sections of a family on a limit cycle.

    **Fields:**

    - `cycle`, `family`: the cycle, and the family that was placed on it.
    - `bound`: the family evaluated on the cycle.
    - `lanes`: the cycle's state at each section (N lanes), in order, within one period from
        section 0.
    - `tape`: the steps of the flow from each section to the next; None if the flow was repeated
        from that of a known cycle.
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
    tape: Tape | None
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
        lanes = self.lanes
        time = lanes.t[0]
        return namespace(lanes.t).append(time, lanes.q[:, 0])

    def __repr__(self):
        system = name_of(self.cycle.system)
        family = type(self.family).__name__
        count = how_many(self.n_sections, "section", "sections")
        head = f"PlacedSections({count} of a {family} on a cycle of {system}"
        if is_traced(self):
            return f"{head}, traced)"
        sections, dimension, start, _ = self._facts().values()
        return folded(
            f"{head}: {sections}; dimension {dimension}; section 0 at t = {start})"
        )

    def _repr_html_(self) -> str | None:
        if is_traced(self):
            return None
        lanes = to_host(self.lanes)
        drawn = orbit_picture(
            self.cycle.trajectory(), (lanes.t, lanes.chart, lanes.q.T)
        )
        title = f"{self.n_sections} of a {type(self.family).__name__}"
        return card("PlacedSections", title, facts(self._facts()), drawn)

    def _facts(self) -> dict[str, str]:
        names = self.cycle.structure.names
        unit = self.cycle.system.time_unit
        t, charts, *_ = to_host(self.lanes)
        durations = np.asarray(self.duration)
        dims = np.asarray(self.dims)
        shortest = np.min(durations)
        longest = np.max(durations)
        inside = (
            f"{np.sum(charts == a)} in {names[a]}"
            for a in dict.fromkeys(charts.tolist())
        )
        return {
            "sections": ", ".join(inside),
            "dimension": " to ".join(
                str(n) for n in np.unique([np.min(dims), np.max(dims)])
            ),
            "section 0 at t": number(t[0], unit=unit),
            "from one to the next": f"{shortest:.4g} to {number(longest, 4, unit)}",
        }

    def structure(self) -> Structure:
        """The system by the indices of its charts and transitions, made anew.

        **Raises:** `DefinitionError`, as `require_current`.
        """
        self.require_current()
        return self.cycle.structure

    def require_current(self) -> None:
        """**Raises:** `DefinitionError` if the system's code has changed since the cycle was found,
        or that of the sections since they were placed."""
        self.cycle.require_current()

        def compare():
            return require_as_made(self.family, "it was placed on a cycle")

        once_in_call(("compared", id(self)), self, compare)

    def observe(self, outputs: OutputNames) -> Float[Array, "N ny"]:
        """Outputs of the cycle at the sections, without input; NaN where a chart does not define
        them.

        **Raises:** `DefinitionError` for a name that is no output.
        """
        require_x64()
        return _observe(self, tuple(check_outputs(self.cycle, outputs).items))

    @property
    def time_is_state(self) -> Bool[Array, " N"]:
        """True if the time of crossing is a coordinate: on state-based sections of a clocked
        system."""
        return namespace(self.bound.time).isinf(self.bound.time) & self.cycle.clocked

    def frames(self) -> tuple[Float[Array, "N n c"], Float[Array, "N c n"]]:
        """Matrices from the coordinates on each section to deviations of (t, q), and back.

        Coordinate j is entry k(j) of (t, q), skipping t on clock sections and on autonomous
        systems, and skipping `drop`. If coordinate j changes by 1, the dropped entry changes by
        -normal_k / normal_drop, so that the point stays on the section.
        """
        normal = self.normal
        drop = self.drop[:, None]
        xp = namespace(normal)
        n = normal.shape[1]
        k = np.arange(n)
        unit = xp.eye(n)

        kept = (k != drop) & ((k > 0) | self.time_is_state[:, None])
        kept_first = xp.argsort(~kept, axis=1, stable=True)
        # A section has at most as many coordinates as its chart has states: (t, q) less the dropped
        # entry.
        exists = k < self.dims[:, None]
        select = xp.where(exists[:, :, None], unit[kept_first], 0.0)

        drops = drop >= 0
        of_dropped = xp.where(drops, xp.take_along_axis(normal, drop, axis=1), 1.0)
        slope = -normal / of_dropped
        is_dropped = (k == drop) & drops
        slopes_of_states = slope[:, None, :]
        along = xp.where(is_dropped[:, :, None], slopes_of_states, 0.0)
        return (unit + along) @ xp.swapaxes(select, 1, 2), select

    @property
    def flow_jacobians(self) -> tuple[Float[Array, "N c c"], Float[Array, "N c nu"]]:
        """A and B of the flow from each section to the next, padded; NaN if it failed."""
        placed = self if is_hidden(self) else to_host(self)
        s = self.structure()
        sizes = placed.across
        _, _, target = placed.onwards()
        assert placed.tape is not None
        with at_ease():
            jacobian, _ = tape_jacobian(
                s, placed.lanes, target, placed.tape, across=sizes
            )
        return placed.between(jacobian)

    def between(
        self, jacobian: Float[Array, "N n m"]
    ) -> tuple[Float[Array, "N c c"], Float[Array, "N c nu"]]:
        """A and B, padded, from the derivatives of (t, q) on the next section by (t, q) and the
        inputs on each section; NaN where the flow failed."""
        xp = namespace(jacobian)
        n = self.normal.shape[1]
        failed = self.result != Result.OK
        jacobian = xp.where(failed[:, None, None], xp.nan, jacobian)
        embed, select = self.frames()
        after = xp.roll(select, -1, axis=0)
        by_state = jacobian[:, :, :n]
        by_input = jacobian[:, :, n:]
        return after @ by_state @ embed, after @ by_input

    @property
    def across(self) -> Float[Array, "A d"] | None:
        """Magnitudes of the states, if deviations along the flow have no meaning: in an autonomous
        system with state-based sections. They are then projected out, so that they do not drown
        strong contraction (see `chain` in `engine/replay.py`). Otherwise None. On the host only."""
        hidden = (
            is_hidden(self) or self.cycle.clocked or np.isfinite(self.bound.time).any()
        )
        return None if hidden else to_host(self.cycle.settings.scale)

    def coordinates(self) -> tuple[tuple[str, ...], ...]:
        """Names of the coordinates on each section: deviations of the time of crossing (`t`) and
        of the chart's states, less the one that the section determines."""
        charts = self.structure().charts
        names = []
        placed = to_host(self)
        columns = placed.lanes.chart, placed.drop, placed.time_is_state
        for a, drop, timed in np.stack(columns, axis=1):
            entries = enumerate(("t", *charts[a].states))
            names.append(tuple(x for k, x in entries if k != drop and (k or timed)))
        return tuple(names)

    def target(
        self, i: Int[Array, " #L"], t: Float[Array, " L"], turns: Int[Array, " #L"]
    ) -> Target:
        """The target of lanes that flow to section i, `turns` periods after the first period."""
        return section_target(self.bound, self.lanes, self.cycle.period, i, t, turns)

    def onwards(self) -> tuple[Int[Array, " N"], Int[Array, " N"], Target]:
        """For each section, the next section, the number of periods until it (0 or 1), and the
        target of the flow to it."""
        following = (
            namespace(self.lanes.t).arange(self.n_sections) + 1
        ) % self.n_sections
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
    """The target of lanes that flow to section i, `turns` periods after the first period. They may
    arrive up to half a period later than the cycle."""
    xp = namespace(t)
    arrival = lanes.t[i] + turns * period
    time = xp.broadcast_to(bound.time[i] + turns * period, t.shape)
    limit = xp.maximum(arrival, t) + 0.5 * period
    return Target(
        time=time,
        index=i,
        event=bound.event[i],
        limit=limit,
        event_sequence=None,
        levels=bound.levels,
        missed=Result.SECTION_MISSED,
    )


def followed_at_once(
    s: Structure,
    lanes: Lanes,
    u: Float[Array, "nu #L"],
    at_event: Bool[Array, " L"],
    period: Float[Array, ""],
) -> Int[Array, " L"]:
    """The transitions (by index; -1: none) that happen at once after the event at which a section
    lies (`at_event`). A flow that begins on the section would miss such an event.

    **Arguments:** `u`: the inputs until the events.
    """
    xp = namespace(lanes.t)
    none = xp.full_like(lanes.chart, -1)

    def next_event():
        target = until(lanes.t)
        watched = watch(s, lanes.t, lanes.chart, lanes.q, u, target, at_event)
        return xp.where(at_event, due_at_once(s, lanes, watched, u, period), none)

    return cond(at_event.any(), next_event, lambda: none)


SectionsLike: TypeAlias = FamilyLike | PlacedSections
"""A family, a single section, a list of sections, or a family that was placed on the cycle."""


@host_first
def _observe(
    placed: PlacedSections, outputs: tuple[str | Output, ...]
) -> Float[Array, "N ny"]:
    s = placed.structure()
    u = namespace(placed.lanes.t).zeros((s.nu, placed.n_sections))
    return observe(s, s.resolve_outputs(outputs), placed.lanes, u).T


def observe(
    s: Structure, z: Outputs, lanes: Lanes, u: Float[Array, "nu L"]
) -> Float[Array, "ny L"]:
    """Outputs of every lane; NaN if its chart does not define them."""
    xp = namespace(lanes.t)
    L = lanes.t.shape[0]

    def work(a, mask, out):
        point = needed(
            mask, [only(mask, x) for x in (lanes.t, lanes.q[: s.dims[a]], u)]
        )
        if on_host(mask):
            rows = kernels.outputs(s, a, tuple(z.items), *point)
            values = rows[:, 0]
        else:
            values = s.by_lane(lambda s, t, q, u: z(a, t, q, u))(*point)
        return xp.where(mask, values, out)

    undefined = xp.full((len(z.names), L), xp.nan)
    return for_each_chart(s, lanes.chart, xp.ones(L, bool), work, undefined)
