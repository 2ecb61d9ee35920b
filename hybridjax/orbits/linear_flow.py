"""The linearized flow along one period of a cycle, dense between events.

`linear_flow(cycle, ...)` returns a `LinearFlow`. Responses, fluctuations, continuous HTFs and
sensitivities are computed from it. The recorded steps of the last *turn* (the flow once around the
cycle) are divided into *pieces*, which end at events, with `NODES` nodes in each. The states at the
nodes come from shorter steps of the same method, and the field is linearized there. Deviations
(`forward`) and their adjoints (`adjoint`) then follow from linear collocation equations, without
further integration. At events, they are multiplied by the saltation matrix (`Jumps`). Two things
must stay: no event lies inside of a piece, and states are padded to the largest chart.

If a response is wrong everywhere, look at `_implicit`; if it is wrong after events, at `_jumps`; if
its derivatives by parameters are wrong, at `_along`; if it loses digits, at `NODES` and `_STEPS`.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Inexact, Int

from .._core.boundary.checked import NeedsValues
from .._core.boundary.kinds import Numbers
from .._core.boundary.values import Reals
from .._core.executor import Array, is_hidden, namespace, on_host, scan, solve, to_host
from .._core.host_derivatives import by_columns
from .._core.memo import Memory, remembered
from ..engine import kernels
from ..engine.lanes import (
    ARRIVE_LEVEL,
    ARRIVE_TIME,
    Lanes,
    Tape,
    fixed,
    for_each_chart,
    side_by_side,
)
from ..engine.replay import Moves, Variation, recorded_moves
from ..engine.saltation import jump
from ..engine.target import Target
from ..linear.time_response import monodromy
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.varied import Varied
from .return_map import ReturnMap, Turn, with_derivatives
from .scale import has_implicit


# Number of nodes of a piece, including both ends. Fewer: polynomials through them lose digits of
# responses. More: collocation equations grow.
NODES = 12

Phases = Annotated[Numbers, Reals("p")]


class Rule(NamedTuple):
    """Lobatto's nodes on [0, 1], weights of integrals and matrices of polynomials through them."""

    nodes: Float[np.ndarray, " K"]
    weights: Float[np.ndarray, " K"]
    derivative: Float[np.ndarray, "K K"]
    """Matrix from values at the nodes to derivatives at the nodes."""
    coefficients: Float[np.ndarray, "K K"]
    """Matrix from values at the nodes to coefficients of Legendre's polynomials."""


@ft.lru_cache
def rule() -> Rule:
    """Lobatto's rule with `NODES` nodes."""
    legendre = np.polynomial.legendre
    unit = np.eye(NODES)
    derivatives = [legendre.legder(e) for e in unit]
    # (The roots are real, but NumPy 2.5 and later return complex numbers.)
    inner = legendre.legroots(derivatives[-1]).real
    x = np.r_[-1.0, np.sort(inner), 1.0]
    x = (x - x[::-1]) / 2
    values = legendre.legvander(x, NODES - 1)
    slopes = np.stack([legendre.legval(x, e) for e in derivatives], axis=1)
    inverse = np.linalg.inv(values)
    return Rule(
        nodes=(x + 1) / 2,
        weights=inverse[0],
        derivative=2 * slopes @ inverse,
        coefficients=inverse,
    )


def polynomials(x: Float[Array, " p"]) -> Float[Array, "p K"]:
    """Legendre's polynomials at points of [0, 1]."""
    xp = namespace(x)
    z = 2 * x - 1
    rows = [xp.ones_like(z), z]
    for k in range(1, NODES - 1):
        # Bonnet's recursion.
        before, last = rows[-2:]
        following = (2 * k + 1) * z * last - k * before
        rows.append(following / (k + 1))
    return xp.stack(rows, axis=-1)


class Jumps(NamedTuple):
    """Derivatives of the events at the ends of pieces. Where no event happens, deviations do not
    change."""

    by_state: Float[Array, "P d d"]
    """The saltation matrix."""
    by_input: Float[Array, "P d nu"]
    """Change of the state by an input, where guard or reset depend on it."""
    delay_by_state: Float[Array, "P d"]
    """Change of the time of the event by the state before it."""
    delay_by_input: Float[Array, "P nu"]
    slip: Float[Array, "P d"]
    """Change of the state after the event, at a fixed time, by the time of the event."""
    delay_by_level: Float[Array, " P"]
    """Change of the time of the event by the level of its guard, or by its schedule."""


class LinearFlow(eqx.Module):
    """One turn of a cycle in P pieces of K nodes, all padded to the largest chart's dimension."""

    t: Float[Array, "P K"]
    """Times of the system's clock."""
    length: Float[Array, " P"]
    chart: Int[Array, " P"]
    event: Int[Array, " P"]
    """Index of the transition at the end, negative for none."""
    q: Float[Array, "P K d"]
    field: Float[Array, "P K d"]
    by_state: Float[Array, "P K d d"]
    """Derivative of the field."""
    by_input: Float[Array, "P K d nu"]
    jumps: Jumps
    size: Float[Array, "P d"]
    """Magnitudes of the states."""

    @property
    def turn(self) -> Float[Array, " P"]:
        """Times of the beginnings of the pieces, since the beginning of the first one."""
        return self.t[:, 0] - self.t[0, 0]

    def evaluated(
        self, s: Structure, function: Callable, rows: int
    ) -> Float[Array, "P K rows n"]:
        """A function (see `with_derivatives`) at the nodes, and its derivatives."""
        P, K, d = self.q.shape
        chart = namespace(self.q).repeat(self.chart, NODES)
        q = self.q.reshape(P * K, d).T
        by = with_derivatives(s, function, chart, self.t.ravel(), q, rows)
        by = namespace(by).moveaxis(by, -1, 0)
        return by.reshape(P, K, rows, -1)

    def after(self, map: ReturnMap) -> Float[Array, "P K"]:
        """Times of the nodes: of the clock, or for an autonomous cycle, since the anchor."""
        return self.t if map.base is None else self.t - self.t[0, 0]

    def _implicit(
        self, sign: float, rows: slice, matrix: Float[Array, "P K d d"], size: Array
    ):
        """The inverse of (D + sign h matrix) on some of the nodes, where D takes derivatives at the
        nodes and h is the length of the piece. It is computed in sizes (magnitudes) of the
        states."""
        xp = namespace(self.q)
        d = self.q.shape[2]
        D = rule().derivative[rows, rows]
        n = len(D)
        ratio = size[:, :, None] / size[:, None]

        # Axes: piece, node, state, node, state.
        same_node = xp.eye(n)[:, None, :, None]
        same_state = np.eye(d)[:, None, :]
        in_sizes = matrix / ratio[:, None]
        field = same_node * in_sizes[:, rows, :, None, :]
        h = self.length[:, None, None, None, None]
        whole = D[:, None, :, None] * same_state
        whole = whole + sign * h * field
        right = np.eye(n * d)
        inverse = solve(whole.reshape(-1, n * d, n * d), right)
        inverse = inverse.reshape(-1, n, d, n, d)
        return inverse * ratio[:, None, :, None, :]

    @remembered
    def forward(self) -> tuple[Float[Array, "P K d d"], Float[Array, "P K d K d"]]:
        """Derivatives of the deviations at the nodes of each piece, by the deviation at the
        beginning of the piece, and by forces at the nodes (times the length of the piece)."""
        xp = namespace(self.q)
        d = self.q.shape[2]
        inverse = self._implicit(-1.0, slice(1, None), self.by_state, self.size)
        by_first = rule().derivative[1:, 0]
        free = -xp.einsum("piajb,j->piab", inverse, by_first)
        unit = xp.broadcast_to(xp.eye(d), (len(free), 1, d, d))
        free = xp.concatenate([unit, free], axis=1)
        widths = [(0, 0), (1, 0), (0, 0), (1, 0), (0, 0)]
        forced = xp.pad(inverse, widths)
        return free, forced

    @remembered
    def adjoint(self) -> Float[Array, "P K d d"]:
        """Derivatives of the covectors at the nodes of each piece by the covector at its end."""
        xp = namespace(self.q)
        d = self.q.shape[2]
        by_state = xp.swapaxes(self.by_state, -1, -2)
        inverse = self._implicit(1.0, slice(0, -1), by_state, 1 / self.size)
        by_last = rule().derivative[:-1, -1]
        free = -xp.einsum("piajb,j->piab", inverse, by_last)
        unit = xp.broadcast_to(xp.eye(d), (len(free), 1, d, d))
        return xp.concatenate([free, unit], axis=1)

    def covectors(self, end: Inexact[Array, "d r"]) -> Inexact[Array, "P K d r"]:
        """Covectors at the nodes, from covectors `end` at the end of the turn."""

        def back(after, piece):
            jump, free = piece
            before = jump.T @ after
            return free @ before, before

        # From the last piece to the first.
        across = self.jumps.by_state[::-1]
        pieces = (across, self.adjoint[::-1, 0])
        _, ends = scan(back, end, pieces)
        return self.adjoint @ ends[::-1, None]

    def at(
        self, phase: Array, period: Array, *values: Inexact[Array, "P K ..."]
    ) -> tuple[Array, ...]:
        """Charts at some phases (in cycles), and interpolated `values`, which are given at the
        nodes."""
        xp = jnp if isinstance(phase, jax.Array) else namespace(self.q)
        time = xp.asarray(phase) % 1.0 * period
        # (If several pieces begin at a phase, the last one is taken: the others have the length 0.)
        begins = xp.asarray(self.turn)
        following = xp.searchsorted(begins, time, side="right")
        k = xp.maximum(following - 1, 0)
        length = xp.asarray(self.length)[k]
        x = (time - begins[k]) / xp.where(length == 0, 1.0, length)
        mix = polynomials(x) @ rule().coefficients
        mixed = []
        for value in values:
            at_nodes = xp.asarray(value)[k]
            mixed.append(xp.einsum("pk,pk...->p...", mix, at_nodes))
        return xp.asarray(self.chart)[k], *mixed

    @remembered
    def pushed(self) -> Float[Array, "P K d nu K"]:
        """Derivatives of the deviations at the nodes of each piece by the inputs at the nodes."""
        force = self.by_input * self.length[:, None, None, None]
        return namespace(force).einsum("piakb,pkbu->piauk", self.forward[1], force)

    def driven(self, waves: Inexact[Array, "P K f"]) -> tuple[Array, Array, Array]:
        """Deviations caused by inputs that are `waves` (each divided by its value at the beginning
        of the piece); and, as further d columns, by the deviations at the beginning of the turn.

        **Returns:** the deviations at the beginnings of pieces (P, d, nu + d, f), the delays of the
        events at the ends of pieces (P, nu + d, f), and the deviations at the end of the turn (d,
        nu + d, f).
        """
        xp = namespace(self.q)
        jumps = self.jumps
        P, K, d = self.q.shape
        nu = self.by_input.shape[3]
        f = waves.shape[2]

        def wide(x):
            """`x` with further columns of zeros, for the deviations at the beginning of the
            turn."""
            kept = [(0, 0)] * (x.ndim - 2)
            return xp.pad(x, kept + [(0, d), (0, 0)])

        # Deviations at the ends of pieces, before their events.
        pushed_at_end = self.pushed[:, -1].reshape(P, -1, K)
        arrived = (pushed_at_end @ waves).reshape(P, d, nu, f)

        # Deviations after the events.
        last = waves[:, -1, None]
        columns = arrived.reshape(P, d, -1)
        jumped = (jumps.by_state @ columns).reshape(P, d, nu, f)
        jumped = jumped + jumps.by_input[..., None] * last[:, None]
        kick = wide(jumped)

        def advance(x, piece):
            through, kick, back = piece
            after = (through @ x.reshape(d, -1)).reshape(x.shape) + kick
            return after * back, x

        own = xp.pad(xp.eye(d), [(0, 0), (nu, 0)])
        begin = own[..., None] + 0 * kick[0]
        through = xp.asarray(self.through, dtype=waves.dtype)
        one_over_wave = 1 / last[:, 0]
        end, x = scan(advance, begin, (through, kick, one_over_wave))

        # The delays of events.
        free, _ = self.forward
        free_at_end = free[:, -1]
        delay_by_begin = (jumps.delay_by_state[:, None] @ free_at_end)[:, 0]
        by_state = xp.einsum("pa,pacf->pcf", delay_by_begin, x)
        by_arrived = xp.einsum("pa,pauf->puf", jumps.delay_by_state, arrived)
        by_input = jumps.delay_by_input[..., None] * last
        delays = by_state + wide(by_arrived + by_input)
        return x, delays / last, end

    @remembered
    def through(self) -> Float[Array, "P d d"]:
        """Matrices from deviations at the beginning of each piece to deviations at the beginning of
        the next."""
        return self.jumps.by_state @ self.forward[0][:, -1]

    def monodromy(self, valid: Bool[Array, " d"]) -> Float[Array, "d d"]:
        """Derivative of the state at the end of the turn by that at its beginning, at fixed times;
        zero outside of the `valid` rows and columns."""
        both = valid[:, None] & valid
        return namespace(self.q).where(both, monodromy(self.through), 0.0)


_hosted = Memory()
_flows = Memory()
_turns = Memory()


def keep_turn(cycle: Any, turn: Turn) -> None:
    """Remember the steps of a cycle's last turn, if they were taken on the host, for
    `last_turn`."""
    record = fixed((turn.pieces, turn.tapes))
    if turn.tapes is not None and not is_hidden(record):
        pieces, tapes = to_host(record)
        _turns.recall(hosted(cycle), None, lambda: (pieces, side_by_side(tapes)))


def remembering(cycle: Any, other: Any) -> Any:
    """The cycle, which now remembers the last turn of `other`, a cycle on the same orbit."""
    _turns.recall(hosted(cycle), None, lambda: last_turn(other))
    return cycle


def hosted(cycle: Any) -> Any:
    """The cycle with its arrays on the host, the same object at each call. A cycle that JAX traces
    is returned as it is."""
    if is_hidden(cycle) or on_host(cycle.period):
        return cycle
    return _hosted.recall(cycle, None, lambda: to_host(cycle))


def last_turn(cycle: Any) -> Any:
    """The starts and the recorded steps of the pieces of a cycle's last turn, side by side. None if
    JAX traces the cycle and no steps are remembered."""
    cycle = hosted(cycle)

    def make():
        return side_by_side(to_host(cycle.return_map).pieces())

    return (
        _turns.get(cycle, None)
        if is_hidden(cycle)
        else _turns.recall(cycle, None, make)
    )


def begin_later(cycle: Any, k: int) -> Any:
    """A clocked cycle as a guess for similar systems, with its beginning moved to piece k. It
    remembers its last turn."""

    def rolled(x):
        return np.roll(x, -k, axis=-1)

    lanes, tape = jax.tree_util.tree_map(rolled, last_turn(cycle))
    count = len(lanes.t)
    is_next_turn = np.arange(count) >= count - k
    later = float(cycle.period) * is_next_turn
    anchor = cycle.anchor._replace(
        t=lanes.t[:1],
        chart=lanes.chart[:1],
        q=lanes.q[:, :1],
    )
    guess = dataclasses.replace(cycle, anchor=anchor)
    later_tape = tape._replace(t=tape.t + later)
    turn = lanes._replace(t=lanes.t + later), later_tape
    _turns.recall(hosted(guess), None, lambda: turn)
    return guess


def recorded_ends(map: ReturnMap, lanes: Lanes) -> Target:
    """The targets at which the recorded pieces end. (The search may have expected another
    period.)"""
    ends = map.ends()
    time = np.append(lanes.t[1:], ends.time[-1])
    return dataclasses.replace(
        ends, time=np.where(np.isfinite(ends.time), time, ends.time)
    )


def linear_flow(
    cycle: Any, longest: float = np.inf, parameter: str | None = None
) -> LinearFlow:
    """Linearize the flow along a cycle. Inputs are those of the system, or, with `parameter`, a
    change of this parameter. `longest`: longest piece, as a part of the period.

    **Raises:** `NeedsValues` inside of `jit` and `vmap`.
    """
    cycle = hosted(cycle)
    if not on_host(cycle.period):
        return _of_cycle(cycle, longest, parameter)

    def make():
        return _linear_flow(cycle, longest, parameter)

    return _flows.recall(cycle, (parameter, longest), make)


def with_inputs(system: HybridSystem, parameter: str | None) -> Structure:
    """The structure of a system, with its inputs, or with a change of the parameter as the only
    input."""
    return Structure(system) if parameter is None else Varied(system, parameter)


# Largest number of explicit steps in a piece. More: polynomials through the nodes lose digits.
# Fewer: more pieces than needed.
_STEPS = 4


class _Pieces(NamedTuple):
    """P pieces of one turn, in D directions of derivatives. Each piece consists of several recorded
    moves without an event in between."""

    first: Int[np.ndarray, " P"]
    last: Int[np.ndarray, " P"]
    """The first and the last move of each piece."""
    time: Inexact[np.ndarray, "P K D"]
    """Times of the nodes."""
    length: Inexact[np.ndarray, "P D"]
    event: Int[np.ndarray, " P"]
    """Index of the transition at the end, negative for none."""


def _pieces(
    moves: Moves, t: Inexact[np.ndarray, "1+M D"], most: int, longest: float
) -> _Pieces:
    """Divide a turn into pieces of at most `most` moves, none of which lasts longer than `longest`.

    **Arguments:** `t`: times at which moves begin, and the end of the turn.
    """
    k = np.arange(len(moves.t))
    after_event = np.roll(moves.code, 1) >= 0
    begins = np.maximum.accumulate(np.where(after_event, k, 0))
    first = np.flatnonzero((k - begins) % most == 0)
    following = np.append(first[1:], len(k))
    last = following - 1
    length = t[following] - t[first]
    event = np.maximum(moves.code[last], -1)

    # Each piece that is too long is divided into equal parts. (Not one that is too long by rounding
    # only.)
    number = np.real(length[:, 0]) / longest
    count = np.ceil(number - 1e-9)
    count = np.maximum(count, 1).astype(int)
    whole = np.repeat(np.arange(len(first)), count)
    parts_before = np.cumsum(count) - count
    part = np.arange(len(whole)) - np.repeat(parts_before, count)
    parts = count[whole]
    place = part[:, None] + rule().nodes
    share = place / parts[:, None]
    begin = t[first][whole]
    duration = length[whole]
    is_last = part == parts - 1
    return _Pieces(
        first=first[whole],
        last=last[whole],
        time=begin[:, None] + share[..., None] * duration[:, None],
        length=duration / parts[:, None],
        event=np.where(is_last, event[whole], -1),
    )


def _linear_flow(
    cycle: Any, longest: float, parameter: str | None, by: Any = None
) -> LinearFlow:
    """The flow linearized at the nodes of pieces; with `by`, its derivatives in these directions of
    the cycle."""
    if not on_host(cycle.period):
        raise NeedsValues(
            "responses, sensitivities, fluctuations and HTFs in continuous time need the values of "
            "a cycle, which `jit` and `vmap` hide: call them outside (`grad` and `jvp` work there)."
        )
    map = cycle.return_map
    K = NODES
    directions = 1
    s = map.structure
    of = with_inputs(map.system, parameter)
    d = s.d
    period = float(map.expected)
    # Times and states at which the recorded moves begin. (Derivatives are taken by complex steps:
    # their tangents are small imaginary parts.)
    lanes, tape = last_turn(cycle)
    moves = recorded_moves(lanes, tape)
    end = map.anchor.t[0] + period
    t = np.append(moves.t, end)[:, None]
    q = moves.q.T[..., None]
    if by is not None:
        directions = len(jax.tree_util.tree_leaves(by)[0])
        of_by = with_inputs(by.system, parameter)
        of = kernels.Tangents(of, of_by, None, None, directions)
        s = kernels.Tangents(s, by.structure, None, None, directions)
        tangents = 1j * kernels.TINY * _along(s, map, lanes, tape, by)
        t = t + tangents[:, 0]
        q = q + tangents[:-1, 1:]
    # (One step of an explicit method is short, so that a piece may have several.)
    most = 1 if has_implicit(s) else _STEPS
    pieces = _pieces(moves, t, most, longest * period)
    chart = moves.chart[pieces.first]
    P = len(pieces.first)

    # Lanes: by piece, node and direction. (Directions are lanes of their own, and come last.)
    each = 1 + d + np.arange(P * K * directions) % directions
    charts = np.repeat(chart, K * directions)
    times = pieces.time.ravel()
    step = _step_at(moves, pieces)
    begin = t[step].ravel()
    start = np.moveaxis(q[step], 2, 0).reshape(d, -1)
    u = kernels.unpushed(s, each)
    states = _ahead(s, begin, charts, start, u, times - begin)
    field = ft.partial(kernels.field, of)
    u = kernels.unpushed(of, each)
    by_field = with_derivatives(of, field, charts, times, states, d, u)

    def lay(x):
        """Reshape lanes to axes of directions, pieces and nodes, which come first."""
        x = x.reshape(*x.shape[:-1], P, K, directions)
        return np.moveaxis(x, (-1, -3, -2), (0, 1, 2))

    states = lay(states)
    jumps = _jumps_at_ends(of, pieces, states[:, :, -1])
    flow = LinearFlow(
        t=lay(times),
        length=pieces.length.T,
        chart=None,
        event=None,
        q=states,
        field=lay(by_field[:, 0]),
        by_state=lay(by_field[:, 2 : 2 + d]),
        by_input=lay(by_field[:, 2 + d :]),
        jumps=jumps,
        size=np.broadcast_to(map.scale[chart], (directions, P, d)),
    )
    if by is not None:
        return jax.tree_util.tree_map(lambda x: x.imag / kernels.TINY, flow)
    flow = jax.tree_util.tree_map(lambda x: x[0], flow)
    return dataclasses.replace(flow, chart=chart, event=pieces.event)


def _jumps_at_ends(
    of: Structure, pieces: _Pieces, states: Inexact[np.ndarray, "directions P d"]
) -> Jumps:
    """The jumps at the ends of pieces, by direction and piece, from the states before them."""
    directions, P, d = states.shape
    direction = np.repeat(np.arange(directions), P)
    u = kernels.unpushed(of, 1 + d + direction)
    events = np.tile(pieces.event, directions)
    times = pieces.time[:, -1].T.ravel()
    jumps = _jumps(of, events, times, u, states.reshape(-1, d))
    return Jumps(*(x.reshape(directions, P, *x.shape[1:]) for x in jumps))


def _step_at(moves: Moves, pieces: _Pieces) -> Int[np.ndarray, "P K"]:
    """The recorded moves in which the nodes of pieces lie."""
    time = np.real(pieces.time)[..., 0]
    step = np.searchsorted(moves.t, time, "right") - 1
    return np.clip(step, pieces.first[:, None], pieces.last[:, None])


def _along(
    s: kernels.Tangents, map: ReturnMap, lanes: Lanes, tape: Tape, by: Any
) -> Float[np.ndarray, "M n D"]:
    """Tangents of times and states at the starts of recorded moves and at the end of the turn."""
    ends = recorded_ends(map, lanes)
    begin, longer = beginning(by, s.d, s.directions)
    # (A turn that ends on a section has a time of its end, too.)
    start = map.anchor.t[0]
    full = map.expected
    time = np.where(np.isfinite(ends.time), ends.time, start + full)
    tape = tape._replace(
        code=np.where(tape.code == ARRIVE_LEVEL, ARRIVE_TIME, tape.code)
    )
    delay = np.outer(longer, (time - start) / full)
    times = begin[0][:, None] + delay
    ends = dataclasses.replace(ends, time=time, levels=None)
    return Variation(s, lanes, ends, tape, times, twice=False).tangents(begin)


def beginning(by: Any, d: int, directions: int) -> tuple[np.ndarray, np.ndarray]:
    """Tangents of (t, q) at the anchor of a cycle, and of its period."""
    begin = np.zeros((1 + d, directions))
    if by.anchor.t is not None:
        begin[0] = by.anchor.t[:, 0]
    if by.anchor.q is not None:
        begin[1:] = by.anchor.q[..., 0].T
    period = by.period
    if period is None:
        period = np.zeros(directions)
    return begin, period


def of_flow(tangents: Any) -> Any:
    """The tangents of those fields of a cycle on which its flow depends; `None` for other
    fields."""
    nothing = jax.tree_util.tree_map(lambda _: None, tangents)
    anchor = tangents.anchor
    anchor = nothing.anchor._replace(t=anchor.t, q=anchor.q)
    moving = dict(system=tangents.system, period=tangents.period, anchor=anchor)
    return dataclasses.replace(nothing, **moving)


def _flow_along(arguments: tuple, by: tuple) -> tuple[LinearFlow, LinearFlow]:
    """The linear flow, and its derivatives in the directions `by` of the cycle."""
    cycle, longest, parameter = arguments
    return _linear_flow(cycle, longest, parameter), _linear_flow(
        cycle, longest, parameter, by[0]
    )


_of_cycle = by_columns(_linear_flow, _flow_along, of_flow, np.inf)


def _ahead(s: Structure, t, chart, q, u, h) -> Float[np.ndarray, "d L"]:
    """States after a step from each lane."""

    def work(a, here, out):
        n = s.dims[a]
        q_here = q[:n, here]
        step = kernels.step(s, a, t[here], q_here, u[:, here], h[here])
        out[:n, here] = step.q
        return out

    everywhere = np.ones(len(t), bool)
    return for_each_chart(s, chart, everywhere, work, np.zeros_like(q))


def _jumps(s: Structure, code, t, u, q) -> Jumps:
    """The events at the ends of pieces, where the states are q."""
    P, d = q.shape
    nu = s.nu

    def zeros(*shape):
        return np.zeros((P, *shape), q.dtype)

    out = Jumps(
        by_state=zeros(d, d),
        by_input=zeros(d, nu),
        delay_by_state=zeros(d),
        delay_by_input=zeros(nu),
        slip=zeros(d),
        delay_by_level=zeros(),
    )
    out.by_state[:] = np.eye(d)
    for g in np.unique(code[code >= 0]).tolist():
        now = np.flatnonzero(code == g)
        source = s.transitions[g].source
        n = s.dims[s.chart_index(source)]
        state = q[now, :n]
        event = jump(s, g, t[now], state, u[:, now])
        m = event.after.shape[1]
        out.by_state[now] = 0.0
        out.by_state[now, :m, :n] = event.saltation
        out.by_input[now, :m] = event.input_saltation
        out.delay_by_state[now, :n] = event.delay_by_state
        out.delay_by_input[now] = event.delay_by_input
        out.slip[now, :m] = event.slip
        out.delay_by_level[now] = event.delay_by_level
    return out


def by_name(s: Structure, chart: Int[Array, " p"], states: Inexact[Array, "p d"]):
    """Padded states (or numbers that belong to states) by name; NaN in charts that lack the
    state."""
    xp = namespace(states)
    points = np.arange(len(chart))
    wide = xp.pad(states, [(0, 0), (0, 1)], constant_values=np.nan)
    named = {}
    for name in s.state_names():
        # (Column d is NaN.)
        column = [s.d] * len(s.charts)
        for a, chart_states in enumerate(x.states for x in s.charts):
            if name in chart_states:
                column[a] = chart_states.index(name)
        named[name] = wide[points, xp.asarray(column)[chart]]
    return named
