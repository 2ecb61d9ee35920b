"""`sweep`: limit cycles over a space of parameters, in pieces, by any number of processes.

`sweep` makes a `SweepJob` from the points and the systems (`family.py`) and the quantities to keep
(`wanted.py`), and `fill` (`_core/pieces/run.py`) runs it: `begin` once, then `run` for each piece,
here or on workers, which call `resume` first. Cycles themselves are found by `solved`
(`orbits/limit_cycles.py`).

Results must not depend on the process that computes a piece: all pieces start from the same cycles
of a coarse pass, and the guess is rounded (`_rounded`). The `description` decides whether a store
holds the same sweep: what changes results must be in it.

If the results of two runs differ, look at `_rounded` and `Begun`; if a store is refused without
need, at the `description` in `sweep`; if a cycle is missing, at `orbits/limit_cycles.py`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .._core.arguments import searching
from .._core.boundary.checked import checked, taken_parameters
from .._core.boundary.kinds import Count, FilePath
from .._core.execution import Execution
from .._core.pieces.description import digest_of, versions
from .._core.pieces.run import DaskClient, fill
from .._core.pieces.store import Blocks, Layout, Variable, near_cube
from .._core.precision import require_x64
from .._core.progress import say, working
from ..engine.settings import SWEEP, Settings
from ..errors import ComputationError, DefinitionError
from ..orbits.batches import Known, numbers_of
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..orbits.limit_cycles import (
    LimitCycles,
    known_from,
    map_for_sweep,
    rough,
    solved,
)
from ..orbits.return_map import ReturnMap
from ..orbits.verdict import require_sound
from ..systems.system import HybridSystem, parameters_of
from .family import Axis, Family, Space, SweepPoints
from .wanted import Measure, Want, Wanted


# Pieces of a large sweep. More: many small files, and worse first guesses. Fewer: more is lost with
# a worker.
_PIECES = 64
# Points of a piece, at least, and of one for which users' functions of cycles are evaluated. More:
# more is lost with a worker. Fewer: many small files.
_SMALLEST = 4000
_MEASURED = 250
# Number of cycles in the coarse pass, which computes first guesses for the pieces. Fewer: worse
# guesses. More: the pass takes longer than its guesses save.
_COARSE = 250
# A guess is rounded to this many digits, relative to the sizes of the states. More: results depend
# in the last digits on how the guess was found. Fewer: Newton's method takes one more step.
_DIGITS = 7


@checked
@working("sweep")
def sweep(
    model: HybridSystem | Callable[..., HybridSystem],
    values: Mapping[str, Axis] | SweepPoints | None = None,
    quantities: Want | Measure | Sequence[Want | Measure] = (
        "period",
        "spectral_radius",
    ),
    *,
    guess: LimitCycle | None = None,
    chunk: Count | None = None,
    store: FilePath | None = None,
    client: DaskClient | None = None,
    **parameters: Axis,
) -> Any:
    """Find limit cycles over a space of parameters, as a labelled array.

    If there are several pieces, a coarse pass first finds cycles at points all over the
    space. A piece of neighboring points then starts from these cycles, and continues
    from its own solved points. A piece does not depend on which process computes it,
    nor when: results are the same to the last bit for any number of processes and
    interruptions (on machines of one kind). If the search fails at a point, it is
    repeated from the nearest point that succeeded, and after a simulation of the
    transient.

    **Arguments:**

    - `model`: a system, some of whose scalar parameters take the values given (names may have
        dots); or a function of these parameters that returns a system.
    - `values`: values of each parameter by name, of which all combinations are taken; or
        `hj.scale.SweepPoints`. A number is the only value of its parameter.
    - `parameters`: the same values as keywords, as in `hj.sweep(system, k=[9, 10])`,
        for parameters without dots in their names.
    - `quantities`: quantities to keep of each cycle: "period", "state" (at its phase
        origin, with the chart), "multipliers", "spectral_radius" (their largest
        modulus), "residual". A quantity may also be a function of a `LimitCycle` that
        returns a number or an array of always the same shape. Its value is kept under
        the name of the function, and is NaN where the function raises
        `ComputationError`. The code of the cycle's `Result` is always kept. Default:
        period and spectral radius.
    - `guess`: the cycle of a similar system. Default: that of the model in the middle.
    - `chunk`: largest number of points in a piece. Default: 4000, with functions 250;
        more in sweeps of more than 64 such pieces without functions.
    - `store`: a folder, or an address for fsspec, of a Zarr group. Points that are in
        the store already are not computed again: after an interruption, repeat the
        call. The store also holds digests of the programs of the model and of the code
        of functions, with the values, helpers and classes that this code can reach (not
        of databases and files). A call with other digests raises an error.
    - `client`: a `distributed.Client`, whose workers compute the pieces.

    **Returns:** an `xarray.Dataset`, whose coordinates are the parameters with their units. With a
    store, values are read when they are used.

    **Raises:** `DefinitionError` for a parameter that does not exist, and for
    quantities that do not exist or change their shape. `DefinitionError` if the store
    cannot be written or holds another sweep (the message gives the difference), and if
    workers of the client cannot run the job. `ComputationError` if there is no cycle in
    the middle, or if the cluster is lost.

    **Example:**

    ```python
    found = hj.sweep(hopper, k=np.linspace(9, 11, 4), b=np.linspace(4, 6, 3))
    found.spectral_radius.plot()
    ```

    **Before:** a model, `hj.models` or `hj.HybridSystem`; `hj.find_limit_cycle`, for a guess.
    **After:** functions of `xarray`.
    """
    require_x64()
    space = _space(model, values, parameters)
    family = Family(model, list(space.axes))
    middle = {}
    for name, x in space.axes.items():
        middle[name] = float(np.sort(x)[len(x) // 2])
    system = family.check(middle)
    wanted = Wanted(quantities, system)
    total = math.prod(space.shape)
    most = chunk or (_MEASURED if wanted.measures else max(total // _PIECES, _SMALLEST))
    blocks = Blocks(space.shape, near_cube(space.shape, most))
    description = {
        "kind": "sweep",
        "versions": versions(),
        "model": family.describe(system),
        "values": {name: digest_of(x) for name, x in space.axes.items()},
        "form": list(space.dims),
        "quantities": list(wanted.names),
        "measures": {name: digest_of(f) for name, f in wanted.measures.items()},
        "guess": None if guess is None else rough(guess),
        "piece": list(blocks.block),
    }
    job = SweepJob(
        family=family,
        system=system,
        space=space,
        blocks=blocks,
        wanted=wanted,
        guess=guess,
        description=description,
    )
    return fill(job, store, client).dataset()


def _space(
    model: HybridSystem | Callable[..., HybridSystem],
    values: Mapping[str, Any] | SweepPoints | None,
    parameters: Mapping[str, Any],
) -> Space:
    """Return the points of a sweep, from values by name, in a table or as keywords.

    **Raises:** `DefinitionError` without values, for a keyword that is no parameter, and for a
    parameter that is given twice.
    """
    parameters = taken_parameters(sweep, model, parameters)
    if isinstance(values, SweepPoints):
        if parameters:
            raise DefinitionError(
                "`hj.scale.SweepPoints` hold the values of all parameters: leave out "
                f"`{next(iter(parameters))}`."
            )
        return Space(values.values, grid=False)
    by_name = dict(values or {})
    for name in parameters:
        if name in by_name:
            raise DefinitionError(f"`{name}` is given twice: leave it out of `values`.")
    axes = {
        name: np.atleast_1d(np.asarray(x, float))
        for name, x in (by_name | parameters).items()
    }
    if not axes or not all(map(len, axes.values())):
        raise DefinitionError(
            "a sweep needs at least one parameter with a value or more, as in "
            f"`hj.sweep(system, {_example(model)}=[0.1, 0.5])`."
        )
    return Space(axes, grid=True)


def _example(model: Any) -> str:
    """Return the name of a parameter."""
    names = parameters_of(model) if isinstance(model, HybridSystem) else {}
    return next((name for name in names if "." not in name), "k")


class Begun(NamedTuple):
    """The common beginning of all pieces: the return map of the guess, the indices of the points of
    the coarse pass (all points, if there is one piece), and their cycles (without the systems)."""

    map: ReturnMap
    index: tuple[np.ndarray, ...]  # type: ignore[assignment]  # (not the method of tuples)
    coarse: Known

    def parts(self) -> Any:
        """Return all arrays but those that follow from the model."""
        x = self.map
        return (
            (x.anchor, x.expected, x.settings.scale, x.conserved),
            self.index,
            self.coarse,
        )


@dataclasses.dataclass(frozen=True)
class SweepJob:
    """**Fields:** `family`: systems as a function of parameters; `system`: that in the middle of
    the `space` of points, which is cut into `blocks`; `wanted`: quantities to keep of each cycle,
    as `variables`; `guess`: a cycle, or None; `begun`: the common beginning of all pieces;
    `cycles`: those of the only piece, if this process has found them."""

    family: Family
    system: HybridSystem
    space: Space
    blocks: Blocks
    wanted: Wanted
    guess: LimitCycle | None
    description: Mapping[str, Any]
    begun: Begun = None  # type: ignore[assignment]
    variables: Mapping[str, Variable] = dataclasses.field(default_factory=dict)
    cycles: LimitCycles | None = None

    def begin(self) -> tuple["SweepJob", Layout]:
        """Return the job after the coarse pass, and the form of its results."""
        begun = self._blank()
        say("a coarse pass")
        solved, cycles = dataclasses.replace(self, begun=begun).coarse()
        variables = self.wanted.variables(cycles)
        units = self.family.units(self.system)
        points = self.space.constants(units)
        states = self.wanted.constants()
        layout = Layout(
            dims=self.space.dims,
            blocks=self.blocks,
            variables=variables,
            constants={**points, **states},
            coordinates=(*points, *states),
            description=self.description,
        )
        begun = begun._replace(coarse=solved)
        whole = cycles if len(self.blocks) == 1 else None
        return dataclasses.replace(
            self, begun=begun, variables=variables, cycles=whole
        ), layout

    def arrays(self) -> list[np.ndarray]:
        """Return the arrays of the common beginning."""
        return [np.asarray(x) for x in jax.tree_util.tree_leaves(self.begun.parts())]

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "SweepJob":
        """Return the job with the beginning that another process computed."""
        blank = self._blank()
        structure = jax.tree_util.tree_structure(blank.parts())
        of_map, index, solved = jax.tree_util.tree_unflatten(structure, arrays)
        begun = Begun(_with(blank.map, *of_map), index, solved)
        return dataclasses.replace(self, begun=begun, variables=layout.variables)

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Return the results at the points of piece k."""
        if len(self.blocks) == 1:
            cycles = self.cycles or self.coarse()[1]
        else:
            coarse = self.family.systems(self.space.at(self.begun.index))
            known = self.begun.coarse._replace(numbers=numbers_of(coarse))
            cycles = self._solved(self._points(k), workers, known)
        shape = [x.stop - x.start for x in self.blocks.slices(k)]
        values = self.wanted.values(cycles, self.variables)
        shaped = {}
        for name, x in values.items():
            shaped[name] = x.reshape(*shape, *x.shape[1:])
        return shaped

    def _points(self, k: int) -> tuple[np.ndarray, ...]:
        """Return the indices of the points of piece k."""
        place = self.blocks.slices(k)
        index = np.meshgrid(*(np.arange(x.start, x.stop) for x in place), indexing="ij")
        return tuple(x.ravel() for x in index)

    def coarse(self) -> tuple[Known, LimitCycles]:
        """Return the cycles of the coarse pass."""
        cycles = self._solved(self.begun.index, None)
        return known_from(cycles), cycles

    def _solved(
        self,
        index: tuple[np.ndarray, ...],
        workers: int | None,
        known: Known | None = None,
    ) -> LimitCycles:
        """Return the cycles at some points."""
        systems = self.family.systems(self.space.at(index))
        threads = Execution(workers=workers).threads
        return solved(systems, self.begun.map, None, threads, known)

    def _blank(self) -> Begun:
        """Return the beginning before the cycles of the coarse pass are known."""
        map = _rounded(map_for_sweep(self._guess(), Settings()))
        # (A Halton sequence: to import that of scipy takes 0.7 s.)
        base = np.resize(
            [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31], len(self.blocks.shape)
        )[:, None]
        k = np.arange(1, 1 + _COARSE)[:, None, None]
        power = base ** np.arange(16.0)
        unit = (k // power % base / (power * base)).sum(axis=2)
        index = tuple(
            np.unique((unit * np.array(self.blocks.shape)).astype(int), axis=0).T
        )
        index = self._points(0) if len(self.blocks) == 1 else index
        n = len(index[0])
        anchor = jax.tree_util.tree_map(
            lambda x: np.repeat(np.asarray(x)[None], n, 0), map.anchor
        )
        blank = Known(
            numbers=None,
            anchor=anchor,
            period=np.zeros(n),
            result=np.zeros(n, int),
        )
        return Begun(map, index, blank)

    def _guess(self) -> LimitCycle:
        if self.guess is not None:
            require_sound(self.guess)
            return self.guess
        say("a cycle in the middle")
        with searching("as `guess`", (ComputationError, DefinitionError)):
            return find_limit_cycle(self.system, settings=Settings(SWEEP, SWEEP))


def _rounded(map: ReturnMap) -> ReturnMap:
    """Return the map with a state, a period and sizes without the last digits of the guess, which
    depend on how it was found."""

    def single(x):
        return np.asarray(x, np.float32).astype(float)

    scale = single(map.settings.scale)
    size = scale[np.asarray(map.anchor.chart)].T
    q = np.round(np.asarray(map.anchor.q) / size, _DIGITS) * size
    anchor = eqx.tree_at(lambda x: x.q, map.anchor, q)
    period = map.expected if map.base is None else single(map.expected)
    return _with(map, anchor, period, scale, map.conserved)


def _with(
    map: ReturnMap,
    anchor: Any,
    expected: Any,
    scale: Any,
    conserved: Any,
) -> ReturnMap:
    settings = dataclasses.replace(map.settings, scale=scale)
    return dataclasses.replace(
        map,
        anchor=anchor,
        expected=expected,
        settings=settings,
        conserved=conserved,
    )
