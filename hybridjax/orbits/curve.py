"""The curve P(q; p) = q in the space of states q and one parameter p, point by point. P is the
return map.

`Curve.step` predicts the next point along the tangent, and `Curve._correct` finds it by Newton's
method; `branches.py` chooses the lengths of steps and looks for bifurcations between points. A
vector z must stay the state followed by the parameter: all rows and tangents have this order. A
*turn* is one application of the return map; *sizes* of states are their magnitudes (`scale.py`).

A branch that ends too early has its cause in `_correct` or `_failure`, whose reason is the
`Result`; one that turns back without need, in the tangent (`_settled`); a change of stability that
is missed or invented, in `Point.tests`, to which a further test function is added.
"""

import dataclasses
import functools as ft
from collections.abc import Iterable

import jax
import numpy as np
from jaxtyping import Complex, Float

from .._core.compilation import at_ease
from .._core.executor import on_the_cpu, svdvals, to_host
from .._core.results import Result
from ..engine.lanes import Lanes
from ..systems.system import HybridSystem
from ..systems.varied import Varied, parameter_of, with_parameters
from .coincidence import SAME
from .cycle import LimitCycle, as_found, what_changed
from .linear_flow import begin_later, last_turn
from .newton import FEW_STEPS
from .return_map import ENOUGH, ReturnMap, Turn, turn_product
from .shooting import newton_steps


# Newton's method ends with a step below this, in sizes of the states; or with a step below
# `_ROUNDING` that does not become smaller, which may be a rounding error. Smaller: it does not end.
# Larger: points are less accurate.
_SMALL = 1e-11
_ROUNDING = 1e-8
# States are scaled by their range over the cycle, but at least by this part of their size. Smaller:
# states that hardly move shorten the steps. Larger: steps are longer than the orbit.
_LEAST_RANGE = 0.02
# A cycle without events counts as an equilibrium if its range is below this part of the range of
# the first cycle. Smaller: near a Hopf point, rounding errors look like a fold, and spoil the
# multipliers. Larger: the branch ends before the Hopf point.
_SHRUNK = 1e-3


# Bytes of recorded steps that the points of a branch keep. More: long branches of large systems
# fill the memory. Less: more of their trajectories are integrated again for figures.
_MOST_BYTES = 2**28


@dataclasses.dataclass
class Point:
    """A cycle on the curve.

    **Fields:** `anchor`, chart and phase (as the time of the first cycle's clock) at which it
    begins; `z` (n,), state (padded) and parameter; `size` (n,), the unit of each entry of `z`;
    `tangent` (n,) of the curve, a unit vector in these sizes; `turn` from there, with derivatives
    with respect to `z`; `steps` of Newton; `kind` of a change of stability there.
    """

    anchor: Lanes
    z: Float[np.ndarray, " n"]
    size: Float[np.ndarray, " n"]
    tangent: Float[np.ndarray, " n"]
    turn: Turn
    steps: int
    kind: str = ""

    @property
    def departure(self) -> Lanes:
        """The lane at which the cycle begins."""
        return jax.tree_util.tree_map(lambda x: x[..., :1], self.turn.pieces)

    @property
    def recorded(self) -> Turn | None:
        """The turn, if its steps are kept."""
        tapes = self.turn.tapes
        return None if tapes is None or tapes.h is None else self.turn

    @property
    def value(self) -> float:
        """The value of the parameter."""
        return float(self.z[-1])

    @property
    def period(self) -> float:
        """The period of the cycle."""
        return float(self.turn.period)

    def oriented(self, sign: float) -> "Point":
        """The point with a tangent along which the parameter grows (or falls)."""
        same = self.tangent[-1] * sign >= 0
        return dataclasses.replace(
            self, tangent=self.tangent if same else -self.tangent
        )

    def cosine(self, other: "Point") -> float:
        """The cosine of the angle between two tangents."""
        tangent = other.tangent * other.size / self.size
        return float(self.tangent @ tangent / np.linalg.norm(tangent))

    @property
    def scaled(self) -> Float[np.ndarray, "d n"]:
        """Derivatives of the residual by state and parameter, in units of `size`."""
        by_column = self.turn.jacobian * self.size
        return by_column / self.size[:-1, None]

    @ft.cached_property
    def multipliers(self) -> Complex[np.ndarray, " d"]:
        """All multipliers, by decreasing modulus, padded with zeros."""
        monodromy = turn_product(self.turn.factors[None])[0]
        values = np.linalg.eigvals(monodromy).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @ft.cached_property
    def tests(self) -> dict[str | int, float]:
        """Functions that change sign when a multiplier crosses the unit circle: two by name, and
        the moduli of all multipliers less 1, by index."""
        rows = np.vstack([self.scaled, self.tangent])
        return {
            "fold": float(self.tangent[-1]),
            "branch point": float(np.sign(np.linalg.det(rows)) * svdvals(rows)[-1]),
            **dict(enumerate(np.abs(self.multipliers) - 1)),
        }


class Curve:
    """Points of the curve through a cycle."""

    def __init__(self, cycle: LimitCycle, parameter: str, span: float):
        self.cycle = cycle
        self.parameter = parameter
        self.span = span
        map = to_host(cycle.return_map)
        # (The limit on steps is the larger one of single searches.)
        steps = max(map.settings.max_steps, ENOUGH)
        settings = dataclasses.replace(map.settings, max_steps=steps)
        self.map = dataclasses.replace(map, settings=settings)
        self.sequence = _rotated(cycle.event_sequence)
        self.value = float(parameter_of(cycle.system, parameter))
        self.least_range = SAME
        self.kept_bytes = 0
        if not self.sequence:
            first_ranges = self._ranges(to_host(cycle.pieces))
            self.least_range = max(SAME, _SHRUNK * float(np.max(first_ranges)))

    def system_at(self, value: float) -> HybridSystem:
        # (JAX compiles a conversion for a number of NumPy, and none for an array.)
        return with_parameters(self.cycle.system, {self.parameter: np.asarray(value)})

    def first(self) -> Point | Result:
        """The cycle itself."""
        size = np.append(self.map.sizes, self.span)
        begin = self.map.anchor, float(self.map.expected)
        z = np.append(self.map.anchor.q, self.value)
        return self._correct(z, self._by_value(size), size, self._by_value(), begin)

    def step(self, before: Point | None, last: Point, length: float) -> Point | Result:
        """The next point, about `length` further along the tangent. `before`: the point before the
        last one, if there is one."""
        ahead = length * last.tangent * last.size
        row = last.tangent / last.size
        guess = last.z + ahead
        period = last.period
        if before and before.anchor is last.anchor:
            further = float(length / (row @ (last.z - before.z)))
            guess = _cubic(before, last, row, 1 + further)
            period += further * (last.period - before.period)
        begin = last.anchor, period
        point = self._correct(
            last.z + ahead, row, last.size, last.tangent, begin, guess
        )
        if isinstance(point, Result):
            return point
        off = point.z - last.z - ahead
        astray = np.linalg.norm(off / last.size)
        return point if astray <= 0.5 * length else Result.NOT_CONVERGED

    def between(self, a: Point, b: Point, where: float) -> Point | Result:
        """The point of the curve nearest to a point on the chord from a to b; `where` is the part
        of the chord."""
        chord = (b.z - a.z) / a.size
        row = chord / np.linalg.norm(chord) / a.size
        z = a.z + where * (b.z - a.z)
        begin = a.anchor, a.period + where * (b.period - a.period)
        return self._correct(z, row, a.size, chord, begin, _cubic(a, b, row, where))

    def land(self, a: Point, b: Point, value: float) -> Point | Result:
        """The point between a and b where the parameter has a value."""
        change = b.z - a.z
        where = (value - a.value) / change[-1]
        z = a.z + where * change
        z[-1] = value
        begin = a.anchor, a.period + where * (b.period - a.period)
        forward = change / a.size
        point = self._correct(z, self._by_value(a.size), a.size, forward, begin)
        if not isinstance(point, Result):
            point.z[-1] = value
        return point

    def elsewhere(self, point: Point) -> Point | None:
        """The same cycle, anchored at a phase of the clock that is far from all events.

        (If an event moves across the phase at which the cycle begins, Newton's method fails
        although the cycle exists.)
        """
        pieces = point.turn.pieces
        tapes = point.turn.tapes
        assert tapes is not None
        events = tapes.t[tapes.code >= 0]
        if self.map.base is not None or not len(events):
            return None
        k = far_from_events(pieces.t, events, float(point.turn.period))
        part = pieces.t[k : k + 1] / point.turn.period
        phase = part * float(self.map.expected)
        anchor = point.anchor._replace(t=phase, chart=pieces.chart[[k]])
        if k == 0:
            return None
        forward = self._by_value() * np.sign(point.tangent[-1])
        z = np.append(pieces.q[:, k], point.value)
        row = self._by_value(point.size)
        begin = anchor, point.period
        moved = self._correct(z, row, point.size, forward, begin)
        return None if isinstance(moved, Result) else moved

    def _by_value(
        self, size: float | Float[np.ndarray, " n"] = 1.0
    ) -> Float[np.ndarray, " n"]:
        """A row vector whose product with z (in units of `size`) is the parameter."""
        return np.append(np.zeros(self.map.structure.d), 1.0) / size

    def _correct(
        self, z0, row, size, forward, begin: tuple[Lanes, float], guess=None
    ) -> Point | Result:
        """Newton's method for a point with row @ (z - z0) = 0, from a guess (default: z0).

        **Arguments:** `begin`: the anchor, and the period that is expected.
        """
        anchor, period = begin
        map = dataclasses.replace(self.map, anchor=anchor)
        if map.base is not None:
            map = dataclasses.replace(map, expected=np.asarray(period))
        rounding = len(z0) * np.finfo(float).eps
        z = z0 if guess is None else guess
        last = np.inf
        for k in range(FEW_STEPS):
            turn = self.turn(map, z)
            failure = self._failure(turn, z)
            if failure is not None:
                return failure
            point = Point(
                anchor=anchor,
                z=z,
                size=size,
                tangent=forward,
                turn=turn,
                steps=k,
            )
            equations = np.vstack([point.scaled, row * size])
            along = row @ (z - z0)
            residual = np.append(turn.residual / size[:-1], along)
            (change,) = newton_steps(equations[None], residual[None], rounding)
            length = np.linalg.norm(change)
            only_rounding = length <= _ROUNDING and length >= 0.5 * last
            if length <= _SMALL or only_rounding:
                return self._settled(point)
            if not length <= 2 * last:
                break
            z = z + change * size
            last = length
        return Result.NOT_CONVERGED

    def turn(self, map: ReturnMap, z: Float[np.ndarray, " n"]) -> Turn:
        """One turn from the point z, of the system with the parameter in z, with derivatives by
        z."""
        varied = Varied(self.system_at(z[-1]), self.parameter)
        with on_the_cpu(), at_ease():
            map = to_host(map.at_phase_of(varied.system))
            return map.turn_with_jacobian(z[:-1], varied=varied)

    def _failure(self, turn: Turn, z: Float[np.ndarray, " n"]) -> Result | None:
        """The reason why a turn cannot be one of the branch: it failed, has other events than the
        first cycle, or meets its section too often. None for a good turn."""
        if int(turn.result) != Result.OK:
            return Result(int(turn.result))
        sequence = _rotated(turn.events)
        if sorted(sequence) != sorted(self.sequence):
            return Result.GRAZING  # events come and go where a guard is touched
        if sequence != self.sequence or not np.all(np.isfinite(turn.residual)):
            return Result.EVENT_ORDER
        if turn.closed and int(turn.meetings) > self.map.multiplicity:
            return Result.EXTRA_TURNS
        if turn.closed and self.map.event >= 0:
            map = to_host(self.map.at_phase_of(self.system_at(z[-1])))
            if map.followed(turn.end) >= 0:
                return Result.EVENT_ORDER
        return None

    def _ranges(self, pieces: Lanes) -> Float[np.ndarray, " d"]:
        """The range of each state over the beginnings of pieces, in sizes of the states."""
        scale = np.asarray(self.map.scale)
        return np.ptp(pieces.q / scale[pieces.chart].T, axis=1)

    def _settled(self, point: Point) -> Point | Result:
        """The point with its tangent, and with `size` from the range of each state on the cycle."""
        scale = np.asarray(self.map.scale)
        ranges = self._ranges(point.turn.pieces)
        if self.map.base is not None and np.max(ranges) <= self.least_range:
            return Result.EQUILIBRIUM
        widest = np.maximum(ranges, _LEAST_RANGE)
        sizes = scale[int(point.anchor.chart[0])] * widest
        point = dataclasses.replace(point, size=np.append(sizes, self.span))
        _, _, right = np.linalg.svd(point.scaled)
        same = right[-1] @ point.tangent >= 0
        tangent = right[-1] if same else -right[-1]
        return dataclasses.replace(point, tangent=tangent, turn=self._kept(point.turn))

    def _kept(self, turn: Turn) -> Turn:
        """A turn with its recorded steps. On long branches only the events are kept."""
        assert turn.tapes is not None
        leaves = jax.tree_util.tree_leaves(turn.tapes)
        self.kept_bytes += sum(x.nbytes for x in leaves)
        if self.kept_bytes <= _MOST_BYTES:
            return turn
        tapes = turn.tapes._replace(h=None, before=None, after=None, chart=None)
        return turn._replace(tapes=tapes)


def _cubic(
    a: Point, b: Point, row: Float[np.ndarray, " n"], x: float
) -> Float[np.ndarray, " n"]:
    """The cubic polynomial through two points with their tangents, evaluated at a part of their
    distance along `row`."""
    chord = b.z - a.z

    def off(p):
        along = p.tangent * p.size
        return along * (row @ chord) / (row @ along) - chord

    on_chord = a.z + x * chord
    beside = (1 - x) * off(a) - x * off(b)
    return on_chord + x * (1 - x) * beside


def far_from_events(t: np.ndarray, events: np.ndarray, period: float) -> int:
    """Which of the times of a cycle is farthest from all events."""
    since = t[:, None] - events
    apart = np.mod(since + 0.5 * period, period) - 0.5 * period
    return int(np.abs(apart).min(axis=1).argmax())


def away_from_events(cycle: LimitCycle) -> LimitCycle:
    """The cycle as a guess for similar clocked systems, with a beginning far from all events. (An
    event that moves across the beginning would change the chart there.)"""
    # (A copy has no recorded turn.)
    cycle = as_found(cycle) if what_changed(cycle.system, cycle.numbers) else cycle
    if not cycle.clocked or what_changed(cycle.system, cycle.numbers):
        return cycle
    path = cycle.trajectory()
    events = path.t[path.event >= 0]
    if not len(events):
        return cycle
    k = far_from_events(last_turn(cycle)[0].t, events, float(cycle.period))
    return begin_later(cycle, k) if k else cycle


def _rotated(sequence: Iterable[int]) -> tuple[int, ...]:
    """Events of a turn in cyclic order, rotated so that the result does not depend on where the
    turn begins."""
    events = tuple(sequence)
    rotations = [events[k:] + events[:k] for k in range(len(events))]
    return min(rotations, default=())
