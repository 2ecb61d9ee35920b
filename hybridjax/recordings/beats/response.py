"""`phase_response`: the phase response curve of a rhythm, from the times of its events under a
known input.

It fits a flat curve, then a smooth one (`estimation.py`), and returns a `PhaseResponse`. The order
must stay, since the smooth fit starts from the flat one. The phase model that forecasts intervals
between events is in `model.py`, and the model of their errors in `errors.py`.

If a curve is wrong, look at `estimation.py`; if forecasts are, at `PhaseResponse.forecast`; if
intervals are lost or counted twice, at `_intervals` and `intervals_of` (`model.py`).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from ..._core.boundary.checked import checked, checked_methods
from ..._core.boundary.kinds import Probability, Vector
from ..._core.findings import Finding, print_findings
from ..._core.progress import say, working
from ..._core.results import Result
from ..._core.showable import Showable
from ..._core.signal import Signal, with_unit
from ..._core.text import rounded, standard_error
from ...errors import DefinitionError
from ...orbits.crossing import SectionLike
from ...orbits.responses import PhaseCurve
from ..fit_warnings import about_phase_response
from ..phase import Phase
from ..phase_estimation import estimate_phase
from ..read import RecordingLike, as_recording
from ..recording import Recording
from ..smoothing import Series
from .estimation import (
    WAVES,
    CurveFit,
    accuracy_of,
    carried_over,
    explained,
    fit_curve,
    fit_rates,
    follows,
    whitened,
)
from .model import Intervals, basis, intervals_of


Waves = Float[np.ndarray, "n p"]


class IntervalForecast(Showable, eqx.Module):
    """Intervals of a recording as a phase response curve forecasts them.

    **Fields:**

    - `start` (L,), `measured` (L,), `duration` (L,): start, duration and forecast of each interval,
      in s. `trial` (L,): its number among the trials that have intervals.
    - `rates` (trials,): of the trials without input, in cycles per second, fitted to `measured`.
    - `counted` (L,): False where a forecast is off by half a cycle or more (a miscounted event).
    - `explained`: fraction of the variance of durations within trials (R2) that is forecast.
    - `result`: `Result.OK` if the fit of the rates converged.
    """

    start: Series
    measured: Series
    duration: Series
    trial: Int[np.ndarray, " L"]
    rates: Float[np.ndarray, " trials"]
    counted: Bool[np.ndarray, " L"]
    explained: float = eqx.field(static=True)
    result: Result = eqx.field(static=True)

    def __repr__(self) -> str:
        return (
            f"IntervalForecast({len(self.start)} intervals of {len(self.rates)} trials, "
            f"{int((~self.counted).sum())} of them miscounted; R2 {self.explained:.3f})"
        )


@checked_methods
class PhaseResponse(PhaseCurve):
    r"""The curve Z of the phase model $\dot\varphi = w + Z(\varphi)\,I(t)$, with its accuracy.

    Z is in cycles per second and unit of the input; $\varphi$ is 0 at an event, and the next event
    happens where it is 1. The curve is free of jitter: it is that of the rhythm without noise.
    Noise spreads the phase, so that a mean phase follows an average of the curve (`with_jitter`),
    which `forecast` uses.

    **Fields:**

    - `coefficients` (K + 1,): coefficients of $\cos(\pi k \varphi)$. `covariance`, and the degrees
      of `dof` with which it was estimated. `detail`: number of coefficients that the data
      determine, while the smoothness of the curve determines the others.
    - `phase` (P,), `values` (P,), `errors` (P,): the curve and its standard errors.
    - `rates` (trials,): w, in cycles per second.
    - `jitter`: standard deviation of the phase at the end of a cycle, in cycles.
    - `left_out`: fraction of the variance of durations within trials (R2) that is forecast in
      intervals to which the curve was not fitted. Each block of intervals is forecast by a fit, to
      first order, to the other blocks. `left_out_flat`: the same for a flat curve.
    - `p_flat`: probability of so much shape if the curve is flat (likelihood ratio; Self and Liang
      1987).
    - `excess`: variance of sums of residuals over blocks relative to that of independent errors.
    - `intervals`: number of intervals. `miscounted`: number of intervals whose forecast is off by
      half a cycle or more, because an event was missed or a recorded event was none. They are not
      used.
    - `memory`: correlation of the residuals of neighboring intervals, beyond a wandering rate.
    - `carried`: effect of a push on the next interval, divided by its effect on its own interval,
      which the curve shows. `carried_error` is its standard error.
    - `wander`: standard deviation of the rate within a trial, divided by the rate, beyond jitter.
      `wander_time`: correlation time of these changes, in s.
    - `within`: fraction of the input's variance that lies within intervals. It is small for a slow
      input.
    - `result`: `Result.OK` if the fit converged.
    """

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    dof: float = eqx.field(static=True)
    detail: float = eqx.field(static=True)
    errors: Float[np.ndarray, " P"]
    rates: Float[np.ndarray, " trials"]
    jitter: float = eqx.field(static=True)
    left_out: float = eqx.field(static=True)
    left_out_flat: float = eqx.field(static=True)
    p_flat: float = eqx.field(static=True)
    excess: float = eqx.field(static=True)
    intervals: int = eqx.field(static=True)
    miscounted: int = eqx.field(static=True)
    memory: float = eqx.field(static=True)
    carried: float = eqx.field(static=True)
    carried_error: float = eqx.field(static=True)
    wander: float = eqx.field(static=True)
    wander_time: float = eqx.field(static=True)
    within: float = eqx.field(static=True)
    result: Result = eqx.field(static=True)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Limits of what the data support."""
        return tuple(about_phase_response(self))

    def __call__(self, phase: Vector) -> Series:
        """Return the curve at some phases, in cycles."""
        return self._waves(phase) @ self.coefficients

    def interval(
        self,
        phase: Vector,
        level: Probability = 0.95,
    ) -> tuple[Series, Series]:
        """Return lower and upper bounds that hold the curve with this probability, as a mean over
        the phases: they are too narrow where it changes faster than elsewhere.

        **Example:**

        ```python
        force = hj.experiments.random_input(100, 100, bandwidth=8)
        z = 0.2 * np.sin(2 * np.pi * np.arange(50) / 50)
        beats = hj.testing.simulate_beats(z, force.T, rate=100, jitter=0.01)
        curve = hj.recordings.phase_response(beats, hj.AtEvent("beat"), input="u")
        low, high = curve.interval(np.linspace(0, 1, 5))
        ```
        """
        waves = self._waves(phase)
        error = _errors(waves, self.covariance)
        quantile = float(stats.t.ppf((1 + level) / 2, self.dof))
        reach = quantile * error
        middle = waves @ self.coefficients
        return middle - reach, middle + reach

    def with_jitter(self, phase: Vector) -> Series:
        """Return the curve averaged over the jitter at some phases, in cycles: the one with which
        the phase model forecasts the mean of many noisy cycles. `self(phase)` is free of jitter.

        **Example:**

        ```python
        force = hj.experiments.random_input(100, 100, bandwidth=8)
        z = 0.2 * np.sin(2 * np.pi * np.arange(50) / 50)
        beats = hj.testing.simulate_beats(z, force.T, rate=100, jitter=0.1)
        curve = hj.recordings.phase_response(beats, hj.AtEvent("beat"), input="u")
        print(curve.with_jitter([0.25, 0.75]), curve([0.25, 0.75]))
        ```
        """
        x = np.asarray(phase, float) % 1.0
        return basis(x, len(self.coefficients) - 1, self.jitter) @ self.coefficients

    def forecast(
        self, recording: RecordingLike, sections: Phase | SectionLike
    ) -> IntervalForecast:
        """Forecast the intervals of a recording, such as one to which the curve was not fitted.

        Each interval is forecast from its own start. Only the rate of each trial is fitted.

        **Arguments:** as those of `phase_response`. The recording must have the same input.

        **Returns:** `hj.recordings.IntervalForecast`.

        **Raises:** `DefinitionError` in the cases of `phase_response`.

        **Example:**

        ```python
        force = hj.experiments.random_input(100, 100, bandwidth=8)
        z = 0.2 * np.sin(2 * np.pi * np.arange(50) / 50)
        fitted = hj.testing.simulate_beats(z, force.T, rate=100, jitter=0.05)
        other = hj.testing.simulate_beats(z, force.T, rate=100, jitter=0.05, seed=1)
        curve = hj.recordings.phase_response(fitted, hj.AtEvent("beat"), input="u")
        print(curve.forecast(other, hj.AtEvent("beat")).explained)
        ```
        """
        recording = as_recording(recording)
        intervals = _intervals(recording, sections, str(self.input))
        fit = fit_rates(intervals, self.coefficients, self.jitter)
        left = float((fit.residual[fit.used] ** 2).sum())
        return IntervalForecast(
            start=intervals.start,
            measured=intervals.duration,
            duration=fit.forecast.duration,
            trial=intervals.trial,
            rates=fit.rates,
            counted=fit.used,
            explained=explained(intervals, fit.used, left),
            result=_code(fit),
        )

    def _waves(self, phase: Vector) -> Waves:
        return basis(np.asarray(phase, float) % 1.0, len(self.coefficients) - 1)

    def _about_wander(self) -> str:
        if not self.wander:
            return ""
        return (
            f"\n  wander       of the rate in a trial {100 * self.wander:.2g} %, forgotten after "
            f"{self.wander_time:.2g} s"
        )

    def __repr__(self) -> str:
        mean = self.coefficients[0]
        error = np.sqrt(self.covariance[0, 0])
        return (
            f"PhaseResponse({self.detail:.1f} effective parameters, {self.intervals} intervals of "
            f"{len(self.rates)} trials, {self.miscounted} of them miscounted)\n"
            f"  mean {with_unit('Z', self.unit)}  {rounded(mean, error)} ± {standard_error(error)} "
            f"(standard error); from {self.values.min():.4g} to {self.values.max():.4g}\n"
            f"  rates        {self.rates.min():.4g} to {self.rates.max():.4g} cycles/s, jitter "
            f"{100 * self.jitter:.2g} % of a cycle{self._about_wander()}\n"
            f"  R2 left out  {self.left_out:.3f}; of a flat curve {self.left_out_flat:.3f}\n"
            "  free of jitter: `forecast` and `with_jitter` average the curve over the jitter\n"
            + print_findings(self.findings, "  ")
        )


@checked
@working("phase_response")
def phase_response(
    recording: RecordingLike,
    sections: Phase | SectionLike,
    input: str,
) -> PhaseResponse:
    r"""Estimate the phase response curve of spikes, heartbeats, taps or steps under a known input.

    The phase model is integrated from each event until its phase is 1, and the resulting durations
    are fitted to the measured ones by least squares. The unknowns are the curve and the rate of
    each trial. The smoothness of the curve is the one with the largest posterior density given the
    data, and the errors of the curve contain the uncertainty of this choice. The curve may be
    discontinuous at an event. Since the end of an interval depends on the input, a regression of
    the measured intervals on the input, with a phase that grows linearly in time, would be biased;
    this estimate is not. Jitter of the rhythm averages the curve over neighboring phases. This is
    corrected: see `docs/mathematics.md`.

    The rate may wander within a trial: fast, or slowly as a random walk does. Such errors are
    correlated from interval to interval, and weighted accordingly (generalized least squares).

    Standard errors are computed from blocks of intervals; errors within a block may depend on each
    other. The blocks are the trials if there are thirty or more, otherwise parts of trials.

    **Arguments:**

    - `recording`: the recording, with the events and the input, or the path of its file, or a table
      (`hj.Recording.from_frame`).
    - `sections`: the event at which each cycle begins, by its name, or a `Phase` estimated from
      events or crossings.
    - `input`: the name of the input signal. It is interpolated linearly between its
      samples, and must not depend on the rhythm (no feedback). The mean of the signal
      in each trial counts as a part of the rhythm: the curve and the rates are those of
      the rhythm under this constant input.

    **Returns:** `hj.recordings.PhaseResponse`: `values` and `errors` (P,), in cycles per second and
    unit of the input, at the phases `phase` (P,) in cycles; `rates` (trials,), in cycles per
    second; `findings`.

    **Raises:** `DefinitionError` for an input that is missing or constant, a phase that is an
    angle, and too few intervals.

    **Example:**

    ```python
    force = np.random.default_rng(0).normal(size=(1, 10_000))
    force = np.repeat(force[:, ::50], 50, axis=1)
    z = 0.2 * np.sin(2 * np.pi * np.arange(50) / 50)
    beats = hj.testing.simulate_beats(z, force, rate=100, jitter=0.01)
    curve = hj.recordings.phase_response(beats, hj.AtEvent("beat"), input="u")
    ```

    **Before:** `hj.read_recording`. **After:** `hj.plot.phase_response`.
    """
    recording = as_recording(recording)
    intervals = _intervals(recording, sections, input)
    total = len(intervals.start)
    if total < 2 * (11 + intervals.trial[-1]):  # half of them for errors
        raise DefinitionError(
            f"{total} intervals are too few for a curve and the rates of their trials: record more."
        )
    say("flat")
    flat = fit_curve(intervals, 0)
    _, left_flat, _ = accuracy_of(intervals, flat)
    say("smooth")
    fit = fit_curve(intervals, WAVES, flat)
    covariance, left, detail = accuracy_of(intervals, fit)
    carried = carried_over(intervals, fit)
    x = np.arange(200) / 200
    waves = basis(x, WAVES)
    return PhaseResponse(
        coefficients=fit.coefficients,
        covariance=covariance.matrix,
        dof=max(covariance.dof, 1.0),
        detail=detail,
        phase=x,
        values=waves @ fit.coefficients,
        errors=_errors(waves, covariance.matrix),
        rates=fit.rates,
        jitter=fit.jitter,
        left_out=explained(intervals, fit.used, left),
        left_out_flat=explained(intervals, flat.used, left_flat),
        p_flat=float(stats.chi2.sf(fit.smoothness.evidence, 1) / 2),
        excess=fit.smoothness.excess,
        intervals=total,
        miscounted=int((~fit.used).sum()),
        memory=_memory(intervals, fit),
        carried=carried.part,
        carried_error=carried.error,
        wander=_wander(fit),
        wander_time=fit.wander.memory,
        within=_within(intervals),
        input=Signal(input, recording.unit(input)),
        result=_code(fit),
    )


def _intervals(
    recording: Recording, sections: Phase | SectionLike, name: str
) -> Intervals:
    """Return the intervals between events, with the input of that name."""
    phase = sections
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    return intervals_of(recording, phase, name)


def _code(fit: CurveFit) -> Result:
    return Result.OK if fit.converged else Result.NOT_CONVERGED


def _errors(waves: Waves, covariance: Float[np.ndarray, "p p"]) -> Series:
    """Return standard errors of a curve at the phases of some waves."""
    return np.sqrt(np.einsum("ni,ij,nj->n", waves, covariance, waves))


def _wander(fit: CurveFit) -> float:
    """Return the standard deviation of a wandering rate, as part of the rate."""
    if not fit.wander.memory:
        return 0.0
    jitter = np.sqrt(fit.smoothness.noise / fit.smoothness.excess)
    return float(fit.wander.size * jitter / np.median(fit.rates))


def _within(intervals: Intervals) -> float:
    """Return the fraction of the input's variance that lies within intervals."""
    nodes = np.arange(len(intervals.inputs))[:, None]
    inside = nodes * intervals.step / 2 < intervals.duration
    count = inside.sum(axis=0)
    mean = (intervals.inputs * inside).sum(axis=0) / count
    apart = ((intervals.inputs - mean) ** 2 * inside).sum()
    whole = (intervals.inputs**2 * inside).sum()
    return float(apart / whole)


def _memory(intervals: Intervals, fit: CurveFit) -> float:
    """Return the correlation of the residuals of successive intervals, without a wandering rate."""
    after = follows(intervals, fit)
    if after.sum() < 3:
        return 0.0
    white = whitened(intervals, fit)
    errors = white(fit.residual[:, None])[:, 0]
    now = errors[1:][after]
    before = errors[:-1][after]
    return float(np.corrcoef(now, before)[0, 1])
