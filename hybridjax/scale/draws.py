"""`monte_carlo`: many draws of a random computation, in pieces, by any number of processes.

It makes the job `Draws`, and `fill` (`_core/pieces/run.py`) runs it. Draw i has its own stream of
random numbers (`_draw`): results do not depend on pieces, processes or interruptions, and this must
stay so. `begin` finds the form of the results from the first draw that succeeds. If draws are
refused for their names or shapes, look at `run` and at `wanted.stacked`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, ExperimentCount, FilePath, Seed
from .._core.pieces.description import digest_of, versions
from .._core.pieces.run import DaskClient, fill
from .._core.pieces.store import Blocks, Layout, Variable
from .._core.progress import working
from ..errors import ComputationError, DefinitionError
from .wanted import as_numbers, form, stacked


# Pieces of a call, unless `chunk` is given. Fewer: more is lost with a worker. More: many small
# files.
_PIECES = 256


@checked
@working("monte_carlo")
def monte_carlo(
    function: Callable[[np.random.Generator], Any],
    draws: ExperimentCount,
    seed: Seed = 0,
    *,
    chunk: Count | None = None,
    store: FilePath | None = None,
    client: DaskClient | None = None,
) -> Any:
    """Draw a random computation many times.

    Draw i has its own stream of random numbers, that of
    `numpy.random.SeedSequence(seed, spawn_key=(i,))`. So results do not depend on the number of
    processes nor on interruptions, and with more draws the first ones stay the same.

    **Arguments:**

    - `function`: takes a `numpy.random.Generator`, and returns a number, an array, or a mapping of
        names to numbers and arrays, with the same names and shapes in every draw. A draw that
        raises `ComputationError` is NaN.
    - `draws`: number of draws. `seed`: seed of all draws. Default: 0.
    - `chunk`: number of draws in a piece. Default: a 256th of all.
    - `store`, `client`: as for `sweep`.

    **Returns:** an `xarray.Dataset` along `draw`, with the variables that `function` names, or
    `value`; and `failed`, 1 for draws that raised `ComputationError`.

    **Raises:** `DefinitionError` for results that are no numbers, or that change their names, their
    shapes, or from real to complex ones, and in the cases of `sweep`; `ComputationError` if all
    draws fail; any other error that `function` raises.

    **Example:**

    ```python
    def multipliers(rng):
        noisy = hj.experiments.add_noise(data, std=1e-5, seed=int(rng.integers(2**31)))
        return hj.fit_multipliers(hj.estimate_htf(noisy), order=2).multipliers
    drawn = hj.scale.monte_carlo(multipliers, 4)
    print(drawn.value.std("draw"))
    ```

    **Before:** `hj.run_experiments`, `hj.experiments.simulate_experiments`. **After:** functions of
    `xarray`.
    """
    length = min(chunk or -(-draws // _PIECES), draws)
    blocks = Blocks((draws,), (length,))
    return fill(Draws(function, seed, blocks), store, client).dataset()


@dataclasses.dataclass(frozen=True)
class Draws:
    """**Fields:** `function`, drawn with streams of `seed`, in `blocks`; `variables`: the form of
    its results."""

    function: Callable[[np.random.Generator], Any]
    seed: int
    blocks: Blocks
    variables: Mapping[str, Variable] = dataclasses.field(default_factory=dict)

    @property
    def description(self) -> dict[str, Any]:
        """JSON from which the draws can be told from others."""
        return {
            "kind": "monte_carlo",
            "versions": versions(),
            "function": digest_of(self.function),
            "draws": self.blocks.shape[0],
            "seed": self.seed,
            "piece": list(self.blocks.block),
        }

    def begin(self) -> tuple["Draws", Layout]:
        """Return the job with the form of its results."""
        variables = self.first()
        numbers = np.arange(self.blocks.shape[0])
        number: dict[str, Any] = {"draw": (("draw",), numbers, {})}
        layout = Layout(
            dims=("draw",),
            blocks=self.blocks,
            variables=variables,
            constants=number,
            coordinates=("draw",),
            description=self.description,
        )
        return dataclasses.replace(self, variables=variables), layout

    def arrays(self) -> list[np.ndarray]:
        """Return nothing: draws depend on their numbers only."""
        return []

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "Draws":
        """Return the job with the form of results in a store."""
        return dataclasses.replace(self, variables=layout.variables)

    def first(self) -> dict[str, Variable]:
        """Return the form of results, from the first draw that succeeds."""
        values = None
        for i in range(*self.blocks.shape):
            values = self._draw(i)
            if isinstance(values, dict):
                return {name: form(name, x) for name, x in values.items()}
        raise ComputationError(f"all draws failed, the last because {values}")

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Return the draws of piece k."""
        (rows,) = self.blocks.slices(k)
        lost = dict.fromkeys(self.variables) | {"failed": np.array(1)}
        columns: dict[str, list] = {name: [] for name in self.variables}
        for i in range(rows.start, rows.stop):
            values = self._draw(i)
            if isinstance(values, ComputationError):
                values = lost
            other = values.keys() ^ columns.keys()
            if other:
                raise DefinitionError(
                    f"`function` must always give the same names: `{min(other)}` is in some draws "
                    "only."
                )
            for name, value in values.items():
                columns[name].append(value)
        variables = self.variables.items()
        return {name: stacked(name, columns[name], x) for name, x in variables}

    def _draw(self, i: int) -> dict[str, np.ndarray] | ComputationError:
        """Return the numbers of draw i by name, with `failed`; or the `ComputationError` that it
        raised.

        **Raises:** `DefinitionError` for results that are no numbers, or have a name of our own.
        """
        stream = np.random.SeedSequence(self.seed, spawn_key=(i,))
        try:
            values = self.function(np.random.default_rng(stream))
        except ComputationError as error:
            return error
        named = values if isinstance(values, Mapping) else {"value": values}
        if not named.keys().isdisjoint(("failed", "draw")):
            raise DefinitionError(
                "results of `function` cannot be named `failed` or `draw`."
            )
        numbers = {name: as_numbers(name, value) for name, value in named.items()}
        return numbers | {"failed": np.array(0)}
