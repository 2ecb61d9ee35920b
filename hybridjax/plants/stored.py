"""Data of experiments on a plant, and a file from which they continue."""

import contextlib
import json
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from .._core.results import Result
from ..errors import DefinitionError
from ..experiments.data import ExperimentData, Simulated
from ..experiments.run import Inputs
from .drive import Trial


def collect(cycle: Any, inputs: Inputs, trials: Sequence[Trial]) -> ExperimentData:
    """Return the data of all experiments."""
    u, N = inputs.part(slice(0, len(inputs))), cycle.n_sections
    S, n, _ = u.shape
    y, late = np.full((S, n, len(cycle.outputs)), np.nan), np.full((S, n), np.nan)
    failed_at, result = np.full(S, -1), np.full(S, int(Result.OK))
    for s, trial in enumerate(trials):
        k = len(trial.late)
        if k:
            y[s, :k] = trial.y - cycle.cycle_outputs[np.arange(k) % N]
        late[s, :k] = trial.late
        if trial.cause:
            failed_at[s] = k
            result[s] = Result.SECTION_MISSED if trial.missed else Result.PLANT_STOPPED
    causes = tuple(x.cause for x in trials)
    return ExperimentData(
        u,
        y,
        n_sections=N,
        periods=inputs.periods,
        inputs=cycle.inputs,
        outputs=cycle.outputs,
        result=result,
        simulated=Simulated(failed_at, None, cycle.sections.label, late, causes),
        cycle_outputs=cycle.cycle_outputs,
    )


def resume(
    file: Any, about: str, count: int, run: Callable[[list[int]], Iterator[Trial]]
) -> list[Trial]:
    """Run the experiments that a file of JSON lines lacks, and append each as it ends.

    **Raises:** `DefinitionError` if the first line of the file is not `about`.
    """
    path, trials = pathlib.Path(file), {}
    lines = path.read_text(errors="replace").splitlines() if path.exists() else []
    if lines and lines[0] != about:
        raise DefinitionError(f"'{file}' holds other results: give another file, or delete it.")
    for line in lines[1:]:
        with contextlib.suppress(ValueError):  # (an interrupted line)
            s, *trial = json.loads(line)
            trials[s] = Trial(*trial)
    missing = [s for s in range(count) if s not in trials]
    with path.open("a") as stream:
        print("" if lines else about, file=stream, flush=True)
        for s, done in zip(missing, run(missing), strict=True):
            trials[s] = done
            print(json.dumps([s, *done]), file=stream, flush=True)
    return [trials[s] for s in range(count)]
