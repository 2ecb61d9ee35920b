"""The curve P(q; p) = q in the space of states and one parameter, point by point."""

import dataclasses
import functools as ft
import itertools
import operator
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.compilation import quick_jit
from .._core.results import Result
from ..engine.lanes import Lanes
from ..errors import DefinitionError
from ..systems.system import HybridSystem
from .cycle import LimitCycle
from .newton import FEW_STEPS, newton_steps
from .return_map import ReturnMap, Turn, turn_product


# Newton's method ends with a step this small, in sizes of the states; from the second number on,
# rounding errors may be all that is left. Smaller: it does not end. Larger: points are less
# accurate.
_SMALL, _ROUNDING = 1e-11, 1e-8
# States that hardly move on the cycle count as if they moved by these parts of the largest move and
# of their own size. Smaller: they shorten the steps. Larger: steps are longer than the orbit.
_FLOOR, _SHARE = 1e-3, 0.02
# Nothing moves if the largest move is at most this part of the largest state, all in sizes.
# Smaller: an equilibrium passes for a cycle. Larger: small cycles are taken for equilibria.
_REST = 1e-6


@dataclasses.dataclass
class Point:
    """A cycle on the curve.

    **Fields:** `anchor`, chart and phase (as the time of the first cycle's clock) at which it
    begins; `departure`, the lane there; `dim`, its number of states; `z` (n,), state (padded) and
    parameter; `size` (n,), what counts as 1 in each; `tangent` (n,) of the curve, a unit vector in
    these sizes; `turn` from there; `steps` of Newton.
    """

    anchor: Lanes
    departure: Lanes
    dim: int
    z: Float[np.ndarray, " n"]
    size: Float[np.ndarray, " n"]
    tangent: Float[np.ndarray, " n"]
    turn: Turn
    steps: int

    @property
    def value(self) -> float:
        """The value of the parameter."""
        return float(self.z[-1])

    def oriented(self, sign: float) -> "Point":
        """The point with a tangent along which the parameter grows (or falls)."""
        same = self.tangent[-1] * sign >= 0
        return dataclasses.replace(self, tangent=self.tangent if same else -self.tangent)

    def cosine(self, other: "Point") -> float:
        """The cosine of the angle between two tangents."""
        tangent = other.tangent * other.size / self.size
        return float(self.tangent @ tangent / np.linalg.norm(tangent))

    @ft.cached_property
    def scaled(self) -> Float[np.ndarray, "d n"]:
        """Derivatives of the residual, all in sizes."""
        return _scaled(self.turn, self.size)

    @ft.cached_property
    def monodromy(self) -> Float[np.ndarray, "m m"]:
        """Derivative of the return map; for an autonomous system across the flow."""
        return turn_product(self.turn.factors[None])[0, : self.dim, : self.dim]

    @ft.cached_property
    def pairs(self) -> list[tuple[complex, complex]]:
        """All pairs of multipliers."""
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        return list(itertools.combinations(values, 2))

    @ft.cached_property
    def tests(self) -> dict[str, float]:
        """Functions that change their signs when a multiplier crosses the unit circle."""
        M = self.monodromy
        products = [x * y - 1 for x, y in self.pairs]
        return {
            "fold": float(self.tangent[-1]),
            "branch point": float(np.linalg.det(np.vstack([self.scaled, self.tangent]))),
            "flip": float(np.linalg.det(M + np.eye(len(M)))),
            "Neimark-Sacker": float(np.prod(products).real) if products else 1.0,
        }

    def has_pair_on_circle(self) -> bool:
        """True if the pair of multipliers whose product is closest to 1 is a complex one."""
        x, y = min(self.pairs, key=lambda pair: abs(pair[0] * pair[1] - 1))
        return bool(x.imag != 0 and x == np.conj(y))


class Curve:
    """Points of the curve through a cycle."""

    def __init__(self, cycle: LimitCycle, parameter: str, span: float):
        self.cycle, self.parameter, self.span = cycle, parameter, span
        self.map, self.sequence = cycle.return_map, _rotated(cycle.event_sequence)
        self.structure = self.map.structure
        _leaf(cycle.system, parameter)
        flat = jax.tree_util.tree_map(
            lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else x, cycle.system
        )
        self.direction = _with(flat, parameter, 1.0)

    def value_of(self, system: HybridSystem) -> float:
        return float(_leaf(system, self.parameter))

    def system_at(self, value: float) -> HybridSystem:
        return _with(self.cycle.system, self.parameter, value)

    def first(self, value: float) -> Point | Result:
        """The cycle itself."""
        z = np.append(np.asarray(self.cycle.anchor.q[:, 0]), value)
        row = np.append(np.zeros(self.structure.d), 1.0)
        size = np.append(np.asarray(self.map.sizes), self.span)
        return self._correct(z, row / size, size, row, self.cycle.anchor)

    def step(self, last: Point, length: float) -> Point | Result:
        """The next point, about `length` further along the tangent."""
        ahead = length * last.tangent * last.size
        point = self._correct(
            last.z + ahead, last.tangent / last.size, last.size, last.tangent, last.anchor
        )
        if isinstance(point, Result):
            return point
        astray = np.linalg.norm((point.z - last.z - ahead) / last.size)
        return point if astray <= 0.5 * length else Result.NOT_CONVERGED

    def between(self, a: Point, b: Point, where: float) -> Point | Result:
        """The point over a place on the chord from a to b."""
        chord = (b.z - a.z) / a.size
        row = chord / np.linalg.norm(chord) / a.size
        return self._correct(a.z + where * (b.z - a.z), row, a.size, chord, a.anchor)

    def land(self, a: Point, b: Point, value: float) -> Point | Result:
        """The point between a and b where the parameter has a value."""
        where = (value - a.value) / (b.value - a.value)
        z = a.z + where * (b.z - a.z)
        z[-1] = value
        row = np.append(np.zeros(len(z) - 1), 1 / a.size[-1])
        point = self._correct(z, row, a.size, (b.z - a.z) / a.size, a.anchor)
        if not isinstance(point, Result):
            point.z[-1] = value
        return point

    def elsewhere(self, point: Point) -> Point | None:
        """The same cycle, anchored at a phase of the clock that is far from all events.

        An event that moves across the phase at which the cycle begins changes the chart there, and
        is no obstacle to the cycle.
        """
        codes = point.turn.codes
        events = np.flatnonzero((codes >= 0).any(axis=1)) + 0.5
        if self.map.base is not None or not len(events):
            return None
        K = len(codes)
        apart = np.abs(np.arange(K)[:, None] - events)
        k = int(np.argmax(np.min(np.minimum(apart, K - apart), axis=1)))
        legs = point.turn.legs
        phase = legs.t[k : k + 1] / point.turn.period * float(self.map.expected)
        anchor = point.anchor._replace(t=jnp.asarray(phase), chart=jnp.asarray(legs.chart[[k]]))
        row = np.append(np.zeros(len(point.z) - 1), 1.0)
        forward = row * np.sign(point.tangent[-1])
        z = np.append(legs.q[:, k], point.value)
        moved = self._correct(z, row / point.size, point.size, forward, anchor)
        return None if k == 0 or isinstance(moved, Result) else moved

    def _correct(self, z0, row, size, forward, anchor: Lanes) -> Point | Result:
        """Newton's method for a point with row @ (z - z0) = 0."""
        z, last, rounding = z0.copy(), np.inf, len(z0) * np.finfo(float).eps
        for k in range(FEW_STEPS):
            departure, turn = self._turn(z, anchor)
            if (failure := self._failure(turn)) is not None:
                return failure
            equations = np.vstack([_scaled(turn, size), row * size])
            residual = np.append(turn.residual / size[:-1], row @ (z - z0))
            (change,) = newton_steps(equations[None], residual[None], rounding)
            if not np.all(np.isfinite(change)):
                return Result.NOT_CONVERGED
            length = np.linalg.norm(change)
            if length <= _SMALL or (length <= _ROUNDING and length >= 0.5 * last):
                dim = self.structure.dims[int(anchor.chart[0])]
                return self._settled(Point(anchor, departure, dim, z, size, forward, turn, k))
            if length > 2 * last:
                break
            z, last = z + change * size, length
        return Result.NOT_CONVERGED

    def _turn(self, z, anchor: Lanes) -> tuple[Lanes, Turn]:
        map = dataclasses.replace(self.map, anchor=anchor)
        out = _turn_along(map, self.system_at(z[-1]), self.direction, jnp.asarray(z[:-1]))
        return jax.tree_util.tree_map(np.asarray, out)

    def _failure(self, turn: Turn) -> Result | None:
        if int(turn.result) != Result.OK:
            return Result(int(turn.result))
        sequence = _rotated(int(g) for g in np.ravel(turn.codes) if g >= 0)
        if sorted(sequence) != sorted(self.sequence):
            return Result.GRAZING  # events come and go where a guard is touched
        if sequence != self.sequence or not np.all(np.isfinite(turn.residual)):
            return Result.EVENT_ORDER
        return None

    def _settled(self, point: Point) -> Point | Result:
        """The point with sizes and a tangent of its own."""
        moves, largest = self._extent(point)
        still = np.max(moves) <= _REST * np.max(largest)
        if still and self.map.base is not None:
            return Result.EQUILIBRIUM
        floor = np.maximum(_FLOOR * np.max(moves), _SHARE * largest)
        moves = np.ones_like(moves) if still else np.maximum(moves, floor)
        sizes = self._sizes(point)
        point = dataclasses.replace(point, size=np.append(moves * sizes, self.span))
        _, _, right = np.linalg.svd(point.scaled)
        tangent = right[-1] * (1.0 if right[-1] @ point.tangent >= 0 else -1.0)
        return dataclasses.replace(point, tangent=tangent)

    def _sizes(self, point: Point) -> Float[np.ndarray, " d"]:
        return np.asarray(dataclasses.replace(self.map, anchor=point.anchor).sizes)

    def _extent(self, point: Point) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """The range of each state of the anchor's chart on the cycle, over all charts that have a
        state of its name, and its largest modulus, both in sizes of the states."""
        s, legs, sizes = self.structure, point.turn.legs, self._sizes(point)
        moves, largest = np.zeros(s.d), np.zeros(s.d)
        for k, name in enumerate(s.charts[int(point.anchor.chart[0])].states):
            values = [point.z[k]]
            for a, chart in enumerate(s.charts):
                if name in chart.states:
                    values.extend(legs.q[chart.states.index(name), legs.chart == a])
            moves[k], largest[k] = np.ptp(values) / sizes[k], np.max(np.abs(values)) / sizes[k]
        return moves, largest


@quick_jit
def _turn_along(
    map: ReturnMap, system: HybridSystem, direction: HybridSystem, q: Float[Array, " d"]
) -> tuple[Lanes, Turn]:
    """The lane at the beginning, and one turn with derivatives by the state and along `direction`
    in the parameters: so one program serves all parameters."""
    map = map.at_phase_of(system)
    return map.departure(q), map.turn_with_jacobian(q, direction=direction)


def _scaled(turn: Turn, size: Float[np.ndarray, " n"]) -> Float[np.ndarray, "d n"]:
    """Derivatives of the residual by state and parameter, all in sizes."""
    by_z = np.column_stack([turn.jacobian, turn.by_parameter])
    return by_z * size / size[:-1, None]


def _rotated(sequence: Iterable[int]) -> tuple[int, ...]:
    """Events of a turn, from the same one on wherever the turn begins."""
    events = tuple(sequence)
    return min((events[k:] + events[:k] for k in range(len(events))), default=())


def _leaf(system: HybridSystem, parameter: str):
    """The parameter of that name.

    **Raises:** `DefinitionError` if there is none.
    """
    leaves = jax.tree_util.tree_leaves_with_path(system)
    is_number = lambda x: eqx.is_inexact_array(x) and x.shape == ()  # noqa: E731
    names = (jax.tree_util.keystr(path).lstrip(".") for path, x in leaves if is_number(x))
    name, text = type(system).__name__, f"parameters are {', '.join(names)}."
    try:
        value = operator.attrgetter(parameter)(system)
    except (AttributeError, TypeError) as error:
        raise DefinitionError(f"{name} has no parameter '{parameter}'; {text}") from error
    if not is_number(value):
        raise DefinitionError(f"'{parameter}' of {name} is no single floating-point number; {text}")
    return value


def _with(system, parameter: str, value):
    return eqx.tree_at(operator.attrgetter(parameter), system, jnp.asarray(value, float))
