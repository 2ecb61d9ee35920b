"""The curve P(q; p) = q in the space of states and one parameter, point by point."""

import dataclasses
import functools as ft
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..._core.results import Result
from ...engine.lanes import Lanes
from ...errors import DefinitionError
from ...systems.structure import Structure
from ...systems.system import HybridSystem
from ..cycle import LimitCycle
from ..return_map import ReturnMap
from .parameter_map import Round, go_round


# Newton's method: most steps; a step (in sizes of the states) that is small enough, and one from
# which on rounding errors may be all that is left.
_MOST, _SMALL, _ROUNDING = 8, 1e-11, 1e-8
# States that hardly move on the cycle count as if they moved by these parts of the largest move and
# of their own size; nothing moves if the largest move is this part of the largest state.
_FLOOR, _SHARE, _REST = 1e-3, 0.02, 1e-6


@dataclasses.dataclass
class Failure:
    """Why there is no point."""

    result: Result


@dataclasses.dataclass
class Point:
    """A cycle on the curve.

    **Fields:** `start`, chart and phase at which it is anchored; `z` (d+1,), state and parameter;
    `size` (d+1,), what counts as 1 in each; `tangent` (d+1,) of the curve, a unit vector in these
    sizes; `round`, see `extended`; `steps` of Newton.
    """

    start: Lanes
    z: Float[np.ndarray, " n"]
    size: Float[np.ndarray, " n"]
    tangent: Float[np.ndarray, " n"]
    round: Round
    steps: int

    @property
    def value(self) -> float:
        """Of the parameter."""
        return float(self.z[-1])

    def oriented(self, sign: float) -> "Point":
        """The same, with a tangent along which the parameter grows (or falls)."""
        same = self.tangent[-1] * sign >= 0
        return dataclasses.replace(self, tangent=self.tangent if same else -self.tangent)

    def cosine(self, other: "Point") -> float:
        """Of the angle between two tangents."""
        theirs = other.tangent * other.size / self.size
        return float(self.tangent @ theirs / np.linalg.norm(theirs))

    def turns_before(self, other: "Point") -> bool:
        """Whether the parameter turns back between the two."""
        return self.tests["fold"] * other.tests["fold"] < 0

    @ft.cached_property
    def scaled(self) -> Float[np.ndarray, "d n"]:
        """Derivatives of the residual, all in sizes."""
        by_z = np.column_stack([self.round.by_state, self.round.by_parameter])
        return by_z * self.size / self.size[:-1, None]

    @ft.cached_property
    def eigenvalues(self) -> np.ndarray:
        return np.linalg.eigvals(self.round.monodromy)

    @ft.cached_property
    def tests(self) -> dict[str, float]:
        """Functions that change their signs where a multiplier crosses the unit circle."""
        M = self.round.monodromy
        mu, n = self.eigenvalues, len(M)
        pairs = [mu[i] * mu[j] - 1 for i in range(n) for j in range(i)]
        return {
            "fold": float(self.tangent[-1]),
            "branch point": float(np.linalg.det(np.vstack([self.scaled, self.tangent]))),
            "flip": float(np.linalg.det(M + np.eye(n))),
            "Neimark-Sacker": float(np.prod(pairs).real) if pairs else 1.0,
        }

    def has_pair_on_circle(self) -> bool:
        """Whether the pair of eigenvalues whose product is closest to 1 is a complex one."""
        mu = self.eigenvalues
        pairs = [(i, j) for i in range(len(mu)) for j in range(i)]
        i, j = min(pairs, key=lambda p: abs(mu[p[0]] * mu[p[1]] - 1))
        return bool(abs(mu[i].imag) > 1e-9 and abs(mu[i] - np.conj(mu[j])) < 1e-6)


class Curve:
    """Points of the curve through a cycle."""

    def __init__(self, cycle: LimitCycle, parameter: str, span: float):
        self.cycle, self.parameter, self.span = cycle, parameter, span
        self.structure = Structure(cycle.system)
        self.kind = ReturnMap(cycle.base, cycle.conserved, cycle.turns)
        self.expected = cycle.period
        self.order = _turned(cycle.order)
        _leaf(cycle.system, parameter)
        flat = jax.tree_util.tree_map(
            lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else x, cycle.system
        )
        self.direction = _with(flat, parameter, 1.0)

    def value_of(self, system: HybridSystem) -> float:
        return float(_leaf(system, self.parameter))

    def system_at(self, value: float) -> HybridSystem:
        return _with(self.cycle.system, self.parameter, value)

    def first(self, value: float) -> Point | Failure:
        """The cycle itself."""
        n = self.structure.d
        z = np.append(np.asarray(self.cycle.start.q[:, 0]), value)
        row = np.append(np.zeros(n), 1.0)
        size = np.append(np.ones(n), self.span)
        return self._correct(z, row, size, row, self.cycle.start)

    def step(self, here: Point, length: float) -> Point | Failure:
        """The next point, about `length` further along the tangent."""
        ahead = length * here.tangent * here.size
        point = self._correct(
            here.z + ahead, here.tangent / here.size, here.size, here.tangent, here.start
        )
        if isinstance(point, Failure):
            return point
        astray = np.linalg.norm((point.z - here.z - ahead) / here.size)
        return point if astray <= 0.5 * length else Failure(Result.NOT_CONVERGED)

    def between(self, a: Point, b: Point, where: float) -> Point | Failure:
        """The point over a place on the chord from a to b."""
        chord = (b.z - a.z) / a.size
        row = chord / np.linalg.norm(chord) / a.size
        return self._correct(a.z + where * (b.z - a.z), row, a.size, chord, a.start)

    def land(self, a: Point, b: Point, value: float) -> Point | Failure:
        """The point between a and b where the parameter has a value."""
        where = (value - a.value) / (b.value - a.value)
        z = a.z + where * (b.z - a.z)
        z[-1] = value
        row = np.append(np.zeros(len(z) - 1), 1 / a.size[-1])
        point = self._correct(z, row, a.size, (b.z - a.z) / a.size, a.start)
        if not isinstance(point, Failure):
            point.z[-1] = value
        return point

    def elsewhere(self, here: Point) -> Point | None:
        """The same cycle, anchored at a phase of the clock that is far from all events.

        An event that moves across the phase at which the cycle begins changes the chart there, and
        is no obstacle to the cycle.
        """
        codes = here.round.codes
        events = np.flatnonzero((codes >= 0).any(axis=1)) + 0.5
        if self.kind.base is not None or not len(events):
            return None
        K = len(codes)
        apart = np.abs(np.arange(K)[:, None] - events)
        k = int(np.argmax(np.min(np.minimum(apart, K - apart), axis=1)))
        legs = here.round.legs
        phase = legs.t[k : k + 1] / here.round.period * self.expected
        start = eqx.tree_at(
            lambda x: (x.t, x.chart), here.start, (jnp.asarray(phase), jnp.asarray(legs.chart[[k]]))
        )
        row = np.append(np.zeros(len(here.z) - 1), 1.0)
        forward = row * np.sign(here.tangent[-1])
        z = np.append(legs.q[:, k], here.value)
        point = self._correct(z, row / here.size, here.size, forward, start)
        return None if k == 0 or isinstance(point, Failure) else point

    def _correct(self, z0, row, size, forward, start: Lanes) -> Point | Failure:
        """Newton's method for a point with row @ (z - z0) = 0."""
        z, last = z0.copy(), np.inf
        for k in range(_MOST):
            round = self._round(z, start)
            if (failure := self._failure(round)) is not None:
                return failure
            by_z = np.column_stack([round.by_state, round.by_parameter])
            A = np.vstack([by_z, row]) * size
            right = np.append(round.residual, row @ (z - z0))
            if not np.all(np.isfinite(A)):
                return Failure(Result.NOT_CONVERGED)
            change = np.linalg.lstsq(A, -right, rcond=1e-14)[0]
            length = np.linalg.norm(change)
            if length <= _SMALL or (length <= _ROUNDING and length >= 0.5 * last):
                return self._point(z, forward, start, round, k)
            if length > 2 * last:
                break
            z, last = z + change * size, length
        return Failure(Result.NOT_CONVERGED)

    def _round(self, z, start: Lanes) -> Round:
        system = self.system_at(z[-1])
        out = go_round(
            system, self.direction, jnp.asarray(z[:-1]), start, self.kind, self.expected,
            self.cycle.settings,
        )  # fmt: skip
        return jax.tree_util.tree_map(np.asarray, out)

    def _failure(self, round: Round) -> Failure | None:
        if int(round.result) != Result.OK:
            return Failure(Result(int(round.result)))
        order = _turned(int(g) for g in np.ravel(round.codes) if g >= 0)
        if sorted(order) != sorted(self.order):
            return Failure(Result.GRAZING)  # events come and go where a guard is touched
        if order != self.order or not np.all(np.isfinite(round.residual)):
            return Failure(Result.EVENT_ORDER)
        return None

    def _point(self, z, forward, start: Lanes, round: Round, steps: int) -> Point | Failure:
        moves, largest = self._extent(int(start.chart[0]), z[:-1], round.legs)
        rest = np.max(moves) <= _REST * np.max(largest)
        if rest and self.kind.base is not None:
            return Failure(Result.EQUILIBRIUM)
        floor = np.maximum(_FLOOR * np.max(moves), _SHARE * largest)
        size = np.append(np.ones_like(moves) if rest else np.maximum(moves, floor), self.span)
        point = Point(start, z, size, forward, round, steps)
        _, _, right = np.linalg.svd(point.scaled)
        tangent = right[-1] * (1.0 if right[-1] @ forward >= 0 else -1.0)
        return dataclasses.replace(point, tangent=tangent)

    def _extent(self, first: int, q, legs) -> tuple[np.ndarray, np.ndarray]:
        """By how much each state of the first chart moves on the cycle, in all charts that have a
        state of its name, and its largest modulus."""
        s = self.structure
        moves, largest = np.zeros(s.d), np.zeros(s.d)
        for k, name in enumerate(s.charts[first].states):
            seen = [q[k]]
            for a, chart in enumerate(s.charts):
                if name in chart.states:
                    seen.extend(legs.q[chart.states.index(name), legs.chart == a])
            moves[k], largest[k] = np.ptp(seen), np.max(np.abs(seen))
        return moves, largest


def _turned(order) -> tuple[int, ...]:
    """Events of a turn, from the same one on wherever the turn begins."""
    order = tuple(order)
    return min((order[k:] + order[:k] for k in range(len(order))), default=())


def _leaf(system: HybridSystem, parameter: str):
    """The parameter of that name.

    **Raises:** `DefinitionError` if there is none.
    """
    try:
        value = operator.attrgetter(parameter)(system)
    except (AttributeError, TypeError) as error:
        raise DefinitionError(
            f"{type(system).__name__} has no parameter '{parameter}'; parameters are "
            f"{', '.join(_names(system))}."
        ) from error
    if not eqx.is_inexact_array(value) or value.shape != ():
        raise DefinitionError(
            f"'{parameter}' of {type(system).__name__} is no single floating-point number; "
            f"parameters are {', '.join(_names(system))}."
        )
    return value


def _names(system):
    leaves = jax.tree_util.tree_leaves_with_path(system)
    return [
        jax.tree_util.keystr(path).lstrip(".")
        for path, x in leaves
        if eqx.is_inexact_array(x) and x.shape == ()
    ]


def _with(system, parameter: str, value):
    return eqx.tree_at(operator.attrgetter(parameter), system, jnp.asarray(value, float))
