"""Limit cycles of many systems at once: the points of a parameter sweep side by side.

`find_limit_cycles` is the public function, and `solved` divides the work. In a large sweep, systems
first follow the *itineraries* of known cycles, that is, their recorded sequences of steps and
events (`many.py`). Systems that leave these itineraries, and those of the first small sweeps, are
solved from the cycles of their neighbors by Newton's method with a search for events
(`batches.py`). `examined` then tests events that coincide, and checks eight cycles by a second
integration (all cycles, if one of the eight has a fault). `examined` must stay the last stage of
both ways. A further field of `LimitCycles` is added where cycles are made: in `_on_routes`,
`_cycles`, `_with_rows`, `LimitCycles.__getitem__`, and in `_stack` of `branches.py`.

If a cycle of a sweep differs from a search for it alone, compare these two ways. If a cycle is
refused after it was found, look at `examined`; if systems are exchanged, at `_with_rows`.
"""

import collections
import dataclasses
import time
from collections.abc import Sequence
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._core import compilation
from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Index
from .._core.compilation import at_ease, identity
from .._core.execution import Execution
from .._core.executor import OutOfTimeError, at_most, from_host, to_host
from .._core.meaning import current_of_many, first_of
from .._core.memo import Memory, remembered
from .._core.precision import require_x64
from .._core.progress import working
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import folded
from ..engine.lanes import Lanes
from ..engine.settings import SWEEP, Settings
from ..errors import DefinitionError
from ..systems.system import (
    HybridSystem,
    arrays_of,
    copies_of,
    name_of,
    require_positive,
)
from .batches import Known, Rounds, Tiles, in_lanes, numbers_of, tiles_of
from .checks import check_found, check_periodic
from .coincidence import commutes
from .crossing import AtEvent, Crossing
from .cycle import LimitCycle, require_unchanged
from .find import kept
from .guess import require_similar
from .linear_flow import keep_turn
from .many import TILE, Many, Solver
from .newton import search as newton
from .repeat import has_route, leaves_of
from .return_map import ReturnMap, Turn, turn_product
from .rivals import coincide_on
from .verdict import verdict


# Number of cycles on which coinciding events are tested for whether they commute; if they do not
# commute on one of these cycles, all cycles are tested. More: the test takes longer. Fewer:
# exceptions are missed.
_LOOKED_AT = 50
# Number of systems from which on programs that follow itineraries are worth their compilation.
# Fewer: a sweep waits for the compiler. More: sweeps without such programs take longer.
WORTH_COMPILING = 250
# CPU seconds that small sweeps have spent on searches, by class of systems.
_searching: dict[tuple, float] = collections.defaultdict(float)
# Number of turns (returns to the section) that are simulated before a search, to find the chart in
# which the cycle begins. More: hopeless searches last longer. Fewer: cycles that begin in another
# chart are lost.
_TURNS = 3
# Number of known cycles that serve as guesses for systems that follow no itinerary. More: the
# nearest known cycle takes longer to find. Fewer: guesses are worse.
_GUESSES = 500
# Number of cycles that are tested for jumps and pulses of fields, and checked in full. More: sweeps
# take longer.
_TESTED = 8


@checked_methods
class LimitCycles(Showable, eqx.Module):
    """Limit cycles of S systems; `cycles[i]` is one of them.

    **Fields**, with the systems on the first axis:

    - `systems`; `period` (S,), NaN where there is no cycle; `anchor`, the lanes at which they
        begin; `pieces`, `factors`: see `LimitCycle`; `residual`, `iterations`, `result` (S,).
    - `codes`: the events of one period, in order, filled up with negative numbers.

    `base`, `settings`, `conserved` and `multiplicity` are those of every cycle.
    """

    systems: HybridSystem
    base: Crossing | AtEvent | None
    period: Float[np.ndarray, " S"]
    anchor: Lanes
    pieces: Lanes
    factors: Float[np.ndarray, "S K d d"]
    residual: Float[np.ndarray, " S"]
    iterations: Int[np.ndarray, " S"]
    result: Int[np.ndarray, " S"]
    codes: Int[np.ndarray, "S R"]
    settings: Settings
    conserved: dict[str, Float[Array, ""]]
    multiplicity: int = eqx.field(static=True)
    numbers: dict[str, Array]

    def __len__(self) -> int:
        return len(self.result)

    def __getitem__(self, i: SupportsIndex) -> LimitCycle:
        """The cycle of system i, found or not (see its `result`)."""

        def take(x):
            # (By NumPy, since JAX compiles a program for each shape.)
            return np.asarray(x)[i]

        def pick(tree):
            return from_host(jax.tree_util.tree_map(take, tree))

        arrays, static = eqx.partition(self.systems, eqx.is_array)
        cycle = LimitCycle(
            eqx.combine(pick(arrays), static),
            self.base,
            pick(self.period),
            pick(self.anchor),
            pick(self.pieces),
            pick(self.factors),
            pick(self.residual),
            pick(self.iterations),
            pick(self.result),
            tuple(int(g) for g in self.codes[i] if g >= 0),
            self.settings,
            self.conserved,
            self.multiplicity,
            pick(self.numbers),
        )
        turns = _turns.get(self, None)
        turn = None if turns is None else turns[i]
        if turn is not None:
            keep_turn(cycle, turn)
        return cycle

    @property
    def scale(self) -> dict[str, float]:
        """The size of each state on every cycle, by name."""
        return self[0].scale

    @property
    def ok(self) -> Bool[np.ndarray, " S"]:
        """True for each cycle that was found."""
        return self.result == Result.OK

    @property
    def failed(self) -> Int[np.ndarray, " F"]:
        """Indices of the systems without a cycle."""
        return np.flatnonzero(~self.ok)

    @property
    def multipliers(self) -> Complex[np.ndarray, "S d"]:
        """Floquet multipliers, by decreasing modulus; NaN for systems without a cycle.

        Eigenvalues of the product of the factors, padded with zeros: those far below the largest
        are lost in rounding. `cycles[i].multipliers` has them.
        """
        require_unchanged(self.systems, self.numbers, first_of(self.systems))
        return self._multipliers

    @remembered
    def _multipliers(self) -> Complex[np.ndarray, "S d"]:
        products = turn_product(np.asarray(self.factors))
        of_found = np.where(self.ok[:, None, None], products, 0.0)
        values = np.linalg.eigvals(of_found)
        moduli = np.round(np.abs(values), 12)
        order = np.lexsort((-np.imag(values), -moduli), axis=-1)
        values = np.take_along_axis(values.astype(complex), order, axis=-1)
        values[~self.ok] = np.nan
        return values

    def summary(self, limit: Index = 5) -> str:
        """`10000/10000 found`, or the reasons of the first `limit` failures. Default: 5."""
        text = [f"{self.ok.sum()}/{len(self)} found"]
        text += [
            f"#{i}: {Result(int(self.result[i])).message}" for i in self.failed[:limit]
        ]
        if len(self.failed) > limit:
            text.append(f"and {len(self.failed) - limit} more")
        return folded("; ".join(text))

    def __repr__(self):
        kind = name_of(self.systems)
        return folded(f"LimitCycles({kind}: {self.summary(1)})")


@checked
@working("find_limit_cycles")
def find_limit_cycles(
    systems: HybridSystem | Sequence[HybridSystem],
    guess: LimitCycle,
    *,
    settings: Settings | None = None,
    execution: Execution | None = None,
) -> LimitCycles:
    """Find the limit cycles of many systems that differ in their parameters.

    If there are 250 systems or more, all of them first follow the itinerary of the
    guess: its charts and events in order, and its steps. Newton's method on this
    itinerary is one compiled program. A system that leaves the itinerary then follows
    that of a neighboring system, which a search has found. Each cycle is integrated
    again, by another method with other steps.

    Fewer systems, and systems that leave all itineraries, are searched side by side. The
    first 256 start from the guess, the others from the cycles of their neighbors. If
    Newton's method fails for a system, the system is simulated for 8 or 40 periods, and
    Newton's method starts again from the final state. Once searches have taken as long as
    it takes to compile the program, all further sweeps of the class use the program.

    **Arguments:**

    - `systems`: a list of systems of one class, or one system whose arrays all have a leading
        axis, as `equinox.filter_vmap` makes it:
        `eqx.filter_vmap(lambda k: VerticalHopper(k=k))(jnp.linspace(8, 13, 100))`.
    - `guess`: a limit cycle of a similar system.
    - `settings`: accuracy of the flow (Default: 1e-9 per step) and its `solver`.
    - `execution`: systems per call (`batch`, Default: 250 on itineraries, otherwise 1024) and
        threads (`workers`).

    **Returns:** `LimitCycles`; its `failed` lists the systems without a cycle. They
    raise no error.

    **Raises:** `DefinitionError` for systems that do not belong together, or have no parameters.

    **Example:**

    ```python
    systems = [hj.models.VerticalHopper(k=k) for k in (9.5, 10.0, 10.5)]
    cycles = hj.orbits.find_limit_cycles(systems, cycle)
    print(cycles.period, cycles.multipliers)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `cycles.to_pandas()`.
    """
    execution = Execution() if execution is None else execution
    systems = _stacked(systems)
    require_positive(systems)
    require_x64(systems)
    settings = Settings() if settings is None else settings
    systems = settings.system(systems)
    first = first_of(systems)
    check_periodic(first)
    map = map_for_sweep(guess, settings)
    require_similar(map, first)
    sound = bool(guess.result == Result.OK) and not verdict(guess).refused
    return solved(systems, map, execution.batch, execution.threads, checked=sound)


def map_for_sweep(guess: LimitCycle, settings: Settings) -> ReturnMap:
    """The return map of `guess`, with the settings of a sweep."""
    settings = settings.filled(SWEEP)
    if settings.scale is None:
        settings = dataclasses.replace(settings, scale=guess.settings.scale)
    return dataclasses.replace(guess.return_map, settings=settings)


def solved(
    systems: HybridSystem,
    map: ReturnMap,
    size: int | None = None,
    workers: int = 1,
    known: Known | None = None,
    checked: bool = True,
) -> LimitCycles:
    """The cycles of systems near that of a return map.

    **Arguments:** `size`: systems per call. `known`: see `Tiles`. `checked`: whether the cycle of
    the map has passed its verdict. Only then do other systems follow its itinerary.
    """
    S = len(leaves_of(systems)[0])
    tiles = tiles_of(systems, map, size, workers)._replace(known=known)
    if not checked or not has_route(map):
        return as_cycles(tiles, tiles.solve(S))
    if S < WORTH_COMPILING:
        rounds = _searched(tiles, S)
        if rounds is not None:
            return as_cycles(tiles, rounds)
    expected = np.full(S, float(map.expected))
    expected = expected if tiles.periods is None else tiles.periods
    times = np.full(S, float(tiles.map.anchor.t[0]))
    if map.base is None:
        times = times * expected / float(map.expected)
    leaves = tuple(np.asarray(x) for x in leaves_of(systems))

    def search(row: int, near: int, solver: Solver) -> ReturnMap | None:
        system = from_host(first_of(_some(systems, np.array([row]))))
        begin = _on_routes(systems, solver, tiles.map)[near].return_map
        at_phase = dict(system=system, expected=expected[row])
        anchor = to_host(begin.anchor)._replace(t=times[row : row + 1])
        return _search(dataclasses.replace(tiles.map, anchor=anchor, **at_phase))

    many = Many(
        leaves=leaves,
        t=times,
        expected=expected,
        workers=workers,
        size=size or TILE,
    )
    solver = Solver(many, tiles.map, search)
    solver.run()
    cycles = _on_routes(systems, solver, tiles.map)
    together = _coincide(cycles, solver, tiles.map)
    # Systems that follow no itinerary, from the cycles of their neighbors.
    left = solver.left
    if len(left):
        near = _some_known(cycles) if known is None else known
        part = tiles_of(_some(systems, left), map, size, workers)
        rounds = part._replace(known=near).solve(len(left))
        cycles = _with_rows(cycles, left, _cycles(part, rounds))
        together[left] = rounds.together
    return examined(cycles, together, solver.found.path >= 0)


def _searched(tiles: Tiles, S: int) -> Rounds | None:
    """The cycles of a small sweep by searches. None if the compiled itinerary is the quicker way:
    searches of this class have taken as long as compilation does, in earlier sweeps, or this one
    takes twice as long."""
    kind = identity((tiles.map,))
    limit = compilation.WORTH_COMPILING
    if _searching[kind] >= limit:
        return None
    begin = time.thread_time()
    try:
        with at_most(2 * limit):
            return tiles.solve(S)
    except OutOfTimeError:
        return None
    finally:
        _searching[kind] += time.thread_time() - begin


def _search(map: ReturnMap) -> ReturnMap | None:
    """The return map of the cycle that a search finds from a map's anchor; None if it fails.
    (Newton's method does not change the chart at the beginning; simulated turns may end in another
    chart.)"""
    with at_ease():
        for _ in range(_TURNS):
            end = map.turn(map.anchor.q[:, 0]).end
            if end.chart == map.anchor.chart:
                break
            anchor = map.departure(end.q[:, 0])._replace(chart=end.chart)
            map = dataclasses.replace(map, anchor=anchor)
    solution = newton(map)
    if not solution.is_fixed_point or verdict(kept(map, solution)).refused:
        return None
    return dataclasses.replace(map, anchor=to_host(solution.anchor))


def _some(systems: HybridSystem, rows) -> HybridSystem:
    """Some of many systems."""

    def pick(x):
        return jax.device_put(np.asarray(x)[rows])

    return jax.tree_util.tree_map(lambda x: pick(x) if eqx.is_array(x) else x, systems)


def _on_routes(systems: HybridSystem, solver: Solver, map: ReturnMap) -> LimitCycles:
    """The cycles that were found on itineraries; NaN for the other systems."""
    found = solver.found
    s = map.structure
    S = len(solver.found.path)
    G = len(s.transitions)
    K = found.pieces_t.shape[1]
    chart = np.zeros((S, K), np.int32)
    events = np.zeros((S, K), np.int32)
    armed = np.zeros((S, G, K), bool)
    codes = np.full((S, 1), -1)
    for path, itinerary in enumerate(solver.itineraries):
        rows = np.flatnonzero(found.path == path)
        if not len(rows):
            continue
        chart[rows] = itinerary.charts
        events[rows] = itinerary.begins
        armed[rows] = itinerary.armed
        more = np.full((S, len(itinerary.events)), -1)
        more[rows] = itinerary.events
        codes = _wider(codes, more)
    pace = np.array([0.0, np.inf, 0.0, 0.0])
    pieces = Lanes(
        t=found.pieces_t,
        chart=chart,
        q=np.swapaxes(found.pieces_q, 1, 2),
        armed=armed,
        events=events,
        pace=np.tile(pace[:, None], (S, 1, K)),
    )
    anchor = jax.tree_util.tree_map(lambda x: x[..., :1], pieces)
    if map.event >= 0:
        anchor.armed[:, map.event] = False
    period = found.period if map.base is not None else solver.many.expected
    missing = found.path < 0
    return LimitCycles(
        systems,
        map.base,
        np.where(missing, np.nan, period),
        anchor._replace(q=found.q[..., None]),
        pieces,
        found.factors,
        found.distance,
        found.turns,
        np.where(missing, Result.NOT_CONVERGED, Result.OK),
        codes,
        map.settings,
        map.conserved,
        map.multiplicity,
        copies_of(systems),
    )


def _wider(codes: np.ndarray, more: np.ndarray) -> np.ndarray:
    """Codes of events, padded to as many columns as `more` has, if it has more."""
    width = max(codes.shape[1], more.shape[1])

    def fill(x):
        missing = width - x.shape[1]
        return np.pad(x, ((0, 0), (0, missing)), constant_values=-1)

    return np.maximum(fill(codes), fill(more))


def _coincide(
    cycles: LimitCycles, solver: Solver, map: ReturnMap
) -> Bool[np.ndarray, " S"]:
    """Whether events coincide, on cycles that were found on routes."""
    out = np.zeros(len(cycles), bool)
    for path, itinerary in enumerate(solver.itineraries):
        rows = np.flatnonzero(solver.found.path == path)
        if not len(rows):
            continue
        systems: Any = in_lanes(cycles.systems, rows)
        some = dataclasses.replace(map, system=systems)
        begin = cycles.anchor.t[rows, 0]
        end = begin + cycles.period[rows]
        ends = solver.ends(path)[rows].T
        together = coincide_on(some, itinerary.events, ends, begin, end)
        out[rows] = together.any(axis=0)
    return out


def known_from(cycles: LimitCycles) -> Known:
    """Cycles as guesses for others."""
    return Known(
        numbers=None,
        anchor=cycles.anchor,
        period=cycles.period,
        result=cycles.result,
    )


def _some_known(cycles: LimitCycles) -> Known | None:
    """Some of the cycles that were found, as guesses for others."""
    rows = np.flatnonzero(cycles.ok)
    if not len(rows):
        return None
    rows = rows[:: -(-len(rows) // _GUESSES)]
    numbers = numbers_of(cycles.systems)
    known = known_from(cycles)._replace(numbers=numbers)
    return jax.tree_util.tree_map(lambda x: np.asarray(x)[rows], known)


def _with_rows(cycles: LimitCycles, rows, others: LimitCycles) -> LimitCycles:
    """Cycles, with others in some rows."""

    def put(x, y):
        x = np.array(x)
        x[rows] = y
        return x

    codes = cycles.codes.copy()
    codes[rows] = -1
    more = np.full((len(cycles), others.codes.shape[1]), -1)
    more[rows] = others.codes
    names = "period", "anchor", "pieces", "factors", "residual", "iterations", "result"
    changed: Any = {
        name: jax.tree_util.tree_map(put, getattr(cycles, name), getattr(others, name))
        for name in names
    }
    return dataclasses.replace(cycles, codes=_wider(codes, more), **changed)


def as_cycles(tiles: Tiles, rounds: Rounds) -> LimitCycles:
    """The last rounds of Newton's method as cycles."""
    return examined(_cycles(tiles, rounds), rounds.together)


def _cycles(tiles: Tiles, rounds: Rounds) -> LimitCycles:
    """The last rounds of Newton's method as cycles, before they are examined."""
    turn = rounds.turn
    map = tiles.map
    return LimitCycles(
        tiles.systems,
        map.base,
        rounds.period,
        rounds.anchor,
        turn.pieces,
        turn.factors,
        turn.distance,
        rounds.steps,
        rounds.result,
        rounds.codes,
        map.settings,
        map.conserved,
        map.multiplicity,
        copies_of(tiles.systems),
    )


_turns = Memory()
"""Recorded turns of many cycles."""


def keep_turns(cycles: LimitCycles, turns: Sequence[Turn | None]) -> LimitCycles:
    """Keep the last turns of cycles, from which their trajectories are made, and return the cycles.
    (A cycle without its last turn is integrated again.)"""
    _turns.recall(cycles, None, lambda: tuple(turns))
    return cycles


def examined(
    cycles: LimitCycles,
    together: Bool[np.ndarray, " S"],
    walked: Bool[np.ndarray, " S"] | None = None,
) -> LimitCycles:
    """The cycles with their final results: `SIMULTANEOUS` if events coincide that do not commute,
    and the results of verdicts. Verdicts are computed for eight cycles; if one of these has a
    fault, for all.

    **Arguments:** `together`: whether events coincide. `walked`: cycles that a second integration
    has checked already. Default: none.

    **Raises:** `DefinitionError` in the cases of `check_found`, for one of eight cycles.
    """
    result = cycles.result.copy()
    rows = np.flatnonzero(together & cycles.ok)
    few = rows[:: -(-len(rows) // _LOOKED_AT)] if len(rows) else rows
    if not all(commutes(cycles[i]) for i in few):
        result[[i for i in rows if not commutes(cycles[i])]] = Result.SIMULTANEOUS
    good = np.flatnonzero(result == Result.OK)
    alone = good if walked is None else good[~walked[good]]
    tested = _spread(alone)
    for i in np.union1d(_spread(good), tested):
        check_found(cycles[i])
    if any(verdict(cycles[i]).refused for i in tested):
        result[alone] = [verdict(cycles[i]).result for i in alone]
    found = np.isin(result, [Result.OK, Result.SINGULAR, Result.SIMULTANEOUS])
    period = np.where(found, cycles.period, np.nan)
    return dataclasses.replace(cycles, result=result, period=period)


def _spread(rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Eight of some rows, or all if they are fewer."""
    number = min(len(rows), _TESTED)
    places = np.linspace(0, len(rows) - 1, number)
    return rows[np.unique(places.astype(int))]


def _stacked(systems) -> HybridSystem:
    """Systems, given in one of the two forms of `find_limit_cycles`, as one system whose arrays
    have a leading axis.

    **Raises:** `DefinitionError` for systems that do not belong together, or have no parameters.
    """
    first, *_ = [systems] if isinstance(systems, HybridSystem) else [*systems, None]
    if first is not None and not arrays_of(first):
        raise DefinitionError(
            f"{name_of(first)} has no parameters, in which systems could differ: use "
            "`find_limit_cycle` for the one that there is."
        )
    if isinstance(systems, HybridSystem):
        shapes = {
            x.shape[:1]
            for x in jax.tree_util.tree_leaves(eqx.filter(systems, eqx.is_array))
        }
        if len(shapes) != 1 or () in shapes:
            raise DefinitionError(
                "all arrays of `systems` need the same leading axis, one entry for each system: "
                "make it by equinox.filter_vmap, or pass a list of systems."
            )
        return current_of_many(systems)
    parts = [jax.tree_util.tree_flatten(x) for x in systems]
    kinds = {(structure, *map(eqx.is_array, leaves)) for leaves, structure in parts}
    if len(kinds) != 1:
        raise DefinitionError(
            "`systems` must be at least one system, all of the same class."
        )

    # (By NumPy: a program of JAX with thousands of arguments compiles for minutes.)
    def stack(x):
        return jax.device_put(np.stack([np.asarray(y) for y in x]))

    columns = zip(*(leaves for leaves, _ in parts), strict=True)
    stacked = [stack(x) if eqx.is_array(x[0]) else x[0] for x in columns]
    return jax.tree_util.tree_unflatten(parts[0][1], stacked)


def rough(cycle: LimitCycle) -> dict[str, Any]:
    """The period and the anchor (in sizes of the states), rounded to digits on which two searches
    agree."""
    chart = int(np.asarray(cycle.anchor.chart)[0])
    q = np.asarray(cycle.anchor.q)[:, 0]
    size = np.asarray(cycle.settings.scale)[chart]
    scaled = (q / size).round(4) + 0.0
    state = [f"{x:.4f}" for x in scaled]
    times = (cycle.period, cycle.anchor.t[0])
    period, time = (f"{float(x):.5g}" for x in times)
    return {"period": period, "time": time, "chart": chart, "state": state}
