"""Batched experiments on a hybrid system around its limit cycle (paper Sec. V)."""

from collections.abc import Iterator
from typing import Unpack

from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Index
from .._core.execution import Execution
from .._core.progress import working
from ..maps.placed import SectionsLike
from ..orbits.cycle import LimitCycle
from ..systems.output import OutputNames
from .campaign import chunks, prepare
from .data import ExperimentData
from .inputs import DesignLike
from .noise import ProcessNoise
from .options import Options, OptionsByName, StartName, options_of
from .stepping.plan import Accuracy


# Experiments in one part of a stream. Twice as many need twice the memory.
CHUNK = 640


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
    accuracy: Accuracy | None = None,
    record_events: bool = False,
    execution: Execution | None = None,
) -> ExperimentData:
    """Excite the system around its limit cycle and record its outputs at the sections.

    All experiments of a batch run side by side in one compiled call, and batches on all cores.
    An experiment that fails (a section missed, events in another order, ...) stops there; the
    others go on. Where the records of all experiments are too many for memory, use
    `stream_experiments` or `store_experiments`.

    **Arguments:**

    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are held from section to section, with n a
        whole number of periods; all that are not discarded are then for estimation.
    - `outputs`: names or `Output`s, recorded at each section before the new input acts.
    - `start`: "cycle" starts on the limit cycle, "periodic" in the periodic response that the
        linearization predicts, which leaves a transient of second order in the inputs, and "steady"
        in the periodic response itself, found by Newton's method, with none.
    - `discard`: cycles that come before the design's periods and are meant to be discarded. By
        default 20 from the cycle (the paper's) and 0 from a periodic start.
    - `process_noise`: a random input beside the excitation, which is not recorded.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to their sizes (`LimitCycle.scale`). By default 1e-9, and 1e-4 in
        single precision. `data.error` is each experiment's own estimate.
    - `record_events`: whether to record when events happen, as `data.events`.
    - `execution`: batches, threads, precision.

    **Returns:** `ExperimentData`. `data.summary()` names what failed and why.

    **Raises:** `DefinitionError` for arguments that do not fit together, or for an accuracy that
    single precision cannot give; `ComputationError` for an unstable cycle, from which any
    experiment would run away, and where a steady start is not found.
    """
    options = Options(start, discard, process_noise, accuracy, record_events, execution)
    campaign = prepare(cycle, sections, design, outputs, options)
    return campaign.run()


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
