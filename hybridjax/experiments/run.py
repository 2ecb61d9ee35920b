"""Batched experiments on a hybrid system around its limit cycle (paper Sec. V)."""

from collections.abc import Iterator

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Index, Path
from .._core.execution import Execution
from .._core.pieces.run import DaskClient
from .._core.progress import working
from ..engine.settings import EXPERIMENT
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.placed import SectionsLike
from ..systems.output import OutputNames
from .campaign import CHUNK, DesignLike, Options, prepare
from .data import ExperimentData
from .noise import ProcessNoise
from .plan import Accuracy
from .start import StartName
from .stored import StoredExperiments, store_experiments


@checked
@working("run_experiments")
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    start: StartName = "cycle",
    discard: Index | None = None,
    process_noise: ProcessNoise | None = None,
    accuracy: Accuracy = EXPERIMENT,
    execution: Execution | None = None,
) -> ExperimentData:
    """Excite the system around its limit cycle and record its outputs at the sections.

    All experiments of a batch run side by side in one compiled call, and batches on all cores.
    An experiment that fails (a section missed, events in another order, ...) stops there; the
    others go on. `hj.experiments.stream_experiments` runs experiments whose records do not fit into
    memory.

    **Arguments:**

    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are held from section to section. n must be a
        whole number of periods. All periods after the discarded ones are for estimation.
    - `outputs`: names or `Output`s, recorded at each section before the new input acts.
    - `start`: initial condition. "cycle" is a state on the limit cycle. "periodic" is a state on
        the periodic response that the linearization predicts, which leaves a transient of second
        order in the inputs. "steady" is a state on the periodic response itself, found by Newton's
        method, without a transient. Default: "cycle".
    - `discard`: number of cycles before the design's periods that are not for estimation. Default:
        20 from the cycle (as in the paper), 0 from a periodic or steady start.
    - `process_noise`: a random input beside the excitation, which is not recorded.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to their sizes (`LimitCycle.scale`). `data.error` estimates the
        error of each experiment. Default: 1e-9.
    - `execution`: batches and threads.

    **Returns:** `ExperimentData`. `data.summary()` lists failures with their causes.

    **Raises:** `DefinitionError` for arguments that do not fit together; `ComputationError` for an
    unstable cycle, from which any experiment would run away, and if a steady start is not found.
    """
    options = Options(start, discard, process_noise, accuracy, execution)
    return prepare(cycle, sections, design, outputs, options).run()


@checked
def stream_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    options: Options = Options(),  # noqa: B008 (immutable)
    *,
    chunk: ExperimentCount = CHUNK,
    store: Path | None = None,
    client: DaskClient | None = None,
) -> Iterator[ExperimentData] | StoredExperiments:
    """Run experiments chunk by chunk, in memory that does not depend on their number.

    ```python
    chunks = hj.experiments.stream_experiments(cycle, sections, design, "yM")
    estimate = hj.estimate_htf(chunks)
    ```

    Without a `store`, each chunk is run when the iterator gets to it. With one, all chunks are run
    and kept. Experiments that are in the store already are not run again: after an interruption,
    repeat the call. The records are the same to the last bit for any number of processes and
    interruptions, on machines of one kind. For this, all of them wait for the optimized program
    (10 s, once).

    **Arguments:** those of `run_experiments`, with its keyword arguments as one object, and

    - `options`: for example `hj.experiments.Options(start="periodic")`. Default: its defaults.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`).
    - `chunk`: number of experiments per chunk. Default: 640.
    - `store`: a folder, or an address for fsspec ("s3://bucket/records.zarr"), of a Zarr group. It
        holds the experiments of one call only.
    - `client`: a `distributed.Client`, whose workers fill the store. Each of them gets the
        `design`, so pass a `Design` or a small array.

    **Returns:** an iterator over `ExperimentData` of consecutive experiments, or with a store
    `StoredExperiments`.

    **Raises:** as `run_experiments`, for arguments that do not fit together at once;
    `DefinitionError` if the store holds other experiments (with the difference) or cannot be
    written, or if the workers of the client cannot run them; `ComputationError` if the cluster is
    lost.
    """
    if store is not None:
        arguments = cycle, sections, design, outputs
        with working("stream_experiments"):
            return store_experiments(arguments, options, chunk, store, client)
    if client is not None:
        raise DefinitionError("a `client` needs a `store` to put records into.")
    campaign = prepare(cycle, sections, design, outputs, options, chunk)
    S = len(campaign.inputs)
    return (campaign.run(slice(k, min(k + chunk, S))) for k in range(0, S, chunk))
