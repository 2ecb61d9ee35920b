"""Findings about estimates from recordings, and the number of strides that a better fit needs.

`identify_recording` calls `diagnosis_of`; `natural_multipliers` and `phase_response` call
`about_natural_multipliers` and `about_phase_response`. Each function below yields the findings of
one kind, and the constants are their limits. Findings about the signals themselves are made in
`inspection/`.

A new finding about a fit is one more function, called in `diagnosis_of`. `undamped` and
`_about_multipliers` skip fits that failed, whose multipliers mean little: this must stay.

If a finding is missed or needless, look at the function that yields it: its limits are the
constants here, or stand in it. If the expected standard errors are wrong, look at the end of
`diagnosis_of`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from scipy import stats

from .._core.boundary.checked import checked
from .._core.findings import Finding, print_findings, warn_of
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import listed, p_value, rounded, standard_error
from ..identify.series.delayed_outputs import late_outputs, ordinary_least_squares
from ..identify.series.fit import SeriesFit
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import CycleGrid, PreparedRecords
from ..identify.validation import Validation
from .data import LEAST_POWER, WHOLE_BAND, SectionData, input_band, input_spectrum
from .findings import NAME_REFERENCE


# There is a finding if fewer than this part of the samples remains after subtracting the number of
# unknowns, or if more than this part is missing. Larger: long recordings are called short. Smaller:
# fits with next to no freedom pass, and every gap is reported.
_FEW = 0.25
# Correlation of two outputs at a section that makes them redundant. Larger: nearly equal ones
# pass. Smaller: outputs that share most of a response are reported.
_SAME_OUTPUTS = 0.98
# A multiplier may come from a tone (hum) if its modulus exceeds this, and if more than a part of
# its mode is left at the end of a record. Larger: hum passes. Smaller: slow modes are called hum.
_DAMPED = 0.9
_DECAYED = 0.1
# A record with fewer cycles than this is short. Larger: every result has this finding. Smaller:
# results with biased multipliers do not have it.
_FEW_CYCLES = 50
# Limits of findings about phase response curves: correlation of neighboring residuals, and level of
# the test for a flat curve. With a larger correlation or a smaller level, curves that the data do
# not support have no finding. With a smaller correlation or a larger level, every curve has
# findings.
_MEMORY = 0.2
_LEVEL = 0.01
# A wide band is explained by a slow input if less than this part of the input's variance lies
# within intervals. Larger: other causes of wide bands get this name. Smaller: slow inputs are not
# named.
_FAST = 0.2


Multipliers = Complex[np.ndarray, " d"]


class Diagnosis(Showable, eqx.Module):
    """Reasons to doubt a fit. Printing it shows the findings.

    **Fields:**

    - `findings` about the data and the fit; none if there is no reason for doubt.
    - `plain` (d,): the multipliers from plain regression (ARX).
    - `bandwidths`: for each input the frequency (cycles per period) up to which it had power.
    - `cycles`: numbers of cycles. `expected` (k, d): the standard errors of the multipliers that
      these numbers of cycles would give.
    """

    findings: tuple[Finding, ...] = eqx.field()
    plain: Multipliers
    bandwidths: tuple[float, ...] = eqx.field(static=True)
    cycles: tuple[int, ...] = eqx.field(static=True)
    expected: Float[np.ndarray, "k d"]

    def __repr__(self) -> str:
        findings = print_findings(self.findings)
        return findings or "No reason to doubt the multipliers was found."

    def with_earlier(self, findings: Sequence[Finding]) -> "Diagnosis":
        """Return the diagnosis with other findings before its own."""
        return replace(self, findings=(*findings, *self.findings))


@checked
def diagnose(
    data: SectionData,
    fit: SeriesFit,
    validation: Validation | None = None,
    findings: Sequence[Finding] = (),
) -> Diagnosis:
    """List the reasons to doubt a fit to recorded data.

    They are: too few strides for the unknowns, more multipliers than the data support, inputs
    without power at the frequencies of the multipliers, redundant outputs, inputs that respond to
    the outputs, confidence intervals that reach the unit circle, an iteration that did not
    converge, gaps and spikes.

    **Arguments:**

    - `data`: the data at the sections, result of `sample_sections`.
    - `fit`: result of `fit_series`.
    - `validation`: a validation on held-out strides, whose tests are reported. Default: None.
    - `findings`: findings of an inspection and of other estimates, which come first. Default: none.

    **Returns:** `hj.recordings.Diagnosis`: `findings`; `plain` (d,), multipliers of a plain
    regression; `bandwidths`, one per input, in cycles per period; `expected` (k, d), the standard
    errors that `cycles` (k,) would give.

    **Raises:** `DefinitionError` for data without inputs, and with too few cycles for the order of
    the fit.

    **Example:**

    ```python
    print(hj.recordings.diagnose(result.data, result.fit))
    ```

    **Before:** `hj.fit_series`, `hj.recordings.hold_out`. **After:** a longer recording, or
    `hj.plot.multipliers`.
    """
    prepared = PreparedRecords(data, free_start=True)
    diagnosis = diagnosis_of(data, prepared, fit, validation)
    warn_of(diagnosis.findings)
    return diagnosis.with_earlier([*findings, *slow_sampling(data)])


def diagnosis_of(
    data: SectionData,
    prepared: PreparedRecords,
    fit: SeriesFit,
    validation: Validation | None,
) -> Diagnosis:
    """Return a diagnosis of the fit alone, from data that were prepared for it."""
    N, R, _, nu = fit.numerators.shape
    d = len(fit.multipliers)
    extra_lags = R - 1 - fit.lead - d * N
    problem = OutputErrorProblem.from_data(prepared, d, extra_lags, free_start=True)
    plain = ordinary_least_squares(late_outputs(problem, d))
    grid = prepared.whole()
    sampled = int(grid.sampled.all(axis=3).sum(axis=(0, 1)).min())
    unknowns = R * nu + len(grid.y) * (d + 1)
    band = input_band(data)
    findings = (
        *_few_strides(sampled, unknowns),
        *_order_and_feedback(fit),
        *_about_excitation(data, fit, band),
        *_about_outputs(grid, fit),
        *_about_multipliers(fit),
        *_about_held_out(validation),
        *_about_samples(data),
    )
    # Variances are proportional to one over the number of strides less the number of unknowns.
    cycles = (100, 300, 1000, 3000)
    parameters = R * nu + d + 1
    later = np.array([max(n - parameters, 0) for n in cycles], float)
    with np.errstate(divide="ignore"):
        smaller = np.sqrt(max(sampled - unknowns, 1) / later)
    return Diagnosis(
        findings=findings,
        plain=plain,
        bandwidths=tuple(band),
        cycles=cycles,
        expected=fit.standard_errors * smaller[:, None],
    )


def slow_sampling(data: SectionData) -> Iterator[Finding]:
    """Find outputs whose errors of interpolation between samples are as large as their
    deviations."""
    # Noise has values up to 1.3, so that the limit must be higher. With a higher limit than this,
    # wrong fits pass: with 10 samples in a cycle, errors were up to four standard errors at 1.6 to
    # 2.1.
    if data.unresolved > 1.5:
        yield Finding(
            "sampling",
            f"without every second sample, outputs would change by {data.unresolved:.2g} times "
            "their deviations: multipliers may be wrong. Sample faster.",
        )


def undamped(data: SectionData, fit: SeriesFit) -> Iterator[Finding]:
    """Find multipliers of modes that decay so little that they may be tones or drift."""
    if fit.result != Result.OK:
        return
    cycles = max(len(record.u) for record in data.records) / data.n_sections
    least = max(_DAMPED, _DECAYED ** (1 / cycles))
    for z in _upper(fit.multipliers):
        if abs(z) > least:
            yield Finding(
                "no decay",
                f"the mode of the multiplier {z:.3g} hardly decays in {cycles:.0f} cycles: look "
                "for hum or drift in the spectra of outputs.",
            )


def _upper(multipliers: Multipliers) -> Multipliers:
    """Return one multiplier of each pair."""
    return multipliers[np.imag(multipliers) >= 0]


def _few_strides(sampled: int, unknowns: int) -> Iterator[Finding]:
    if sampled - unknowns < _FEW * sampled:
        yield Finding(
            "few strides",
            f"a section was sampled {sampled} times for {unknowns} unknowns; record more, take "
            "fewer sections, or excite fewer inputs.",
        )


def _order_and_feedback(fit: SeriesFit) -> Iterator[Finding]:
    yield from fit.findings
    if any(finding.cause == "feedback" for finding in fit.findings):
        yield Finding("feedback", NAME_REFERENCE)


def _about_excitation(
    data: SectionData,
    fit: SeriesFit,
    band: Sequence[float],
) -> Iterator[Finding]:
    f, power = input_spectrum(data)
    # (Without convergence, the multipliers are those of the last step.)
    found = _upper(fit.multipliers) if fit.result == Result.OK else ()
    for name, edge, strength in zip(fit.inputs, band, power.T, strict=True):
        for z in found:
            at = abs(np.angle(z)) / (2 * np.pi)
            shifted = f[:, None] - [at, -at]
            distance = np.abs((shifted + 0.5) % 1 - 0.5).min(axis=1)
            near = strength[distance < 0.1].max(initial=0)
            if near < LEAST_POWER * strength.max():
                yield Finding(
                    "weak excitation",
                    f"{name} has next to no power at {at:.2f} + k cycles per period, where the "
                    f"multiplier {z:.3g} is seen.",
                )
        if edge >= WHOLE_BAND * fit.n_sections / 2:
            continue
        determined = (
            f"transfer functions are determined up to {edge:.3g} cycles per period, where the "
            f"power of {name} ends."
        )
        if edge < 1:
            yield Finding(
                "narrow excitation",
                f"{determined} Responses at different phases can hardly be told apart.",
            )
        else:
            yield Finding("band", determined)


def _about_outputs(grid: CycleGrid, fit: SeriesFit) -> Iterator[Finding]:
    """Find pairs of outputs whose median correlation over the sections is nearly one."""
    N, ny = grid.y.shape[2:]
    measured = np.where(grid.sampled, grid.y, np.nan)
    y = measured.reshape(-1, N, ny)
    for i, j in combinations(range(ny), 2):
        pair = y[..., [i, j]]
        known = np.asarray(np.isfinite(pair).all(axis=2))
        # (An output that is constant at a section has no correlation.)
        with np.errstate(invalid="ignore"):
            correlations = [np.corrcoef(pair[known[:, n], n].T)[0, 1] for n in range(N)]
        if np.median(np.nan_to_num(np.abs(correlations))) > _SAME_OUTPUTS:
            yield Finding(
                "outputs",
                f"{fit.outputs[i]} and {fit.outputs[j]} carry the same information at sections: "
                "cycles between crossings may have smaller errors.",
            )


def _about_multipliers(fit: SeriesFit) -> Iterator[Finding]:
    if fit.result != Result.OK:
        return
    for z, error in zip(fit.multipliers, fit.standard_errors, strict=True):
        if z.imag >= 0 and abs(z) + 2 * error > 1:
            yield Finding(
                "stability",
                f"the interval of the multiplier {z:.3g} reaches the unit circle.",
            )


def _about_held_out(validation: Validation | None) -> Iterator[Finding]:
    """Find assumptions of a fit that its validation on held-out strides contradicts.

    Correlation in time is no finding: smoothing and disturbances of the state cause it, and
    standard errors allow for it. Residuals below a hundredth of the output are no finding, either:
    with little noise, the test notices the nonlinear response to small pushes.
    """
    if validation is None:
        return
    worst = int(validation.independence.argmin())
    if not validation.independent and validation.fit[worst] < 99:
        p = validation.independence[worst]
        yield Finding(
            "left over",
            f"residuals of the held-out strides depend on the input ({p_value(p)}): raise `order`, "
            "sample faster, or push less.",
        )
    if validation.unexplained:
        yield Finding(
            "no fit",
            f"{listed(validation.unexplained)}: the model predicts held-out strides no better than "
            "the mean cycle does: it explains nothing.",
        )


def _about_samples(data: SectionData) -> Iterator[Finding]:
    if data.missing > _FEW:
        yield Finding("gaps", f"{100 * data.missing:.0f} % of the samples are missing.")
    for name, count in zip(data.signals, data.spikes, strict=True):
        if count:
            yield Finding(
                "spikes", f"isolated outliers of {name} that were left out: {count}."
            )


def about_natural_multipliers(result: Any) -> Iterator[Finding]:
    """Limits of a result of `natural_multipliers`."""
    each = result.cycles / result.records
    if each < _FEW_CYCLES:
        bias = (1 + 3 * abs(result.multipliers[0])) / each
        yield Finding(
            "few cycles",
            f"{each:.3g} in each of {result.records} records; a bias of about {bias:.2f} was "
            "corrected to first order only.",
        )
    if result.strength < 0.5:
        yield Finding(
            "weak instruments",
            f"earlier sections explain {100 * result.strength:.0f} % of the states' variance.",
        )
    largest = result.interval()[0, 1]
    if largest >= 1:
        yield Finding(
            "stability",
            f"the interval of the largest modulus reaches {largest:.2f}, beyond 1.",
        )


def about_phase_response(curve: Any) -> Iterator[Finding]:
    """Limits of a result of `phase_response`."""
    if curve.p_flat > _LEVEL:
        yield Finding(
            "shape",
            f"a flat curve explains the data as well ({p_value(curve.p_flat)}).",
        )
    low, high = curve.interval(curve.phase)
    half = (high - low) / 2
    wide = half.max() > abs(curve.coefficients[0]) / 2
    worst = int(np.argmax(half))
    if wide:
        yield Finding(
            "wide",
            f"at phase {curve.phase[worst]:.2f} the 95 % interval reaches {half[worst]:.2g} to "
            "either side, more than half of the mean.",
        )
    if wide and curve.within < _FAST:
        yield Finding(
            "slow input",
            f"only {100 * curve.within:.2g} % of the variance of {curve.input} lie within "
            "intervals, so that the data determine the mean of the curve, but hardly its shape: "
            "add input that changes within a cycle, up to twice the frequency of the rhythm.",
        )
    jitter = max(curve.jitter, 1e-6)
    finest = max(1, round(1 / (np.pi * jitter)))
    yield Finding(
        "resolution",
        f"the jitter of {100 * curve.jitter:.2g} % of a cycle hides what is finer than harmonic "
        f"{finest} at the end of a cycle.",
    )
    if curve.excess > 2:
        yield Finding(
            "misfit",
            f"residuals of a block of intervals add up to {curve.excess:.1f} times the variance of "
            "independent errors: the phase model lacks something.",
        )
    carried = curve.carried / curve.carried_error
    if 2 * stats.t.sf(abs(carried), curve.dof) < _LEVEL:
        yield Finding(
            "memory",
            "a push changes the next interval, too: by "
            f"{rounded(curve.carried, curve.carried_error)} ± "
            f"{standard_error(curve.carried_error)} (standard error) times the change of its own. "
            "The curve shows the change of its own interval; the shift that stays is another. "
            "`hj.identify_recording` with `outputs=()` fits durations with their memory.",
        )
    elif abs(curve.memory) > _MEMORY:
        yield Finding(
            "memory",
            f"residuals of neighboring intervals are correlated by {curve.memory:.2f}: an interval "
            "depends on the one before, and the curve shows the effect of a push on its own.",
        )
    if curve.miscounted:
        yield Finding(
            "miscounted",
            f"{curve.miscounted} of {curve.intervals} intervals miss the model by half a cycle or "
            "more, as if an event had been missed; they are not used.",
        )
    if curve.result != Result.OK:
        yield Finding("no convergence", f"{Result(curve.result).message}.")
