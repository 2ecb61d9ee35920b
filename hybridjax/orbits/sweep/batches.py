"""Cycles of many systems, solved in compiled calls of one size, each from a guess of its own."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree
from tqdm import tqdm

from ..._core.compile import quick_jit
from ..._core.garbage_collector import uncollected
from ..._core.results import Result
from ..._core.threads import in_threads
from ...engine.lanes import Lanes
from ...engine.move import move
from ...engine.settings import TRANSIENT, Settings
from ...engine.target import toward, until
from ...sections.families import AtEvent, ListLevels
from ...systems.structure import Structure
from ..cycle import LimitCycle
from ..return_map import ReturnMap, Turn, closes, judge, newton_step, turn_with_jacobian


# Newton steps before a system is given up, or tried again; and before it is left until those that
# need more steps than most go on together.
_NEWTON, _USUAL = 6, 3
# Periods for which a system flows freely before Newton tries again.
_SETTLE = 40
# Ridge of the least squares, relative to their trace: directions in which neighbors hardly differ
# get no slope.
_RIDGE = 1e-12
# A step with a guessed Jacobian is taken if it is at most this part of the state.
_NEAR = 0.03
# Up to this many parameters, guesses from neighbors are quadratic.
_FEW = 4


class Rounds(NamedTuple):
    """What the last Newton step of S systems saw; S is the leading axis of every array."""

    start: Lanes
    jacobian: Float[np.ndarray, "S d d"]
    size: Float[np.ndarray, " S"]
    """Of that step, relative to the tolerance; infinite where the turn was too long, NaN where it
    failed."""
    period: Float[np.ndarray, " S"]
    factors: Float[np.ndarray, "S K d d"]
    seen: Turn
    """Without the codes of events,"""
    codes: Int[np.ndarray, "S E"]
    """which stand here, filled up with -1."""
    result: Int[np.ndarray, " S"]
    steps: Int[np.ndarray, " S"]


class Tiles(NamedTuple):
    """How the systems are solved."""

    systems: Any
    """Their arrays have a leading axis of S systems."""
    guess: LimitCycle
    settings: Settings
    size: int
    """Systems in one compiled call."""
    workers: int
    programs: "Programs"
    """`QUICK` or `FULL`."""

    @property
    def parameters(self) -> Float[np.ndarray, "S p"]:
        """The numbers in which the systems differ, each in units of its spread. (What is not finite
        has no neighbors to learn from; it is taken for the mean.)"""
        arrays = jax.tree_util.tree_leaves(eqx.filter(self.systems, eqx.is_inexact_array))
        flat = np.concatenate([np.asarray(x).reshape(len(x), -1) for x in arrays], axis=1)
        good = np.isfinite(flat)
        count = np.maximum(good.sum(axis=0), 1)
        flat = np.where(good, flat - np.where(good, flat, 0.0).sum(axis=0) / count, 0.0)
        spread = np.sqrt((flat**2).sum(axis=0) / count)
        if not spread.any():
            return flat[:, :1]
        return flat[:, spread > 0] / spread[spread > 0]

    def solve(self, S: int, progress: bool) -> Rounds:
        """Newton for all systems: first for some, spread over all, from the one guess there is,
        then for as many again from where their neighbors' cycles are, and so on."""
        parameters = self.parameters
        order = np.random.default_rng(0).permutation(S)
        bar = tqdm(total=S, disable=not progress, desc="cycles")
        rows = order[: self.size]
        with uncollected:  # here the programs are compiled
            out = self._again(rows, self._newton(rows, *self._given(len(rows)), _NEWTON))
        bar.update(len(rows))
        while (done := len(out.result)) < S:
            rows = order[done : 2 * done]
            rows = rows[cKDTree(parameters[rows]).indices]  # systems of one call are neighbors
            order[done : 2 * done] = rows
            guesses = self._by_neighbors(parameters[order[:done]], out, parameters[rows])
            part = self._newton(rows, *self._first_step(rows, *guesses), _USUAL)
            out = _join(out, part._replace(steps=part.steps + 1))
            bar.update(len(rows))
        bar.close()
        late = np.flatnonzero(out.size > 1)
        if len(late):
            start, period = _pick((out.start, out.period), late)
            part = self._newton(order[late], start, period, _NEWTON - _USUAL)
            out = _replace(out, late, part._replace(steps=part.steps + out.steps[late]))
        return _pick(self._again(order, out), np.argsort(order))

    def _given(self, count: int) -> tuple[Lanes, Float[np.ndarray, " S"]]:
        given = self.guess.start, self.guess.period
        return jax.tree_util.tree_map(lambda x: np.repeat(np.asarray(x)[None], count, 0), given)

    def _again(self, rows, out: Rounds) -> Rounds:
        """Another try for the systems that failed, from where they are after flowing freely."""
        failed = np.flatnonzero(out.result != Result.OK)
        if not len(failed):
            return out
        begin = self._in_tiles(
            self.programs.settled, self._threads, rows[failed], *self._given(len(failed))
        )
        there = np.isfinite(begin[0].q).all(axis=(1, 2))
        if not there.any():
            return out
        failed, begin = failed[there], _pick(begin, there)
        return _replace(out, failed, self._newton(rows[failed], *begin, _NEWTON))

    def _by_neighbors(self, known, out: Rounds, wanted):
        """The cycle of the nearest system, moved as those around it in the same chart suggest:
        its start, its period, and the Jacobian there (NaN where nothing is known)."""
        ok = np.flatnonzero(out.result == Result.OK)
        if not len(ok):
            blank = np.full((len(wanted), *out.jacobian.shape[1:]), np.nan)
            return *self._given(len(wanted)), blank
        known = known[ok]
        terms = _powers(known[:1]).shape[1]
        _, near = cKDTree(known).query(wanted, min(2 * terms + 3, len(ok)))
        near = near.reshape(len(wanted), -1)
        first = near[:, 0]
        start, period, jacobian = _pick((out.start, out.period, out.jacobian), ok)
        flat = jacobian.reshape(len(ok), -1)
        values = np.concatenate([start.q[..., 0], period[:, None], flat], axis=1)
        same = start.chart[near] == start.chart[first][:, None]
        apart = _powers(known[near] - known[first][:, None]) * same
        change = (values[near] - values[first][:, None]) * same
        across = apart.transpose(0, 2, 1)
        gram = across @ apart
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        ridge = np.where(size > 0, _RIDGE * size, 1.0) * np.eye(gram.shape[-1])
        slope = np.linalg.solve(gram + ridge, across @ change)
        guess = values[first] + (_powers(wanted - known[first])[:, None] @ slope)[:, 0]
        d = start.q.shape[1]
        start = eqx.tree_at(lambda x: x.q, _pick(start, first), guess[:, :d, None])
        return start, guess[:, d], guess[:, d + 1 :].reshape(-1, d, d)

    def _first_step(self, rows, start: Lanes, period, jacobian):
        """Newton's first step, with Jacobians that are guessed, where it is a small one."""
        if not np.isfinite(jacobian).any():
            return start, period
        turned = self._in_tiles(self._turn, self._threads, rows, start, period, wanted=False)
        start, period, residual, *_ = turned
        before = start.q[..., 0]
        q, _ = newton_step(before, residual, jacobian)
        small = (np.abs(q - before) <= _NEAR * (1 + np.abs(before))).all(axis=1, keepdims=True)
        q = np.where(small, q, before)
        return eqx.tree_at(lambda x: x.q, start, q[..., None]), period

    def _newton(self, rows, start: Lanes, period, steps: int) -> Rounds:
        """Newton's method; systems that are done make room for others."""
        out = self._step(rows, start, period)
        for _ in range(steps - 1):
            going = np.flatnonzero(out.size > 1)
            if not len(going):
                break
            part = self._step(rows[going], *_pick((out.start, out.period), going))
            out = _replace(out, going, part._replace(steps=part.steps + out.steps[going]))
        judged = self._in_tiles(self.programs.verdict, 1, rows, out.start, out.period, out.seen)
        start, period, factors, result = judged
        return out._replace(start=start, period=period, factors=factors, result=result)

    def _step(self, rows, start: Lanes, period) -> Rounds:
        """One step of Newton's method."""
        start, period, residual, jacobian, seen, codes = self._in_tiles(
            self._turn, self._threads, rows, start, period
        )
        q, size = newton_step(start.q[..., 0], residual, jacobian)
        # A turn that closes but met its section too often was given too long a period.
        extra = closes(start.q[..., 0], seen) & (seen.meetings > self.guess.turns)
        period[extra] = self.guess.turns * seen.period[extra] / seen.meetings[extra]
        size[extra] = np.inf
        start, once = eqx.tree_at(lambda x: x.q, start, q[..., None]), np.ones(len(rows), int)
        return Rounds(start, jacobian, size, period, seen.factors, seen, codes, -once, once)

    def _turn(self, *arguments, wanted: bool = True):
        *found, codes = self.programs.turn(*arguments, np.asarray(wanted))
        return *found, front(np.asarray(codes))

    @property
    def _threads(self) -> int:
        """One where programs factorize matrices (`held`): in several threads of XLA's pool, these
        would wait for each other forever."""
        return 1 if self.guess.conserved else self.workers

    def _in_tiles(self, work, workers: int, rows, *arguments, **options):
        """`work` for some systems, in calls of one size, so that there is one program for all."""
        arrays, rest = eqx.partition(self.systems, eqx.is_array)

        def tile(k):
            some = np.arange(k, k + self.size) % len(rows)
            systems = eqx.combine(_pick(arrays, rows[some]), rest)
            part = work(systems, self.guess, *_pick(arguments, some), self.settings, **options)
            return _pick(part, slice(len(rows) - k))

        return _join(*in_threads(tile, range(0, len(rows), self.size), workers))


def _powers(x: Float[np.ndarray, "*S p"]) -> Float[np.ndarray, "*S r"]:
    """x, and for few parameters the products of two of its columns."""
    p = x.shape[-1]
    i, j = np.triu_indices(p if p <= _FEW else 0)
    return np.concatenate([x, x[..., i] * x[..., j]], axis=-1)


def _pick(tree, rows):
    return jax.tree_util.tree_map(lambda x: np.asarray(x)[rows], tree)


def _join(*parts):
    return jax.tree_util.tree_map(lambda *x: np.concatenate(_of_one_width(x)), *parts)


def _of_one_width(parts):
    """Arrays with as many columns as the widest, filled up with -1 (codes of events)."""
    width = max((x.shape[1] for x in parts if x.ndim == 2), default=0)
    if all(x.ndim != 2 or x.shape[1] == width for x in parts):
        return parts
    fill = lambda x: ((0, 0), (0, width - x.shape[1]))  # noqa: E731
    return [np.pad(x, fill(x), constant_values=-1) if x.ndim == 2 else x for x in parts]


def _replace(out: Rounds, rows, new: Rounds) -> Rounds:
    """`out` with other values in some rows, which are written in place where they fit."""

    def put(x, y):
        x, y = _of_one_width((x, y))
        x[rows] = y
        return x

    return jax.tree_util.tree_map(put, out, new)


def front(codes: Int[np.ndarray, "S R"]) -> Int[np.ndarray, "S E"]:
    """Codes of events moved to the front of each row, and the columns without any left out."""
    row, column = np.divmod(np.flatnonzero(codes >= 0), codes.shape[1])
    count = np.bincount(row, minlength=len(codes))
    out = np.full((len(codes), max(count.max(initial=0), 1)), -1, codes.dtype)
    out[row, np.arange(len(row)) - (np.cumsum(count) - count)[row]] = codes[row, column]
    return out


def _kind(guess: LimitCycle) -> ReturnMap:
    return ReturnMap(guess.base, guess.conserved, guess.turns)


def _turn(systems, guess: LimitCycle, start: Lanes, period, settings, wanted):
    """One turn of every system from its start, at the same phase of its own clock, with the
    Jacobian if it is `wanted`."""

    def one(system, start, expected):
        start, expected = _on_clock(system, guess, start, expected)
        kind = _kind(guess)
        residual, seen, jacobian = turn_with_jacobian(
            start.q[:, 0], system, start, kind, expected, settings, wanted
        )
        bare = eqx.tree_at(lambda x: x.codes, seen, None)
        return start, expected, residual, jacobian, bare, seen.codes.ravel()

    return eqx.filter_vmap(one)(systems, start, period)


def _verdict(systems, guess: LimitCycle, start: Lanes, period, seen: Turn, settings):
    """The starts ready to be left, periods, factors, and result codes."""

    def one(system, start, expected, seen):
        return judge(start.q[:, 0], seen, system, start, _kind(guess), expected, settings)

    return eqx.filter_vmap(one)(systems, start, period, seen)


def _settled(systems, guess: LimitCycle, start: Lanes, period, settings):
    """Where systems are after they have flowed freely for a while, at the guess's phase or
    section (NaN for those that do not get there), and their expected periods."""
    base = guess.base
    patient = Settings(rtol=TRANSIENT, atol=TRANSIENT, max_steps=512 * _SETTLE)

    def one(system, start, expected):
        start, expected = _on_clock(system, guess, start, expected)
        s, u = Structure(system), jnp.zeros((len(system.inputs), 1))
        moved = move(s, start, u, until(start.t + _SETTLE * expected), patient)
        if base is not None:
            at_event = isinstance(base, AtEvent)
            event = s.transition_index(base.name) if at_event else -1
            target = toward(jnp.full(1, jnp.inf), event, moved.lanes.t + 3 * expected)
            if not at_event:
                target = eqx.tree_at(
                    lambda x: x.levels, target, ListLevels((base,)), is_leaf=lambda x: x is None
                )
            moved = move(s, moved.lanes, u, target, patient, moved.h, moved.result)
        q = jnp.where(moved.result == Result.OK, moved.lanes.q, jnp.nan)
        start = eqx.tree_at(lambda x: (x.chart, x.q), start, (moved.lanes.chart, q))
        return start, expected

    return eqx.filter_vmap(one)(systems, start, period)


def _on_clock(system, guess: LimitCycle, start: Lanes, expected: Array):
    """The start at the same phase of this system's clock, and its period."""
    if guess.clocked:
        expected = guess.turns * jnp.asarray(system.period(), float)
        start = eqx.tree_at(lambda x: x.t, start, guess.start.t / guess.period * expected)
    return start, expected


class Programs(NamedTuple):
    """The functions above, compiled."""

    turn: Callable
    verdict: Callable
    settled: Callable


# For few systems, and for many.
QUICK, FULL = (
    Programs(*map(jit, (_turn, _verdict, _settled))) for jit in (quick_jit, eqx.filter_jit)
)
