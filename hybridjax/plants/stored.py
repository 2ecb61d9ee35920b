"""Data of experiments on a plant, in memory or in a store."""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from .._core.pieces.description import digest_of
from .._core.pieces.run import fill
from .._core.pieces.store import Blocks, Layout, Variable
from .._core.progress import counted
from .._core.results import Result
from ..experiments.data import ExperimentData, Simulated
from ..experiments.run import Inputs
from ..experiments.stored import StoredExperiments, layout_of
from .drive import Trial
from .processes import Workers


def collect(cycle: Any, inputs: Inputs, trials: Iterable[Trial], first: int = 0) -> ExperimentData:
    """Return the data of consecutive experiments, the first of which is number `first`."""
    trials = list(trials)
    u, N = inputs.part(slice(first, first + len(trials))), cycle.n_sections
    n, ny = u.shape[1], len(cycle.outputs)
    y, late = np.full((len(trials), n, ny), np.nan), np.full((len(trials), n), np.nan)
    failed_at = np.full(len(trials), -1)
    result = np.full(len(trials), int(Result.OK))
    for s, trial in enumerate(trials):
        k = len(trial.late)
        y[s, :k] = np.reshape(trial.y, (k, ny)) - cycle.cycle_outputs[np.arange(k) % N]
        late[s, :k] = trial.late
        if trial.cause:
            failed_at[s] = k
            result[s] = Result.SECTION_MISSED if trial.missed else Result.PLANT_STOPPED
    return ExperimentData(
        u,
        y,
        n_sections=N,
        periods=inputs.periods,
        inputs=cycle.inputs,
        outputs=cycle.outputs,
        result=result,
        simulated=Simulated(
            failed_at, None, cycle.sections.label, late, tuple(x.cause for x in trials)
        ),
        cycle_outputs=cycle.cycle_outputs,
    )


@dataclasses.dataclass(frozen=True)
class PlantJob:
    """Experiments of `inputs` around a `cycle`, run by `workers` in pieces of eight."""

    cycle: Any
    inputs: Inputs
    workers: Workers

    @property
    def blocks(self) -> Blocks:
        return Blocks((len(self.inputs),), (min(8, len(self.inputs)),))

    def trials(self, rows: slice) -> Iterator[Trial]:
        """Run consecutive experiments."""
        first = self.cycle.seed + 1 + rows.start
        u = self.inputs.part(rows)
        items = ((first + s, x.tolist()) for s, x in enumerate(u))
        yield from counted(self.workers.run(items), "experiments", len(u))

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """Return the records of piece k."""
        (rows,) = self.blocks.slices(k)
        data: Any = collect(self.cycle, self.inputs, self.trials(rows), rows.start)
        causes = np.zeros((len(data.u), 200), np.int32)  # (longer ones are cut off)
        for s, cause in enumerate(data.simulated.causes):
            codes = [ord(x) for x in cause[:200]]
            causes[s, : len(codes)] = codes
        return {
            "u": data.u, "y": data.y, "result": data.result, "failed_at": data.failed_at,
            "error": data.error, "late": data.simulated.late, "cause": causes,
        }  # fmt: skip

    def begin(self) -> tuple["PlantJob", Layout]:
        """Return the job, and the form of its records."""
        cycle = self.cycle
        n = self.inputs.cycles * cycle.n_sections
        layout = layout_of(
            self.blocks, n, cycle.inputs, cycle.outputs, cycle.cycle_outputs, self.description
        )
        layout.variables.update(  # type: ignore[attr-defined]
            late=Variable("<f8", ("sample",), (n,)),
            cause=Variable("<i4", ("character",), (200,)),
        )
        return self, layout

    def arrays(self) -> list[np.ndarray]:
        """Return what the records depend on and another process would measure anew."""
        return [self.cycle.cycle_outputs]

    def resume(self, layout: Layout, arrays: list[np.ndarray]) -> "PlantJob":
        """Return the job with the cycle of another process."""
        cycle = dataclasses.replace(self.cycle, cycle_outputs=arrays[0])
        return dataclasses.replace(self, cycle=cycle)

    @property
    def description(self) -> dict[str, Any]:
        """JSON from which the experiments can be told from others. A plant is described by the
        cycle that was measured."""
        cycle, inputs = self.cycle, self.inputs
        return {
            "kind": "experiments",
            "plant": type(cycle.plant).__name__,
            "cycle": [f"{x:.6g}" for x in (cycle.period, *np.ravel(cycle.cycle_outputs))],
            "family": digest_of(cycle.sections),
            "inputs": digest_of(inputs.part(slice(0, len(inputs)))),
            "seed": cycle.seed,
            "cycles": inputs.cycles,
            "data": {
                "n_sections": cycle.n_sections,
                "periods": inputs.periods,
                "inputs": [[str(x), x.unit] for x in cycle.inputs],
                "outputs": [[str(x), x.unit] for x in cycle.outputs],
                "label": cycle.sections.label,
            },
        }


def restore(job: PlantJob, address: Any) -> ExperimentData:
    """Run the experiments that a store lacks, and return all of them."""
    store = fill(job, address)
    stored = StoredExperiments(address)
    x: Any = {name: store.array(name) for name in store.layout.variables}
    causes = ("".join(chr(c) for c in row if c > 0) for row in x["cause"])
    return ExperimentData(
        x["u"],
        x["y"],
        n_sections=stored.n_sections,
        periods=job.inputs.periods,
        inputs=job.cycle.inputs,
        outputs=job.cycle.outputs,
        result=x["result"],
        simulated=Simulated(
            x["failed_at"],
            None,
            job.cycle.sections.label,
            x["late"],
            tuple(causes),
        ),
        cycle_outputs=store.array("cycle_outputs"),
    )
