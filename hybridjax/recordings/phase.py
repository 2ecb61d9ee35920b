"""`Phase`: the phase of all trials of a recording, as `estimate_phase` returns it.

Each trial has stretches (`Winding`) without long gaps, in which time and phase determine each
other. `samples` and `by_trial` give data and stretches together. Two things must stay, since all
that counts sections relies on them: the phase is a whole number at section 0, and time and phase of
a `Winding` increase strictly.

The phase itself is computed in `phase_estimation.py`: if a cycle is missing or doubled, look there.
If a time between events is wrong, look at `Winding.when`, which interpolates; if the period or its
jitter is, at `Phase.periods`.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import signal
from scipy.interpolate import PchipInterpolator

from .._core.arguments import require_equal
from .._core.boundary.checked import checked
from .._core.memo import remembered
from .._core.showable import Showable
from .._core.text import folded, how_many
from ..errors import DefinitionError
from .recording import Recording, Trial
from .smoothing import Series


# Longest gap, in cycles, across which cycles are counted. Longer: half a revolution of an angle may
# be missed, and the count is wrong. Shorter: at low sampling rates, stretches end at every missing
# sample.
LONGEST_GAP = 0.25
# Number of harmonics of a cycle that are resolved by default. It sets the number of sections, and
# the bandwidth of the signals of an angle. More: noisier phases, more unknowns. Fewer: impacts and
# other fast parts are smeared.
HARMONICS = 32


class Winding(eqx.Module):
    """The phase of one stretch of a trial.

    **Fields:** `time` (n,), `phase` (n,) in cycles: both strictly increasing. `linear`: whether
    the phase is linear in between, or smooth. `gaps` (g, 2): start and end of the times at which
    it was interpolated and not observed.
    """

    time: Float[np.ndarray, " n"]
    phase: Float[np.ndarray, " n"]
    linear: bool = eqx.field(static=True)
    gaps: Float[np.ndarray, "g 2"] = eqx.field(default_factory=lambda: np.zeros((0, 2)))

    def when(self, phase: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return the times at which the phase has these values, by inverse interpolation."""
        if self.linear:
            return np.interp(phase, self.phase, self.time)
        return PchipInterpolator(self.phase, self.time)(phase)

    def edges(self) -> Float[np.ndarray, " c1"]:
        """Return the times at which the phase is a whole number."""
        first = np.ceil(self.phase[0])
        last = np.floor(self.phase[-1])
        return self.when(np.arange(first, last + 1))

    def at(self, time: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return the phase at some times; NaN outside of the stretch."""
        return np.interp(time, self.time, self.phase, left=np.nan, right=np.nan)


class Phase(Showable, eqx.Module):
    """The phase of all trials of a recording, as `estimate_phase` returns it.

    **Fields:**

    - `stretches`: for each trial, its uninterrupted stretches.
    - `periods`: for each trial, the durations of its cycles. `period`: their median.
    - `n_sections`: the number N of the family that defined the phase; None for phases defined by
      crossings, events or functions.
    - `backwards`: fraction of samples at which the angle ran backwards (noise).
    - `dropped`: number of events taken for doubled. `missed`: number of cycles left out because an
      event was missed.
    - `lead`: number of cycles by which the phase depends on the future.
    """

    stretches: tuple[tuple[Winding, ...], ...]
    n_sections: int | None = eqx.field(static=True, default=None)
    backwards: float = eqx.field(static=True, default=0.0)
    dropped: int = eqx.field(static=True, default=0)
    missed: int = eqx.field(static=True, default=0)
    lead: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        """**Raises:** `DefinitionError` for stretches that hold fewer than two whole cycles."""
        if self.cycles < 2:
            raise DefinitionError(
                f"the recording has {self.cycles} whole cycles: record more."
            )

    @remembered
    def periods(self) -> tuple[Float[np.ndarray, " _"], ...]:
        periods = []
        for parts in self.stretches:
            each = [np.diff(part.edges()) for part in parts]
            periods.append(np.concatenate([np.zeros(0), *each]))
        return tuple(periods)

    @property
    def period(self) -> float:
        return float(np.median(np.concatenate(self.periods)))

    @checked
    def plot(self, *, ax: object = None) -> Any:
        """Draw the periods of the cycles in order, and their distribution.

        **Arguments:** `ax`: two Axes. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (1, 2): the periods in seconds against the number
        of the cycle, and their histogram.

        **Raises:** `DefinitionError` if `ax` does not hold two Axes.

        **Example:**

        ```python
        result.phase.plot()
        ```
        """
        return super().plot(ax=ax)

    def by_trial(self, recording: Recording) -> list[tuple[Trial, tuple[Winding, ...]]]:
        """Return each trial with the stretches (uninterrupted parts) of its phase.

        **Raises:** `DefinitionError` for a recording with another number of trials.
        """
        require_equal(
            "phase and recording",
            "numbers of trials",
            len(self.stretches),
            len(recording.trials),
        )
        return list(zip(recording.trials, self.stretches, strict=True))

    def samples(
        self, recording: Recording, name: str
    ) -> list[tuple[Trial, Series, tuple[Winding, ...]]]:
        """Return each trial with the samples of a signal and its stretches.

        **Raises:** `DefinitionError` in the cases of `by_trial`, and for an unknown signal.
        """
        k = recording.column(name)
        return [(t, t.values[:, k], parts) for t, parts in self.by_trial(recording)]

    @property
    def cycles(self) -> int:
        """Number of whole cycles."""
        return sum(len(p) for p in self.periods)

    @property
    def drift(self) -> float:
        """Relative change of the period per cycle: a straight line through each trial."""
        square = 0.0
        product = 0.0
        for period in self.periods:
            if len(period) > 2:
                k = np.arange(len(period)) - (len(period) - 1) / 2
                square += k @ k
                product += k @ period
        return float(product / max(square, 1.0) / self.period)

    @property
    def jitter(self) -> float:
        """Relative standard deviation of the periods about a straight line through the periods of
        each trial."""
        residuals = [signal.detrend(p) for p in self.periods if len(p) > 2]
        dof = sum(len(x) - 2 for x in residuals)
        square = sum(x @ x for x in residuals) / max(dof, 1)
        return float(np.sqrt(square)) / self.period

    def __repr__(self) -> str:
        pieces = sum(len(s) for s in self.stretches)
        stretches = how_many(pieces, "stretch", "stretches")
        trials = how_many(len(self.stretches), "trial", "trials")
        text = (
            f"Phase({self.cycles} cycles in {stretches} of {trials}; "
            f"period {self.period:.6g} s, jitter {100 * self.jitter:.2g} %, drift "
            f"{100 * self.drift:.2g} % per cycle"
        )
        if self.backwards:
            text += f"; {100 * self.backwards:.2g} % of samples ran backwards"
        if self.dropped:
            text += f"; {how_many(self.dropped, 'doubled event', 'doubled events')} left out"
        if self.missed:
            text += f"; {how_many(self.missed, 'cycle', 'cycles')} with missed events left out"
        return folded(text + ")")
