r"""Random deviations from a cycle under weak noise, to first order.

Over a piece of the cycle the covariance C of deviations satisfies dC/dt = Df C + C Df^T + B B^T,
and events multiply it by saltation matrices; it is stationary if it is the same one period later
(periodic Lyapunov equation; S. Bittanti, P. Colaneri, Periodic systems, Springer 2009). Without a
clock the phase Z . x diffuses without bound. It is taken out, so that deviations are those across
the cycle, at equal phases.

`LimitCycle.fluctuations` calls `fluctuations`, and `_noisy` takes the stages in order: the effect
of each *piece* of the cycle (a part between events) and of each event (`_pieces`), one period
(`_around`), the stationary covariance (`_stationary`), and the covariance at the nodes
(`_within_pieces`). The order of the numbers in all vectors and matrices must stay: states, delay of
the last event, durations (`_Pieces`).

If covariances are wrong everywhere, look at `_pieces`; if they are wrong inside of pieces alone, at
`_within_pieces`; if durations are wrong, at `_events` and the last rows of `jump` in `_pieces`; if
the diffusion is, at `_diffusion`; if a stable cycle is refused, at `_stationary`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Index, NonNegative
from .._core.compilation import one_program
from .._core.executor import Array, is_traced, namespace, on_host, put, scan, solve
from .._core.showable import Showable
from .._core.text import number
from ..errors import ComputationError
from ..systems.structure import Structure
from ..systems.system import name_of
from .linear_flow import LinearFlow, Phases, linear_flow, rule
from .responses import closing, effect_of_pushes
from .return_map import SINGULAR
from .sensitivity import section_delay


# A standard deviation below this part of the largest one that the same noise could cause is a
# rounding error, and becomes zero. Smaller: states that noise does not reach get random digits, or
# roots of negative variances. Larger: noise that reaches a state through a weak coupling alone is
# lost.
_ROUNDING = 1e-12

Strengths = Mapping[str, NonNegative]
Resets = Mapping[str, Strengths]
Given = Strengths | None
GivenResets = Resets | None


@checked_methods
class Fluctuations(Showable, eqx.Module):
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
    """Matrix from states, delay of the last event and durations to the same numbers one period
    later."""
    joint: Float[Array, "n n"]
    """Stationary covariance of states, delay of the last event and durations."""
    varies: Bool[Array, " E"]
    """Whether the noise reaches each duration."""
    at_nodes: Float[Array, "P K d d"]
    unresolved: Float[Array, ""]
    """The largest difference of covariances at ends of pieces, computed in two ways."""
    to_nodes: Float[Array, "P K d d"]
    """Matrix from deviations at phase 0 to deviations at the nodes, across the cycle. `to_end`: to
    deviations at phase 0 one period later."""
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
        covariance = self.at_nodes
        if lag:
            d = covariance.shape[-1]
            power = namespace(covariance).linalg.matrix_power
            turns = power(self.step[:d, :d], lag - 1)
            covariance = self.to_nodes @ turns @ self.to_end @ covariance
        return self.flow.at(phase, self.period, covariance)[1]

    def durations(self, lag: Index = 0) -> Float[Array, "E E"]:
        """Covariance of durations (from each event to the next one of `events`) with durations
        `lag` periods before. The sum of all entries is the covariance of periods from the last
        event to the next such event."""
        n = len(self.joint) - len(self.events)
        xp = namespace(self.joint)
        later = xp.linalg.matrix_power(self.step, lag) @ self.joint
        both = self.varies[:, None] & self.varies
        return xp.where(both, later[n:, n:], 0.0)

    def __repr__(self):
        system = self.structure.system
        name = name_of(system)
        if is_traced(self):
            return f"Fluctuations({name}, traced)"
        unit = system.time_unit
        rows = []
        if self.diffusion:
            diffusion = number(self.diffusion, unit=unit)
            rows.append(f"{diffusion}: diffusion of the phase")
        before = [*self.events[-1:], *self.events]
        deviations = np.sqrt(np.diag(self.durations()))
        for a, b, x in zip(before, self.events, deviations, strict=False):
            rows.append(f"{number(x, 6, unit)}: standard deviation from {a} to {b}")
        lines = "".join(f"\n  {row}" for row in rows)
        return f"Fluctuations({name})" + lines


def fluctuations(
    cycle: Any, white: Strengths, guards: Strengths, resets: Resets
) -> Fluctuations:
    """Deviations from a cycle under noise (see `LimitCycle.fluctuations`)."""
    return _noisy(cycle, linear_flow(cycle), white, guards, resets)


class _Pieces(NamedTuple):
    """The pieces of one period, each with the event at its end. Matrices act on vectors of n
    numbers: the d states, the delay of the last event, and the durations of the period so far."""

    forward: Float[Array, "P n n"]
    """The effect of the piece."""
    collected: Float[Array, "P n n"]
    """Covariance of the noise that is collected over the piece."""
    jump: Float[Array, "P n n"]
    """The effect of the event."""
    added: Float[Array, "P n n"]
    """Covariance of the noise that the event adds."""


class _Events(NamedTuple):
    """The events at the ends of pieces."""

    hit: Bool[Array, " P"]
    """Whether there is an event."""
    delay: Float[Array, "P d"]
    """Derivative of the time of the event by the state before it."""
    delay_by_noise: Float[Array, " P"]
    """Standard deviation of the time of the event by the noise in the level of its guard."""
    slot: Bool[Array, "P E"]
    """Which of the durations ends with the event."""


@one_program
def _noisy(
    cycle: Any, flow: LinearFlow, white: Any, guards: Any, resets: Any
) -> Fluctuations:
    """The fluctuations, from the linear flow. One period without fluctuations at its beginning
    gives the effect and the noise of a turn; a second one, that begins with the stationary
    fluctuations, gives the covariances on the way."""
    map = cycle.return_map
    s = map.structure
    xp = namespace(flow.q)
    levels, scatter = _at_events(s, guards, resets)
    events = _events(cycle, flow, levels)
    names = _names_of_events(cycle)
    columns = _columns(s, flow, white)
    pieces = _pieces(flow, events, columns, scatter)
    n = pieces.forward.shape[-1]
    d = flow.q.shape[-1]

    # One period that begins without fluctuations.
    none = xp.zeros((n, n))
    (turn, noise), (begin, *_) = _around(pieces, none)
    valid = xp.append(map.valid, xp.ones(n - d, bool))
    turn = xp.where(valid[:, None], turn, 0.0)
    field = flow.field[0, 0]
    phase = closing(map, turn[:d, :d], field).phase
    diffusion = _diffusion(map, phase, noise[:d, :d])

    # (A state ahead of the cycle meets the next events earlier.)
    no_noise = xp.zeros(n - d - 1)
    ahead = xp.concatenate([-field, xp.ones(1), no_noise])
    wide_phase = xp.append(phase, xp.zeros(n - d))
    across = xp.eye(n) + ahead[:, None] * wide_phase
    step = across @ turn
    noise = across @ noise @ across.T
    joint = _stationary(step, noise, d)

    # One period that begins with the stationary fluctuations.
    _, (_, before_pieces, before_events) = _around(pieces, joint)
    before_events = before_events[:, :d, :d]
    at_nodes = _within_pieces(flow, columns, before_pieces[:, :d, :d])
    unresolved = _largest_difference(at_nodes, before_events)
    to_end = flow.covectors(xp.eye(d))
    phase_at_nodes = (to_end @ phase)[..., None, :]
    along = flow.field[..., None] * phase_at_nodes
    across_nodes = np.eye(d) - along
    at_nodes = across_nodes @ at_nodes @ xp.swapaxes(across_nodes, -1, -2)
    sizes = map.scale[flow.chart]
    free, _ = flow.forward
    from_begin = across_nodes @ free @ begin[:, None, :d, :d]
    to_end_by_row = xp.swapaxes(to_end, -1, -2)
    to_section = across[:d, :d] @ to_end_by_row
    return Fluctuations(
        diffusion,
        tuple(names),
        s,
        flow,
        map.expected,
        step,
        joint,
        _varying_durations(events, before_events, sizes),
        _without_rounding(at_nodes, sizes),
        unresolved,
        from_begin,
        to_section,
    )


def _names_of_events(cycle: Any) -> list[str]:
    """Names of the events of a turn; of its section for an autonomous cycle without events."""
    map = cycle.return_map
    names = [map.structure.transitions[g].name for g in cycle.event_sequence]
    if names or map.base is None:
        return names
    return [str(map.base)]


def _events(cycle: Any, flow: LinearFlow, levels: np.ndarray) -> _Events:
    """The events of a cycle. For an autonomous cycle without events, its section counts as an
    event.

    `levels`: standard deviations of levels, by index of the transition."""
    map = cycle.return_map
    xp = namespace(flow.q)
    hit = flow.event >= 0
    delay = flow.jumps.delay_by_state
    if map.base is not None and not cycle.event_sequence:
        hit = put(hit, -1, True)
        delay_of_section, *_ = section_delay(map, flow.field[0, 0])
        delay = put(delay, -1, delay_of_section)
    level_of_event = xp.asarray(levels)[flow.event]
    delay_by_noise = level_of_event * flow.jumps.delay_by_level
    count = len(_names_of_events(cycle))
    number_of_event = xp.cumsum(hit)[:, None] - 1
    slot = (number_of_event == np.arange(count)) & hit[:, None]
    return _Events(
        hit=hit,
        delay=delay,
        delay_by_noise=delay_by_noise,
        slot=slot,
    )


def _pieces(
    flow: LinearFlow,
    events: _Events,
    columns: Float[Array, "P K d r"],
    scatter: Float[np.ndarray, "G d"],
) -> _Pieces:
    """The pieces of a turn. `columns`: effects of white noise on the states; `scatter`: standard
    deviations of states after events, by index of the transition."""
    xp = namespace(flow.q)
    P, _, d = flow.q.shape
    E = events.slot.shape[-1]
    n = d + 1 + E
    turned = xp.swapaxes(flow.adjoint, -1, -2) @ columns
    weights = flow.length[:, None] * rule().weights
    weight = weights[..., None, None]
    square = weight * turned @ xp.swapaxes(turned, -1, -2)
    collected = xp.sum(square, axis=1)
    free, _ = flow.forward
    stays = np.arange(n) >= d
    forward = _pad(free[:, -1], n) + np.diag(stays)
    # An event begins a new delay and ends a duration: the duration changes by the new delay minus
    # the delay of the event before.
    none = xp.zeros((P, d, 1 + E))
    each = events.slot[..., None]
    delay = events.delay[:, None]
    kept = 1.0 - events.hit[:, None, None]
    jump = xp.block(
        [
            [flow.jumps.by_state, none],
            [delay, kept, none[:, :1, 1:]],
            [each * delay, -1.0 * each, (1.0 - each) * np.eye(E)],
        ]
    )
    ones = xp.ones((P, 1))
    by_delay = xp.concatenate([flow.jumps.slip, ones, events.slot], axis=1)
    late = events.delay_by_noise[:, None] * by_delay
    deviations = xp.asarray(scatter)[flow.event]
    scattered = deviations[:, :, None] ** 2 * np.eye(d)
    by_noise = late[:, :, None] * late[:, None]
    added = by_noise + _pad(scattered, n)
    return _Pieces(forward, _pad(collected, n), jump, added)


def _around(pieces: _Pieces, covariance: Float[Array, "n n"]):
    """One period that begins with this covariance. Returns the derivative and the covariance at the
    end of the period; then both before each piece, and the covariance before each event."""

    def over_piece(carry, piece):
        forward, collected, jump, added = piece
        derivative, covariance = carry
        before_event = forward @ covariance @ forward.T + collected
        after = jump @ forward @ derivative, jump @ before_event @ jump.T + added
        return after, (derivative, covariance, before_event)

    begin = namespace(covariance).eye(len(covariance)), covariance
    return scan(over_piece, begin, tuple(pieces))


def _diffusion(
    map: Any, phase: Float[Array, " d"], noise: Float[Array, "d d"]
) -> Float[Array, ""]:
    """Growth of the variance of the phase per time. `phase`: gradient of the phase; `noise`:
    covariance that one period adds to the states."""
    xp = namespace(noise)
    spread = phase @ noise @ phase
    reached = spread > _rounding(phase, noise, map.sizes)
    return xp.where(reached, spread / map.expected, 0.0)


def _stationary(
    step: Float[Array, "n n"], noise: Float[Array, "n n"], d: int
) -> Float[Array, "n n"]:
    """The covariance that a turn keeps, which has this effect and adds this noise: first of the d
    states, whose deviations alone last for more than a turn.

    **Raises:** `ComputationError` for a cycle that is not stable.
    """
    xp = namespace(step)
    states = step[:d, :d]
    if on_host(step):
        largest = np.abs(np.linalg.eigvals(states)).max(initial=0.0)
        if not largest < 1 - SINGULAR:
            raise ComputationError(
                "noise drives deviations away, because the cycle is not stable."
            )
    lyapunov = np.eye(d * d) - xp.kron(states, states)
    of_states = xp.linalg.solve(lyapunov, noise[:d, :d].ravel())
    joint = _pad(of_states.reshape(d, d), len(step))
    # Durations depend on the states of this period and of the last one, so that two iterations
    # suffice.
    for _ in range(2):
        joint = step @ joint @ step.T + noise
    return joint


def _within_pieces(
    flow: LinearFlow,
    columns: Float[Array, "P K d r"],
    before: Float[Array, "P d d"],
) -> Float[Array, "P K d d"]:
    """Covariances of the states at the nodes of pieces, from those before the pieces."""
    xp = namespace(before)
    free, _ = flow.forward
    inward = solve(free, columns)
    h = flow.length[:, None, None, None]
    rate = h * inward @ xp.swapaxes(inward, -1, -2)
    # (Integrals are zero at the first node.)
    integral = np.linalg.inv(rule().derivative[1:, 1:])
    integral = np.pad(integral, [(1, 0), (1, 0)])
    collected = xp.einsum("ij,pjab->piab", integral, rate)
    from_begin = before[:, None] + collected
    return free @ from_begin @ xp.swapaxes(free, -1, -2)


def _largest_difference(
    at_nodes: Float[Array, "P K d d"], ends: Float[Array, "P d d"]
) -> Float[Array, ""]:
    """Largest difference of covariances at the ends of pieces, relative to those on the cycle."""
    xp = namespace(ends)
    apart = xp.abs(at_nodes[:, -1] - ends)
    difference = xp.max(apart, axis=0)
    variance = xp.abs(xp.diagonal(at_nodes, axis1=2, axis2=3))
    size = xp.sqrt(xp.max(variance, axis=(0, 1)))
    products = size[:, None] * size
    # (States that no noise reaches have products of zero.)
    return xp.max(difference / xp.maximum(products, 1e-300))


def _without_rounding(
    covariance: Float[Array, "P K d d"], sizes: Float[Array, "P d"]
) -> Float[Array, "P K d d"]:
    """Covariances with zeros for states that noise does not reach."""
    xp = namespace(covariance)
    variance = xp.diagonal(covariance, axis1=2, axis2=3)
    relative = variance / sizes[:, None] ** 2
    random = relative > _ROUNDING**2 * xp.max(relative)
    both = random[..., None] & random[..., None, :]
    return xp.where(both, covariance, 0.0)


def _varying_durations(
    events: _Events, before: Float[Array, "P d d"], sizes: Float[Array, "P d"]
) -> Bool[Array, " E"]:
    """Whether noise reaches each duration. `before`: covariances of the states before events."""
    xp = namespace(before)
    by_states = xp.einsum("pi,pij->pj", events.delay, before)
    variance = xp.sum(by_states * events.delay, axis=-1)
    of_piece = zip(events.delay, before, sizes, strict=True)
    rounding = xp.stack([_rounding(*x) for x in of_piece])
    has_noise = events.delay_by_noise != 0
    varies = events.hit & ((variance > rounding) | has_noise)
    late_ends = xp.any(varies[:, None] & events.slot, axis=0)
    # The delay of an event changes the durations before and after it.
    return late_ends | xp.roll(late_ends, 1)


def _rounding(
    gradient: Float[Array, " d"],
    covariance: Float[Array, "d d"],
    sizes: Float[Array, " d"],
) -> Float[Array, ""]:
    """The variance of a function with this gradient that may be a rounding error. It is the largest
    variance of a state times the square of the largest derivative, both in sizes."""
    xp = namespace(covariance)
    steepest = xp.max(xp.abs(gradient) * sizes)
    widest = xp.max(xp.abs(xp.diagonal(covariance)) / sizes**2)
    return _ROUNDING**2 * steepest**2 * widest


def _pad(x: Float[Array, "*P d d"], n: int) -> Float[Array, "*P n n"]:
    """Matrices with zeros for further rows and columns."""
    more = n - x.shape[-1]
    kept = [(0, 0)] * (x.ndim - 2)
    return namespace(x).pad(x, kept + [(0, more), (0, more)])


def _columns(
    s: Structure, flow: LinearFlow, white: Strengths
) -> Float[Array, "P K d r"]:
    """Effects of white noise of strength 1 on the states."""
    xp = namespace(flow.q)
    require_among("state or input", white, [*s.state_names(), *s.inputs], "`white`: ")
    of_states = []
    for chart in s.charts:
        strengths = [white.get(name, 0.0) for name in chart.states]
        padding = [0.0] * (s.d - len(strengths))
        of_states.append(strengths + padding)
    of_inputs = np.array([white.get(x, 0.0) for x in s.inputs])
    at_nodes = xp.asarray(of_states)[flow.chart]
    alone = at_nodes[:, None, :, None] * np.eye(s.d)
    direct = effect_of_pushes(s, flow) @ alone
    return xp.concatenate([direct, flow.by_input * of_inputs], axis=-1)


def _at_events(
    s: Structure, guards: Strengths, resets: Resets
) -> tuple[Float[np.ndarray, " G+1"], Float[np.ndarray, "G+1 d"]]:
    """Standard deviations of levels, and of states after events, by index of the transition. The
    last ones are zero, for no transition."""
    names = [transition.name for transition in s.transitions]
    require_among("transition", guards, names, "`guards`: ")
    require_among("transition", resets, names, "`resets`: ")
    levels = np.array([*(guards.get(name, 0.0) for name in names), 0.0])
    scatter = np.zeros((len(names) + 1, s.d))
    for row, transition in zip(scatter, s.transitions, strict=False):
        states = s.charts[s.chart_index(transition.target)].states
        chosen = resets.get(transition.name, {})
        require_among("state", chosen, states, f"`resets`: after '{transition.name}' ")
        row[: len(states)] = [chosen.get(state, 0.0) for state in states]
    return levels, scatter
