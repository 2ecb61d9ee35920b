"""Batched experiments on a hybrid system around its limit cycle (paper Sec. V)."""

from collections.abc import Iterator
from typing import Unpack, overload

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Index, Path
from .._core.pieces.place import check_share
from .._core.pieces.run import DaskClient
from .._core.progress import working
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.placed import SectionsLike
from ..systems.output import OutputNames
from .campaign import chunks, prepare
from .data import ExperimentData
from .inputs import DesignLike
from .options import CHUNK, OptionsByName, options_of
from .stored.pieces import prepare_pieces
from .stored.store import StoredExperiments, store_experiments


@overload
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    store: None = None,
    **options: Unpack[OptionsByName],
) -> ExperimentData: ...


@overload
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    store: Path,
    chunk: ExperimentCount = CHUNK,
    client: DaskClient | None = None,
    share: tuple[Index, ExperimentCount] = (0, 1),
    **options: Unpack[OptionsByName],
) -> StoredExperiments: ...


@checked
@working("run_experiments")
def run_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    store: Path | None = None,
    chunk: ExperimentCount = CHUNK,
    client: DaskClient | None = None,
    share: tuple[Index, ExperimentCount] = (0, 1),
    **options: Unpack[OptionsByName],
) -> ExperimentData | StoredExperiments:
    """Excite the system around its limit cycle and record its outputs at the sections.

    All experiments of a batch run side by side in one compiled call, and batches on all cores.
    An experiment that fails (a section missed, events in another order, ...) stops there; the
    others go on. Where the records of all experiments are too many for memory, keep them in a
    `store`, or use `stream_experiments`.

    In a store, experiments that are there already are not run again: after an interruption, make
    the same call. The records are the same to the last bit for any number of processes and
    interruptions, on machines of one kind; so all wait for the program that is compiled thoroughly
    (10 s, once).

    **Arguments:**

    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are held from section to section, with n a
        whole number of periods; all that are not discarded are then for estimation.
    - `outputs`: names or `Output`s, recorded at each section before the new input acts.
    - `start`: "cycle", the default, starts on the limit cycle, "periodic" in the periodic response
        that the linearization predicts, which leaves a transient of second order in the inputs, and
        "steady" in the periodic response itself, found by Newton's method, with none.
    - `discard`: cycles that come before the design's periods and are meant to be discarded. By
        default 20 from the cycle (the paper's) and 0 from a periodic start.
    - `process_noise`: a random input beside the excitation, which is not recorded.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to their sizes (`LimitCycle.scale`). By default 1e-9, and 1e-4 in
        single precision. `data.error` is each experiment's own estimate.
    - `record_events`: whether to record when events happen, as `data.events`.
    - `execution`: batches, threads, precision.
    - `store`: a folder, or an address that fsspec knows ("s3://bucket/records.zarr"), for a Zarr
        group. It holds the experiments of one call only.
    - `chunk`: of a store, the experiments in one piece.
    - `client`: a `distributed.Client`, whose workers fill the store. Each gets the `design`: let
        that be a `Design`, or small.
    - `share`: `(rank, size)` where several processes without a client fill one store: this one does
        the pieces rank, rank + size, ...; those above 0 wait until the first has begun the store.

    **Returns:** `ExperimentData`, or with a store `StoredExperiments`. `data.summary()` names what
    failed and why.

    **Raises:** `DefinitionError` for arguments that do not fit together, for an accuracy that
    single precision cannot give, if the store holds other experiments (with the difference) or
    cannot be written, or for a client whose workers cannot do it; `ComputationError` for an
    unstable cycle, from which any experiment would run away, where a steady start is not found, and
    if the cluster is lost; `TypeError` for an argument that does not exist.
    """
    chosen = options_of(run_experiments, options)
    check_share(share)
    if store is not None:
        job = prepare_pieces(cycle, sections, design, outputs, chosen, chunk)
        return store_experiments(store, job, client, share)
    if client is not None or share != (0, 1):
        raise DefinitionError("a `client` or a `share` needs a `store` to put records into.")
    return prepare(cycle, sections, design, outputs, chosen).run()


@checked
def stream_experiments(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    chunk: ExperimentCount = CHUNK,
    **options: Unpack[OptionsByName],
) -> Iterator[ExperimentData]:
    """Run experiments chunk by chunk, in memory that does not depend on their number.

    `estimate_htf(stream_experiments(...))` never holds more than one chunk of inputs and records.

    **Arguments:** as for `run_experiments`, and

    - `chunk`: the number of experiments that are run, and given out, together.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`).

    **Returns:** an iterator over `ExperimentData` of consecutive experiments; each chunk is run
    when it is asked for.

    **Raises:** as `run_experiments`; for arguments that do not fit together at once; `TypeError`
    for an argument that does not exist.
    """
    chosen = options_of(stream_experiments, options)
    campaign = prepare(cycle, sections, design, outputs, chosen, chunk)
    parts = chunks(len(campaign.inputs), chunk)
    return map(campaign.run, parts)
