"""The functions whose zeros end a move: guards, and the level function of the target section."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, namespace, on_host, put
from .._core.lanes import pick, put_rows, shared
from ..systems.solver import Method
from ..systems.structure import Structure, stacked
from . import kernels
from .lanes import for_each_chart, only
from .solver import take_step
from .solver.step import LaneField, Step, short_step
from .solver.tableau import method_of
from .target import Target


class Watch(NamedTuple):
    """Watched functions at a point, signed so that they fall at their event: one row for each
    transition, and a last one for the target's level. Rows that mean nothing in a lane's chart
    have value 1 and rate 0."""

    value: Float[Array, "W L"]
    rate: Float[Array, "W L"]


def chart_field(
    s: Structure, a: int, u: Float[Array, "nu L"], some: Bool[np.ndarray, " L"] | None = None
) -> LaneField:
    """Field of chart a over lanes; on the host only `some`, if not all are needed."""
    if on_host(u):
        return lambda t, q: kernels.field(s, a, t, q, u, some)[:, 0]
    field = s.by_lane(lambda s, t, q, u: s.field(a, t, q, u), name=("field", a))
    return lambda t, q: field(t, q, u)


class Settled(NamedTuple):
    """Lanes moved onto the zero of the function that they cross."""

    past: Float[Array, " L"]
    """Time from the start to the zero."""
    q: Float[Array, "n L"]
    f: Float[Array, "n L"]
    """The field there."""
    last: Float[Array, " L"]
    """The part of `past` that the second of two corrections added."""
    error: Float[Array, "n L"]
    """A bound on the error of the first correction: the distance between two methods."""


class ChartFlow(NamedTuple):
    """What lanes meet in one chart: its field and its watched functions, under their inputs and
    for their targets."""

    s: Structure
    a: int
    u: Float[Array, "nu L"]
    target: Target
    some: Bool[np.ndarray, " L"] | None = None
    """On the host, the lanes that are needed; all, if that is not said."""

    @property
    def method(self) -> Method:
        return method_of(self.s, self.a)

    @property
    def field(self) -> LaneField:
        return chart_field(self.s, self.a, self.u, self.some)

    def only(self, some: Bool[Array, " L"]) -> "ChartFlow":
        """Itself for fewer lanes."""
        return self._replace(some=some) if on_host(some) and not some.all() else self

    @property
    def rows(self) -> list[int]:
        """Rows of a `Watch` that mean something here: the guards, and the target's level."""
        levels = self.target.levels
        level = levels is not None and shared(levels).present(self.s, self.a)
        return self.s.guards(self.a) + [len(self.s.transitions)] * level

    def step(
        self,
        t: Float[Array, " #L"],
        q: Float[Array, "n L"],
        h: Float[Array, " #L"],
        unroll: bool = False,
    ) -> Step:
        """A step from (t, q) over h (see `take_step`)."""
        if on_host(q):
            return kernels.step(self.s, self.a, t, q, self.u, h, self.some)
        return take_step(self.method, self.field, t, q, h, unroll)

    def step_along(
        self,
        t: Float[Array, " #L"],
        q: Float[Array, "n L"],
        h: Float[Array, " #L"],
        along: Float[Array, "n L"],
    ) -> tuple[Step, Float[Array, "n L"], Float[Array, "n L"]]:
        """A step, and the derivatives of its end and of its error along a direction of states."""
        if on_host(q):
            return kernels.step_along(self.s, self.a, t, q, self.u, h, along)
        field = self.field
        step = lambda q: take_step(self.method, field, t, q, h, still=field)  # noqa: E731
        value, tangent = jax.jvp(step, (q,), (along,))
        return value, tangent.q, tangent.error

    def watch(
        self, t: Float[Array, " #L"], q: Float[Array, "n L"], f: Float[Array, "n L"]
    ) -> Watch:
        """The watched functions, in the order of `rows`; f is the field there."""
        a, levels = self.a, self.target.levels
        if on_host(q):
            index = self.target.index
            rows = kernels.watched(self.s, a, levels, t, q, self.u, index, self.some)
            return Watch(rows[:, 0], rows[:, 1] + np.sum(rows[:, 2 : 2 + len(q)] * f, axis=1))
        level = levels is not None and shared(levels).present(self.s, a)
        kinds = self.s.guard_kinds(a)

        def one(s, levels, t, q, u, i, f):
            def all_of_them(t, q):
                rows = s.guard_values(kinds, t, q, u)
                return stacked(rows + ([levels.level(s, a, i, t, q)] if level else []))

            return jax.jvp(all_of_them, (t, q), (jnp.ones_like(t), f))

        many = self.s.by_lane(one, levels, name=("watch", a))
        return Watch(*many(t, q, self.u, self.target.index, f))

    def settle(
        self,
        t: Float[Array, " #L"],
        q: Float[Array, "n L"],
        f: Float[Array, "n L"],
        which: Int[Array, " L"],
        first: Float[Array, " L"] | None = None,
    ) -> Settled:
        """Two corrections onto the zero of watched function `which` (-1: stay).

        f is the field at (t, q). The first correction is a short step of known length, or if
        `first` is not given, of Newton's; the second is a Newton step. From the crossing itself (up
        to rounding) they change nothing, but carry the derivatives of the crossing's time and state
        exactly, to second order: this is the saltation formula.
        """
        field, rows = self.field, self.rows

        def newton(t, q, f):
            value, rate = self.watch(t, q, f)
            value, rate = pick(value, rows, which), pick(rate, rows, which)
            return -value / namespace(rate).where(rate == 0, 1.0, rate)

        first = newton(t, q, f) if first is None else first
        q, error = short_step(field, t, q, f, first)
        f = field(t + first, q)
        last = newton(t + first, q, f)
        return Settled(first + last, q + last * f, f, last, error)


def chart_flow(
    s: Structure, a: int, here: Bool[Array, " L"], u: Float[Array, "nu L"], target: Target
) -> ChartFlow:
    """The `ChartFlow` of the lanes `here`; the others are taken along as copies of one of them."""
    index = only(here, target.index)
    if index is not target.index:
        target = dataclasses.replace(target, index=index)
    return ChartFlow(s, a, only(here, u), target).only(here)


def slopes(
    s: Structure,
    t: Float[Array, " L"],
    chart: Int[Array, " L"],
    q: Float[Array, "d L"],
    u: Float[Array, "nu #L"],
) -> Float[Array, "d L"]:
    """The field at every lane."""

    def work(a, here, out):
        n = s.dims[a]
        f = chart_field(s, a, only(here, u))(only(here, t), only(here, q[:n]))
        return put(out, slice(n), xp.where(here, f, out[:n]))

    xp = namespace(q)
    return for_each_chart(s, chart, xp.ones(t.shape, bool), work, xp.zeros_like(q))


def watch(
    s: Structure,
    t: Float[Array, " L"],
    chart: Int[Array, " L"],
    q: Float[Array, "d L"],
    u: Float[Array, "nu L"],
    target: Target,
    mask: Bool[Array, " L"],
) -> Watch:
    """All watched functions at the lanes of `mask`."""

    def work(a, here, out):
        flow = chart_flow(s, a, here, u, target)
        if not flow.rows:
            return out
        point = only(here, t), only(here, q[: s.dims[a]])
        return write(out, flow.rows, here, flow.watch(*point, flow.field(*point)))

    return for_each_chart(s, chart, mask, work, nothing(s, t))


def nothing(s: Structure, t: Float[Array, " L"]) -> Watch:
    """A `Watch` of lanes at times t whose rows mean nothing."""
    xp, shape = namespace(t), (len(s.transitions) + 1, len(t))
    return Watch(xp.ones(shape), xp.zeros(shape))


def write(out: Watch, rows: list[int], here: Bool[Array, " L"], new: Watch) -> Watch:
    """`out` with its `rows` replaced by those of `new` for the lanes `here`."""
    return Watch(*(put_rows(x, rows, here, y) for x, y in zip(out, new, strict=True)))
