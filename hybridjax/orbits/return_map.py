"""The return map of a cycle.

One turn is cut into pieces, whose Jacobians are found together with the pieces: their product is
the Jacobian of the return map, and they themselves are the factors of the monodromy.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.executor import Array, namespace, on_host, scan, singular_values, stop_gradient
from .._core.memo import remembered
from .._core.results import Result
from ..engine import kernels
from ..engine.events import arm
from ..engine.jacobian import flow_jacobian
from ..engine.lanes import Lanes, start_lanes
from ..engine.move import move
from ..engine.replay import replay
from ..engine.settings import Settings
from ..engine.target import Target, toward, until
from ..engine.watch import slopes, watch
from ..linear.time_response import monodromy
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from .crossing import AtEvent, Crossing, ListLevels


# Pieces into which one turn is cut: their Jacobians are the factors of the monodromy. Doubled, a
# program runs a little longer, and strong contraction is seen a little better.
LEGS = 16
# An autonomous system flows freely up to this part of its last turn, then to the section. Nearer
# to 1, a shorter return is missed.
_FREE = 0.75
# J - I, in sizes of the states, is singular if its smallest singular value is below this. Doubled,
# cycles half as isolated are refused.
SINGULAR = 1e-7
# A turn closes if no state is further from where it began than this part of its size. Doubled,
# sweeps accept cycles of half the accuracy.
_CLOSED = 2e-8
# A system rests if no state moves by this many times what the accuracy leaves undecided. Doubled,
# cycles twice as large are taken for an equilibrium.
_REST = 1e3


class Return(NamedTuple):
    """Where one turn leads."""

    residual: Float[Array, " d"]
    """P(q) - q, less the step back to the values of conserved quantities (see `held`); NaN where
    the turn fails, or ends in another chart."""
    period: Float[Array, ""]
    """Time that the turn took."""
    result: Int[Array, ""]
    """`Result` code of the flow."""


class Turn(NamedTuple):
    """One turn with its derivatives: what Newton's method sees."""

    residual: Float[Array, " d"]
    """As in `Return`."""
    jacobian: Float[Array, "d d"]
    """Derivative of the residual by the state."""
    by_parameter: Float[Array, " d"] | None
    """Derivative of the residual along a direction in the parameters, if one was given."""
    legs: Lanes
    """States at the beginnings of the K pieces."""
    factors: Float[Array, "K d d"]
    """Jacobians of the flow over the pieces; for an autonomous system on the states modulo the
    direction of the flow."""
    codes: Int[Array, "K R"] | None
    """Events of each piece, by index of the transition; negative where there is none."""
    times: Float[Array, "K R"] | None
    """When they happened."""
    period: Float[Array, ""]
    distance: Float[Array, ""]
    """Largest part of the residual in sizes of the states."""
    result: Int[Array, ""]
    meetings: Int[Array, ""]
    """How often the turn met the section that it ended on, as far as its pieces show it."""

    @property
    def closed(self) -> Bool[Array, "..."] | Bool[np.ndarray, "..."]:
        """Whether it came back to where it began (also of many turns at once, on the host)."""
        return self.distance <= _CLOSED


class ReturnMap(eqx.Module):
    """The return map P of a system, and which of its fixed points is meant.

    **Fields:**

    - `system`; `settings` of the flow, with the sizes of the states.
    - `anchor`: one lane, the chart and the time of the clock at which every turn begins, and the
        state from which Newton's method starts.
    - `base`: the section of an autonomous system; `None` for a clocked one, whose section is the
        phase of the clock at the anchor.
    - `expected`: the period of one turn; for an autonomous system a rough value.
    - `conserved`: values of conserved quantities, by the name of the output; they choose one
        cycle of a family.
    - `multiplicity`: periods of the clock, or meetings with the section, in one turn.
    """

    system: HybridSystem
    settings: Settings
    anchor: Lanes
    base: Crossing | AtEvent | None
    expected: Float[Array, ""]
    conserved: dict[str, Float[Array, ""]]
    multiplicity: int = eqx.field(static=True)

    @remembered
    def structure(self) -> Structure:
        return Structure(self.system)

    @property
    def sizes(self) -> Float[Array, " d"]:
        """What counts as 1 in each state of the anchor's chart."""
        return self.sizes_in(self.anchor.chart)[0]

    def sizes_in(self, chart: Int[Array, " L"]) -> Float[Array, "L d"]:
        """What counts as 1 in each state of some charts."""
        return self.settings.scale[chart]

    @property
    def valid(self) -> Bool[Array, " d"]:
        """Which entries of the padded state the anchor's chart has."""
        s = self.structure
        chart = self.anchor.chart[0]
        return np.arange(s.d) < namespace(chart).asarray(s.dims)[chart]

    def at_phase_of(self, system: HybridSystem) -> "ReturnMap":
        """That of another system; a clocked one begins at the same phase of its own clock."""
        if self.base is not None:
            return dataclasses.replace(self, system=system)
        expected = self.multiplicity * jnp.asarray(system.period(), float)
        time = self.anchor.t * (expected / self.expected)
        anchor = eqx.tree_at(lambda x: x.t, self.anchor, time)
        return dataclasses.replace(self, system=system, anchor=anchor, expected=expected)

    def departure(self, q: Float[Array, " d"]) -> Lanes:
        """The lane at the beginning of a turn: an event that was just there is not due again."""
        s, anchor = self.structure, self.anchor
        lanes, xp = start_lanes(s, anchor.t, anchor.chart, q[:, None]), namespace(q)
        u, everywhere = xp.zeros((s.nu, 1)), xp.ones(1, bool)
        seen = watch(s, lanes.t, lanes.chart, lanes.q, u, until(lanes.t), everywhere)
        lanes = arm(s, lanes, seen, self.expected[None])
        if isinstance(self.base, AtEvent):
            own = np.arange(len(s.transitions))[:, None] == s.transition_index(self.base.name)
            lanes = lanes._replace(armed=lanes.armed & ~own)
        return lanes

    def turn(self, q: Float[Array, " d"]) -> Return:
        """One turn from a state on the section."""

        def flow(lanes, target, h, result):
            u = namespace(q).zeros((self.structure.nu, 1))
            moved = move(
                self.structure, lanes, u, target, self.settings, h, result, new_input=False
            )
            return moved, None

        there, _ = self.travel(q, flow)
        return there

    def turn_with_jacobian(
        self,
        q: Float[Array, " d"],
        wanted: Bool[Array, ""] | bool = True,
        direction: HybridSystem | None = None,
    ) -> Turn:
        """One turn from a state on the section, with its derivatives.

        **Arguments:** `wanted`: whether derivatives by the state are; otherwise they mean nothing.
        `direction`: in the parameters, a system whose numbers are the direction (the phase of the
        clock at the anchor stays what it is).
        """
        s, n, xp = self.structure, q.shape[0], namespace(q)
        growth = self._growth_of_times(direction)

        def flow(lanes, target, h, result):
            jacobian, moved, tape = flow_jacobian(
                s, lanes, target, self.settings, h, result, of_states=True, new_input=False,
                wanted=wanted,
            )  # fmt: skip
            factor = jacobian[0, 1 : n + 1]
            if direction is not None:

                def end(step):
                    grown = 1 + growth * step
                    begin = eqx.tree_at(lambda x: x.t, lanes, lanes.t * grown)
                    time = jnp.where(jnp.isfinite(target.time), target.time * grown, jnp.inf)
                    to = dataclasses.replace(target, time=time)
                    moved = Structure(_moved(self.system, direction, step))
                    return replay(moved, begin, jnp.zeros((s.nu, 1)), to, tape)[1][:, 0]

                # The parameter as one more state, which stays what it is.
                column = _derivative(end)[:, None]
                last = jnp.zeros((1, n + 1)).at[0, n].set(1.0)
                factor = jnp.concatenate([jnp.concatenate([factor, column], axis=1), last])
            return moved, (lanes, factor, tape.code, tape.t)

        there, (legs, factors, codes, times) = self.travel(q, flow)
        legs = jax.tree_util.tree_map(lambda x: xp.moveaxis(x[..., 0], 0, -1), legs)
        codes, product = codes[..., 0], monodromy(factors)
        off, by_state = self.held(q)
        jacobian = xp.where(self.valid[:, None], product[:n, :n], 0.0) - np.eye(n) - by_state
        by_parameter = None
        if direction is not None:
            hold = lambda step: self._with(_moved(self.system, direction, step)).held(q)[0]  # noqa: E731
            by_parameter = jnp.where(self.valid, product[:n, n], 0.0) - _derivative(hold)
        factors = factors[:, :n, :n]
        if self.base is not None:
            factors = self._across(legs, factors)
        defect = xp.abs(there.residual) + xp.abs(off)
        return Turn(
            there.residual, jacobian, by_parameter, legs, factors, codes, times[..., 0],
            there.period, xp.max(defect / self.sizes), there.result, self._meetings(legs, codes),
        )  # fmt: skip

    def judge(self, q: Float[Array, " d"], turn: Turn) -> Int[Array, ""]:
        """Whether a state lies on a cycle, and what is wrong if it does not: a `Result` code."""
        sizes, valid, xp = self.sizes, self.valid, namespace(q)
        defect = monodromy(turn.factors) - xp.diag(valid * 1.0) - self.held(q)[1]
        singular = singular_values(defect * sizes / sizes[:, None])
        smallest = xp.min(xp.where(np.arange(len(q)) < valid.sum(), singular, np.inf))
        code = xp.where(turn.result == Result.OK, Result.NOT_CONVERGED, turn.result)
        found = xp.where(smallest < SINGULAR, Result.SINGULAR, Result.OK)
        code = xp.where(turn.closed, found, code)
        if self.base is not None:
            same = turn.legs.chart == self.anchor.chart
            apart = xp.max(xp.abs(turn.legs.q - q[:, None]) / sizes[:, None], axis=0)
            farthest = xp.max(xp.where(same, apart, np.inf))
            still = farthest <= _REST * xp.maximum(self.settings.atol, turn.distance)
            extra = turn.meetings > self.multiplicity
            code = xp.where(turn.closed & extra, Result.EXTRA_TURNS, code)
            code = xp.where(turn.closed & still, Result.EQUILIBRIUM, code)
        return code.astype(np.int32)

    def held(self, q: Float[Array, " d"]) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """The step of the state that takes conserved quantities away from their values, as far as
        they are away, and its derivative (with the direction of the step held fixed).

        Along P(q) - q nothing that is conserved changes, so that P(q) - q and this step can add up
        to zero only where both are zero; and J - I is regular once the derivative is taken from it.
        """
        s, xp, sizes = self.structure, namespace(q), self.sizes
        if not self.conserved:
            return xp.zeros_like(q), xp.zeros((s.d, s.d))
        excess, gradient = self._excess(q)
        steep = xp.linalg.norm(gradient * sizes, axis=1, keepdims=True)
        steep = xp.where(steep > 0, steep, 1.0)
        back = sizes[:, None] * xp.linalg.pinv(gradient * sizes / steep) / steep.T
        back = stop_gradient(back)
        return back @ excess, back @ gradient

    def _excess(self, q: Float[Array, " d"]) -> tuple[Float[Array, " c"], Float[Array, "c d"]]:
        """Conserved quantities less their values, and the derivative."""
        s, names, t = self.structure, tuple(self.conserved), self.anchor.t[0]
        values = namespace(q).stack(list(self.conserved.values()))
        if on_host(q):
            a = int(self.anchor.chart[0])
            n = s.dims[a]
            point = t[None], q[:n, None], np.zeros((s.nu, 1))
            found = kernels.outputs(s, a, names, *point)[..., 0]
            gradient = np.zeros((len(names), s.d))
            gradient[:, :n] = found[:, 2 : 2 + n]
            return found[:, 0] - values, gradient
        outputs, u = s.resolve_outputs(names), jnp.zeros(s.nu)
        branches = [lambda q, a=a: outputs(a, t, q[: s.dims[a]], u) for a in range(len(s.charts))]
        excess = lambda q: jax.lax.switch(self.anchor.chart[0], branches, q) - values  # noqa: E731
        return excess(q), jax.jacfwd(excess)(q)

    def _with(self, system: HybridSystem) -> "ReturnMap":
        return dataclasses.replace(self, system=system)

    def travel(self, q: Float[Array, " d"], flow: Callable) -> tuple[Return, Any]:
        """One turn, piece by piece, each done by `flow`, and what `flow` returned besides."""
        targets, xp = self._leg_targets(), namespace(q)
        each, common = eqx.partition(targets, _per_lane(targets))

        def leg(carry, target):
            lanes, h, result = carry
            target = jax.tree_util.tree_map(lambda x: x[None], target)
            moved, extra = flow(lanes, eqx.combine(target, common), h, result)
            return (moved.lanes, moved.h, moved.result), extra

        first_step = (0.5 * self.expected / LEGS)[None]
        begin = (self.departure(q), first_step, xp.zeros(1, xp.int32))
        (end, _, result), extra = scan(leg, begin, each)
        same = (result[0] == Result.OK) & (end.chart[0] == self.anchor.chart[0])
        residual = xp.where(self.valid, end.q[:, 0], 0.0) - q - self.held(q)[0]
        residual = xp.where(same, residual, np.nan)
        return Return(residual, end.t[0] - self.anchor.t[0], result[0]), extra

    def _leg_targets(self) -> Target:
        """Targets of the pieces of one turn: K - 1 times, then the section it began on."""
        xp, t0, expected = namespace(self.anchor.t), self.anchor.t[0], self.expected
        k = xp.arange(1, LEGS + 1)
        if self.base is None:
            return toward(t0 + expected * k / LEGS, -1, t0 + 2 * expected)
        free = 1 - (1 - _FREE) / self.multiplicity
        time = xp.where(k < LEGS, t0 + free * expected * k / (LEGS - 1), np.inf)
        target = toward(time, -1, t0 + 3 * expected)
        last = k == LEGS
        if isinstance(self.base, AtEvent):
            event = self.structure.transition_index(self.base.name)
            event = xp.where(last, event, -1).astype(np.int32)
            return dataclasses.replace(target, event=event)
        index = xp.where(last, 0, -1).astype(np.int32)
        return dataclasses.replace(target, index=index, levels=ListLevels((self.base,)))

    def _meetings(self, legs: Lanes, codes: Int[Array, "K R"]) -> Int[Array, ""]:
        s, xp = self.structure, namespace(codes)
        if self.base is None:
            return xp.asarray(self.multiplicity, dtype=np.int32)
        if isinstance(self.base, AtEvent):
            own = codes == s.transition_index(self.base.name)
            return xp.sum(own, dtype=np.int32)
        K = legs.t.shape[0]
        target = dataclasses.replace(until(legs.t), levels=ListLevels((self.base,)))
        u, everywhere = xp.zeros((s.nu, K)), xp.ones(K, bool)
        level = watch(s, legs.t, legs.chart, legs.q, u, target, everywhere).value[-1]
        falls = (level[1:-1] > 0) & (level[2:] <= 0) & (legs.events[1:-1] == legs.events[2:])
        return 1 + xp.sum(falls, dtype=np.int32)

    def _across(self, legs: Lanes, factors: Float[Array, "K d d"]) -> Float[Array, "K d d"]:
        """The factors on the states modulo the direction of the flow.

        Along the flow of an autonomous system nothing contracts. Taken out of every factor, that
        direction cannot drown a strong contraction across it.
        """
        s, xp, sizes = self.structure, namespace(factors), self.sizes_in(legs.chart)
        f = slopes(s, legs.t, legs.chart, legs.q, xp.zeros((s.nu, legs.t.shape[0]))).T / sizes
        f = f / xp.linalg.norm(f, axis=1, keepdims=True)
        project = np.eye(s.d) - f[:, :, None] * f[:, None, :]
        project = project * sizes[:, :, None] / sizes[:, None, :]
        return xp.roll(project, -1, axis=0) @ factors @ project

    def _growth_of_times(self, direction: HybridSystem | None) -> Float[Array, ""]:
        """How fast all times of a turn grow, relatively, along a direction in the parameters:
        with the period of the clock, if there is one."""
        if direction is None or self.base is not None:
            return np.zeros(())
        period = lambda step: jnp.asarray(  # noqa: E731
            _moved(self.system, direction, step).period(), float
        )
        return _derivative(period) / period(0.0)


def turn_product(factors: Float[np.ndarray, "S K d d"]) -> Float[np.ndarray, "S d d"]:
    """Products of the factors of S turns, on the host."""
    return ft.reduce(lambda product, factor: factor @ product, np.moveaxis(factors, 1, 0))


def _derivative(function: Callable[[Array], Array]) -> Array:
    """Of a function of one number, at zero."""
    return jax.jvp(function, (jnp.zeros(()),), (jnp.ones(()),))[1]


def _moved(system: HybridSystem, direction: HybridSystem, step) -> HybridSystem:
    """`system`, with its parameters moved by `step` along `direction`."""
    return jax.tree_util.tree_map(
        lambda x, v: x + step * v if eqx.is_inexact_array(x) else x, system, direction
    )


def _per_lane(targets: Target) -> Target:
    """Mark the leaves of a `Target` that have one entry per lane."""
    marks = jax.tree_util.tree_map(lambda _: False, targets)
    fields = lambda x: (x.time, x.index, x.event, x.limit)  # noqa: E731
    return eqx.tree_at(fields, marks, (True,) * 4)
