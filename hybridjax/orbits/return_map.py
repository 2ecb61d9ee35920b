"""The return map P of a cycle: from a state on the section to the state where the flow meets it
again.

One application of P is called a *turn*. It is cut into *pieces* of nearly equal duration. The
Jacobians of the pieces are computed with the pieces: their product is the Jacobian of P, and they
are the factors of the monodromy matrix. *Sizes* of states are their magnitudes (`scale.py`), and a
*lane* is one trajectory of many that are computed side by side.

Searches call `ReturnMap.turn` and `turn_with_jacobian`, and get a `Return` or a `Turn`. There are
two ways to the same Jacobians, which must agree: `_linear_on_host` (NumPy) and `_linear_in_program`
(JAX). `judge` decides whether a turn is a cycle, and returns the reason if it is none. There, each
reason replaces the reasons before it: their order must stay, and so must the sign of the residual,
P(q) - q, on which all of Newton's methods rely.

If a turn is wrong, compare these two ways; if both are wrong in the same way, look at `travel`, and
at the search. If a good turn is refused, look at `judge`, and the limits `SINGULAR` and `CLOSED`;
if conserved quantities drift, at `held`.
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

from .._core.compilation import at_ease
from .._core.executor import (
    namespace,
    on_host,
    put,
    scan,
    stop_gradient,
    svdvals,
    to_host,
)
from .._core.lanes import PerLane
from .._core.memo import remembered
from .._core.results import Result
from ..engine import kernels
from ..engine.arrays import Array
from ..engine.events import arm, belongs, due_at_once, enabled
from ..engine.itinerary.rows import PIECES
from ..engine.lanes import Lanes, Tape, for_each_chart, only, side_by_side, start_lanes
from ..engine.move import Options, flow_jacobian, follow, stride, tape_jacobian, through
from ..engine.replay import projections
from ..engine.search.state import Recorded
from ..engine.settings import Settings
from ..engine.target import Target, toward, until
from ..engine.watch import Watch, slopes, watch
from ..linear.time_response import monodromy
from ..systems.structure import Structure
from ..systems.system import HybridSystem
from ..systems.varied import Varied
from .crossing import AtEvent, Crossing, to_section


# Least value of the limit on steps, for a piece of a turn with an implicit method and for the flow
# from one section to the next. Smaller: a fast jump (van der Pol's oscillator at mu = 1000) or many
# events reach the limit. Larger: vain searches last longer.
PATIENCE = 1024
# Limit on the steps of a piece of a turn after the default limit was reached. Fewer: cycles of
# neurons are not found. More: vain searches last longer.
ENOUGH = 4096
# In an autonomous system, crossings of the section count after this part of the expected period.
# Nearer to 1: a shorter return is missed. Smaller: an earlier crossing is taken for the return.
# (Not a simple fraction: pieces would end at the events of symmetric cycles.)
_FREE = 0.73
# J - I (in sizes of the states) is singular if its smallest singular value is below this. Smaller:
# cycles of a family pass for isolated ones. Larger: cycles with a multiplier near 1 are rejected.
SINGULAR = 1e-7
# A turn closes if the distance of its ends, in sizes of the states, is below this. Smaller:
# rounding rejects cycles of sweeps. Larger: turns that Newton's method has not finished are
# accepted.
CLOSED = 2e-8
# Its distance must also be below this multiple of the accuracy of the flow, or of the accuracy
# times the derivative of the turn. Smaller: rounding rejects cycles. Larger: errors of the cycle
# exceed the accuracy asked for.
_ACCURACIES = 20.0
_ROUNDED = 1e-12
# The state is an equilibrium if no state moves by more than this multiple of the accuracy. Smaller:
# an equilibrium passes for a cycle. Larger: small cycles are taken for equilibria.
_REST = 1e3


class Return(NamedTuple):
    """The end of one turn."""

    residual: Float[Array, " d"]
    """P(q) - q, less the step back to the values of conserved quantities (see `held`); NaN if the
    turn fails, or ends in another chart."""
    period: Float[Array, ""]
    """Duration of the turn."""
    result: Int[Array, ""]
    """`Result` code of the flow."""
    end: Lanes
    """The lane at the end."""


class Turn(NamedTuple):
    """One turn with its derivatives, for Newton's method. The first fields are those of its
    `Return`."""

    residual: Float[Array, " d"]
    period: Float[Array, ""]
    result: Int[Array, ""]
    end: Lanes
    jacobian: Float[Array, "d n"]
    """Derivative of the residual with respect to the state, and along the parameters if asked."""
    pieces: Lanes
    """States at the beginnings of the K pieces."""
    factors: Float[Array, "K d d"]
    """Jacobians of the flow over the pieces. In an autonomous system, the direction of the flow is
    projected out."""
    codes: Int[Array, "K R"]
    """Events of each piece, by index of the transition; negative for none. (`None` in sweeps.)"""
    distance: Float[Array, ""]
    """Largest entry of the residual, in sizes of the states."""
    meetings: Int[Array, ""]
    """Number of crossings of the section during the turn, as far as the states at the ends of
    pieces show."""
    record: Recorded | None
    """The K pieces with the lengths, ends and events of their steps. (`None` on the host.)"""
    tapes: Tape | None
    """The recorded steps of all pieces. (`None` in sweeps.)"""

    @property
    def closed(self) -> Bool[Array, "..."] | Bool[np.ndarray, "..."]:
        """True if the turn ends at its beginning (also of many turns at once, on the host)."""
        return self.distance <= CLOSED

    @property
    def events(self) -> tuple[int, ...]:
        """The events of a single turn, whose values are known, by index of the transition."""
        codes = np.asarray(self.codes)
        return tuple(codes[codes >= 0].tolist())


class _Linear(NamedTuple):
    """A turn with the Jacobians of its pieces, which stand on the first axis."""

    end: Return
    pieces: Lanes
    factors: Float[Array, "K *S d d"]
    tapes: Tape
    record: Recorded | None = None
    gap: Array | float = 0.0
    """Largest gap between moves, if the turn was computed from many starts."""
    by_parameter: Float[Array, " d"] | None = None
    """Derivative of the end by the parameter of a `Varied` system."""


class ReturnMap(eqx.Module):
    """The return map P of a system, with the data that select one of its fixed points.

    **Fields:**

    - `system`; `settings` of the flow, with the sizes of the states.
    - `anchor`: one lane, the chart and the time of the clock at which every turn begins, and the
        state from which Newton's method starts.
    - `base`: the section of an autonomous system; `None` for a clocked one, whose section is the
        phase of the clock at the anchor.
    - `expected`: the period of one turn; for an autonomous system a rough value.
    - `conserved`: values of conserved quantities, by the name of the output; they select one
        cycle of a family.
    - `multiplicity`: periods of the clock, or crossings of the section, in one turn.
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
        system: Any = self.system  # (may have lanes on the host)
        return (kernels.Systems if isinstance(system, PerLane) else Structure)(system)

    @property
    def scale(self) -> Float[Array, "A d"]:
        """Sizes of the states by chart, padded."""
        assert self.settings.scale is not None
        return self.settings.scale

    @remembered
    def sizes(self) -> Float[Array, " d"]:
        """Sizes of the states of the anchor's chart."""
        return self.each(self.scale[self.anchor.chart])

    @remembered
    def valid(self) -> Bool[Array, " d"]:
        """The entries of the padded state that the anchor's chart has."""
        chart = self.each(self.anchor.chart)
        dims = namespace(chart).asarray(self.structure.dims)[chart]
        return np.arange(self.structure.d) < dims[..., None]

    @property
    def event(self) -> int:
        """Index of the transition with which every turn begins and ends; -1 for none."""
        base = self.base
        return (
            self.structure.transition_index(base.name)
            if isinstance(base, AtEvent)
            else -1
        )

    def each(self, x: Array) -> Array:
        """Move lanes from the last axis to the first. For a single lane, remove the axis."""
        return x if self.expected.ndim else x[0]

    def at_phase_of(self, system: HybridSystem) -> "ReturnMap":
        """The map of another system. If it is clocked, turns begin at the same phase of its own
        clock."""
        if self.base is not None:
            return dataclasses.replace(self, system=system)
        period = jnp.asarray(system.period(), float)
        # (With arrays of the host JAX would compile a program for each operation.)
        expected = self.multiplicity * (
            to_host(period) if on_host(self.expected) else period
        )
        ratio = expected / self.expected
        anchor = self.anchor._replace(t=self.anchor.t * ratio)
        return dataclasses.replace(
            self, system=system, anchor=anchor, expected=expected
        )

    def watch(self, lanes: Lanes, target: Target) -> Watch:
        """Guards and levels at lanes, without input."""
        xp = namespace(lanes.t)
        L = lanes.t.shape[0]
        u = xp.zeros((self.structure.nu, L))
        everywhere = xp.ones(L, bool)
        s = self._structure_of(lanes)
        return watch(s, lanes.t, lanes.chart, lanes.q, u, target, everywhere)

    def slopes(self, lanes: Lanes) -> Float[Array, "d L"]:
        """The vector field at lanes, without input."""
        shape = (self.structure.nu, lanes.t.shape[0])
        u = namespace(lanes.t).zeros(shape)
        structure = self._structure_of(lanes)
        return slopes(structure, lanes.t, lanes.chart, lanes.q, u)

    def _structure_of(self, lanes: Lanes) -> Structure:
        """The structure of the system. If there are many systems and `lanes` are the pieces of all
        turns, the structure has a copy of each system for each of its pieces."""
        turns = len(self.anchor.t)
        count = len(lanes.t)
        if turns == count:
            return self.structure
        return self.structure.at(np.arange(count) % turns)

    def departure(self, q: Float[Array, " d"]) -> Lanes:
        """The lane at the beginning of a turn; an event that has just happened is not armed."""
        s = self.structure
        anchor = self.anchor
        xp = namespace(q)
        states = xp.atleast_2d(q).T
        lanes = start_lanes(s, anchor.t, anchor.chart, states)
        span = xp.atleast_1d(self.expected)
        watched = self.watch(lanes, until(lanes.t))
        lanes = arm(s, lanes, watched, span)
        index = np.arange(len(s.transitions))[:, None]
        other = index != self.event
        return lanes._replace(armed=lanes.armed & other) if self.event >= 0 else lanes

    def turn(self, q: Float[Array, " d"], record: Recorded | None = None) -> Return:
        """One turn from a state on the section. With a `record`, its steps are repeated, from a
        state close to its start."""
        s = self.structure
        u = namespace(q).zeros((self.structure.nu, 1))

        def flow(lanes, target, h, result, piece):
            return follow(s, lanes, u, target, piece).moved, None

        return self.travel(
            q, Options(new_input=False) if record is None else flow, record
        )[0]

    def turn_with_jacobian(
        self,
        q: Float[Array, " d"],
        record: Recorded | None = None,
        varied: Varied | None = None,
        travelled: tuple[Return, Any, Any] | None = None,
    ) -> Turn:
        """One turn from a state on the section, with its derivatives.

        **Arguments:** `record`: see `turn`. `varied`: the system with a parameter by which
        derivatives are taken, too, at the same phase of the clock (on the host). `travelled`: the
        turn, if it is already known from `travel`, and the largest gap between its moves (on the
        host).
        """
        xp = namespace(q)
        if on_host(q):
            linear = self._linear_on_host(q, varied, travelled)
        else:
            linear = self._linear_in_program(q, record)
        end = linear.end
        off, held = self.held(q, varied)
        returned = monodromy(linear.factors)
        if linear.by_parameter is not None:
            returned = np.column_stack([returned, linear.by_parameter])
        returned = xp.where(self.valid[..., None], returned, 0.0)
        unit = np.eye(*held.shape[-2:])
        jacobian = returned - unit - held

        lanes = side_by_side(linear.pieces)
        factors = linear.factors
        if self.base is not None:
            f = self.slopes(lanes).T.reshape(PIECES, *q.shape)
            scale = self.scale[lanes.chart].reshape(PIECES, *q.shape)
            factors = across(f, scale, factors)

        distance = xp.abs(end.residual) + xp.abs(off)
        parts = distance / self.sizes
        by_lane = xp.moveaxis(linear.tapes.code, -1, 0)
        codes = self.each(by_lane)

        def pieces_last(x):
            return self.each(xp.moveaxis(x, (0, -1), (-1, 0)))

        return Turn(
            *end,
            jacobian=jacobian,
            pieces=jax.tree_util.tree_map(pieces_last, linear.pieces),
            factors=xp.moveaxis(factors, 0, -3),
            codes=codes,
            distance=xp.max(parts, axis=-1) + linear.gap,
            meetings=self._meetings(lanes, codes),
            record=linear.record,
            tapes=linear.tapes,
        )

    def _linear_in_program(
        self, q: Float[Array, " d"], record: Recorded | None
    ) -> "_Linear":
        """A turn whose pieces are computed and linearized one after the other."""
        s = self.structure

        def flow(lanes, target, h, result, piece):
            if piece is None:
                jacobian, moved, tape = flow_jacobian(
                    s, lanes, target, self.settings, h, result
                )
            else:
                moved, tape = piece
                jacobian, end = tape_jacobian(s, lanes, target, tape, of_states=True)
                moved = moved._replace(lanes=moved.lanes._replace(t=end[0], q=end[1:]))
            steps = tape._replace(before=None, after=None, chart=None)
            factor = self.each(jacobian[:, 1:])
            return moved, (lanes, factor, tape, Recorded(moved, steps))

        end, (pieces, factors, tapes, record) = self.travel(q, flow, record)
        return _Linear(
            end=end,
            pieces=pieces,
            factors=factors,
            tapes=tapes,
            record=record,
        )

    def _linear_on_host(
        self,
        q: Float[np.ndarray, " d"],
        varied: Varied | None,
        travelled: tuple[Return, Any, Any] | None,
    ) -> "_Linear":
        """A turn whose pieces are linearized together, once the whole turn is known."""
        if travelled is None:
            options = Options(
                True, new_input=False, tangents=True, at_once=varied is not None
            )
            travelled = *self.travel(q, options), 0.0
        end, (pieces, _, tapes), gap = travelled
        ends, levels = self.ends().split()
        lanes, tape, ends = side_by_side((pieces, tapes, ends))
        ends = ends.with_levels(levels)
        d = self.structure.d
        by_parameter = None
        if varied is None:
            s = self._structure_of(lanes)
            by, _ = tape_jacobian(s, lanes, ends, tape, True)
            by_state = by[:, 1:]
            factors = by_state.reshape(PIECES, *q.shape, d)
        else:
            by, at = tape_jacobian(varied, lanes, ends, tape, False)
            by_parameter = self._by_parameter(varied, by[:, 1:], at)
            factors = by[:, 1:, 1 : 1 + d]
        return _Linear(
            end=end,
            pieces=pieces,
            factors=factors,
            tapes=tapes,
            gap=gap,
            by_parameter=by_parameter,
        )

    def _by_parameter(
        self,
        varied: Varied,
        by: Float[np.ndarray, "K d m"],
        ends: Float[np.ndarray, "n K"],
    ) -> Float[np.ndarray, " d"]:
        """Derivative of the end of a turn by a parameter, from the derivatives of its pieces by (t,
        q, u)."""
        t0 = self.anchor.t[0]
        later = 0.0
        if self.base is None:
            longer = kernels.by_parameter_of_period(varied) * self.multiplicity
            later = longer / self.expected
        by_begin = later * t0 * by[0, :, 0]
        column = by_begin + by[0, :, -1]
        for piece in by[1:]:
            carried = piece[:, 1:-1] @ column
            column = carried + piece[:, -1]
        last_state = ends[1:, -1:]
        end = self.anchor._replace(t=ends[:1, -1], q=last_state)
        moved = later * (t0 + self.expected)
        return column + moved * self.slopes(end)[:, 0]

    def judge(self, q: Float[Array, " d"], turn: Turn) -> Int[Array, ""]:
        """The `Result` code of a state: OK if the turn is a cycle, otherwise the reason why not."""
        sizes = self.sizes
        xp = namespace(q)
        defect = self._defect(q, turn)
        existing = self.valid.sum(axis=-1)[..., None]
        counts = np.arange(self.structure.d) < existing
        singular_values = xp.where(counts, svdvals(defect), np.inf)
        smallest = xp.min(singular_values, axis=-1)
        # (Large derivatives also amplify the rounding errors of the start.)
        modulus = xp.abs(defect)
        grown = xp.max(modulus, axis=(-2, -1))
        assert self.settings.rtol is not None
        accuracy = xp.maximum(_ACCURACIES * self.settings.rtol, _ROUNDED * grown)
        is_accurate = turn.distance <= accuracy
        closed_enough = turn.closed & is_accurate
        is_ok = turn.result == Result.OK
        code = xp.where(is_ok, Result.NOT_CONVERGED, turn.result)
        closed = xp.where(smallest < SINGULAR, Result.SINGULAR, Result.OK)
        is_known = ~xp.isnan(smallest)
        code = xp.where(closed_enough & is_known, closed, code)
        if self.base is not None:
            if self.event >= 0:
                is_followed = self.followed(turn.end) >= 0
                ends_at_once = turn.closed & is_followed
                code = xp.where(ends_at_once, Result.EVENT_ORDER, code)
            extra = turn.meetings > self.multiplicity
            code = xp.where(turn.closed & extra, Result.EXTRA_TURNS, code)
            at_rest = turn.closed & self._rests(q, turn)
            code = xp.where(at_rest, Result.EQUILIBRIUM, code)
        is_beyond = turn.closed & self._beyond(turn)
        code = xp.where(is_beyond, Result.GUARD_BEYOND, code)
        for d in range(1, self.multiplicity):
            if self.multiplicity % d:
                continue
            # (A cycle that closes after a part of its turns has a lower multiplicity.)
            sooner = self.expected * (d / self.multiplicity)
            shorter = dataclasses.replace(self, multiplicity=d, expected=sooner)
            part = shorter.turn(q)
            distance = xp.abs(part.residual) / sizes
            misfit = xp.max(distance, axis=-1)
            early = misfit <= CLOSED
            code = xp.where(turn.closed & early, Result.EXTRA_TURNS, code)
        return code.astype(np.int32)

    def _defect(self, q: Float[Array, " d"], turn: Turn) -> Float[Array, "d d"]:
        """The derivative of P(q) - q, in sizes of the states."""
        sizes = self.sizes
        unit = self.valid[..., None] * np.eye(self.structure.d)
        factors = namespace(q).moveaxis(turn.factors, -3, 0)
        returned = monodromy(factors)
        defect = returned - unit - self.held(q)[1]
        in_columns = defect * sizes[..., None, :]
        return in_columns / sizes[..., None]

    def _rests(self, q: Float[Array, " d"], turn: Turn) -> Bool[Array, ""]:
        """Test whether the state does not move during a turn, as at an equilibrium."""
        xp = namespace(q)
        chart = self.each(self.anchor.chart)[..., None]
        same = turn.pieces.chart == chart
        difference = turn.pieces.q - q[..., None]
        apart = xp.abs(difference)
        apart = apart / self.sizes[..., None]
        farthest_state = xp.max(apart, axis=-2)
        in_same_chart = xp.where(same, farthest_state, np.inf)
        farthest = xp.max(in_same_chart, axis=-1)
        return farthest <= _REST * xp.maximum(self.settings.atol, turn.distance)

    def _beyond(self, turn: Turn) -> Bool[Array, "..."]:
        """True if a guard is below zero at the beginnings of all pieces in its chart, and no piece
        has crossed it: it was never armed."""
        s = self.structure
        shape = turn.distance.shape
        if not any(s.guards(a) for a in range(len(s.charts))):
            return namespace(turn.distance).zeros(shape, bool)
        xp = namespace(turn.distance)
        lanes = turn.pieces
        if shape:
            # (The pieces of turns of many systems stand side by side.)
            by_piece = jax.tree_util.tree_map(
                lambda x: xp.moveaxis(x, (-1, 0), (0, -1)), lanes
            )
            lanes = side_by_side(by_piece)
        watched = self.watch(lanes, until(lanes.t))
        value = watched.value[:-1]
        rate = watched.rate[:-1]
        longest = CLOSED * xp.max(self.expected)
        error = longest * xp.abs(rate)
        here = belongs(s, lanes.chart)[:-1]
        u = xp.zeros((s.nu, len(lanes.t)))
        structure = self._structure_of(lanes)
        holds = []
        for g, transition in enumerate(s.transitions):
            source = lanes.chart == s.chart_index(transition.source)
            which = xp.where(source, np.int32(g), np.int32(-1))
            holds.append(enabled(structure, lanes.t, lanes.q, u, which))
        codes = turn.codes.reshape(*shape, -1)
        fired = [xp.any(codes == g, axis=-1) for g in range(len(s.transitions))]

        def at_any_piece(x):
            return x.reshape(len(x), PIECES, *shape).any(axis=1)

        is_below = value < -error
        is_above = value > error
        passed = here & ~lanes.armed & is_below
        fine = here & (lanes.armed | is_above)
        passed = at_any_piece(passed & xp.stack(holds))
        fine = at_any_piece(fine)
        # (An event that happens may leave its own guard below zero.)
        never_armed = passed & ~fine & ~xp.stack(fired)
        return never_armed.any(axis=0)

    def followed(self, end: Lanes) -> Int[Array, ""]:
        """The transition (by index; -1: none) that follows at once on the event with which a turn
        ends, so that the next turn would begin without it."""
        if self.expected.ndim:
            end = side_by_side(end)
        xp = namespace(end.t)
        watched = self.watch(end, until(end.t))
        u = xp.zeros((self.structure.nu, len(end.t)))
        span = xp.atleast_1d(self.expected)
        return self.each(due_at_once(self.structure, end, watched, u, span))

    def held(
        self, q: Float[Array, " d"], varied: Varied | None = None
    ) -> tuple[Float[Array, " d"], Float[Array, "d n"]]:
        """A step of the state that changes conserved quantities by their difference from the given
        values; and its derivative by the state and the parameter of `varied` (with the direction of
        the step held fixed).

        The residual of Newton's method is P(q) - q minus this step. Conserved quantities do not
        change along P(q) - q, so that the residual is zero only if both parts are zero; and its
        Jacobian is regular.
        """
        xp = namespace(q)
        sizes = self.sizes
        if not self.conserved:
            return xp.zeros_like(q), xp.zeros(
                (*q.shape, q.shape[-1] + (varied is not None))
            )
        values, gradient = self.outputs(q, tuple(self.conserved), varied)
        excess = values - xp.stack(list(self.conserved.values()))
        by_state = gradient[..., : q.shape[-1]]
        scaled = by_state * sizes[..., None, :]
        steep = xp.linalg.norm(scaled, axis=-1, keepdims=True)
        steep = xp.where(steep > 0, steep, 1.0)
        back = (
            sizes[..., None]
            * xp.linalg.pinv(scaled / steep)
            / xp.swapaxes(steep, -1, -2)
        )
        back = stop_gradient(back)
        shift = (back @ excess[..., None])[..., 0]
        return shift, back @ gradient

    def outputs(
        self,
        q: Float[Array, " d"],
        names: tuple[str, ...],
        varied: Varied | None = None,
    ) -> tuple[Float[Array, " c"], Float[Array, "c n"]]:
        """Outputs in the anchor's chart at the anchor's time, and their derivatives by the state
        and the parameter of `varied`."""
        s = varied or self.structure
        t, chart, *_ = self.anchor

        def outputs(a, *point):
            return kernels.outputs(s, a, names, *point)

        q = namespace(q).atleast_2d(q).T
        by = self.each(
            with_derivatives(s, outputs, chart, t, q, len(names)).transpose(2, 0, 1)
        )
        columns = 2 + s.d + (varied is not None)
        return by[..., 0], by[..., 2:columns]

    def travel(
        self, q: Float[Array, " d"], flow: Any, record: Recorded | None = None
    ) -> tuple[Return, Any]:
        """One turn, piece by piece. If `flow` is a function, it computes each piece, and its other
        results are returned, too. If `flow` is an `Options`, `through` computes the pieces.

        The first K - 1 pieces end at given times, the last one on the section on which the turn
        began.
        """
        xp = namespace(q)
        ends = self.ends()

        def follow_piece(carry, end):
            lanes, h, result = carry
            *end, piece = end
            time, index, event, limit = (xp.atleast_1d(x) for x in end)
            target = Target(
                time=time,
                index=index,
                event=event,
                limit=limit,
                event_sequence=None,
                levels=ends.levels,
                missed=ends.missed,
            )
            moved, extra = flow(lanes, target, h, result, piece)
            return (moved.lanes, moved.h, moved.result), extra

        lanes, each = self.departure(q), self.each  # (no `events` is `Result.OK`)
        h = xp.atleast_1d(0.5 * self.expected / PIECES)
        if isinstance(flow, Options):
            u = xp.zeros((self.structure.nu, len(h)))
            begin = (lanes, stride(h), lanes.events)
            (end, _, result), extra = through(
                self.structure, begin, u, ends, self.settings, flow
            )
        else:
            rows = ends.time, ends.index, ends.event, ends.limit, record
            start = (lanes, h, lanes.events)
            (end, _, result), extra = scan(follow_piece, start, rows)
        is_ok = result == Result.OK
        same_chart = end.chart == self.anchor.chart
        same = each(is_ok & same_chart)
        returned = xp.where(self.valid, each(end.q.T), 0.0)
        off, _ = self.held(q)
        residual = returned - q - off
        residual = xp.where(same[..., None], residual, np.nan)
        return Return(
            residual=residual,
            period=each(end.t - self.anchor.t),
            result=each(result),
            end=end,
        ), extra

    def pieces(self) -> tuple[Lanes, Tape]:
        """The starts and tapes of the pieces of one turn."""
        options = Options(True, new_input=False, tangents=True)
        with at_ease():
            state = self.anchor.q[:, 0]
            _, (lanes, _, tapes) = self.travel(state, options)
        return lanes, tapes

    def ends(self) -> Target:
        """The targets of the pieces, as lanes; for several lanes, by piece and lane."""
        t0 = self.each(self.anchor.t)
        expected = self.expected
        xp = namespace(self.expected)
        ones = [1] * expected.ndim
        numbers = xp.arange(1, PIECES + 1)
        k = numbers.reshape(PIECES, *ones)
        if self.base is None:
            times = t0 + expected * k / PIECES
            return toward(times, -1, t0 + 2 * expected)
        free = 1 - (1 - _FREE) / self.multiplicity
        grid = t0 + free * expected * k / (PIECES - 1)
        time = xp.where(k < PIECES, grid, np.inf)
        target = toward(time, -1, t0 + 3 * expected)
        section = to_section(target, self.base, self.event)
        last = k == PIECES
        return dataclasses.replace(
            section,
            event=xp.where(last, section.event, -1).astype(np.int32),
            index=xp.where(last, section.index, -1).astype(np.int32),
        )

    def _meetings(self, pieces: Lanes, codes: Int[Array, "K R"]) -> Int[Array, ""]:
        """Number of crossings of the section (see `Turn`): how often its event happens, or how
        often its level falls through zero between pieces and at the end of the turn. With a clock,
        as many as are wanted."""
        xp = namespace(codes)
        shape = codes.shape[:-2]
        if self.base is None:
            return xp.full(shape, self.multiplicity, np.int32)
        if self.event >= 0:
            is_section = codes == self.event
            return xp.sum(is_section, axis=(-2, -1), dtype=np.int32)
        section = to_section(until(pieces.t), self.base)
        level = self.watch(pieces, section).value[-1]
        level = level.reshape(PIECES, *shape)
        events = pieces.events.reshape(PIECES, *shape)
        above = level[1:-1] > 0
        at_or_below = level[2:] <= 0
        crosses = above & at_or_below
        without_event = events[1:-1] == events[2:]
        falls = crosses & without_event
        return 1 + xp.sum(falls, axis=0, dtype=np.int32)


def across(
    f: Float[Array, "K *b d"],
    sizes: Float[Array, "K *b d"],
    factors: Float[Array, "K *b d d"],
) -> Float[Array, "K *b d d"]:
    """Factors of an autonomous system, with the direction f of the flow projected out.

    Along the flow of an autonomous system, deviations neither grow nor decay. If this direction
    stayed in the factors, it would drown strong contractions across it.
    """
    project = projections(f, sizes)
    next_project = namespace(project).roll(project, -1, axis=0)
    return next_project @ factors @ project


def with_derivatives(
    s: Structure,
    function: Callable,
    chart: Int[Array, " L"],
    t: Array,
    q: Array,
    rows: int,
    u: Array | None = None,
) -> Float[Array, "rows columns L"]:
    """Evaluate a function and its derivatives by the time, the d states and the inputs at points of
    any charts; rows and columns that a chart does not have are zero.

    **Arguments:** `function`: a function of chart, t, q and u, like those of `engine.kernels`. `u`:
    inputs. Default: 0.
    """
    xp = namespace(t)
    L = len(t)
    u = xp.zeros((s.nu, 1)) if u is None else u

    def work(a, here, out):
        n = s.dims[a]
        time = only(here, t)
        state = only(here, q[:n])
        point = time, state, only(here, u)
        by = function(a, *point)
        inputs = slice(2 + s.d, 2 + s.d + s.nu)
        columns = np.r_[: 2 + n, inputs]
        index = np.ix_(np.arange(len(by)), columns)
        return put(out, index, xp.where(here, by, out[index]))

    width = 2 + s.d + s.nu
    begin = xp.zeros((rows, width, L), t.dtype)
    return for_each_chart(s, chart, xp.ones(L, bool), work, begin)


def turn_product(factors: Float[np.ndarray, "S K d d"]) -> Float[np.ndarray, "S d d"]:
    """Products of the factors of S turns, on the host."""
    return ft.reduce(
        lambda product, factor: factor @ product, np.moveaxis(factors, 1, 0)
    )
