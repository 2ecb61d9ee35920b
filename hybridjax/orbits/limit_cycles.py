"""Limit cycles of many systems at once: the points of a parameter sweep side by side."""

import dataclasses
from collections.abc import Sequence
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Index
from .._core.execution import Execution
from .._core.executor import from_host
from .._core.meaning import current_of_many, first_of
from .._core.memo import remembered
from .._core.precision import require_x64
from .._core.progress import working
from .._core.results import Result
from .._core.text import folded
from ..engine.lanes import Lanes
from ..engine.settings import SWEEP, Settings
from ..errors import DefinitionError
from ..systems.system import HybridSystem, arrays_of, copies_of, require_positive
from .batches import Rounds, Tiles, tiles_of
from .checks import check_found, check_periodic
from .coincidence import commutes
from .crossing import AtEvent, Crossing
from .cycle import LimitCycle, require_unchanged
from .return_map import ReturnMap, turn_product
from .verdict import verdict


# Cycles that are tested for whether events that coincide commute; all are, if one of these fails.
# More: the test takes longer. Fewer: exceptions are missed.
_LOOKED_AT = 50
# Cycles that are tested for jumps and pulses of fields, and checked in full, which takes longer.
_TESTED = 8


@checked_methods
class LimitCycles(eqx.Module):
    """Limit cycles of S systems; `cycles[i]` is one of them.

    **Fields**, with the systems on the first axis:

    - `systems`; `period` (S,), NaN where there is no cycle; `anchor`, the lanes at which they
        begin; `legs`, `factors`: see `LimitCycle`; `residual`, `iterations`, `result` (S,).
    - `codes`: the events of one period, in order, filled up with negative numbers.

    `base`, `settings`, `conserved` and `multiplicity` are those of every cycle.
    """

    systems: HybridSystem
    base: Crossing | AtEvent | None
    period: Float[np.ndarray, " S"]
    anchor: Lanes
    legs: Lanes
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
        take = lambda x: np.asarray(x)[i]  # (JAX compiles a program for each shape)  # noqa: E731
        pick = lambda tree: from_host(jax.tree_util.tree_map(take, tree))  # noqa: E731
        arrays, static = eqx.partition(self.systems, eqx.is_array)
        return LimitCycle(
            eqx.combine(pick(arrays), static),
            self.base,
            pick(self.period),
            pick(self.anchor),
            pick(self.legs),
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
        values = np.linalg.eigvals(np.where(self.ok[:, None, None], products, 0.0))
        order = np.lexsort((-np.imag(values), -np.round(np.abs(values), 12)), axis=-1)
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
        return folded(f"LimitCycles({type(self.systems).__name__}: {self.summary(1)})")


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

    Newton's method first finds the cycles of a few systems in parallel, from the guess. Each
    further round solves four times as many systems, with the cycles of neighboring systems as
    guesses. If Newton's method fails for a system, the system is simulated for 8 or 40 periods, and
    Newton's method starts again from the final state.

    **Arguments:**

    - `systems`: a list of systems of one class, or one system whose arrays all have a leading
        axis, as `equinox.filter_vmap` makes it:
        `eqx.filter_vmap(lambda k: VerticalHopper(k=k))(jnp.linspace(8, 13, 100))`.
    - `guess`: a limit cycle of a similar system.
    - `settings`: accuracy of the flow (Default: 1e-9 per step) and its `solver`.
    - `execution`: systems per call (`batch`, Default: 1024, and 250 in the compiled calls of more
        than 8000 systems) and threads (`workers`).

    **Returns:** `LimitCycles`; its `failed` lists the systems without a cycle. Nothing is raised
    for those.

    **Raises:** `DefinitionError` for systems that do not belong together, or have no parameters.
    """
    execution = Execution() if execution is None else execution
    systems = _stacked(systems)
    require_positive(systems)
    require_x64(systems)
    settings = Settings() if settings is None else settings
    systems = settings.system(systems)
    arrays, static = eqx.partition(systems, eqx.is_array)
    S = len(jax.tree_util.tree_leaves(arrays)[0])
    check_periodic(eqx.combine(jax.tree_util.tree_map(lambda x: x[0], arrays), static))
    map = map_for_sweep(guess, settings)
    tiles = tiles_of(systems, map, execution.batch, execution.threads, S)
    return as_cycles(tiles, tiles.solve(S))


def map_for_sweep(guess: LimitCycle, settings: Settings) -> ReturnMap:
    """The return map of `guess`, with the settings of a sweep."""
    settings = settings.filled(SWEEP)
    if settings.scale is None:
        settings = dataclasses.replace(settings, scale=guess.settings.scale)
    return dataclasses.replace(guess.return_map, settings=settings)


def as_cycles(tiles: Tiles, rounds: Rounds) -> LimitCycles:
    """The last rounds of Newton's method as cycles."""
    turn, map = rounds.turn, tiles.map
    cycles = LimitCycles(
        tiles.systems,
        map.base,
        rounds.period,
        rounds.anchor,
        turn.legs,
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
    return examined(cycles, rounds.together)


def examined(cycles: LimitCycles, together: Bool[np.ndarray, " S"]) -> LimitCycles:
    """The cycles, with the result `COINCIDENCE` if events coincide (`together`) that do not
    commute, and with those of their verdicts: of eight cycles and, if one of these has a fault, of
    all.

    **Raises:** `DefinitionError` as `check_found`, for one of eight cycles.
    """
    result = cycles.result.copy()
    rows = np.flatnonzero(together & cycles.ok)
    few = rows[:: -(-len(rows) // _LOOKED_AT)] if len(rows) else rows
    if not all(commutes(cycles[i]) for i in few):
        result[[i for i in rows if not commutes(cycles[i])]] = Result.COINCIDENCE
    good = np.flatnonzero(result == Result.OK)
    places = np.linspace(0, len(good) - 1, min(len(good), _TESTED))
    tested = good[np.unique(places.astype(int))]
    for i in tested:
        check_found(cycles[i])
    if any(verdict(cycles[i]).refused for i in tested):
        result[good] = [verdict(cycles[i]).result for i in good]
    found = np.isin(result, [Result.OK, Result.SINGULAR, Result.COINCIDENCE])
    period = np.where(found, cycles.period, np.nan)
    return dataclasses.replace(cycles, result=result, period=period)


def _stacked(systems) -> HybridSystem:
    first, *_ = [systems] if isinstance(systems, HybridSystem) else [*systems, None]
    if first is not None and not arrays_of(first):
        raise DefinitionError(
            f"{type(first).__name__} has no parameters, in which systems could differ: use "
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
    stack = lambda x: jax.device_put(np.stack([np.asarray(y) for y in x]))  # noqa: E731
    columns = zip(*(leaves for leaves, _ in parts), strict=True)
    stacked = [stack(x) if eqx.is_array(x[0]) else x[0] for x in columns]
    return jax.tree_util.tree_unflatten(parts[0][1], stacked)


def rough(cycle: LimitCycle) -> dict[str, Any]:
    """The period and the anchor, in sizes of the states, in digits on which two searches agree."""
    chart = int(np.asarray(cycle.anchor.chart)[0])
    q, size = np.asarray(cycle.anchor.q)[:, 0], np.asarray(cycle.settings.scale)[chart]
    state = [f"{x:.4f}" for x in (q / size).round(4) + 0.0]
    period, time = (f"{float(x):.5g}" for x in (cycle.period, cycle.anchor.t[0]))
    return {"period": period, "time": time, "chart": chart, "state": state}
