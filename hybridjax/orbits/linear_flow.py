"""The linearized flow along one turn of a cycle, dense between events.

The steps of one turn are recorded, and the field is linearized at nodes within each: the states
there come from shorter steps of the same method. On these nodes, deviations and their adjoints
follow from linear collocation equations, without further integration. At events they jump by the
saltation matrix.
"""

import functools as ft
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Inexact, Int

from .._core.compilation import at_ease
from .._core.executor import Array, is_inside_program, is_traced, namespace, on_host, scan, to_host
from .._core.memo import Memory
from ..engine import kernels
from ..engine.lanes import IDLE, Lanes, Tape, for_each_chart, only
from ..engine.move import Options, move
from ..engine.replay import replay
from ..engine.target import Target, toward, until
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.transition import Scheduled
from .return_map import ReturnMap, with_derivatives
from .scale import has_implicit


# Nodes of a piece, both ends among them. Fewer: polynomials through them lose digits of responses.
# More: collocation equations grow.
NODES = 12


class Rule(NamedTuple):
    """Lobatto's nodes on [0, 1], weights of integrals and matrices of polynomials through them."""

    nodes: Float[np.ndarray, " K"]
    weights: Float[np.ndarray, " K"]
    derivative: Float[np.ndarray, "K K"]
    """From values at the nodes to derivatives there."""
    coefficients: Float[np.ndarray, "K K"]
    """From values at the nodes to coefficients of Legendre's polynomials."""


@ft.lru_cache
def rule() -> Rule:
    legendre, last = np.polynomial.legendre, np.eye(NODES)[-1]
    # (Roots are real here, and complex numbers since NumPy 2.5.)
    x = np.r_[-1.0, np.sort(legendre.legroots(legendre.legder(last)).real), 1.0]
    x = (x - x[::-1]) / 2
    vander = legendre.legvander(x, NODES - 1)
    slopes = np.stack([legendre.legval(x, legendre.legder(e)) for e in np.eye(NODES)], axis=1)
    inverse = np.linalg.inv(vander)
    weights = 1 / (NODES * (NODES - 1) * legendre.legval(x, last) ** 2)
    return Rule((x + 1) / 2, weights, 2 * slopes @ inverse, inverse)


def polynomials(x: Float[Array, " p"]) -> Float[Array, "p K"]:
    """Legendre's polynomials at points of [0, 1]."""
    z = 2 * x - 1
    rows = [namespace(x).ones_like(z), z]
    for k in range(1, NODES - 1):
        rows.append(((2 * k + 1) * z * rows[k] - k * rows[k - 1]) / (k + 1))
    return namespace(x).stack(rows, axis=-1)


class Jumps(NamedTuple):
    """Deviations across the ends of pieces; where no event happens, they stay as they are."""

    by_state: Float[Array, "P d d"]
    """The saltation matrix."""
    by_input: Float[Array, "P d nu"]
    """Change of the state by an input that guard and reset depend on."""
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

    @property
    def turn(self) -> Float[Array, " P"]:
        """Times of the beginnings of the pieces, from that of the turn."""
        return self.t[:, 0] - self.t[0, 0]

    def _implicit(self, sign: float, rows: slice, matrix: Float[Array, "P K d d"]):
        """The inverse of (derivative + sign h matrix) on some of the nodes."""
        d, D = self.q.shape[2], rule().derivative[rows, rows]
        n, xp = len(D), namespace(self.q)
        field = xp.eye(n)[:, None, :, None] * matrix[:, rows, :, None, :]
        whole = D[:, None, :, None] * np.eye(d)[:, None, :]
        whole = whole + sign * self.length[:, None, None, None, None] * field
        shape = len(self.length), n * d, n * d
        return xp.linalg.inv(whole.reshape(shape)).reshape(-1, n, d, n, d)

    def forward(self) -> tuple[Float[Array, "P K d d"], Float[Array, "P K d K d"]]:
        """Deviations at the nodes of each piece by that at its beginning, and by forces at the
        nodes (times the length of the piece)."""
        xp, d = namespace(self.q), self.q.shape[2]
        inverse = self._implicit(-1.0, slice(1, None), self.by_state)
        free = -xp.einsum("piajb,j->piab", inverse, rule().derivative[1:, 0])
        free = xp.concatenate([xp.broadcast_to(xp.eye(d), (len(free), 1, d, d)), free], axis=1)
        return free, xp.pad(inverse, [(0, 0), (1, 0), (0, 0), (1, 0), (0, 0)])

    def adjoint(self) -> Float[Array, "P K d d"]:
        """Covectors at the nodes of each piece by that at its end."""
        xp, d = namespace(self.q), self.q.shape[2]
        inverse = self._implicit(1.0, slice(0, -1), xp.swapaxes(self.by_state, -1, -2))
        free = -xp.einsum("piajb,j->piab", inverse, rule().derivative[:-1, -1])
        return xp.concatenate([free, xp.broadcast_to(xp.eye(d), (len(free), 1, d, d))], axis=1)

    def backward(
        self, adjoint: Float[Array, "P K d d"], end: Float[Array, "d r"]
    ) -> Float[Array, "P d r"]:
        """Covectors at the ends of pieces, before their events, by those at the end of the turn."""

        def back(after, piece):
            jump, free = piece
            before = jump.T @ after
            return free @ before, before

        return scan(back, end, (self.jumps.by_state[::-1], adjoint[::-1, 0]))[1][::-1]

    def at(
        self, phase: Array, period: Array, *values: Inexact[Array, "P K ..."]
    ) -> tuple[Array, ...]:
        """Charts, and values that are given at the nodes, at some phases in cycles."""
        xp = jnp if isinstance(phase, jax.Array) else namespace(self.q)
        time = xp.asarray(phase) % 1.0 * period
        # (The last piece that begins there: those before may have the length 0.)
        turn = xp.asarray(self.turn)
        k = xp.maximum(xp.searchsorted(turn, time, side="right") - 1, 0)
        length = xp.asarray(self.length)[k]
        x = (time - turn[k]) / xp.where(length == 0, 1.0, length)
        mix = polynomials(x) @ rule().coefficients
        mixed = (xp.einsum("pk,pk...->p...", mix, xp.asarray(y)[k]) for y in values)
        return xp.asarray(self.chart)[k], *mixed

    def monodromy(
        self, free: Float[Array, "P K d d"], valid: Bool[Array, " d"]
    ) -> Float[Array, "d d"]:
        """Derivative of the state at the end of the turn by that at its beginning, at fixed times;
        zero outside of the `valid` rows and columns."""
        xp = namespace(self.q)
        step = lambda product, piece: (piece[0] @ (piece[1] @ product), None)  # noqa: E731
        whole, _ = scan(step, xp.eye(self.q.shape[2]), (self.jumps.by_state, free[:, -1]))
        return xp.where(valid[:, None] & valid, whole, 0.0)


_flows = Memory()


class Course(NamedTuple):
    """A cycle as its linearized flow takes it."""

    owner: Any
    """The cycle, for which linearized flows are kept."""
    map: ReturnMap
    legs: Lanes
    """States at the beginnings of the pieces of one turn."""
    period: Float[Array, ""]
    events: tuple[int, ...]
    inputs: HybridSystem
    """The system, or the same one with other inputs, by which the flow is linearized."""

    @property
    def linearized(self) -> Structure:
        return Structure(self.inputs)

    def linear_flow(self, longest: float = np.inf) -> LinearFlow:
        """Linearize the flow along the cycle, in pieces no longer than this part of the period.

        (If they are traced, their lengths are not known, and all are divided as the longest
        possible would be.)
        """
        if is_traced(self) or is_inside_program():
            return _linear_flow(self, longest)
        name = type(self.inputs), getattr(self.inputs, "parameter", ""), longest
        make = lambda: _linear_flow(to_host(self), longest)  # noqa: E731
        return _flows.recall(self.owner, name, make)


def _linear_flow(course: Course, longest: float) -> LinearFlow:
    _, map, legs, period, events, _ = course
    s, xp = map.structure, namespace(period)
    L = legs.t.shape[0]
    ends = xp.concatenate([legs.t[1:], (map.anchor.t[0] + period)[None]])
    last = np.arange(L) == L - 1
    target = toward(xp.where(last & (map.event >= 0), xp.inf, ends), -1, ends + 0.5 * period)
    event = xp.asarray(np.where(last, map.event, -1).astype(np.int32))
    target = eqx.tree_at(lambda x: x.event, target, event)
    u = xp.zeros((s.nu, L))
    options = Options(tape=True, new_input=False, tangents=True)
    first = xp.full(L, 1.0) * (0.5 * period / L)
    with at_ease():
        tape = move(s, legs, u, target, map.settings, first, options=options).tape
        assert tape is not None
        pieces = _pieces(map, legs, target, tape, ends[-1:])
        if on_host(pieces.t):
            first, joined = _joined(s, pieces, longest * period)
            divide = np.maximum(np.ceil(joined.h / (longest * period) - 1e-9), 1).astype(int)
        else:
            first, joined = np.arange(len(pieces.t)), pieces
            divide = np.full(len(first), max(int(np.ceil(_LONGEST / longest)), 1))
        return _linearized(course, pieces, first, joined, divide)


# Bound on the steps of a turn that is traced, whose number is not known. Fewer: results for long
# turns are NaN. More: programs take longer.
_MOST = 256
# Explicit steps of a piece. More: its polynomials lose digits. Fewer: more pieces than needed.
_STEPS = 4
# The longest step that a turn can have, in parts of the period (see `ReturnMap.travel`).
_LONGEST = 0.5


class _Pieces(NamedTuple):
    """Recorded moves, leg by leg."""

    t: Float[Array, " P"]
    chart: Int[Array, " P"]
    q: Float[Array, "d P"]
    h: Float[Array, " P"]
    code: Int[Array, " P"]


def _pieces(map: ReturnMap, legs: Lanes, target: Target, tape: Tape, end: Array) -> _Pieces:
    xp, s = namespace(legs.t), map.structure

    def row(lanes, row):
        begin = lanes.t, lanes.chart, lanes.q
        moving = row.code != IDLE
        if on_host(lanes.t):
            t, q = row.t, row.after
        else:
            single = jax.tree_util.tree_map(lambda x: x[None], row)
            t, q = replay(s, lanes, jnp.zeros((s.nu, len(lanes.t))), target, single)
        t, q = xp.where(moving, t, lanes.t), xp.where(moving, q, lanes.q)
        chart = xp.where(moving, row.chart, lanes.chart)
        return lanes._replace(t=t, q=q, chart=chart), _Pieces(*begin, t - begin[0], row.code)

    _, rows = scan(row, legs, tape)  # rows by legs
    # Rows of legs, one leg after the other.
    join = lambda x: xp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], -1)  # noqa: E731
    pieces = _Pieces(*(join(x) for x in rows))
    if on_host(legs.t):
        return _Pieces(*(x[..., pieces.code != IDLE] for x in pieces))
    idle = pieces.code == IDLE
    used = xp.argsort(idle, stable=True)[:_MOST]
    lost = (~idle).sum() > _MOST
    # Those that are not used stand at the end of the turn.
    finish = _Pieces(end[:1], map.anchor.chart, map.anchor.q, xp.zeros(1), pieces.code[:1])
    either = (xp.where(idle, y, x) for x, y in zip(pieces, finish, strict=True))
    pieces = _Pieces(*(x[..., used] for x in either))
    pieces = pieces._replace(code=xp.where(idle[used], IDLE, pieces.code))
    return pieces._replace(h=xp.where(lost, xp.nan, pieces.h))


def _joined(s: Structure, steps: _Pieces, longest: Array) -> tuple[np.ndarray, _Pieces]:
    """Pieces of several steps between events, because a step of an explicit method is short for
    the polynomials of a piece, and the indices of their first steps."""
    first, length, most = [0], 0.0, 1 if has_implicit(s) else _STEPS
    for k, h in enumerate(steps.h[1:], 1):
        length += steps.h[k - 1]
        if steps.code[k - 1] >= 0 or k - first[-1] == most or length + h > longest:
            first.append(k)
            length = 0.0
    h, code = np.add.reduceat(steps.h, first), steps.code[np.append(first[1:], len(steps.h)) - 1]
    return np.array(first), _Pieces(*(x[..., first] for x in steps))._replace(h=h, code=code)


def _linearized(
    course: Course, steps: _Pieces, first: np.ndarray, pieces: _Pieces, divide: np.ndarray
) -> LinearFlow:
    """The flow linearized at nodes of pieces, each divided into some parts, whose states follow
    from the recorded steps."""
    s, of, events = course.map.structure, course.linearized, course.events
    xp, K, nodes = namespace(steps.t), NODES, rule().nodes
    whole = np.repeat(np.arange(len(divide)), divide)
    part = np.arange(len(whole)) - np.repeat(np.cumsum(divide) - divide, divide)
    of_piece = (part[:, None] + nodes) / divide[whole, None]
    t, chart, _, h, code = (x[..., whole] for x in pieces)
    P = len(whole)
    time, charts = (t[:, None] + h[:, None] * of_piece).ravel(), xp.repeat(chart, K)
    step = np.repeat(first[whole], K)
    if len(first) < len(steps.t):
        last = np.append(first[1:], len(steps.t))[whole] - 1
        step = np.clip(np.searchsorted(steps.t, time, "right") - 1, step, np.repeat(last, K))
    states = _ahead(s, steps.t[step], charts, steps.q[:, step], time - steps.t[step])
    code = xp.where(part == divide[whole] - 1, xp.maximum(code, -1), -1)
    by = with_derivatives(of, ft.partial(kernels.field, of), charts, time, states, s.d)
    d = s.d
    field, by_state, by_input = (
        x.reshape(*x.shape[:-1], P, K) for x in (by[:, 0], by[:, 2 : 2 + d], by[:, 2 + d :])
    )
    field = xp.moveaxis(field, 0, -1)
    by_state, by_input = (xp.moveaxis(x, (2, 3), (0, 1)) for x in (by_state, by_input))
    states = xp.moveaxis(states.reshape(d, P, K), 0, -1)
    time = time.reshape(P, K)
    end = time[:, -1], states[:, -1].T, field[:, -1]
    jumps = _jumps(of, end, xp.roll(field[:, 0], -1, axis=0), code, events)
    lengths = h / divide[whole]
    return LinearFlow(time, lengths, chart, code, states, field, by_state, by_input, jumps)


def _ahead(s: Structure, t, chart, q, h) -> Float[Array, "d L"]:
    """States after a step from each lane."""
    xp, L = namespace(t), len(t)
    if not on_host(t):
        code = jnp.full((1, L), IDLE + 1)  # a move
        tape = Tape(h[None], code, None, None, None, None)
        lanes = Lanes(t, chart, q, None, None, None)
        return replay(s, lanes, jnp.zeros((s.nu, L)), until(t + h), tape)[1]

    def work(a, here, out):
        n = s.dims[a]
        out[:n, here] = kernels.step(s, a, t[here], q[:n, here], np.zeros((s.nu, 1)), h[here]).q
        return out

    return for_each_chart(s, chart, xp.ones(L, bool), work, xp.zeros_like(q))


def _jumps(s: Structure, end, after, code, events) -> Jumps:
    """The events at the `end` (times, states and fields) of pieces; `after`: fields after them."""
    t, q, f = end
    xp, (P, d) = namespace(t), f.shape
    out = Jumps(
        xp.broadcast_to(xp.eye(d), (P, d, d)), xp.zeros((P, d, s.nu)),
        xp.zeros((P, d)), xp.zeros((P, s.nu)), xp.zeros((P, d)), xp.zeros(P),
    )  # fmt: skip
    for g in sorted(set(events)):
        fired = code == g
        if on_host(fired) and not fired.any():
            continue
        tr = s.transitions[g]
        a = s.chart_index(tr.source)
        n, u = s.dims[a], xp.zeros((s.nu, 1))
        point = only(fired, t), only(fired, q[:n]), u
        by = xp.moveaxis(kernels.linear_reset(s, s.member(g), *point), -1, 0)
        m, n_u = by.shape[1], 2 + n
        by_t, by_q, by_u = by[:, :, 1], by[:, :, 2:n_u], by[:, :, n_u:]
        moves, pushed, delay = xp.zeros((P, n)), xp.zeros((P, s.nu)), xp.ones(P)
        if not isinstance(tr.guard, Scheduled):
            index = np.zeros(1, np.int32)
            guard = kernels.watched(s, a, None, *point, xp.asarray(index))[s.guards(a).index(g)]
            guard = xp.moveaxis(guard, -1, 0)
            rate = guard[:, 1] + xp.sum(guard[:, 2:n_u] * f[:, :n], axis=1)
            delay = -1 / xp.where(fired, rate, 1.0)
            moves, pushed = guard[:, 2:n_u] * delay[:, None], guard[:, n_u:] * delay[:, None]
        slip = by_t + xp.einsum("pij,pj->pi", by_q, f[:, :n]) - after[:, :m]
        salted = by_q + slip[:, :, None] * moves[:, None, :]
        driven = by_u + slip[:, :, None] * pushed[:, None, :]
        new = Jumps(
            xp.pad(salted, [(0, 0), (0, d - m), (0, d - n)]),
            xp.pad(driven, [(0, 0), (0, d - m), (0, 0)]),
            xp.pad(moves, [(0, 0), (0, d - n)]), pushed, xp.pad(slip, [(0, 0), (0, d - m)]), delay,
        )  # fmt: skip
        choose = lambda x, y, fired=fired: xp.where(fired.reshape(-1, *[1] * (x.ndim - 1)), x, y)  # noqa: E731
        out = Jumps(*(choose(x, y) for x, y in zip(new, out, strict=True)))
    return out


def by_name(s: Structure, chart: Int[Array, " p"], states: Inexact[Array, "p d"]):
    """Padded states, or what belongs to them, by name; NaN in charts that lack one."""
    xp, out = namespace(states), {}
    for name in s.state_names():
        rows = [c.states.index(name) if name in c.states else -1 for c in s.charts]
        column = xp.asarray(rows)[chart]
        value = xp.take_along_axis(states, xp.maximum(column, 0)[:, None], axis=1)[:, 0]
        out[name] = xp.where(column >= 0, value, xp.nan)
    return out
