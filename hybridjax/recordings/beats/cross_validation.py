"""Forecasts of intervals that were left out, for any phase response curve."""

from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..._core.arguments import Numbers
from ..._core.boundary.checked import checked
from ..._core.boundary.values import Reals, Whole
from ..._core.progress import working
from ...errors import DefinitionError
from ...orbits.crossing import AtEvent, Crossing
from ..phase.winding import Phase
from ..recording import Recording
from .estimation import WAVES, fit_curve, fit_rates, miscounted
from .intervals import intervals_of
from .phase_model import Table
from .response import PhaseResponse, phase_of, share


Folds = Annotated[int, Whole(2, 50)]


class IntervalForecast(eqx.Module):
    """Durations of intervals as they were, and as they were forecast from others.

    **Fields:**

    - `measured`, `forecast` (L,), in s; `start` (L,), when each begins; `trial` (L,).
    - `counted` (L,): those that the forecast misses by less than half a cycle.
    - `r2`: the share of the variance of durations within trials that is forecast; `r2_counted`:
      of the intervals that count.
    """

    start: Float[np.ndarray, " L"]
    measured: Float[np.ndarray, " L"]
    forecast: Float[np.ndarray, " L"]
    trial: Int[np.ndarray, " L"]
    counted: Bool[np.ndarray, " L"]
    r2: float = eqx.field(static=True)
    r2_counted: float = eqx.field(static=True)

    def __repr__(self) -> str:
        return (
            f"IntervalForecast({len(self.measured)} intervals; R2 {self.r2:.3f}, "
            f"{self.r2_counted:.3f} of the {int(self.counted.sum())} that count)"
        )


@checked
@working("forecast_intervals")
def forecast_intervals(
    recording: Recording,
    phase: Phase | AtEvent | Crossing,
    *,
    input: str,
    curve: PhaseResponse | Annotated[Numbers, Reals("n")],
    folds: Folds = 5,
) -> IntervalForecast:
    """How well a phase response curve forecasts when the next event comes.

    Each trial is cut into as many parts as there are `folds`; what is forecast of a part is learned
    from the other parts of all trials.

    **Arguments:** `phase`, `input`: as for `phase_response`. `curve`: one that was estimated: it
    is fitted anew without the part that is left out; or values at n equal steps of the phase from 0
    on (one value: a flat curve), as they are: then only the rates of the trials are learned.

    **Raises:** `DefinitionError` as `phase_response`, and for a curve without values.
    """
    if not isinstance(curve, PhaseResponse) and not len(np.asarray(curve)):
        raise DefinitionError("`curve` needs at least one value.")
    intervals = intervals_of(recording, phase_of(recording, phase), input)
    place = np.concatenate([np.arange(n) / n for n in np.bincount(intervals.trial)])
    fold = np.minimum((place * folds).astype(int), folds - 1)
    forecast, rate = np.zeros(len(place)), np.zeros(len(place))
    first = None
    for k in range(folds):
        out = fold == k
        if isinstance(curve, PhaseResponse):
            first = fit_curve(intervals, WAVES, first, ~out)
            found = first
        else:
            found = fit_rates(intervals, Table.of_curve(np.asarray(curve, float)), ~out)
        forecast[out], rate[out] = found.forecast.duration[out], found.forecast.rate[out]
    left = intervals.duration - forecast
    counted = ~miscounted(left, rate)
    every = np.ones(len(left), bool)
    return IntervalForecast(
        start=intervals.start,
        measured=intervals.duration,
        forecast=forecast,
        trial=intervals.trial,
        counted=counted,
        r2=share(intervals, every, (left**2).sum()),
        r2_counted=share(intervals, counted, (left[counted] ** 2).sum()),
    )
