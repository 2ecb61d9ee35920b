"""Limit cycles over a space of parameters."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, ExperimentCount, Index, Path
from .._core.pieces.blocks import Blocks, near_cube
from .._core.pieces.description import array_digest, function_digest, versions
from .._core.pieces.layout import Layout
from .._core.pieces.place import check_share, filled
from .._core.pieces.run import DaskClient
from .._core.precision import require_x64
from .._core.progress import say, working
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle, rough
from ..orbits.find import find_limit_cycle
from ..orbits.limit_cycles import BATCH
from ..systems.system import HybridSystem
from .family import Family
from .job import Begun, SweepJob, coarse_pass
from .points import Axes, Grid, Points
from .wanted import Measure, Want, Wanted


# More points than this are computed only where they are asked for by `force`: an hour on two cores.
# Doubled, two hours are spent by mistake.
LARGE = 50_000_000
# Points of a piece, at most, and pieces of a large sweep, at least. Pieces twice as large have half
# the files, and lose twice as much with a worker.
_MOST, _PIECES = 4000, 64


@checked
@working("sweep")
def sweep(
    model: HybridSystem | Callable[..., HybridSystem],
    over: Axes | Points,
    want: Want | Sequence[Want] = ("period", "spectral_radius"),
    *,
    measures: Mapping[str, Measure] | None = None,
    guess: LimitCycle | None = None,
    chunk: Count | None = None,
    store: Path | None = None,
    client: DaskClient | None = None,
    share: tuple[Index, ExperimentCount] = (0, 1),
    force: bool = False,
) -> Any:
    """Limit cycles over a space of parameters, as a labelled array.

    ```python
    over = {"k": np.linspace(8, 13, 100), "b": np.linspace(3, 7, 100)}
    map = hj.sweep(hj.models.VerticalHopper(), over)
    map.spectral_radius.plot()
    ```

    A coarse pass finds cycles that are spread over all points; pieces of neighboring points then
    start from these, and within a piece from each other. So a piece does not depend on who computes
    it, and when: results are the same to the last bit for any number of processes and interruptions
    (on machines of one kind). A point where that fails is tried again from the nearest point that
    succeeded, and after it has flowed freely for a while.

    **Arguments:**

    - `model`: a system, some of whose parameters (scalar ones, with dots for those of parts) take
        the values given; or a function of these parameters that returns a system.
    - `over`: values of each parameter by name, of which all combinations are taken; or `Points`,
        such as those of `sobol_points`.
    - `want`: what is kept of each cycle: "period", "state" (at its anchor, with the chart),
        "multipliers", "spectral_radius" (their largest modulus), "events" (at most four times as
        many as the coarse pass has met), "residual". The code of its `Result` always is.
    - `measures`: functions of a `LimitCycle` by name, for anything else: a number, or an array of
        always the same shape (`lambda cycle: hj.linearize(cycle, phase, "y").htf(0.3).H`). NaN
        where they raise `ComputationError`.
    - `guess`: the cycle of a system nearby. By default that of the model in the middle.
    - `chunk`: points of a piece at most; by default up to 4000, with `measures` 250.
    - `store`: a folder, or an address that fsspec knows, for a Zarr group. What is there already is
        not computed again: after an interruption, make the same call.
    - `client`: a `distributed.Client`, whose workers do the pieces.
    - `share`: `(rank, size)` where several processes without a client fill one store: this one does
        the pieces rank, rank + size, ...; those above 0 wait until the first has begun the store.
    - `force`: compute more than 50 million points.

    **Returns:** an `xarray.Dataset` with the parameters as coordinates. Of a store, values are read
    when they are used.

    **Raises:** `DefinitionError` for parameters that the model does not have, an empty axis, a
    store of something else (with the difference), a client whose workers lack the package or have
    another version; `ComputationError` if there is no cycle in the middle, or the cluster was lost.
    """
    require_x64()
    check_share(share)
    points = over if isinstance(over, Points) else Grid(_axes(over))
    total = math.prod(points.shape)
    names = (want,) if isinstance(want, str) else tuple(want)
    wanted = Wanted(names, {} if measures is None else measures)
    bytes_each = 8 * (1 + len(names) + len(wanted.measures))
    if total > LARGE and not force:
        raise DefinitionError(
            f"these are {total:.3g} points, about {total / 5000 / 3600:.3g} hours of one core and "
            f"{total * bytes_each / 1e9:.3g} GB: say `force=True` if that is meant."
        )
    family = Family(model, list(points.axes))
    middle = {name: _middle(values) for name, values in points.axes.items()}
    system = family.check(middle)
    most = chunk or (BATCH if wanted.measures else min(max(total // _PIECES, BATCH), _MOST))
    blocks = Blocks(points.shape, near_cube(points.shape, most))
    description = {
        "kind": "sweep",
        "versions": versions(),
        "model": family.describe(middle),
        "over": {name: array_digest(x) for name, x in points.axes.items()},
        "form": list(points.dims),
        "want": list(wanted.names),
        "measures": {name: function_digest(f) for name, f in wanted.measures.items()},
        "guess": None if guess is None else rough(guess),
        "piece": list(blocks.block),
    }
    job = SweepJob(family, points, blocks, wanted)

    def begin() -> tuple[SweepJob, Layout, list[np.ndarray]]:
        begun, cycles = coarse_pass(job, _guess(guess, system), client)
        variables = wanted.variables(cycles)
        constants = points.constants(family.units(system))
        more = wanted.constants(cycles)
        layout = Layout(
            points.dims, blocks, variables, {**constants, **more},
            (*constants, *more), description,
        )  # fmt: skip
        return dataclasses.replace(job, begun=begun, variables=variables), layout, begun.arrays()

    def again(layout: Layout, start: list[np.ndarray]) -> SweepJob:
        begun = Begun.restored(job, _guess(guess, system), start)
        return dataclasses.replace(job, begun=begun, variables=layout.variables)

    return filled(begin, again, description, store, client, share).dataset()


def _axes(over: Axes) -> dict[str, np.ndarray]:
    axes = {name: np.asarray(x, float) for name, x in over.items()}
    if not axes:
        raise DefinitionError("`over` must name at least one parameter.")
    for name, x in axes.items():
        if not len(x):
            raise DefinitionError(f"the axis `{name}` is empty: give it at least one value.")
    return axes


def _middle(values: np.ndarray) -> float:
    return float(np.sort(values)[len(values) // 2])


def _guess(guess: LimitCycle | None, system: HybridSystem) -> LimitCycle:
    if guess is not None:
        return guess
    say("a cycle in the middle")
    try:
        return find_limit_cycle(system)
    except (ComputationError, DefinitionError) as error:
        raise type(error)(
            f"no limit cycle was found in the middle of the axes, so give one by `guess=`: {error}"
        ) from error
