"""The phase response curve of a rhythm, from the times of its events under a known input."""

from collections.abc import Iterator
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from ..._core.arguments import Numbers
from ..._core.boundary.checked import checked, checked_methods
from ..._core.boundary.kinds import Probability
from ..._core.boundary.values import Reals
from ..._core.html import COLORS, Curve, card, picture, text
from ..._core.progress import say, working
from ..._core.results import Result
from ..._core.signal import Signal, unit_of, with_unit
from ..._core.text import p_value
from ...errors import DefinitionError
from ...orbits.crossing import AtEvent, Crossing
from ..phase.estimation import estimate_phase
from ..phase.winding import Phase
from ..recording import Recording
from .estimation import WAVES, CurveFit, accuracy_of, fit_curve
from .intervals import Intervals, intervals_of
from .phase_model import basis
from .plain import plain_curve


# Phases at which a curve is given. Doubled: smoother figures.
_POINTS = 200
# Intervals to be had besides one for each trial, half of them. Doubled: more is refused.
_FEWEST = 10
# Half of the 95 % band, relative to the mean of the curve, that is wide. Doubled: less is said.
_WIDE = 0.5
# Correlation of what is left of neighboring intervals that is said. Doubled: less is.
_MEMORY = 0.2
# Share of intervals that are miscounted, and said. Doubled: less is said.
_MISCOUNTED = 0.01
# Excess of the variance of sums over blocks that is said. Doubled: less is.
_EXCESS = 2.0
# Level of the test for a flat curve. Doubled: more curves have a shape by chance.
_LEVEL = 0.01

Phases = Annotated[Numbers, Reals("n")]


@checked_methods
class PhaseResponse(eqx.Module):
    r"""The curve Z of the phase model $\dot\varphi = w + Z(\varphi)\,I(t)$, with its accuracy.

    Z is in cycles per second and unit of the input; $\varphi$ is 0 at an event, and the next one
    happens where it is 1.

    **Fields:**

    - `coefficients` (K + 1,): of $\cos(\pi k \varphi)$; `covariance`, and the degrees of `freedom`
      with which it was estimated. `detail`: how many numbers the data determine, the smoothness of
      the curve the others.
    - `phase` (P,), `values` (P,), `errors` (P,): the curve and its standard errors. `plain` (P,):
      the curve by regression of durations on the input at phases that grow linearly from event to
      event, which is biased.
    - `rates` (trials,): w, in cycles per second. `trials`: their names.
    - `jitter`: standard deviation of the phase at the end of a cycle, in cycles.
    - `left_out`: the share of the variance of durations within trials (R2) that is forecast of
      blocks of intervals that the curve was not fitted to, by fits to the others to first order;
      `left_out_flat`: by a flat curve.
    - `r2`: the same share for all intervals that count, in the fit itself.
    - `p_flat`: how probable so much shape is where there is none (likelihood ratio; Self and Liang
      1987).
    - `excess`: how many times the variance of independent errors the sums over blocks have.
    - `intervals`: how many there are; `miscounted`: how many of them miss the model by half a
      cycle or more (an event was missed, or one was none), and do not count.
    - `memory`: correlation of what is left of neighboring intervals.
    - `result`: whether the fit came to its end.
    """

    coefficients: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    freedom: float = eqx.field(static=True)
    detail: float = eqx.field(static=True)
    phase: Float[np.ndarray, " P"]
    values: Float[np.ndarray, " P"]
    errors: Float[np.ndarray, " P"]
    plain: Float[np.ndarray, " P"]
    rates: Float[np.ndarray, " trials"]
    trials: tuple[str, ...] = eqx.field(static=True)
    jitter: float = eqx.field(static=True)
    left_out: float = eqx.field(static=True)
    left_out_flat: float = eqx.field(static=True)
    r2: float = eqx.field(static=True)
    p_flat: float = eqx.field(static=True)
    excess: float = eqx.field(static=True)
    intervals: int = eqx.field(static=True)
    miscounted: int = eqx.field(static=True)
    memory: float = eqx.field(static=True)
    input: str = eqx.field(static=True)
    result: Result = eqx.field(static=True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the data cannot tell, in plain words."""
        return tuple(_about(self))

    def __call__(self, phase: Phases) -> Float[np.ndarray, " n"]:
        """The curve at some phases, in cycles."""
        return self._waves(phase) @ self.coefficients

    def interval(
        self, phase: Phases, level: Probability = 0.95
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lower and upper bounds that hold the curve with this probability, as a mean over the
        phases: they are too narrow where it changes faster than elsewhere."""
        waves = self._waves(phase)
        error = np.sqrt(np.einsum("ni,ij,nj->n", waves, self.covariance, waves))
        reach = float(stats.t.ppf((1 + level) / 2, self.freedom)) * error
        middle = waves @ self.coefficients
        return middle - reach, middle + reach

    def _waves(self, phase: Phases) -> Float[np.ndarray, "n p"]:
        return basis(np.asarray(phase, float) % 1.0, len(self.coefficients) - 1)

    def _repr_html_(self) -> str:
        low, high = self.interval(self.phase)
        drawn = [
            Curve(self.phase, low, color=COLORS[-1]),
            Curve(self.phase, high, "95 %", COLORS[-1]),
            Curve(self.phase, self.plain, "plain regression", COLORS[1]),
            Curve(self.phase, self.values, "estimated", COLORS[0]),
        ]
        first, *lines = repr(self).splitlines()
        of = first.removeprefix("PhaseResponse(").removesuffix(")")
        shown = picture(drawn, "phase (cycles)", with_unit("Z", curve_unit(self.input)))
        return card("PhaseResponse", of, shown, text("\n".join(x.strip() for x in lines)))

    def __repr__(self) -> str:
        mean, error = self.coefficients[0], np.sqrt(self.covariance[0, 0])
        unit = with_unit("Z", curve_unit(self.input))
        lines = [
            f"PhaseResponse(detail of {self.detail:.1f} numbers, {self.intervals} intervals of "
            f"{len(self.trials)} trials, {self.miscounted} of them miscounted)",
            f"  mean {unit}  {mean:.4g} +- {error:.2g}; from {self.values.min():.4g} to "
            f"{self.values.max():.4g}",
            f"  rates        {self.rates.min():.4g} to {self.rates.max():.4g} cycles/s, jitter "
            f"{100 * self.jitter:.2g} % of a cycle",
            f"  R2 left out  {self.left_out:.3f}; of a flat curve {self.left_out_flat:.3f}",
        ]
        return "\n".join([*lines, *(f"  {text}" for text in self.warnings)])


def curve_unit(name: str) -> str:
    """Of a phase response to this input."""
    return f"cycles / ({unit_of(name)} s)" if unit_of(name) else "cycles / s / input"


@checked
@working("phase_response")
def phase_response(
    recording: Recording,
    phase: Phase | AtEvent | Crossing,
    *,
    input: str,
) -> PhaseResponse:
    r"""The phase response curve of spikes, heartbeats, taps or steps under a known input.

    The phase model is integrated from each event until its phase is 1, and the durations that this
    gives are fitted to those measured by least squares, over the curve and the rate of each trial.
    The curve is as smooth as makes the data most probable, and need not be the same just after an
    event and just before the next. The end of an interval depends on the input, so that a
    regression of measured intervals on the input at a linear phase is biased; this is not. The
    averaging of the curve by the jitter of the rhythm is undone: see `docs/mathematics.md`.

    **Arguments:**

    - `phase`: the event at which each cycle begins, or a `Phase` that was found from events or
      crossings.
    - `input`: the name of the signal that acted; linear between its samples. It must not depend on
      the rhythm (no feedback).

    Standard errors are those of blocks of intervals, whose errors may depend on each other: trials
    if there are thirty or more, else parts of them.

    **Raises:** `DefinitionError` for an input that is missing or constant, a phase that is an
    angle, and too few intervals.
    """
    intervals = intervals_of(recording, phase_of(recording, phase), input)
    total = len(intervals.start)
    if total < 2 * (_FEWEST + intervals.trials):
        raise DefinitionError(
            f"{total} intervals are too few for a curve and the rates of {intervals.trials} "
            "trials: record more."
        )
    say("flat")
    flat = fit_curve(intervals, 0)
    say("smooth")
    fit = fit_curve(intervals, WAVES, flat)
    accuracy = accuracy_of(intervals, fit)
    matrix = accuracy.covariance.matrix
    x = np.arange(_POINTS) / _POINTS
    waves = basis(x, WAVES)
    return PhaseResponse(
        coefficients=fit.coefficients,
        covariance=matrix,
        freedom=max(accuracy.covariance.freedom, 1.0),
        detail=accuracy.detail,
        phase=x,
        values=waves @ fit.coefficients,
        errors=np.sqrt(np.einsum("ni,ij,nj->n", waves, matrix, waves)),
        plain=waves @ plain_curve(intervals, fit),
        rates=fit.rates,
        trials=intervals.names,
        jitter=fit.jitter,
        left_out=share(intervals, fit.used, accuracy.left_out.sum()),
        left_out_flat=share(intervals, flat.used, accuracy_of(intervals, flat).left_out.sum()),
        r2=share(intervals, fit.used, (fit.residual[fit.used] ** 2).sum()),
        p_flat=float(stats.chi2.sf(fit.smoothness.evidence, 1) / 2),
        excess=fit.smoothness.excess,
        intervals=total,
        miscounted=int((~fit.used).sum()),
        memory=_memory(intervals, fit),
        input=Signal(input, recording.unit(input)),
        result=Result.OK if fit.converged else Result.NOT_CONVERGED,
    )


def phase_of(recording: Recording, phase: Phase | AtEvent | Crossing) -> Phase:
    """The phase, or that of these events."""
    return phase if isinstance(phase, Phase) else estimate_phase(recording, phase)


def share(intervals: Intervals, used: Bool[np.ndarray, " L"], left: int | float) -> float:
    """Of the variance of durations within trials, what is explained where so much is left."""
    count = np.maximum(intervals.sums(1.0 * used), 1)
    mean = intervals.sums(intervals.duration * used) / count
    whole = ((intervals.duration - mean[intervals.trial])[used] ** 2).sum()
    return float(1 - left / whole) if whole > 0 else 0.0


def _memory(intervals: Intervals, fit: CurveFit) -> float:
    """Correlation of what is left of intervals that follow each other."""
    missed, end = fit.residual * fit.forecast.rate, intervals.start + intervals.duration
    next_to = fit.used[1:] & fit.used[:-1] & (np.diff(intervals.trial) == 0)
    next_to &= np.abs(intervals.start[1:] - end[:-1]) < 1e-6 * intervals.duration[1:]
    if next_to.sum() < 3:
        return 0.0
    return float(np.corrcoef(missed[1:][next_to], missed[:-1][next_to])[0, 1])


def _about(r: PhaseResponse) -> Iterator[str]:
    """What the data cannot tell."""
    mean, p = abs(r.coefficients[0]), p_value(r.p_flat)
    if r.p_flat > _LEVEL:
        yield (
            f"Shape: nothing is seen of it ({p} for a flat one); R2 of intervals left out is "
            f"{r.left_out_flat:.3f} with the mean alone."
        )
    else:
        yield (
            f"Shape: it adds {r.left_out - r.left_out_flat:.3f} to the R2 of intervals left out; a "
            f"flat curve has {r.left_out_flat:.3f} of {r.left_out:.3f}."
        )
    low, high = r.interval(r.phase)
    half = (high - low) / 2
    if half.max() > _WIDE * mean:
        worst = int(np.argmax(half))
        yield (
            f"Wide: at phase {r.phase[worst]:.2f} the 95 % interval reaches {half[worst]:.2g} to "
            f"either side, {100 * half[worst] / max(mean, 1e-300):.0f} % of the mean."
        )
    off = np.sqrt(np.mean((r.plain - r.values) ** 2))
    if off > np.sqrt(np.mean(r.errors**2)):
        yield (
            f"Plain regression at phases that grow linearly would be off by {off:.2g} (rms, of a "
            f"mean of {mean:.2g}); do not use it here."
        )
    finest = max(1, round(1 / (np.pi * max(r.jitter, 1e-6))))
    yield (
        f"Resolution: the jitter of {100 * r.jitter:.2g} % of a cycle hides what is finer than "
        f"harmonic {finest} at the end of a cycle."
    )
    if r.excess > _EXCESS:
        yield (
            f"Misfit: what is left of a block of intervals adds up to {r.excess:.1f} times the "
            "variance of independent errors: the phase model lacks something. Intervals allow for "
            "that, but do not know what it does to the curve."
        )
    if abs(r.memory) > _MEMORY:
        yield (
            f"Memory: what is left of neighboring intervals is correlated by {r.memory:.2f}: one "
            "number, the phase, is not all of the state. Standard errors allow for it."
        )
    if r.miscounted > _MISCOUNTED * r.intervals:
        yield (
            f"Miscounted: {r.miscounted} of {r.intervals} intervals "
            f"({100 * r.miscounted / r.intervals:.1f} %) miss the model by half a cycle or "
            "more, as if an event had been missed; they do not count."
        )
    if r.result != Result.OK:
        yield f"The fit did not end: {Result(r.result).message}."
