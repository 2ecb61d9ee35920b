"""Slow changes of signals that are no response to the inputs."""

from typing import Annotated

import equinox as eqx
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive, SignalNames
from .._core.boundary.values import Number
from ..errors import DefinitionError
from .phase.winding import Phase
from .recording import Recording, Trial
from .smoothing import FEWEST, gaps, inside, means, spline
from .spikes import without_spikes


# The longest gap, in cycles, in a cycle whose mean is known. Doubled: means of cycles with half of
# their samples count.
_LONGEST_GAP = 0.25
# The least number of cycles that drift takes. Doubled: faster drift is refused.
_FASTEST_DRIFT = 4


DriftCycles = Annotated[float, Number("a positive number of cycles", above=0, infinite=True)]
"""Slower than in so many cycles; infinite: a constant."""


def check_drift(cycles: int | float) -> None:
    """**Raises:** `DefinitionError` for a drift that is too fast to be told from responses."""
    if not cycles >= _FASTEST_DRIFT:
        raise DefinitionError(f"drift takes {_FASTEST_DRIFT} cycles or more, not {cycles:g}.")


@checked
def without_drift(
    recording: Recording, phase: Phase, signals: SignalNames, cycles: Positive
) -> Recording:
    """A recording without the slow drift of some signals, such as that of sensors.

    The means of a signal over each cycle are smoothed by a spline, which passes one half of changes
    that take twice as many `cycles`, and subtracted; the mean of all stays. A phase that was found
    from drifting signals is good enough; estimate it again from the result.

    **Raises:** `DefinitionError` for signals that are not there, fewer than four cycles, or a phase
    of other trials.
    """
    columns = [recording.column(x) for x in signals]
    check_drift(cycles)
    if len(phase.stretches) != len(recording.trials):
        raise DefinitionError(
            f"the phase is of {len(phase.stretches)} trials, the recording has "
            f"{len(recording.trials)}."
        )
    trials = []
    for trial, stretches in zip(recording.trials, phase.stretches, strict=True):
        values = trial.values.copy()
        whole = [w.when(np.arange(np.ceil(w.phase[0]), w.phase[-1])) for w in stretches]
        for k in columns:
            x = without_spikes(values[:, k])
            holes = gaps(trial.time, np.isfinite(x), _LONGEST_GAP * phase.period)
            middles, levels = [np.zeros(0)], [np.zeros(0)]
            for edges in whole:
                known = ~inside(holes, edges[:-1], edges[1:])
                middles.append(((edges[:-1] + edges[1:]) / 2)[known])
                levels.append(means(trial.time, x, edges)[known])
            middle, level = np.concatenate(middles), np.concatenate(levels)
            if len(middle) >= FEWEST:
                slow = spline(middle, level - level.mean(), 0.5 / (cycles * phase.period))
                values[:, k] -= slow(np.clip(trial.time, middle[0], middle[-1]))
        trials.append(Trial(trial.time, values, trial.events, trial.name))
    return eqx.tree_at(lambda r: r.trials, recording, tuple(trials))
