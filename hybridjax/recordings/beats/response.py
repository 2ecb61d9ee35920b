"""The phase response curve of a rhythm, from the times of its events under a known input."""

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import stats

from ..._core.boundary.checked import checked, checked_methods
from ..._core.boundary.kinds import Probability, Vector
from ..._core.findings import Finding, print_findings
from ..._core.progress import say, working
from ..._core.results import Result
from ..._core.signal import Signal, with_unit
from ...errors import DefinitionError
from ...orbits.crossing import AtEvent, Crossing
from ...orbits.responses import PhaseCurve
from ..fit_warnings import about_phase_response
from ..phase import Phase
from ..phase_estimation import estimate_phase
from ..recording import Recording
from ..smoothing import Series
from .estimation import WAVES, CurveFit, accuracy_of, fit_curve
from .model import Intervals, basis, intervals_of


Waves = Float[np.ndarray, "n p"]


@checked_methods
class PhaseResponse(PhaseCurve):
    r"""The curve Z of the phase model $\dot\varphi = w + Z(\varphi)\,I(t)$, with its accuracy.

    Z is in cycles per second and unit of the input; $\varphi$ is 0 at an event, and the next event
    happens where it is 1.

    **Fields:**

    - `coefficients` (K + 1,): coefficients of $\cos(\pi k \varphi)$. `covariance`, and the degrees
      of `dof` with which it was estimated. `detail`: number of coefficients that the data
      determine, while the smoothness of the curve determines the others.
    - `phase` (P,), `values` (P,), `errors` (P,): the curve and its standard errors.
    - `rates` (trials,): w, in cycles per second.
    - `jitter`: standard deviation of the phase at the end of a cycle, in cycles.
    - `left_out`: fraction of the variance of durations within trials (R2) that is forecast in
      blocks of intervals to which the curve was not fitted, by fits to the others to first order.
      `left_out_flat`: the same for a flat curve.
    - `p_flat`: probability of so much shape if the curve is flat (likelihood ratio; Self and Liang
      1987).
    - `excess`: variance of sums of residuals over blocks relative to that of independent errors.
    - `intervals`: number of intervals. `miscounted`: number of those whose forecast is off by half
      a cycle or more (an event was missed, or one was none); they are not used.
    - `memory`: correlation of the residuals of neighboring intervals.
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
        reach = float(stats.t.ppf((1 + level) / 2, self.dof)) * error
        middle = waves @ self.coefficients
        return middle - reach, middle + reach

    def _waves(self, phase: Vector) -> Waves:
        return basis(np.asarray(phase, float) % 1.0, len(self.coefficients) - 1)

    def __repr__(self) -> str:
        mean = self.coefficients[0]
        error = np.sqrt(self.covariance[0, 0])
        return (
            f"PhaseResponse({self.detail:.1f} effective parameters, {self.intervals} intervals of "
            f"{len(self.rates)} trials, {self.miscounted} of them miscounted)\n"
            f"  mean {with_unit('Z', self.unit)}  {mean:.4g} ± {error:.2g} (standard error); from "
            f"{self.values.min():.4g} to {self.values.max():.4g}\n"
            f"  rates        {self.rates.min():.4g} to {self.rates.max():.4g} cycles/s, jitter "
            f"{100 * self.jitter:.2g} % of a cycle\n"
            f"  R2 left out  {self.left_out:.3f}; of a flat curve {self.left_out_flat:.3f}\n"
            + print_findings(self.findings, "  ")
        )


@checked
@working("phase_response")
def phase_response(
    recording: Recording,
    sections: Phase | AtEvent | Crossing,
    *,
    input: str,
) -> PhaseResponse:
    r"""Estimate the phase response curve of spikes, heartbeats, taps or steps under a known input.

    The phase model is integrated from each event until its phase is 1, and the resulting durations
    are fitted to the measured ones by least squares. The unknowns are the curve and the rate of
    each trial. The smoothness of the curve maximizes the marginal likelihood of the data; the curve
    may be discontinuous at an event. The end of an interval depends on the input, so that a
    regression of measured intervals on the input at a linear phase is biased; this estimate is not.
    The averaging of the curve by the jitter of the rhythm is undone: see `docs/mathematics.md`.

    Standard errors come from blocks of intervals, whose errors may depend on each other: trials if
    there are thirty or more, else parts of them.

    **Arguments:**

    - `recording`: the recording, with the events and the input.
    - `sections`: the event at which each cycle begins, or a `Phase` estimated from events or
      crossings.
    - `input`: the name of the signal that acted; linear between its samples. It must not depend on
      the rhythm (no feedback). The curve and the rates are those at its mean in each trial.

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
    phase = sections
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, phase)
    intervals = intervals_of(recording, phase, input)
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
        left_out=_explained(intervals, fit, left),
        left_out_flat=_explained(intervals, flat, left_flat),
        p_flat=float(stats.chi2.sf(fit.smoothness.evidence, 1) / 2),
        excess=fit.smoothness.excess,
        intervals=total,
        miscounted=int((~fit.used).sum()),
        memory=_memory(intervals, fit),
        input=Signal(input, recording.unit(input)),
        result=Result.OK if fit.converged else Result.NOT_CONVERGED,
    )


def _errors(waves: Waves, covariance: Float[np.ndarray, "p p"]) -> Series:
    """Return standard errors of a curve at the phases of some waves."""
    return np.sqrt(np.einsum("ni,ij,nj->n", waves, covariance, waves))


def _explained(intervals: Intervals, fit: CurveFit, left: float) -> float:
    """Return R2: the explained fraction of the variance of durations within trials."""
    count = np.maximum(intervals.sums(1.0 * fit.used), 1)
    mean = intervals.sums(intervals.duration * fit.used) / count
    deviation = intervals.duration - mean[intervals.trial]
    whole = (deviation[fit.used] ** 2).sum()
    return float(1 - left / whole) if whole > 0 else 0.0


def _memory(intervals: Intervals, fit: CurveFit) -> float:
    """Return the correlation of the residuals of successive intervals."""
    end = intervals.start + intervals.duration
    pause = np.abs(intervals.start[1:] - end[:-1])
    follows = fit.used[1:] & fit.used[:-1] & (np.diff(intervals.trial) == 0)
    follows &= pause < 1e-6 * intervals.duration[1:]
    if follows.sum() < 3:
        return 0.0
    later = fit.missed[1:][follows]
    earlier = fit.missed[:-1][follows]
    return float(np.corrcoef(later, earlier)[0, 1])
