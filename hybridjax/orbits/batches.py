"""Limit cycles of many systems of one class, by Newton's method side by side on the host.

`limit_cycles.py` makes `Tiles` of the systems of a sweep and calls `Tiles.solve`, which returns
`Rounds`: the last Newton step of each system, with its result code. Each system begins from a guess
of its own, mostly the cycle of its nearest neighbor in the parameters. A *turn* is one application
of the return map: the flow from the section back to it. A *tile* is a number of systems that are
computed by one call; in it, each system is a *lane*, an entry on the last axis of every array. The
results of a call have the systems on the first axis (`_apart`), and `Tiles.solve` returns them in
the order of `systems`: both must stay.

If a system fails here whose cycle `find_limit_cycle` finds, look at `_step` (Newton) and `_again`
(further attempts); if it gets a cycle of another branch, at `_nearest`, which chooses its guess; if
a good turn is refused, at `_verdict`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.compilation import at_ease, uncollected
from .._core.execution import in_threads
from .._core.executor import on_the_cpu, to_host
from .._core.lanes import PerLane
from .._core.progress import working
from .._core.results import Result
from ..engine.kernels import WIDE
from ..engine.lanes import Lanes
from ..engine.move import move
from ..engine.settings import TRANSIENT, Settings
from ..engine.target import toward, until
from ..systems.system import HybridSystem
from .crossing import to_section
from .guess import require_similar
from .newton import FEW_STEPS
from .return_map import ReturnMap, Turn
from .rivals import coincide, events_on
from .scale import in_sizes
from .shooting import excess, newton_steps, one_by_one


# Periods for which a system is simulated before each further attempt of Newton's method. (0: for
# unstable cycles.) Fewer: slow transients remain. More: each failure takes longer.
_SETTLE = 8, 0, 40


def _apart(map: ReturnMap, lanes: Lanes) -> Lanes:
    """The lanes of many systems, moved to the first axis. The lane of a single system is returned
    as it is."""
    return jax.tree_util.tree_map(one_by_one, lanes) if map.expected.ndim else lanes


def _turn(map: ReturnMap):
    """One turn of a system, or of many systems side by side on the host. Returns the anchor, the
    expected period, the turn with its Jacobian, and whether events coincide on it."""
    turn = map.turn_with_jacobian(map.each(map.anchor.q.T))
    assert turn.tapes is not None
    together = coincide(map.structure, events_on(map, turn.tapes), turn.period)
    turn = turn._replace(record=None, tapes=None, end=_apart(map, turn.end))
    return _apart(map, map.anchor), map.expected, turn, together


def _verdict(map: ReturnMap, turn: Turn):
    """The anchors at the beginning of a turn, periods, and result codes."""
    q = map.anchor.q.T
    period = map.expected if map.base is None else turn.period
    return _apart(map, map.departure(q)), period, map.judge(q, turn)


def _settle(map: ReturnMap, periods: int):
    """Simulate some periods, and on to the phase of the clock or to the section at which the guess
    begins. Returns the ends (NaN for systems that do not reach it), and the expected periods."""
    patient = Settings(TRANSIENT, TRANSIENT, 512 * periods, map.settings.scale)
    s = map.structure
    anchor = map.anchor
    expected = map.expected
    u = np.zeros((s.nu, len(expected)))
    moved = move(s, anchor, u, until(anchor.t + periods * expected), patient).moved
    if map.base is not None:
        target = toward(
            np.full_like(expected, np.inf), -1, moved.lanes.t + 3 * expected
        )
        target = to_section(target, map.base, map.event)
        moved = move(s, moved.lanes, u, target, patient, moved.h, moved.result).moved
    q = np.where(moved.result == Result.OK, moved.lanes.q, np.nan)
    return _apart(map, anchor._replace(chart=moved.lanes.chart, q=q)), expected


class Rounds(NamedTuple):
    """The last Newton step of S systems; S is the leading axis of every array."""

    anchor: Lanes
    excess: Float[np.ndarray, " S"]
    """Length of the last Newton step relative to the tolerance; infinite if the turn was too long,
    NaN if the turn failed."""
    period: Float[np.ndarray, " S"]
    turn: Turn
    """The last turn. Its codes of events are in `codes` instead."""
    codes: Int[np.ndarray, "S E"]
    """Codes of events, padded with -1."""
    together: Bool[np.ndarray, " S"]
    """Whether two events of the turn coincide."""
    result: Int[np.ndarray, " S"]
    steps: Int[np.ndarray, " S"]


class Known(NamedTuple):
    """Known cycles of K systems, which serve as guesses for other systems."""

    numbers: Float[np.ndarray, "K p"] | None
    """Parameters of the K systems (see `numbers_of`)."""
    anchor: Lanes
    period: Float[np.ndarray, " K"]
    result: Int[np.ndarray, " K"]


class Tiles(NamedTuple):
    """Systems, and how they are solved."""

    systems: HybridSystem
    """The systems; their arrays have a leading axis of S."""
    map: ReturnMap
    """The return map of the guess, with the settings asked for, on the host."""
    periods: Float[np.ndarray, " S"] | None
    """Periods of one turn of clocked systems."""
    size: int
    """Systems in one call."""
    workers: int
    known: Known | None = None

    def solve(self, S: int) -> Rounds:
        """Newton's method for all systems, each from the nearest known cycle. If no cycle is known,
        a few systems, spread over all, begin from the guess, and the others from the cycles of
        these few.

        Systems that fail begin again from the cycle of the nearest system: first from the end of a
        simulation that begins on it, then from the cycle itself, then from the end of a longer
        simulation (`_SETTLE`).
        """
        numbers = numbers_of(self.systems)
        order = np.random.default_rng(0).permutation(S)
        known = self.known
        rest = order
        parts: list[Rounds] = []
        with working("cycles", S) as call, uncollected():
            call.done = 0
            if known is None:
                first, rest = np.split(order, [min(self.size, WIDE)])
                out = self._newton(first, *self._given(first), FEW_STEPS)
                if not (out.result == Result.OK).any():
                    out = self._again(first, out, self._given, _SETTLE)
                known = Known(
                    numbers=numbers[first],
                    anchor=out.anchor,
                    period=out.period,
                    result=out.result,
                )
                parts.append(out)
            for k in range(0, len(rest), self.size):
                call.done = S - len(rest) + k
                rows = rest[k : k + self.size]
                begin = self._nearest(numbers[rows], known)
                parts.append(self._newton(rows, *begin, FEW_STEPS))
        out = _join(*parts)
        found = Known(
            numbers=numbers[order],
            anchor=out.anchor,
            period=out.period,
            result=out.result,
        )
        known = found if self.known is None else _join(found, known)
        if (known.result == Result.OK).any():

            def nearest(rows):
                return self._nearest(numbers[rows], known)

            out = self._again(order, out, nearest, _SETTLE)
        return _pick(out, np.argsort(order))

    def _given(self, rows) -> tuple[Lanes, Float[np.ndarray, " S"]]:
        """The anchor and the period of the guess, once for each row."""
        given = self.map.anchor, self.map.expected
        return jax.tree_util.tree_map(
            lambda x: np.repeat(np.asarray(x)[None], len(rows), 0), given
        )

    def _again(
        self, rows, out: Rounds, guesses: Callable, settle: tuple[int, ...]
    ) -> Rounds:
        """More attempts for the systems that failed: from guesses, or from the ends of simulations
        that last `periods` periods."""
        for periods in settle:
            failed = np.flatnonzero(out.result != Result.OK)
            if not len(failed):
                break
            begin = guesses(rows[failed])
            if periods:
                begin = self._in_tiles(
                    _settle, rows[failed], *begin, options=(periods,)
                )
            arrived = np.isfinite(begin[0].q).all(axis=(1, 2))
            if arrived.any():
                failed = failed[arrived]
                anchor, period = _pick(begin, arrived)
                part = self._newton(rows[failed], anchor, period, FEW_STEPS)
                part = part._replace(steps=part.steps + out.steps[failed])
                out = _replace(out, failed, part)
        return out

    def _nearest(
        self, numbers: Float[np.ndarray, "n p"], known: Known
    ) -> tuple[Lanes, Float[np.ndarray, " n"]]:
        """The anchors and periods of the cycles of the nearest systems; those of the guess if no
        cycle is known."""
        ok = np.flatnonzero(known.result == Result.OK)
        if not len(ok):
            return self._given(numbers)
        assert known.numbers is not None
        _, place = nearest(numbers, known.numbers[ok])
        return _pick((known.anchor, known.period), ok[place])

    def _newton(self, rows, anchor: Lanes, period, steps: int) -> Rounds:
        """Newton's method; systems that have converged make room for others."""
        out = self._step(rows, anchor, period)
        for _ in range(steps - 1):
            going = np.flatnonzero(out.excess > 1)
            if not len(going):
                break
            picked = _pick((out.anchor, out.period), going)
            part = self._step(rows[going], *picked)
            out = _replace(
                out, going, part._replace(steps=part.steps + out.steps[going])
            )
        anchor, period, result = self._in_tiles(
            _verdict, rows, out.anchor, out.period, out.turn._replace(codes=out.codes)
        )
        return out._replace(anchor=anchor, period=period, result=result)

    def _step(self, rows, anchor: Lanes, period) -> Rounds:
        """One step of Newton's method."""
        anchor, period, turn, codes, together = self._turn(rows, anchor, period)
        scale = np.asarray(self.map.settings.scale)
        sizes = scale[anchor.chart[:, 0]]
        jacobian = in_sizes(turn.jacobian, sizes)
        step = newton_steps(jacobian, turn.residual / sizes)
        q = anchor.q[..., 0] + step * sizes
        size = excess(q / sizes, step)
        # If a turn closes but has met its section too often, the expected period was too long.
        extra = turn.closed & (turn.meetings > self.map.multiplicity)
        period[extra] = (
            self.map.multiplicity * turn.period[extra] / turn.meetings[extra]
        )
        # (Newton's method does not change the chart at the beginning, but a turn may end in another
        # chart.)
        is_elsewhere = (turn.end.chart != anchor.chart)[:, 0]
        other = (turn.result == Result.OK) & is_elsewhere
        anchor = anchor._replace(q=q[..., None])
        anchor.q[other] = turn.end.q[other]
        anchor.chart[other] = turn.end.chart[other]
        size[extra | other] = np.inf
        once = np.ones(len(rows), int)
        return Rounds(
            anchor=anchor,
            excess=size,
            period=period,
            turn=turn,
            codes=codes,
            together=together,
            result=-once,
            steps=once,
        )

    def _turn(self, rows, anchor: Lanes, period):
        """Anchors, expected periods, turns, codes of events, and whether two coincide."""

        def events(turned):
            anchor, expected, turn, together = jax.tree_util.tree_map(
                np.asarray, turned
            )
            codes = front(turn.codes.reshape(len(turn.codes), -1))
            return anchor, expected, turn._replace(codes=None), codes, together

        return self._in_tiles(_turn, rows, anchor, period, then=events)

    def _in_tiles(
        self,
        function,
        rows,
        anchor: Lanes,
        period,
        *others,
        options=(),
        then=lambda x: x,
    ):
        """Call `function` with the return maps of some systems and further arguments, in calls of
        few different sizes. (JAX compiles each operation once for each size.)"""
        map = self.map

        def run(k):
            left = len(rows) - k
            size = min(self.size, -(-left // WIDE) * WIDE)
            # (A tile that is not full gets the first systems again; their results are cut off.)
            tile = np.arange(k, k + size) % len(rows)
            begin, expected, *further = _pick((anchor, period, *others), tile)
            if self.periods is not None:
                expected = self.periods[rows[tile]]
            grown = expected / map.expected if map.base is None else np.ones(size)
            begin = begin._replace(t=map.anchor.t * grown[:, None])
            side = in_lanes(self.systems, rows[tile])
            begin = jax.tree_util.tree_map(
                lambda x: np.moveaxis(x[..., 0], 0, -1), begin
            )
            replaced: Any = dict(system=side, anchor=begin, expected=expected)
            with on_the_cpu(), at_ease():
                results = function(
                    dataclasses.replace(map, **replaced), *further, *options
                )
            return _pick(then(results), slice(left))

        tiles = range(0, len(rows), self.size)
        return _join(*in_threads(run, tiles, min(self.workers, len(tiles))))


def tiles_of(
    systems: HybridSystem, map: ReturnMap, size: int | None, workers: int
) -> Tiles:
    """Systems, and how they are solved."""
    arrays, static = eqx.partition(systems, eqx.is_array)
    require_similar(
        map, eqx.combine(jax.tree_util.tree_map(lambda x: x[0], arrays), static)
    )
    periods = None
    if map.base is None:

        def of_one(system):
            return map.multiplicity * jnp.asarray(system.period(), float)

        periods = np.asarray(eqx.filter_vmap(of_one)(systems))
    return Tiles(
        systems=systems,
        map=to_host(map),
        periods=periods,
        size=size or 4 * WIDE,
        workers=workers,
    )


def in_lanes(systems: HybridSystem, rows: Int[np.ndarray, " n"]) -> PerLane:
    """The systems `rows`, side by side."""
    arrays, static = eqx.partition(systems, eqx.is_array)
    last = jax.tree_util.tree_map(
        lambda x: np.moveaxis(np.asarray(x)[rows], 0, -1), arrays
    )
    split = (True,) * len(jax.tree_util.tree_leaves(last))
    return PerLane(eqx.combine(jax.device_put(last), static), split)


def numbers_of(systems: HybridSystem) -> Float[np.ndarray, "S p"]:
    """The parameters of systems, one row for each system."""
    arrays = jax.tree_util.tree_leaves(eqx.filter(systems, eqx.is_inexact_array))
    rows = [np.asarray(x).reshape(len(x), -1) for x in arrays]
    return np.concatenate(rows, axis=1)


def nearest(
    numbers: Float[np.ndarray, "n p"], known: Float[np.ndarray, "K p"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """For each system, the distance to the nearest known system, and the index of the latter. Each
    parameter is measured in units of its spread. (Parameters that are not finite are replaced by
    the mean.)"""
    from scipy.spatial import KDTree  # (a third of a second)

    finite = np.ma.masked_invalid(np.concatenate([known, numbers]))
    apart = (finite - finite.mean(axis=0)).filled(0.0)
    spread = np.sqrt(np.mean(apart**2, axis=0))
    points = apart / np.where(spread > 0, spread, 1.0)
    tree = KDTree(points[: len(known)])
    distance, place = tree.query(points[len(known) :])
    return distance, np.asarray(place)


def _pick(tree, rows):
    return jax.tree_util.tree_map(lambda x: np.asarray(x)[rows], tree)


def _join(*parts):
    return jax.tree_util.tree_map(lambda *x: np.concatenate(_of_one_width(x)), *parts)


def _of_one_width(parts):
    """Pad codes of events with -1 to the same number of columns. Other arrays are returned as they
    are."""
    width = max((x.shape[1] for x in parts if x.ndim == 2), default=0)
    if all(x.ndim != 2 or x.shape[1] == width for x in parts):
        return parts

    def fill(x):
        return (0, 0), (0, width - x.shape[1])

    padded = []
    for x in parts:
        if x.ndim == 2:
            x = np.pad(x, fill(x), constant_values=-1)
        padded.append(x)
    return padded


def _replace(out: Rounds, rows, new: Rounds) -> Rounds:
    """`out` with the values of `new` in some rows. They are written in place if their shapes
    agree."""

    def put(x, y):
        x, y = _of_one_width((x, y))
        x[rows] = y
        return x

    return jax.tree_util.tree_map(put, out, new)


def front(codes: Int[np.ndarray, "S R"]) -> Int[np.ndarray, "S E"]:
    """Codes of events moved to the front of each row, without the columns that are empty."""
    places = np.flatnonzero(codes >= 0)
    row, column = np.divmod(places, codes.shape[1])
    count = np.bincount(row, minlength=len(codes))
    width = max(count.max(initial=0), 1)
    out = np.full((len(codes), width), -1, codes.dtype)
    begins = np.cumsum(count) - count
    place = np.arange(len(row)) - begins[row]
    out[row, place] = codes[row, column]
    return out
