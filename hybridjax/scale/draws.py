"""Many draws of a random computation."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, ExperimentCount, Index, Path, Seed
from .._core.pieces.blocks import Blocks
from .._core.pieces.description import function_digest, versions
from .._core.pieces.layout import Constant, Layout, Variable
from .._core.pieces.place import filled
from .._core.pieces.run import DaskClient, call
from .._core.progress import working
from ..errors import ComputationError, DefinitionError


# Pieces of a call, unless it is told how many draws each has. Doubled, twice the files, and half as
# much is lost with a worker.
_PIECES = 256


@checked
@working("monte_carlo")
def monte_carlo(
    function: Callable[[np.random.Generator], Any],
    draws: ExperimentCount,
    seed: Seed = 0,
    *,
    chunk: Count | None = None,
    store: Path | None = None,
    client: DaskClient | None = None,
    share: tuple[Index, ExperimentCount] = (0, 1),
) -> Any:
    """Draw a random computation many times.

    ```python
    def error(rng):
        data = hj.experiments.add_noise(clean, 1e-4, seed=int(rng.integers(2**31)))
        return hj.fit_multipliers(hj.estimate_htf(data), order=2).multipliers

    errors = hj.monte_carlo(error, 1000, client=client)
    errors.value.std("draw")
    ```

    Draw i has a stream of random numbers of its own, that of
    `numpy.random.SeedSequence(seed, spawn_key=(i,))`. So results do not depend on the number of
    processes, nor on interruptions, and more draws leave the first ones what they are.

    **Arguments:**

    - `function` of a `numpy.random.Generator`: gives a number, an array, or a mapping of names to
        such; always of the same shapes. A draw that raises `ComputationError` is NaN.
    - `draws`: how many. `seed`, of all of them.
    - `chunk`: draws in one piece.
    - `store`, `client`, `share`: as of `sweep`.

    **Returns:** an `xarray.Dataset` along `draw`, with the variables that `function` names, or
    `value`; and `failed`, 1 for draws that raised `ComputationError`.

    **Raises:** `DefinitionError` for results that are no numbers, or change their names, their
    shapes, or from real to complex ones, and as `sweep`; `ComputationError` if the first draws
    fail, so that it is not known what results look like; what else `function` raises.
    """
    blocks = Blocks((draws,), (min(chunk or -(-draws // _PIECES), draws),))
    description = {
        "kind": "monte_carlo",
        "versions": versions(),
        "function": function_digest(function),
        "draws": draws,
        "seed": seed,
        "piece": list(blocks.block),
    }
    job = Draws(function, seed, blocks)

    def begin() -> tuple[Draws, Layout, list[np.ndarray]]:
        variables = call(job, "first", client)
        number = {"draw": Constant(("draw",), np.arange(draws))}
        layout = Layout(("draw",), blocks, variables, number, ("draw",), description)
        return dataclasses.replace(job, variables=variables), layout, []

    def again(layout: Layout, start: list[np.ndarray]) -> Draws:
        return dataclasses.replace(job, variables=layout.variables)

    return filled(begin, again, description, store, client, share).dataset()


# Draws after which nobody hopes for one that succeeds. Doubled, twice as many.
_HOPE = 20


@dataclasses.dataclass(frozen=True)
class Draws:
    """**Fields:** `function`, drawn with streams of `seed`, in `blocks`; `variables`, what it
    gives."""

    function: Callable[[np.random.Generator], Any]
    seed: int
    blocks: Blocks
    variables: Mapping[str, Variable] = dataclasses.field(default_factory=dict)

    def first(self) -> dict[str, Variable]:
        """What results look like, from the first draw that succeeds."""
        for i in range(min(_HOPE, *self.blocks.shape)):
            try:
                values = self._draw(i)
            except ComputationError as error:
                failure = error
                continue
            found = {
                name: Variable(x.dtype.str, tuple(f"{name}_{j}" for j in range(x.ndim)), x.shape)
                for name, x in values.items()
            }
            return found | {"failed": Variable("<i8")}
        raise ComputationError(f"the first draws all failed, the last because {failure}")

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """The draws of piece k."""
        (rows,) = self.blocks.slices(k)
        count = rows.stop - rows.start
        found = {
            name: np.full((count, *x.shape), x.fill, x.dtype) for name, x in self.variables.items()
        }
        for i in range(count):
            try:
                values = self._draw(rows.start + i)
            except ComputationError:
                found["failed"][i] = 1
                continue
            found["failed"][i] = 0
            unlike = _difference(values, self.variables)
            if unlike is not None:
                raise DefinitionError(
                    "`function` must always give arrays of the same names and shapes, and real or "
                    f"complex ones only: draw {rows.start + i} has {unlike}."
                )
            for name, x in values.items():
                found[name][i] = x
        return found

    def _draw(self, i: int) -> dict[str, np.ndarray]:
        stream = np.random.SeedSequence(self.seed, spawn_key=(i,))
        values = self.function(np.random.default_rng(stream))
        named = values if isinstance(values, Mapping) else {"value": values}
        found = {}
        for name, value in named.items():
            x = np.asarray(value)
            if x.dtype.kind not in "biufc" or name in ("failed", "draw"):
                raise DefinitionError(
                    f"`function` must give numbers, by names other than `failed` and `draw`, not "
                    f"`{name}`: a {type(value).__name__}."
                )
            found[name] = x.astype(complex if x.dtype.kind == "c" else float)
        return found


def _difference(values: Mapping[str, np.ndarray], variables: Mapping[str, Variable]) -> str | None:
    """What a draw gives that the first one did not, in words."""
    for name, x in values.items():
        if name not in variables or x.shape != variables[name].shape:
            return f"`{name}` of the shape {x.shape}"
        if x.dtype.kind == "c" and np.dtype(variables[name].dtype).kind != "c":
            return f"`{name}` with complex numbers"
    missing = [name for name in variables if name not in (*values, "failed")]
    return f"no `{missing[0]}`" if missing else None
