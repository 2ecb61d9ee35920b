"""Limit cycles of many systems, found along the recorded itineraries of known cycles.

An *itinerary* is the sequence of charts, steps and events of a cycle, and a `Route` has that of a
known cycle (`repeat.py`). `limit_cycles.py` makes a `Solver` and calls `run`. All systems first
follow the route of the guess by Newton's method (`_take`). A system that does not converge begins
again from a neighbor whose cycle was found on the same route; a system that leaves the route waits
for another one. Searches then find further cycles, whose routes are tried for the remaining
systems. Systems that still have no cycle are left to `batches.py`. A *lane* is one system of a
call, and a *leg* a part between two events. Two things must stay: a cycle counts only after a
second integration (`Many.attempt`), and `Found.path` is an index into `Solver.itineraries`.

If a cycle is wrong, look at `repeat.py`; if many systems are left over, at `Solver.nearest` and the
constants, which limit rounds and searches.
"""

import collections
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .._core.compilation import identity, whole
from .._core.execution import in_threads
from .._core.executor import on_the_cpu
from .._core.results import Result
from ..engine.itinerary.rows import PIECES, Itinerary
from .batches import nearest
from .repeat import (
    Check,
    Corrected,
    Maps,
    Plan,
    Route,
    agrees,
    correct,
    factors_across,
    judge,
    on_device,
    route_of,
    travel,
)
from .return_map import ReturnMap


# Number of lanes of a call. More: arrays do not fit the cache. Fewer: calls cost more.
TILE = 250
# A further route is tried if the last one has suited at least this part of the systems. Larger:
# systems that could follow a route are searched. Smaller: sweeps of relaxation oscillators, which
# need other steps for each system, try many routes in vain.
_WORTH = 0.125
# Number of rounds in which systems begin from neighbors, and number of new routes that searches
# find. More: hopeless systems cost more. Fewer: more are left to the search.
_ROUNDS = 4
_SEARCHES = 6


class Found(NamedTuple):
    """The cycles of S systems, some of them found; S is the leading axis of every array."""

    path: Int[np.ndarray, " S"]
    """Number of the itinerary that the system follows; negative for systems without a cycle."""
    q: Float[np.ndarray, "S d"]
    period: Float[np.ndarray, " S"]
    pieces_t: Float[np.ndarray, "S K"]
    pieces_q: Float[np.ndarray, "S K d"]
    factors: Float[np.ndarray, "S K d d"]
    distance: Float[np.ndarray, " S"]
    turns: Int[np.ndarray, " S"]


class Many(NamedTuple):
    """Systems whose cycles are wanted.

    **Fields:** `leaves`: arrays of the systems, with S on the first axis; `t`, `expected` (S,):
    times of anchors and periods.
    """

    leaves: tuple[np.ndarray, ...]
    t: Float[np.ndarray, " S"]
    expected: Float[np.ndarray, " S"]
    workers: int
    size: int
    """Lanes of a call."""

    def attempt(self, route: Route, rows, q, ends, finer: bool = False) -> "_Attempt":
        """Newton's method for some systems on a route, from states and ends of legs."""
        itinerary = route.finer if finer else route.first
        found: Corrected = self._in_tiles(_correct, route, itinerary, rows, q, ends)
        codes = judge(route, found, self.t[rows], self.expected[rows])
        code = np.array(codes)
        good = np.flatnonzero(code == Result.OK)
        if len(good):
            start = found.q[good], found.passage.ends[good]
            check = self._in_tiles(_travel, route, route.other, rows[good], *start)
            differs = ~agrees(route, found.q[good], check)
            code[good[differs]] = Result.NOT_VERIFIED
        return _Attempt(rows, found, code)

    def _in_tiles(self, function, route: Route, itinerary: Itinerary, rows, q, ends):
        """Call a function of lanes for some systems, in calls of one size."""
        plan = Plan.of(itinerary)
        map = on_device(route.map)
        program = whole(function, (), (map,), loops=True)

        def run(k):
            own = np.arange(k, k + self.size) % len(rows)
            lanes = rows[own]
            leaves = tuple(x[lanes] for x in self.leaves)
            numbers = leaves, self.t[lanes], self.expected[lanes]
            with on_the_cpu():
                result = program(numbers, plan, q[own], ends[own])
            left = min(self.size, len(rows) - k)
            return jax.tree_util.tree_map(lambda x: x[:left], result)

        tiles = range(0, len(rows), self.size)
        parts = in_threads(run, tiles, min(self.workers, len(tiles)))
        return jax.tree_util.tree_map(lambda *x: np.concatenate(x), *parts)


class _Attempt(NamedTuple):
    """What Newton's method has found for some systems."""

    rows: Int[np.ndarray, " n"]
    found: Corrected
    code: Int[np.ndarray, " n"]
    """Result codes, from `judge` and a second integration."""


def _correct(map: ReturnMap, numbers, plan: Plan, q, ends) -> Corrected:
    return correct(Maps(map, *numbers), plan, q, ends)


def _travel(map: ReturnMap, numbers, plan: Plan, q, ends) -> Check:
    return travel(Maps(map, *numbers), plan, q, ends)


class Solver:
    """The search for the cycles of many systems, route after route."""

    def __init__(self, many: Many, map: ReturnMap, search: Callable):
        """**Arguments:** `map`: return map of a known cycle. `search(system, near, solver)`: finds
        a cycle by a search, and returns its return map or None. (`system` and `near` are numbers of
        systems; the cycle of `near` is known.)"""
        S = len(many.t)
        d = map.anchor.q.shape[0]
        self.many, self._search = many, search
        key = _key(map, many.leaves)
        if key in _routes:
            _routes.move_to_end(key)
        else:
            _routes[key] = [route_of(map)]
            while len(_routes) > _KEPT:
                _routes.popitem(last=False)
        self.routes = _routes[key]
        flat = [x.reshape(S, -1).astype(float) for x in many.leaves]
        self._numbers = np.concatenate([many.expected[:, None], *flat], axis=1)
        self._finite = np.isfinite(self._numbers).all(axis=1)
        self.pending = np.flatnonzero(self._finite)
        self._ends: dict[int, np.ndarray] = {}

        def blank(*shape):
            return np.full((S, *shape), np.nan)

        pieces = blank(PIECES), blank(PIECES, d), blank(PIECES, d, d)
        none = np.full(S, -1)
        self.found = Found(none, blank(d), blank(), *pieces, blank(), none + 1)

    def run(self) -> None:
        """Find cycles on the known routes, then on new ones."""
        for number in range(len(self.routes)):
            self._take(number)
        for _ in range(_SEARCHES + 1 - len(self.routes)):
            known = np.flatnonzero(self.found.path >= 0)
            are_few = len(known) < _WORTH * len(self.found.path)
            if not len(self.pending) or are_few:
                return
            distance, near = self.nearest(self.pending, known)
            first = np.argmin(distance)
            first_near = int(near[first])
            map = self._search(int(self.pending[first]), first_near, self)
            if map is None:
                return
            before = len(self.pending)
            route = route_of(map)
            if not route.first.certain:
                return
            self.routes.append(route)
            self._take(len(self.routes) - 1)
            if before - len(self.pending) < _WORTH * before:
                return

    def nearest(self, rows, known) -> tuple[np.ndarray, np.ndarray]:
        """For each system, the distance to the nearest one with a known cycle, and the number of
        the latter."""
        distance, place = nearest(self._numbers[rows], self._numbers[known])
        return distance, known[place]

    def _take(self, number: int) -> None:
        """Find the cycles of the systems without one on a route."""
        route = self.routes[number]
        rows = self.pending
        if not len(rows) or not route.first.certain:
            return
        many = self.many
        expected = float(route.map.expected)
        q = np.repeat(route.map.anchor.q.T, len(rows), axis=0)
        grown = many.expected[rows] / expected
        since = route.first.ends * grown[:, None]
        ends = many.t[rows, None] + since
        for _ in range(_ROUNDS):
            attempt = many.attempt(route, rows, q, ends)
            self._keep(number, attempt)
            coarse = attempt.code == Result.STEP_LIMIT
            if coarse.any():
                start = attempt.found.q[coarse], attempt.found.passage.ends[coarse]
                again = many.attempt(route, rows[coarse], *start, finer=True)
                self._keep(number, again, finer=True)
            # (A system that has converged and left the route needs another route.)
            rows = rows[attempt.code == Result.NOT_CONVERGED]
            known = np.flatnonzero(self.found.path // 2 == number)
            if not len(rows) or not len(known):
                break
            _, near = self.nearest(rows, known)
            q = self.found.q[near]
            ends = self._ends[number][near]
        self.pending = np.flatnonzero(self._finite & (self.found.path < 0))

    def _keep(self, number: int, attempt: _Attempt, finer: bool = False) -> None:
        """Keep the cycles that an attempt has found."""
        ok = np.flatnonzero(attempt.code == Result.OK)
        route = self.routes[number]
        itinerary = route.finer if finer else route.first
        rows = attempt.rows[ok]
        found = attempt.found
        passage = found.passage
        out = self.found
        out.path[rows] = 2 * number + finer
        out.q[rows] = found.q[ok]
        out.period[rows] = (passage.t - self.many.t[attempt.rows])[ok]
        out.pieces_t[rows] = passage.pieces_t[ok]
        out.pieces_q[rows] = passage.pieces_q[ok]
        factors = factors_across(route.map, itinerary, passage)
        out.factors[rows] = factors[ok]
        out.distance[rows] = found.distance[ok]
        out.turns[rows] = found.turns[ok]
        S = len(self.many.t)
        E = passage.ends.shape[1]
        ends = self._ends.setdefault(number, np.full((S, E), np.nan))
        ends[rows] = passage.ends[ok]

    @property
    def left(self) -> Int[np.ndarray, " n"]:
        """The systems without a cycle."""
        return np.flatnonzero(self.found.path < 0)

    @property
    def itineraries(self) -> list[Itinerary]:
        """The itineraries of all routes, two of each (see `_DENSITIES` in `repeat.py`)."""
        return [x for route in self.routes for x in (route.first, route.finer)]

    def ends(self, path: int) -> Float[np.ndarray, "S E"]:
        """Ends of legs of the systems on an itinerary; NaN for others."""
        return self._ends[path // 2]


# Routes of the last calls, so that a repeated call needs no search. More: memory. Fewer:
# alternating calls search again.
_KEPT = 16
_routes: collections.OrderedDict[Any, list[Route]] = collections.OrderedDict()


def _key(map: ReturnMap, leaves: tuple[np.ndarray, ...]) -> tuple:
    """A key of everything on which the routes of a call depend."""
    arrays = [*jax.tree_util.tree_leaves(eqx.filter(map, eqx.is_array)), *leaves]
    digest = hashlib.sha1(usedforsecurity=False)
    for x in arrays:
        digest.update(np.ascontiguousarray(x).view(np.uint8).data)
    return identity(map), digest.digest()
