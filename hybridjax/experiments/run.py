"""Batched experiments on a hybrid system around its limit cycle (paper Sec. V)."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Array, Float

from ..orbits.cycle import LimitCycle
from ..systems.output import Output
from .campaign import chunks, prepare
from .data import ExperimentData
from .design.design import Design
from .variation import vary


# Experiments in one part of a stream.
CHUNK = 640


def run_experiments(
    cycle: LimitCycle,
    sections,
    design: Design | Float[np.ndarray, "S n nu"] | Float[Array, "S n nu"],
    outputs: Sequence[str | Output] | str | Output,
    *,
    start: str = "cycle",
    discard: int | None = None,
    periods: int | None = None,
    process_noise: float = 0.0,
    seed: int = 0,
    accuracy: float | None = None,
    scale: Mapping[str, float] | None = None,
    precision: str = "double",
    batch: int | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> ExperimentData:
    """Excite the system around its limit cycle and record its outputs at the sections.

    All experiments of a batch run side by side in one compiled call, and batches on all cores.
    An experiment that fails (a section missed, events in another order, ...) stops there; the
    others go on. Where the records of all experiments are too many for memory, use
    `stream_experiments` or `store_experiments`.

    **Arguments:**

    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are held from section to section, with n a
        whole number of periods; then `periods` says how many of the last ones are for estimation
        (by default all that are not discarded).
    - `outputs`: names or `Output`s, recorded at each section before the new input acts.
    - `start`: "cycle" starts on the limit cycle, "periodic" in the periodic response that the
        linearization predicts, so that there is almost no transient, and "steady" in the periodic
        response itself, found by Newton's method, with none.
    - `discard`: cycles that come before the design's periods and are meant to be discarded. By
        default 20 from the cycle (the paper's) and 0 from a periodic start.
    - `process_noise`: standard deviation of a random input, held from section to section, that
        acts beside the excitation and is not recorded. `seed`: of it.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to `scale`. By default 1e-9, and 1e-4 in single precision.
        `data.error` is each experiment's own estimate.
    - `scale`: sizes of states by name (of time as `t`); by default the largest on the cycle.
    - `precision`: "double" or "single". Single precision computes the experiments in 32 bits, the
        cycle, the sections and the plan remain in 64. What rounding costs is measured on the
        cycle and is part of `data.error`.
    - `batch`: experiments per compiled call, by default what is fastest. Another size compiles
        another program.
    - `workers`: threads that run batches at the same time; by default all cores on CPU, and one
        on an accelerator.
    - `progress`: show a progress bar over the batches.

    **Returns:** `ExperimentData`. `data.summary()` names what failed and why.

    **Raises:** `DefinitionError` for arguments that do not fit together, or for an accuracy that
    single precision cannot give; `ComputationError` for an unstable cycle, from which any
    experiment would run away.
    """
    campaign = _prepare(
        cycle, sections, design, outputs, start=start, discard=discard, periods=periods,
        process_noise=process_noise, seed=seed, accuracy=accuracy, scale=scale,
        precision=precision, batch=batch, workers=workers,
    )  # fmt: skip
    return campaign.run(slice(0, campaign.count), progress)


def stream_experiments(
    cycle: LimitCycle,
    sections,
    design: Design | Float[np.ndarray, "S n nu"] | Float[Array, "S n nu"],
    outputs: Sequence[str | Output] | str | Output,
    *,
    chunk: int = CHUNK,
    batch: int | None = None,
    workers: int | None = None,
    **options,
) -> Iterator[ExperimentData]:
    """Run experiments chunk by chunk, in memory that does not depend on their number.

    `estimate_htf(stream_experiments(...))` never holds more than one chunk of inputs and records.

    **Arguments:** as for `run_experiments`, and

    - `chunk`: the number of experiments that are run, and given out, together.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`).

    **Returns:** an iterator over `ExperimentData` of consecutive experiments; each chunk is run
    when it is asked for.

    **Raises:** as `run_experiments`, at once.
    """
    about = dict(chunk=chunk, batch=batch, workers=workers)
    campaign = _prepare(cycle, sections, design, outputs, **about, **options)
    return map(campaign.run, chunks(campaign.count, chunk))


def _prepare(*arguments, start="cycle", process_noise=0.0, seed=0, **options):
    """`prepare`, and what is done beside it."""
    steady = start == "steady"
    start = "periodic" if steady else start
    return vary(prepare(*arguments, start=start, **options), steady, process_noise, seed)
