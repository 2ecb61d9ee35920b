"""`run_experiments`: all experiments at once, in chunks, or in a Zarr store that any number of
processes fills.

The experiments themselves are computed by a `Campaign` (`run.py`). This file decides only which of
them run together, and where the records go. `ExperimentJob` is what the general code for stores
(`_core/pieces/`) asks for: the description of the experiments, and the records of each chunk.

A further option that changes records must be in `ExperimentJob.description`: otherwise a store with
other records is continued. If a store is refused without need, look there. If processes write
different records, look at `arrays`: all that is computed before the first experiment must be in it.
If the records of all of them are wrong, look at `run.py`.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, TypedDict, Unpack, overload

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
    result_flags,
)
from .._core.progress import working
from .._core.showable import Showable
from .._core.signal import Signal, unit_of
from ..engine.settings import EXPERIMENT
from ..errors import DefinitionError
from ..linear.ldtp import LDTP, Gain
from ..orbits.checks import default_outputs
from ..orbits.cycle import LimitCycle
from ..orbits.limit_cycles import rough
from ..sections.placed import SectionsLike
from ..systems.system import OutputNames, describe
from .data import ExperimentData, Simulated, summary
from .design.design import Design
from .noise import ProcessNoise
from .plan import Accuracy
from .run import CHUNK, Campaign, DesignLike, RunOptions, prepare
from .start import StartName


_KIND = "experiments"


@checked
class StoredExperiments(Showable):
    """Experiments in a store that `run_experiments(..., store=...)` fills.

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


class _Options(TypedDict, total=False):
    """Options that all forms of `run_experiments` take."""

    start: StartName
    discard: Index | None
    process_noise: ProcessNoise | None
    accuracy: Accuracy
    execution: Execution | None
    feedback: LDTP | Gain | None


@overload
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames | None = None,
    **options: Unpack[_Options],
) -> ExperimentData: ...
@overload
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames | None = None,
    *,
    chunk: ExperimentCount,
    **options: Unpack[_Options],
) -> Iterator[ExperimentData]: ...
@overload
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames | None = None,
    *,
    chunk: ExperimentCount | None = None,
    store: FilePath,
    client: DaskClient | None = None,
    **options: Unpack[_Options],
) -> StoredExperiments: ...
@checked
@working("run_experiments")
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames | None = None,
    *,
    start: StartName = "cycle",
    discard: Index | None = None,
    process_noise: ProcessNoise | None = None,
    accuracy: Accuracy = EXPERIMENT,
    execution: Execution | None = None,
    feedback: LDTP | Gain | None = None,
    chunk: ExperimentCount | None = None,
    store: FilePath | None = None,
    client: DaskClient | None = None,
) -> ExperimentData | Iterator[ExperimentData] | StoredExperiments:
    """Excite the system around its limit cycle and record its outputs at the sections.

    The experiments of a batch run in one compiled call, and the batches on all cores. An experiment
    that fails (a section missed, events in another order, ...) stops there; the others continue.
    With `chunk` or `store`, records need not fit into memory.

    Without a `store`, each chunk is run when the iterator gets to it. With a `store`, all chunks
    are run and kept. Experiments that are in the store already are not run again: after an
    interruption, repeat the call. The records are the same to the last bit for any number of
    processes and interruptions, on machines of one kind.

    **Arguments:**

    - `cycle`: a stable limit cycle, result of `hj.find_limit_cycle`.
    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are constant from section to section. n must
        be a whole number of periods. All periods after the discarded ones are used for estimation.
    - `outputs`: names or `Output`s, recorded at each section before the new input acts. Default:
        all states that every chart defines, as of `linearize`.
    - `start`: initial condition. "cycle" is a state on the limit cycle. "periodic" is a state on
        the periodic response that the linearization predicts, which leaves a transient of second
        order in the inputs. "steady" is a state on the periodic response itself, found by Newton's
        method, without a transient. Default: "cycle".
    - `discard`: number of cycles before the design's periods, which are not used for estimation.
        Default: 20 from the cycle (as in the paper), 0 from a periodic or steady start.
    - `process_noise`: a random input that is added to the excitation and is not recorded.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to their characteristic magnitudes (`LimitCycle.scale`).
        `data.error` estimates the error of each experiment. Default: 1e-9.
    - `execution`: batches and threads.
    - `feedback`: a controller F that acts during the experiments. The input is $u = r - F y$, where
        r is the `design` and y are the deviations of the `outputs` from the cycle, measured before
        u acts. F is an `LDTP` from the outputs to the inputs, by name, or a static gain, (nu, ny)
        or (N, nu, ny). It may stabilize an unstable cycle. Default: None.
    - `chunk`: number of experiments per chunk. Default: all experiments at once; 640 in a store.
    - `store`: a folder, or an address for fsspec ("s3://bucket/records.zarr"), of a Zarr group. It
        holds the experiments of one call only. The `design` may then be an array that lies on disk
        (`numpy.load(file, mmap_mode="r")`). Default: None.
    - `client`: a `distributed.Client`, whose workers fill the store. Each of them gets the
        `design`, so pass a `Design` or a small array. Default: None.

    **Returns:** `ExperimentData` with inputs `u` (S, n, nu) and outputs `y` (S, n, ny); with a
    `chunk` an iterator over those of consecutive experiments; with a `store` the
    `StoredExperiments`. `data.summary()` lists failures with their causes. With `feedback` its
    inputs are u, then r, named "r", or "r0", "r1", ... where there are several.

    **Raises:** `DefinitionError` for arguments that do not fit together. `DefinitionError` if the
    store cannot be written or holds other experiments (the message gives the difference), or if the
    workers of the client cannot run the experiments. `ComputationError` for an unstable cycle or
    loop, because experiments would diverge from it. `ComputationError` if a steady start is not
    found, or if the cluster is lost.

    **Example:**

    ```python
    data = hj.run_experiments(cycle, sections, design, ("yM", "vM"))
    chunks = hj.run_experiments(cycle, sections, design, "yM", chunk=4)
    htf = hj.estimate_htf(chunks)
    ```

    **Before:** `hj.find_limit_cycle`, `hj.multisine` or `hj.optimal_design`. **After:**
    `hj.experiments.add_noise`, `hj.estimate_htf`, `hj.fit_series`, `hj.validate`.
    """
    if outputs is None:
        outputs = default_outputs(cycle.structure)
    options = RunOptions(
        start=start,
        discard=discard,
        process_noise=process_noise,
        accuracy=accuracy,
        execution=execution,
        feedback=feedback,
    )
    if store is not None:
        _check_storable(options)
        # (Batches as for one thread: their size does not depend on the machine.)
        execution = dataclasses.replace(execution or Execution(), workers=1)
        options = dataclasses.replace(options, execution=execution)
        chunk = chunk or CHUNK
    elif client is not None:
        raise DefinitionError("a `client` needs a `store` to put records into.")
    campaign = prepare(cycle, sections, design, outputs, options, chunk)
    if chunk is None:
        return campaign.run()
    S = len(campaign.inputs)
    if store is None:
        return (campaign.run(slice(k, min(k + chunk, S))) for k in range(0, S, chunk))
    fill(ExperimentJob(campaign, Blocks((S,), (min(chunk, S),))), store, client)
    return StoredExperiments(store)


def _check_storable(options: RunOptions) -> None:
    if options.feedback is not None:
        raise DefinitionError(
            "a store keeps no experiments with feedback: leave `store` out."
        )


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
            "result": Variable("<i8", attributes=result_flags()),
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
            dims=("experiment",),
            blocks=self.blocks,
            variables=variables,
            constants=constants,
            coordinates=coordinates,
            description=text,
        )

    def arrays(self) -> list[np.ndarray]:
        """Return the arrays on which records depend, in addition to inputs and parameters: those of
        the cycle, its sections, the step schedule and the linearization."""
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
        """A JSON description of the experiments, by which a store recognizes them."""
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
