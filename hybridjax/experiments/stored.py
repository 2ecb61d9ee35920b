"""Experiments in a Zarr store: more than memory holds, run by any number of processes."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, FilePath, Index
from .._core.execution import Execution
from .._core.pieces.description import digest_of, versions
from .._core.pieces.run import DaskClient, fill
from .._core.pieces.store import (
    Blocks,
    Constant,
    Layout,
    Variable,
    ZarrStore,
    absolute,
    flags,
)
from .._core.progress import working
from .._core.results import Result
from .._core.showable import Showable
from .._core.signal import Signal, unit_of
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.limit_cycles import rough
from ..sections.placed import SectionsLike
from ..systems.system import OutputNames, describe
from .data import ExperimentData, Simulated, summary
from .design.design import Design
from .run import CHUNK, Campaign, DesignLike, Options, prepare


_KIND = "experiments"


@checked
class StoredExperiments(Showable):
    """Experiments in a store that `stream_experiments(..., store=...)` fills.

    Iterating over them reads chunk after chunk as `ExperimentData`, so that
    `estimate_htf(StoredExperiments(store))` needs memory for one chunk only.
    """

    def __init__(self, store: FilePath):
        """**Arguments:** `store`: its folder or address.

        **Raises:** `DefinitionError` if it holds no experiments.
        """
        self.address = absolute(store)
        try:
            self._store = ZarrStore(self.address)
            about = self._store.layout.description
            if about["kind"] != _KIND:
                raise KeyError
        except (DefinitionError, KeyError, TypeError, ValueError) as error:
            raise DefinitionError(f"'{store}' holds no experiments.") from error
        blocks = self._store.layout.blocks
        self.experiments = blocks.shape[0]
        self.chunk = blocks.block[0]
        self._about = about["data"]
        self.n_sections: int = self._about["n_sections"]

    def __len__(self) -> int:
        """Return the number of chunks, missing ones included."""
        return len(self._store.layout.blocks)

    def missing(self) -> list[int]:
        """Return the indices of the chunks that are missing."""
        return self._store.missing()

    def __getitem__(self, k: Index) -> ExperimentData:
        """Return chunk k. **Raises:** `FileFormatError` if it is damaged."""
        if k >= len(self):
            raise IndexError(f"there are {len(self)} chunks, and none of number {k}.")
        x = self._store.read(k)
        about = self._about
        return ExperimentData(
            x["u"],
            x["y"],
            n_sections=self.n_sections,
            periods=about["periods"],
            inputs=tuple(Signal(*named) for named in about["inputs"]),
            outputs=tuple(Signal(*named) for named in about["outputs"]),
            result=x["result"],
            simulated=Simulated(x["failed_at"], x["error"], about["label"]),
            cycle_outputs=self._store.array("cycle_outputs"),
        )

    def __iter__(self) -> Iterator[ExperimentData]:
        """Read chunk after chunk. **Raises:** `DefinitionError` if one is missing;
        `FileFormatError` if one is damaged."""
        missing = len(self.missing())
        if missing:
            raise DefinitionError(
                f"{missing} of {len(self)} chunks in '{self.address}' are missing: make the call "
                "that began it again to run them."
            )
        for k in range(len(self)):
            yield self[k]

    @property
    def dataset(self) -> Any:
        """All experiments as `xarray.Dataset`, whose values are read when they are used."""
        return self._store.dataset()

    def summary(self, limit: Index = 5) -> str:
        """Return the same as `ExperimentData.summary`, for all experiments."""
        result, failed_at = (
            self._store.array(name) for name in ("result", "failed_at")
        )
        return summary(result, failed_at, self.n_sections, limit)

    def __repr__(self) -> str:
        ready = len(self) - len(self.missing())
        return (
            f"StoredExperiments('{self.address}': {self.experiments} experiments, {ready} of "
            f"{len(self)} chunks)"
        )


@checked
def stream_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    options: Options = Options(),  # noqa: B008 (immutable)
    *,
    chunk: ExperimentCount = CHUNK,
    store: FilePath | None = None,
    client: DaskClient | None = None,
) -> Iterator[ExperimentData] | StoredExperiments:
    """Run experiments chunk by chunk, in memory that does not depend on their number.

    ```python
    chunks = hj.experiments.stream_experiments(cycle, sections, design, "yM")
    estimate = hj.estimate_htf(chunks)
    ```

    Without a `store`, each chunk is run when the iterator gets to it. With a `store`, all chunks
    are run and kept. Experiments that are in the store already are not run again: after an
    interruption, repeat the call. The records are the same to the last bit for any number of
    processes and interruptions, on machines of one kind.

    **Arguments:** those of `run_experiments`, with its keyword arguments as one object, and

    - `options`: for example `hj.experiments.Options(start="periodic")`. Default: `Options()`.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`).
    - `chunk`: number of experiments per chunk. Default: 640.
    - `store`: a folder, or an address for fsspec ("s3://bucket/records.zarr"), of a Zarr group. It
        holds the experiments of one call only.
    - `client`: a `distributed.Client`, whose workers fill the store. Each of them gets the
        `design`, so pass a `Design` or a small array.

    **Returns:** an iterator over `ExperimentData` of consecutive experiments, or with a store
    `StoredExperiments`.

    **Raises:** as `run_experiments` (at once for arguments that do not fit together);
    `DefinitionError` if the store holds other experiments (with the difference) or cannot be
    written, or if the workers of the client cannot run them; `ComputationError` if the cluster is
    lost.
    """
    if store is None:
        if client is not None:
            raise DefinitionError("a `client` needs a `store` to put records into.")
        campaign = prepare(cycle, sections, design, outputs, options, chunk)
        S = len(campaign.inputs)
        return (campaign.run(slice(k, min(k + chunk, S))) for k in range(0, S, chunk))
    if options.feedback is not None:
        raise DefinitionError(
            "a store keeps no experiments with feedback: leave `store` out."
        )
    # (Batches as for one thread: their size does not depend on the machine.)
    execution = dataclasses.replace(options.execution or Execution(), workers=1)
    options = dataclasses.replace(options, execution=execution)
    with working("stream_experiments"):
        campaign = prepare(cycle, sections, design, outputs, options, chunk)
        S = len(campaign.inputs)
        fill(ExperimentJob(campaign, Blocks((S,), (min(chunk, S),))), store, client)
    return StoredExperiments(store)


@dataclasses.dataclass(frozen=True)
class ExperimentJob:
    """**Fields:** `campaign`, in `blocks` of experiments."""

    campaign: Campaign
    blocks: Blocks

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Return the records of chunk k."""
        (rows,) = self.blocks.slices(k)
        data = self.campaign.run(rows, Execution(workers=workers).threads)
        return {
            "u": data.u,
            "y": data.y,
            "result": data.result,
            "failed_at": data.failed_at,
            "error": data.error,
        }

    def begin(self) -> tuple["ExperimentJob", Layout]:
        """Return the job, and the form of its records."""
        campaign = self.campaign
        text = self.description
        placed = campaign.placed
        values = campaign.at_sections
        n = campaign.inputs.cycles * placed.n_sections
        u = placed.cycle.structure.inputs
        variables = {
            "u": Variable("<f8", ("sample", "input"), (n, len(u))),
            "y": Variable("<f8", ("sample", "output"), (n, len(values.outputs.names))),
            "result": Variable(
                "<i8", attributes=flags([x.name.lower() for x in Result])
            ),
            "failed_at": Variable("<i8"),
            "error": Variable("<f8"),
        }
        constants: dict[str, Constant] = {
            "input": (("input",), np.array(list(map(str, u))), {}),
            "output": (("output",), np.array(list(map(str, values.outputs.names))), {}),
            "cycle_outputs": (("section", "output"), values.on_cycle, {}),
        }
        coordinates = "input", "output"
        return self, Layout(
            ("experiment",), self.blocks, variables, constants, coordinates, text
        )

    def arrays(self) -> list[np.ndarray]:
        """Return the arrays that records depend on beside inputs and parameters: those of the
        cycle, of the sections on it, of the step schedule and of the linearization."""
        leaves = jax.tree_util.tree_leaves(eqx.filter(self._computed(), eqx.is_array))
        return [np.asarray(x) for x in leaves]

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "ExperimentJob":
        """Return the job with the arrays of another process."""
        mine, other = eqx.partition(self._computed(), eqx.is_array)
        leaves, structure = jax.tree_util.tree_flatten(mine)
        pairs = zip(leaves, arrays, strict=True)
        new = [
            jax.numpy.asarray(x) if isinstance(old, jax.Array) else x
            for old, x in pairs
        ]
        placed, stepping, model = eqx.combine(
            jax.tree_util.tree_unflatten(structure, new), other
        )
        campaign = dataclasses.replace(
            self.campaign, placed=placed, stepping=stepping, model=model
        )
        return dataclasses.replace(self, campaign=campaign)

    def _computed(self) -> Any:
        return self.campaign.placed, self.campaign.stepping, self.campaign.model

    @property
    def description(self) -> dict[str, Any]:
        """JSON from which the experiments can be told from others."""
        campaign = self.campaign
        placed = campaign.placed
        inputs = campaign.inputs
        noise = campaign.process_noise
        z = campaign.at_sections.outputs
        return {
            "kind": _KIND,
            "versions": versions(),
            "model": describe(placed.cycle.system),
            "cycle": rough(placed.cycle),
            "family": digest_of(placed.family),
            "design": _design(inputs.source),
            "start": campaign.start,
            "process_noise": None if noise is None else dataclasses.asdict(noise),
            "accuracy": campaign.stepping.accuracy,
            "batch": campaign.execution.batch,
            "chunk": self.blocks.block[0],
            "experiments": self.blocks.shape[0],
            "cycles": inputs.cycles,
            "data": {
                "n_sections": placed.n_sections,
                "periods": inputs.periods,
                "inputs": [[str(x), unit_of(x)] for x in z.structure.inputs],
                "outputs": [[str(x), unit_of(x)] for x in z.names],
                "label": placed.family.label,
            },
            "outputs": [x if isinstance(x, str) else digest_of(x) for x in z.items],
        }


def _design(source: Design | np.ndarray) -> str:
    if isinstance(source, Design):
        return digest_of(source)
    parts = (
        source[k : k + CHUNK] for k in range(0, len(source), CHUNK)
    )  # (may lie on disk)
    return digest_of(*map(digest_of, parts))
