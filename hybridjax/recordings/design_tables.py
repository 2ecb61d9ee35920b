"""`attach_design`: add the inputs that hardware played to a recording in which they were not
measured.

They are read from the CSV table of the design (`Design.write`), and placed by the phase of the
recording. The order must stay: experiment s belongs to trial s, and its first row to section 0 of
the first whole cycle.

If a command is shifted by sections or cycles, look at `first_whole`, and at the rows of zeros
before and after each experiment. A command is NaN outside of the first stretch of a trial's phase,
and so after a long gap, too.
"""

from pathlib import Path

import numpy as np

from .._core.arguments import require_equal
from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath
from .._core.findings import Finding
from ..errors import FileFormatError
from ..experiments.design.tables import BY_PHASE
from .formats.columns import Wanted
from .phase import Phase, Winding
from .read import RecordingLike, as_recording, read_tables
from .recording import Recording, Trial


@checked
def attach_design(recording: RecordingLike, phase: Phase, path: FilePath) -> Recording:
    """Add the commanded inputs of hardware to a recording in which they were not measured.

    Experiment s was applied in trial s, from the first whole cycle on, and each value held from its
    section to the next. Sample such inputs in the middle: `sample_sections(..., sampled="middle")`.

    **Arguments:**

    - `recording`: the recording, one trial per experiment, in the order of the table; or the path
      of its file, or a table (`hj.Recording.from_frame`).
    - `phase`: result of `estimate_phase` for this recording.
    - `path`: a table by phase that `Design.write` wrote.

    **Returns:** `hj.Recording` with the same trials and the commanded inputs as further signals, in
    the units of the design. The command is NaN after an interruption of
    the phase (a long gap, a missed event), with a finding.

    **Raises:** `FileFormatError` if the file is no table by phase, or has experiments of different
    lengths; `DefinitionError` if the numbers of trials and experiments differ, or the recording has
    a signal of the same name.

    **Example:**

    ```python
    command = hj.multisine(8, 16, frequencies=(0, 0.5), inputs="command")
    command.write("design.csv", cycles=48)
    phase = hj.recordings.estimate_phase(recording, apex)
    both = hj.recordings.attach_design(recording, phase, "design.csv")
    ```

    **Before:** `design.write`, `hj.recordings.estimate_phase`. **After:**
    `hj.recordings.sample_sections`.
    """
    recording = as_recording(recording)
    columns = read_tables(Path(path), Wanted("time"))[0].values
    if not set(BY_PHASE) <= set(columns):
        raise FileFormatError(
            f"'{path}' must be a table by phase: leave out `period` and `rate`."
        )
    experiment = columns["experiment"]
    N = int(columns["section"].max()) + 1
    _, counts = np.unique(experiment, return_counts=True)
    falls = (np.diff(experiment) < 0).any()
    if (counts != counts[0]).any() or falls:
        raise FileFormatError(
            f"'{path}' must have experiments of one length, in order."
        )
    require_equal(
        "recording and table", "numbers of trials", len(recording.trials), len(counts)
    )
    names = [name for name in columns if name not in BY_PHASE]
    command = np.stack(
        [columns[name].reshape(len(counts), -1) for name in names], axis=2
    )
    # Zero before and after the experiment.
    command = np.pad(command, ((0, 0), (1, 1), (0, 0)))
    trials = []
    for s, (trial, stretches) in enumerate(phase.by_trial(recording)):
        added = np.full((len(trial.time), len(names)), np.nan)
        findings = []
        if stretches:
            first = stretches[0]
            # (After the last section of a trial, up to a cycle is unknown.)
            cycle = np.ptp(first.time) / np.ptp(first.phase)
            if trial.time[-1] - first.time[-1] > cycle:
                findings.append(_after_end(trial, first))
            now = first.at(trial.time)
            during = np.isfinite(now)
            first_whole = np.ceil(first.phase[0])
            section = np.floor((now[during] - first_whole) * N).astype(int)
            last = command.shape[1] - 1
            added[during] = command[s, np.clip(section + 1, 0, last)]
        signals = dict(zip(names, added.T, strict=True))
        commanded = Recording(trial.time, signals, name=trial.name, findings=findings)
        measured = recording.with_trials([trial])
        trials.append(Recording.beside([measured, commanded]))
    return Recording.join(trials)


def _after_end(trial: Trial, stretch: Winding) -> Finding:
    """Return the finding about the samples of a trial after its first stretch."""
    stop = stretch.time[-1]
    count = int((trial.time > stop).sum())
    text = (
        f"trial '{trial.name}': the command is unknown in {count} samples after {stop:.6g} s, "
        "where its phase is interrupted or ends, as cycles are not counted from there on."
    )
    return Finding("command unknown", text, "left out")
