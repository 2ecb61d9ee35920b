r"""Random deviations from a cycle under weak noise, to first order.

Over a piece of the cycle the covariance C of deviations satisfies dC/dt = Df C + C Df^T + B B^T,
and events multiply it by saltation matrices; it is stationary where it closes over a turn (periodic
Lyapunov equation; S. Bittanti, P. Colaneri, Periodic systems, Springer 2009). Without a clock the
phase Z . x diffuses and is taken out: the deviations are those across the cycle at equal phases.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Index, NonNegative
from .._core.compilation import one_program
from .._core.executor import Array, is_traced, namespace, on_host, put, scan, solve
from .._core.text import number
from ..errors import ComputationError
from ..systems.structure import Structure
from .linear_flow import LinearFlow, linear_flow, rule
from .responses import Phases, loop, surface
from .return_map import SINGULAR
from .sensitivity import section_delay


# Largest standard deviation, relative to the largest to which the same noise could lead, that is
# rounding and becomes zero. Smaller: what the noise does not reach gets digits of chance, and roots
# of negative variances. Larger: noise that reaches a state through a weak coupling alone is lost.
_ROUNDING = 1e-12

Strengths = Mapping[str, NonNegative]
Resets = Mapping[str, Strengths]
Given = Strengths | None
GivenResets = Resets | None


@checked_methods
class Fluctuations(eqx.Module):
    """Stationary deviations from a cycle under noise (see `LimitCycle.fluctuations`).

    **Fields:**

    - `diffusion`: growth of the variance of the phase, in time, per time; 0 if a clock drives the
        system.
    - `events`: names of the events of one period; for an autonomous cycle without events, its
        section.
    """

    diffusion: Float[Array, ""]
    events: tuple[str, ...] = eqx.field(static=True)
    structure: Structure
    flow: LinearFlow
    period: Float[Array, ""]
    step: Float[Array, "n n"]
    """From states, the delay of the last event and durations to those one turn later."""
    joint: Float[Array, "n n"]
    """Their stationary covariance."""
    varies: Bool[Array, " E"]
    """Whether the noise reaches each duration."""
    at_nodes: Float[Array, "P K d d"]
    unresolved: Float[Array, ""]
    """The largest difference of covariances at ends of pieces, computed in two ways."""
    to_nodes: Float[Array, "P K d d"]
    """From deviations at phase 0 to those at the nodes, across the cycle; `to_end` one turn on."""
    to_end: Float[Array, "P K d d"]

    def covariance(self, phase: Phases, lag: Index = 0) -> Float[Array, "p d d"]:
        """Covariance of the states at some phases, right after events, with those `lag` periods
        before. Rows and columns have the order of the chart's states, and zeros beyond.

        Without a clock phases are asymptotic phases, and deviations along the cycle are left out
        (see `diffusion`).

        **Raises:** `ComputationError` if an implicit method steps over fast decays.
        """
        if on_host(self.period) and self.unresolved > SINGULAR:
            raise ComputationError(
                "steps skip fast decays: use an explicit method or `durations`."
            )
        C, d = self.at_nodes, self.at_nodes.shape[-1]
        if lag:
            turns = namespace(C).linalg.matrix_power(self.step[:d, :d], lag - 1)
            C = self.to_nodes @ turns @ self.to_end @ C
        return self.flow.at(phase, self.period, C)[1]

    def durations(self, lag: Index = 0) -> Float[Array, "E E"]:
        """Covariance of the durations that end at the `events` of a turn, each since the event
        before, with those `lag` turns before. The sum of all entries is the covariance of periods
        from the last event to the next such event."""
        n = len(self.joint) - len(self.events)
        xp, varies = namespace(self.joint), self.varies
        later = xp.linalg.matrix_power(self.step, lag) @ self.joint
        return xp.where(varies[:, None] & varies, later[n:, n:], 0.0)

    def __repr__(self):
        name, unit = (
            type(self.structure.system).__name__,
            self.structure.system.time_unit,
        )
        if is_traced(self):
            return f"Fluctuations({name}, traced)"
        rows = [f"{number(self.diffusion, unit=unit)}: diffusion of the phase"]
        rows = rows if self.diffusion else []
        before, spread = (
            [*self.events[-1:], *self.events],
            np.sqrt(np.diag(self.durations())),
        )
        for a, b, x in zip(before, self.events, spread, strict=False):
            rows.append(f"{number(x, 6, unit)}: standard deviation from {a} to {b}")
        return f"Fluctuations({name})" + "".join(f"\n  {x}" for x in rows)


def fluctuations(
    cycle: Any, white: Strengths, guards: Strengths, resets: Resets
) -> Fluctuations:
    """Deviations from a cycle under noise (see `LimitCycle.fluctuations`)."""
    return _noisy(cycle, linear_flow(cycle), white, guards, resets)


@one_program
def _noisy(
    cycle: Any, flow: LinearFlow, white: Any, guards: Any, resets: Any
) -> Fluctuations:
    map, events = cycle.return_map, cycle.event_sequence
    s, period = map.structure, map.expected
    levels, scatter = _at_events(s, guards, resets)
    xp, jumps = namespace(flow.q), flow.jumps
    (P, _, d), clocked, f = flow.q.shape, map.base is None, flow.field[0, 0]
    names = [s.transitions[g].name for g in events] or (
        [] if clocked else [str(map.base)]
    )
    n, E = d + 1 + len(names), len(names)
    sizes = map.scale[flow.chart]
    # Noise in the states, collected over each piece.
    B, (free, _) = _columns(s, flow, white), flow.forward
    turned = xp.swapaxes(flow.adjoint, -1, -2) @ B
    weight = (flow.length[:, None] * rule().weights)[..., None, None]
    collected = xp.sum(weight * turned @ xp.swapaxes(turned, -1, -2), axis=1)
    # Noise of events, and what each makes of the states before, of the delay of the last event,
    # and of durations.
    hit, delay = flow.event >= 0, jumps.delay_by_state
    if not (clocked or events):  # the section is the event
        hit, delay = put(hit, -1, True), put(delay, -1, section_delay(map, f)[0])
    slot = (xp.cumsum(hit)[:, None] - 1 == np.arange(E)) & hit[:, None]
    each, none = slot[..., None], xp.zeros((P, d, 1 + E))
    jump = xp.block(
        [
            [jumps.by_state, none],
            [delay[:, None], 1.0 - hit[:, None, None], none[:, :1, 1:]],
            [each * delay[:, None], -1.0 * each, (1.0 - each) * np.eye(E)],
        ]
    )
    late = xp.asarray(levels)[flow.event] * jumps.delay_by_level
    late = late[:, None] * xp.concatenate([jumps.slip, xp.ones((P, 1)), slot], axis=1)
    added = late[:, :, None] * late[:, None]
    added += _pad(xp.asarray(scatter)[flow.event][:, :, None] ** 2 * np.eye(d), n)
    forward = _pad(free[:, -1], n) + np.diag(np.arange(n) >= d)

    def turn(carry, piece):
        forward, collected, jump, added = piece
        (M, C), after = carry, forward @ carry[1] @ forward.T + collected
        return (jump @ forward @ M, jump @ after @ jump.T + added), (M, C, after)

    pieces = forward, _pad(collected, n), jump, added
    (M, Q), (begin, *_) = scan(turn, (xp.eye(n), xp.zeros((n, n))), pieces)
    M = xp.where(xp.append(map.valid, xp.ones(n - d, bool))[:, None], M, 0.0)
    _, Z = loop(map, M[:d, :d], f)
    spread, to_end = Z @ Q[:d, :d] @ Z, flow.covectors(xp.eye(d))
    reached = spread > _rounding(Z, Q[:d, :d], map.sizes)
    diffusion = xp.where(reached, spread / period, 0.0)
    # (A state ahead of the cycle meets the next events earlier.)
    ahead = xp.concatenate([-f, xp.ones(1), xp.zeros(E)])
    last = xp.eye(n) + ahead[:, None] * xp.append(Z, xp.zeros(n - d))
    across = np.eye(d) - flow.field[..., None] * (to_end @ Z)[..., None, :]
    step, Q = last @ M, last @ Q @ last.T
    states, noise = step[:d, :d], Q[:d, :d]
    if (
        on_host(step)
        and not np.abs(np.linalg.eigvals(states)).max(initial=0.0) < 1 - SINGULAR
    ):
        raise ComputationError(
            "noise drives deviations away, because the cycle is not stable."
        )
    joint = xp.linalg.solve(np.eye(d * d) - xp.kron(states, states), noise.ravel())
    joint = _pad(joint.reshape(d, d), n)
    for _ in range(
        2
    ):  # durations follow from the states of this turn and from the last
        joint = step @ joint @ step.T + Q
    _, (_, C, after) = scan(turn, (xp.eye(n), joint), pieces)
    inward = solve(free, B)
    rate = flow.length[:, None, None, None] * inward @ xp.swapaxes(inward, -1, -2)
    integral = np.pad(np.linalg.inv(rule().derivative[1:, 1:]), [(1, 0), (1, 0)])
    whole = xp.einsum("ij,pjab->piab", integral, rate)
    C = free @ (C[:, None, :d, :d] + whole) @ xp.swapaxes(free, -1, -2)
    off = xp.max(xp.abs(C[:, -1] - after[:, :d, :d]), axis=0)
    size = xp.sqrt(xp.max(xp.abs(xp.diagonal(C, axis1=2, axis2=3)), axis=(0, 1)))
    unresolved = xp.max(off / xp.maximum(size[:, None] * size, 1e-300))
    C = across @ C @ xp.swapaxes(across, -1, -2)
    variance = xp.diagonal(C, axis1=2, axis2=3) / sizes[:, None] ** 2
    random = variance > _ROUNDING**2 * xp.max(variance)
    C = xp.where(random[..., None] & random[..., None, :], C, 0.0)
    # A delay of an event counts for the durations before and after it.
    before, by_level = after[:, :d, :d], xp.asarray(levels)[flow.event]
    late = xp.sum(xp.einsum("pi,pij->pj", delay, before) * delay, axis=-1)
    of_chance = xp.stack(
        [_rounding(*x) for x in zip(delay, before, sizes, strict=True)]
    )
    by_noise = hit & ((late > of_chance) | (by_level * jumps.delay_by_level != 0))
    late_ends = xp.any(by_noise[:, None] & slot, axis=0)
    varies = late_ends | xp.roll(late_ends, 1)
    to_end = last[:d, :d] @ xp.swapaxes(to_end, -1, -2)
    return Fluctuations(
        diffusion,
        tuple(names),
        s,
        flow,
        period,
        step,
        joint,
        varies,
        C,
        unresolved,
        across @ free @ begin[:, None, :d, :d],
        to_end,
    )


def _rounding(
    gradient: Float[Array, " d"],
    covariance: Float[Array, "d d"],
    sizes: Float[Array, " d"],
) -> Float[Array, ""]:
    """The variance of a function with this gradient that may be rounding: that of the most random
    state, times the square of the largest derivative, both by sizes."""
    xp = namespace(covariance)
    steepest = xp.max(xp.abs(gradient) * sizes)
    widest = xp.max(xp.abs(xp.diagonal(covariance)) / sizes**2)
    return _ROUNDING**2 * steepest**2 * widest


def _pad(x: Float[Array, "*P d d"], n: int) -> Float[Array, "*P n n"]:
    more = n - x.shape[-1]
    return namespace(x).pad(x, [(0, 0)] * (x.ndim - 2) + [(0, more), (0, more)])


def _columns(
    s: Structure, flow: LinearFlow, white: Strengths
) -> Float[Array, "P K d r"]:
    """Effects of white noise of strength 1 on the states."""
    xp = namespace(flow.q)
    require_among("state or input", white, [*s.state_names(), *s.inputs], "`white`: ")
    names = [(*chart.states, *[""] * s.d)[: s.d] for chart in s.charts]
    of_states = xp.asarray([[white.get(x, 0.0) for x in states] for states in names])
    direct = surface(s, flow) @ (of_states[flow.chart][:, None, :, None] * np.eye(s.d))
    driven = flow.by_input * np.array([white.get(x, 0.0) for x in s.inputs])
    return xp.concatenate([direct, driven], axis=-1)


def _at_events(s: Structure, guards: Strengths, resets: Resets):
    """Standard deviations of levels and of states after events, by index of the transition."""
    names = [x.name for x in s.transitions]
    for argument, given in (("guards", guards), ("resets", resets)):
        require_among("transition", given, names, f"`{argument}`: ")
    scatter = np.zeros((len(names) + 1, s.d))
    for row, x in zip(scatter, s.transitions, strict=False):
        states, chosen = (
            s.charts[s.chart_index(x.target)].states,
            resets.get(x.name, {}),
        )
        require_among("state", chosen, states, f"`resets`: after '{x.name}' ")
        row[: len(states)] = [chosen.get(y, 0.0) for y in states]
    return np.array([*(guards.get(x, 0.0) for x in names), 0.0]), scatter
