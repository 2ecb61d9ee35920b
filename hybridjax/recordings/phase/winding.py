"""The phase of a recording."""

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from ...errors import DefinitionError


# The longest gap, in cycles, across which turns are counted. Doubled: stretches go on across gaps
# of half a cycle, where a turn may be lost unseen.
LONGEST_GAP = 0.25


class Winding(eqx.Module):
    """The phase of one stretch of a trial.

    **Fields:** `time` (n,), `phase` (n,) in cycles: both strictly increasing. `linear`: whether
    the phase is linear in between, or smooth. `gaps` (g, 2): start and end of the times at which
    it was not seen, but interpolated.
    """

    time: Float[np.ndarray, " n"]
    phase: Float[np.ndarray, " n"]
    linear: bool = eqx.field(static=True)
    gaps: Float[np.ndarray, "g 2"] = eqx.field(default_factory=lambda: np.zeros((0, 2)))

    def when(self, phase: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """The times at which the phase has these values, by inverse interpolation."""
        if self.linear:
            return np.interp(phase, self.phase, self.time)
        return PchipInterpolator(self.phase, self.time)(phase)


class Phase(eqx.Module):
    """The phase of all trials of a recording, as `estimate_phase` finds it.

    **Fields:**

    - `stretches`: for each trial, the stretches that are not interrupted.
    - `periods`: for each trial, the durations of its cycles. `period`: their median.
    - `n_sections`: the number N of the family that defined it; None where cycles go from one
      crossing or event to the next, or a function defined it.
    - `backwards`: the share of samples at which the angle ran backwards (noise).
    - `dropped`: events taken for doubled; `missed`: cycles left out since an event was missed.
    - `lead`: how many cycles the phase looks ahead.
    """

    stretches: tuple[tuple[Winding, ...], ...]
    periods: tuple[Float[np.ndarray, " _"], ...]
    period: float = eqx.field(static=True)
    n_sections: int | None = eqx.field(static=True)
    backwards: float = eqx.field(static=True)
    dropped: int = eqx.field(static=True)
    missed: int = eqx.field(static=True)
    lead: int = eqx.field(static=True)

    def __init__(
        self,
        stretches: list[tuple[Winding, ...]],
        *,
        n_sections: int | None = None,
        backwards: float = 0.0,
        dropped: int = 0,
        missed: int = 0,
        lead: int = 0,
    ):
        """**Raises:** `DefinitionError` for stretches that hold fewer than two whole cycles."""
        self.stretches = tuple(stretches)
        self.periods = tuple(_periods(parts) for parts in stretches)
        everything = np.concatenate(self.periods)
        if len(everything) < 2:
            raise DefinitionError(
                f"the recording holds {len(everything)} whole cycles; at least two are needed to "
                "speak of a period."
            )
        self.period = float(np.median(everything))
        self.n_sections, self.backwards, self.lead = n_sections, backwards, lead
        self.dropped, self.missed = dropped, missed

    @property
    def cycles(self) -> int:
        """The number of whole cycles."""
        return sum(len(p) for p in self.periods)

    @property
    def drift(self) -> float:
        """Change of the period per cycle, relative to it: a straight line through each trial."""
        slopes, weights = [], []
        for p in self.periods:
            k = np.arange(len(p)) - (len(p) - 1) / 2
            if len(p) > 2:
                slopes.append(float(k @ p / (k @ k)))
                weights.append(float(k @ k))
        return float(np.average(slopes, weights=weights)) / self.period if slopes else 0.0

    @property
    def jitter(self) -> float:
        """Standard deviation of the periods of each trial about their line, relative to them."""
        rest, freedom = 0.0, 0
        for p in self.periods:
            if len(p) > 2:
                k = np.arange(len(p))
                rest += float(((p - np.polyval(np.polyfit(k, p, 1), k)) ** 2).sum())
                freedom += len(p) - 2
        return float(np.sqrt(rest / freedom)) / self.period if freedom else 0.0

    def __repr__(self) -> str:
        notes = ""
        if self.backwards:
            notes += f"; {100 * self.backwards:.2g} % of samples ran backwards"
        if self.dropped:
            notes += f"; {self.dropped} doubled events left out"
        if self.missed:
            notes += f"; {self.missed} cycles with missed events left out"
        pieces = sum(len(s) for s in self.stretches)
        return (
            f"Phase({self.cycles} cycles in {pieces} stretches of {len(self.stretches)} trials; "
            f"period {self.period:.6g}, jitter {100 * self.jitter:.2g} %, drift "
            f"{100 * self.drift:.2g} % per cycle{notes})"
        )


def _periods(parts: tuple[Winding, ...]) -> Float[np.ndarray, " _"]:
    """Durations of the whole cycles of one trial's stretches."""
    each = [np.zeros(0)]
    for part in parts:
        whole = np.arange(np.ceil(part.phase[0]), np.floor(part.phase[-1]) + 1)
        each.append(np.diff(part.when(whole)))
    return np.concatenate(each)
