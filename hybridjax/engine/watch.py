"""The functions whose zeros end a step: guards, and the level function of the target section.

Here these *watched functions* are only evaluated. The search calls `ChartFlow.watch` for values and
rates; the search and the replay call `ChartFlow.locate` for the zero near a given state, from which
crossings get their times and derivatives. Whether a function has crossed zero within a step is
decided in `search/accept.py`, and in `itinerary/flags.py` for trajectories that follow an
itinerary. All watched functions are signed so that they fall at their event: with a wrong sign,
events are missed or happen at once. Signs are given in `Structure.guard_values`, and by the `level`
of the target.

If a crossing has a wrong time, look at `ChartFlow.locate`; if functions of another chart are
evaluated, at `chart_flow` and `ChartFlow.rows`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.executor import namespace, on_host, put
from .._core.lanes import PerLane, pick, put_rows, shared
from ..systems.solver import Method
from ..systems.structure import Structure
from . import kernels
from .arrays import (
    AnyInputs,
    AnyTimes,
    Array,
    Index,
    Inputs,
    Mask,
    Padded,
    States,
    Times,
)
from .lanes import for_each_chart, only
from .runge_kutta import LaneField, Step, short_step, step_along, take_step
from .target import AbstractLevels, Target


class Watch(NamedTuple):
    """Values and rates of watched functions, signed so that they fall at their event. There is a
    row for each transition, and a last row for the target's level. Rows of other charts than a
    lane's own have the value 1 and the rate 0."""

    value: Float[Array, "W L"]
    rate: Float[Array, "W L"]


def chart_field(
    s: Structure, a: int, u: AnyInputs, some: Mask | None = None
) -> LaneField:
    """Field of chart a over lanes; on the host only for the lanes `some`, if not all are needed."""
    if on_host(u):
        return lambda t, q: kernels.field(s, a, t, q, u, some)[:, 0]
    field = s.by_lane(lambda s, t, q, u: s.field(a, t, q, u), name=("field", a))
    return lambda t, q: field(t, q, u)


class Located(NamedTuple):
    """Lanes moved onto the zero of the function that they cross."""

    past: Times
    """Time from the start to the zero."""
    q: States
    f: States
    """The field at the zero."""
    last: Times
    """The part of `past` that the second of two corrections added."""
    error: States
    """A bound on the error of the first correction: the distance from methods of order 2."""


class ChartFlow(NamedTuple):
    """The field and the watched functions of one chart. Inputs and targets are those of the lanes;
    a target gives its level function by index."""

    s: Structure
    a: int
    u: Inputs
    levels: AbstractLevels | PerLane | None
    index: Index
    subset: Mask | None = None
    """On the host, the lanes that are needed; `None` for all."""

    @property
    def method(self) -> Method:
        return self.s.method(self.a)

    @property
    def field(self) -> LaneField:
        return chart_field(self.s, self.a, self.u, self.subset)

    def only(self, some: Mask) -> "ChartFlow":
        """The flow of fewer lanes."""
        return self._replace(subset=some) if on_host(some) and not some.all() else self

    @property
    def has_level(self) -> bool:
        s = self.s
        a = self.a
        levels = self.levels
        if levels is None:
            return False
        return s.once(("level", a), (levels,), lambda: shared(levels).present(s, a))

    @property
    def rows(self) -> list[int]:
        """Rows of a `Watch` that belong to the chart: its guards, and the target's level if the
        chart has one."""
        rows = list(self.s.guards(self.a))
        if self.has_level:
            rows.append(len(self.s.transitions))
        return rows

    def step(self, t: AnyTimes, q: States, h: AnyTimes) -> Step:
        """A step from (t, q) over h (see `take_step`)."""
        if on_host(q):
            return kernels.step(self.s, self.a, t, q, self.u, h, self.subset)
        return take_step(self.method, self.field, t, q, h)

    def step_along(
        self, t: AnyTimes, q: States, h: AnyTimes, along: States
    ) -> tuple[Step, States, States]:
        """A step, and the derivatives of its end and of its estimate along a direction."""
        if on_host(q):
            return kernels.step_along(
                self.s, self.a, t, q, self.u, h, along, self.subset
            )
        return step_along(self.method, self.field, t, q, h, along)

    def watch(self, t: AnyTimes, q: States, f: States) -> Watch:
        """The watched functions, in the order of `rows`; f is the field there."""
        a = self.a
        levels = self.levels
        index = self.index
        if on_host(q):
            rows = kernels.watched(self.s, a, levels, t, q, self.u, index, self.subset)
            gradient = rows[:, 2 : 2 + len(q)]
            rate = rows[:, 1] + np.sum(gradient * f, axis=1)
            return Watch(rows[:, 0], rate)
        kinds = self.s.guard_kinds(a)

        def watch(s, levels, t, q, u, i, f):
            def functions(t, q):
                return kernels.watched_at(a, kinds, s, levels, t, q, u, i)

            return jax.jvp(functions, (t, q), (jnp.ones_like(t), f))

        of_lanes = self.s.by_lane(watch, levels, name=("watch", a))
        return Watch(*of_lanes(t, q, self.u, index, f))

    def locate(
        self,
        t: AnyTimes,
        q: States,
        f: States,
        which: Index,
        first: Times | None = None,
    ) -> Located:
        """The zero of watched function `which` (-1: none) near (t, q), where the field is f.

        Two corrections are made: a short step of the length `first` (default: Newton's), then a
        Newton step. If (t, q) is at the crossing up to rounding, they do not change it, but their
        derivatives are the exact first and second derivatives of the time and the state of the
        crossing: this is the saltation formula.
        """
        field = self.field
        rows = self.rows

        def newton(t, q, f):
            watched = self.watch(t, q, f)
            value = pick(watched.value, rows, which)
            rate = pick(watched.rate, rows, which)
            return -value / namespace(rate).where(rate == 0, 1.0, rate)

        step = newton(t, q, f) if first is None else first
        q, error = short_step(field, t, q, f, step)
        f = field(t + step, q)
        last = newton(t + step, q, f)
        return Located(
            past=step + last,
            q=q + last * f,
            f=f,
            last=last,
            error=error,
        )


def chart_flow(
    s: Structure, a: int, here: Mask, u: Inputs, target: Target
) -> ChartFlow:
    """The `ChartFlow` of the lanes `here`. Other lanes are replaced by copies of one of these."""
    flow = ChartFlow(
        s=s,
        a=a,
        u=only(here, u),
        levels=target.levels,
        index=only(here, target.index),
    )
    return flow.only(here)


def slopes(s: Structure, t: Times, chart: Index, q: Padded, u: AnyInputs) -> Padded:
    """The field at every lane."""

    def work(a, here, out):
        n = s.dims[a]
        field = chart_field(s, a, only(here, u))
        f = field(only(here, t), only(here, q[:n]))
        return put(out, slice(n), xp.where(here, f, out[:n]))

    xp = namespace(q)
    return for_each_chart(s, chart, xp.ones(t.shape, bool), work, xp.zeros_like(q))


def watch(
    s: Structure,
    t: Times,
    chart: Index,
    q: Padded,
    u: Inputs,
    target: Target,
    mask: Mask,
) -> Watch:
    """All watched functions at the lanes of `mask`."""

    def work(a, here, out):
        flow = chart_flow(s, a, here, u, target)
        if not flow.rows:
            return out
        time = only(here, t)
        state = only(here, q[: s.dims[a]])
        point = time, state
        watched = flow.watch(*point, flow.field(*point))
        return write(out, flow.rows, here, watched)

    return for_each_chart(s, chart, mask, work, no_events(s, t))


def no_events(s: Structure, t: Times) -> Watch:
    """A `Watch` of lanes at times t in which no row belongs to a chart: values 1, rates 0."""
    xp = namespace(t)
    shape = (len(s.transitions) + 1, len(t))
    return Watch(xp.ones(shape), xp.zeros(shape))


def write(out: Watch, rows: list[int], here: Mask, new: Watch) -> Watch:
    """`out` with some rows replaced by those of `new`, for the lanes `here`. `rows`: the rows in
    `out`."""
    value = put_rows(out.value, rows, here, new.value)
    rate = put_rows(out.rate, rows, here, new.rate)
    return Watch(value, rate)
