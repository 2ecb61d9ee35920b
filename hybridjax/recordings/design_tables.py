"""The next experiment as a table, for hardware that plays one, and back."""

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers
from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount, Positive, SectionCount
from .._core.boundary.values import Reals
from .._core.writing import replacing
from ..errors import DefinitionError, FileFormatError
from ..experiments.design.design import Design
from .formats.columns import Wanted
from .phase.winding import Phase
from .read import read_tables
from .recording import Recording


# Rounding of times, in sections, where a held value changes. Doubled: nothing changes.
_ROUNDING = 1e-9


@checked
def write_design(
    path: str | os.PathLike,
    design: Design,
    *,
    cycles: PeriodCount | None = None,
    period: Positive | None = None,
    rate: Positive | None = None,
) -> None:
    """Write the inputs of a design to a CSV file.

    - Without `period`, for hardware that triggers on phase: a row for each section, with the
      columns `experiment`, `cycle`, `section`, `phase` and the inputs, which are held until the
      next section. `read_design` reads it.
    - With `period` and `rate`, for hardware that does not: a row for each sample, with
      `experiment`, `time` and the inputs.

    **Arguments:** `cycles` of each experiment, by default its periods P; `period` of the cycle in
    seconds and `rate` in samples per second.

    **Raises:** `DefinitionError` for a period without a rate, and a file that cannot be written.
    """
    if (period is None) != (rate is None):
        raise DefinitionError("a table against time needs both the period and the rate.")
    u = np.asarray(design.inputs(cycles or design.periods))
    S, n, _ = u.shape
    N = design.n_sections
    if period is None or rate is None:
        header = ["experiment", "cycle", "section", "phase"]
        k = np.arange(n)
        place = np.stack([k // N, k % N, (k % N) / N], axis=1)
    else:
        header = ["experiment", "time"]
        time = np.arange(int(n / N * period * rate)) / rate
        u = u[:, np.minimum((time * N / period + _ROUNDING).astype(int), n - 1)]
        place = time[:, None]
    with replacing(Path(path)) as new, open(new, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*header, *design.input_names])
        for s in range(S):
            for row in np.concatenate([place, u[s]], axis=1):
                table.writerow([s, *(f"{x:.10g}" for x in row)])


@checked
def read_design(path: str | os.PathLike) -> dict[str, Float[np.ndarray, "S n"]]:
    """The inputs by name, for each experiment and section, from a table of `write_design`.

    **Raises:** `FileFormatError` if it is no such table, or has experiments of different lengths.
    """
    columns = read_tables(Path(path), Wanted("time"))[0].values
    needed = ("experiment", "cycle", "section", "phase")
    if not set(needed) <= set(columns):
        raise FileFormatError(f"'{path}' has no columns {', '.join(needed)}: no table by phase.")
    experiment = columns["experiment"]
    count = np.unique(experiment, return_counts=True)[1]
    if (count != count[0]).any() or (np.diff(experiment) < 0).any():
        raise FileFormatError(f"'{path}' has experiments of different lengths, or out of order.")
    return {k: v.reshape(len(count), -1) for k, v in columns.items() if k not in needed}


@checked
def add_command(
    recording: Recording,
    phase: Phase,
    command: Mapping[str, Annotated[Numbers, Reals("S n")]],
    n_sections: SectionCount,
) -> Recording:
    """A recording with what hardware was told to apply, where that was not measured itself.

    Experiment s was applied in trial s, from the first whole cycle on, and each value held from its
    section to the next. Sample such inputs in the middle: `section_data(..., sampled="middle")`.

    **Arguments:** `command`: as `read_design` gives it. `n_sections`: N of the design.

    **Raises:** `DefinitionError` if the numbers of trials and experiments differ, or names are
    taken.
    """
    trials = []
    for name, values in command.items():
        if name in recording.signals:
            raise DefinitionError(f"the recording has a signal '{name}' already.")
        if len(values) != len(recording.trials):
            raise DefinitionError(
                f"there are {len(recording.trials)} trials, but the table has {len(values)} "
                "experiments."
            )
    for s, (trial, stretches) in enumerate(zip(recording.trials, phase.stretches, strict=True)):
        added = np.full((len(trial.time), len(command)), np.nan)
        if stretches:
            winding = stretches[0]
            inside = (trial.time >= winding.time[0]) & (trial.time <= winding.time[-1])
            now = np.interp(trial.time[inside], winding.time, winding.phase)
            k = np.floor((now - np.ceil(winding.phase[0])) * n_sections).astype(int)
            for i, values in enumerate(command.values()):
                row = np.pad(values[s], (1, 1), constant_values=0.0)  # nothing before and after
                added[inside, i] = row[np.clip(k + 1, 0, len(row) - 1)]
        signals = dict(zip(recording.signals, trial.values.T, strict=True))
        signals |= dict(zip(command, added.T, strict=True))
        units = dict(zip(recording.signals, recording.units, strict=True))
        trials.append(
            Recording(
                trial.time,
                signals,
                events=trial.events,
                units=units,
                name=trial.name,
                notes=recording.notes,
            )
        )
    return Recording.join(trials)
