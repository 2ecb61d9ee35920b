"""The next experiment as a table, for hardware that plays one, and back."""

import csv
from pathlib import Path

import numpy as np

from .._core.arguments import require_equal
from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath, PeriodCount, Positive
from .._core.writing import replacing
from ..errors import DefinitionError, FileFormatError
from ..experiments.design.design import Design
from .formats.columns import Wanted
from .phase import Phase
from .read import read_tables
from .recording import Recording


_BY_PHASE = ("experiment", "cycle", "section", "phase")


@checked
def write_design(
    path: FilePath,
    design: Design,
    *,
    cycles: PeriodCount | None = None,
    period: Positive | None = None,
    rate: Positive | None = None,
) -> None:
    """Write the inputs of a design to a CSV file.

    - Without `period`, for hardware that triggers on phase: a row for each section, with the
      columns `experiment`, `cycle`, `section`, `phase` and the inputs, which are held until the
      next section (zero-order hold).
    - With `period` and `rate`, for other hardware: a row for each sample, with `experiment`, `time`
      and the inputs.

    **Arguments:** `cycles`: cycles of each experiment. Default: its periods P. `period`: period of
    the cycle in seconds. `rate`: samples per second.

    **Raises:** `DefinitionError` for a period without a rate, a rate with less than one sample for
    each section, and a file that cannot be written.
    """
    if (period is None) != (rate is None):
        raise DefinitionError(
            "a table against time needs both the period and the rate."
        )
    u = np.asarray(design.signals(cycles or design.periods))
    n = u.shape[1]
    N = design.n_sections
    if period is None or rate is None:
        header = _BY_PHASE
        cycle, section = np.divmod(np.arange(n), N)
        place = np.stack([cycle, section, section / N], axis=1)
    elif period * rate < N:
        raise DefinitionError(
            f"`rate` must be {N / period:g} or more: a sample for each section."
        )
    else:
        header = ("experiment", "time")
        rounding = 1e-6
        time = np.arange(np.ceil(n / N * period * rate - rounding)) / rate
        held = (time * N / period + 1e-9).astype(int)
        u = u[:, np.minimum(held, n - 1)]
        place = time[:, None]
    with (
        replacing(Path(path)) as new,
        open(new, "w", newline="", encoding="utf-8") as file,
    ):
        table = csv.writer(file)
        table.writerow([*header, *design.inputs])
        for experiment, inputs in enumerate(u):
            for row in np.concatenate([place, inputs], axis=1):
                table.writerow([experiment, *(f"{x:.10g}" for x in row)])


@checked
def attach_design(recording: Recording, phase: Phase, path: FilePath) -> Recording:
    """Add the commanded inputs of hardware to a recording in which they were not measured.

    Experiment s was applied in trial s, from the first whole cycle on, and each value held from its
    section to the next. Sample such inputs in the middle: `sample_sections(..., sampled="middle")`.

    **Arguments:** `path`: a table by phase that `write_design` wrote.

    **Raises:** `FileFormatError` if the file is no table by phase, or has experiments of different
    lengths; `DefinitionError` if the numbers of trials and experiments differ, or the recording has
    a signal of the same name.
    """
    columns = read_tables(Path(path), Wanted("time"))[0].values
    if not set(_BY_PHASE) <= set(columns):
        raise FileFormatError(
            f"'{path}' must be a table by phase: leave out `period` and `rate`."
        )
    experiment = columns["experiment"]
    N = int(columns["section"].max()) + 1
    _, counts = np.unique(experiment, return_counts=True)
    if (counts != counts[0]).any() or (np.diff(experiment) < 0).any():
        raise FileFormatError(
            f"'{path}' must have experiments of one length, in order."
        )
    require_equal(
        "recording and table", "numbers of trials", len(recording.trials), len(counts)
    )
    names = [name for name in columns if name not in _BY_PHASE]
    command = np.stack(
        [columns[name].reshape(len(counts), -1) for name in names], axis=2
    )
    # Zero before and after the experiment.
    command = np.pad(command, ((0, 0), (1, 1), (0, 0)))
    trials = []
    for s, (trial, stretches) in enumerate(phase.by_trial(recording)):
        added = np.full((len(trial.time), len(names)), np.nan)
        if stretches:
            first = stretches[0]
            now = first.at(trial.time)
            during = np.isfinite(now)
            section = np.floor((now[during] - np.ceil(first.phase[0])) * N).astype(int)
            added[during] = command[s, np.clip(section + 1, 0, command.shape[1] - 1)]
        signals = dict(zip(names, added.T, strict=True))
        commanded = Recording(trial.time, signals, name=trial.name)
        measured = recording.with_trials([trial])
        trials.append(Recording.beside([measured, commanded]))
    return Recording.join(trials)
