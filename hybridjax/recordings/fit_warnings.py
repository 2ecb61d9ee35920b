"""Reasons to doubt what is estimated from recordings, and how many strides a better fit needs.

Warnings about the signals themselves are made in `inspection/`.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.findings import Finding, print_findings, warn_of
from .._core.results import Result
from .._core.text import listed, p_value
from ..identify.series.fit import SeriesFit
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import MAY_DRIFT, CycleGrid, PreparedRecords
from ..identify.series.subspace import late_outputs, ordinary_least_squares
from ..identify.validate import Validation
from .data import LEAST_POWER, WHOLE_BAND, SectionData, input_band, input_spectrum
from .findings import NAME_REFERENCE


# Fraction of samples: if fewer remain beyond the number of unknowns, strides are few; if more are
# missing, they are reported. Larger: long recordings are called short. Smaller: fits with next to
# no freedom pass, and every gap is reported.
_FEW = 0.25
# Correlation of two outputs at a section that makes them redundant. Larger: nearly equal ones
# pass. Smaller: outputs that share most of a response are reported.
_SAME_OUTPUTS = 0.98
# Least modulus of a multiplier that may be that of a tone, and what is left of its mode at the end
# of a record. Larger: hum passes. Smaller: slow modes are called hum.
_DAMPED, _DECAYED = 0.9, 0.1
# Cycles per record below which there are few. Larger: every result comes with the warning.
# Smaller: a user trusts biased multipliers.
_FEW_CYCLES = 50
# Limits of warnings: correlation of neighboring residuals, and level of the test for a flat curve.
# Larger (the level: smaller): a user trusts what the data do not support. Smaller: every curve
# comes with warnings.
_MEMORY, _LEVEL = 0.2, 0.01


class Advice(eqx.Module):
    """Reasons to doubt a fit. Printing it shows the warnings.

    **Fields:**

    - `warnings`: findings about the data and the fit; none if there is no reason for doubt.
    - `plain` (d,): the multipliers from plain regression (ARX).
    - `band`: for each input the frequency (cycles per period) up to which it had power.
    - `strides`: numbers of strides. `expected` (k, d): the standard errors of the multipliers that
      so many strides like these would give.
    """

    warnings: tuple[Finding, ...]
    plain: Complex[np.ndarray, " d"]
    band: tuple[float, ...] = eqx.field(static=True)
    strides: tuple[int, ...] = eqx.field(static=True)
    expected: Float[np.ndarray, "k d"]

    def __repr__(self) -> str:
        return (
            print_findings(self.warnings)
            or "No reason to doubt the multipliers was found."
        )


@checked
def advise(
    data: SectionData,
    fit: SeriesFit,
    validation: Validation | None = None,
    findings: Sequence[Finding] = (),
) -> Advice:
    """List the reasons to doubt a fit to recorded data.

    They are: too few strides for the unknowns, more multipliers than the data support, inputs
    without power at the frequencies of the multipliers, redundant outputs, inputs that answer the
    outputs, confidence intervals that reach the unit circle, an iteration that did not converge,
    gaps and spikes.

    **Arguments:** `data`: the data at the sections. `fit`: the result of `fit_series`.
    `validation`: a validation on held-out strides, whose tests are reported. `findings`: findings
    of an inspection and of other estimates, which come first. Default: none.
    """
    N, R, _, nu = fit.numerators.shape
    d, records = len(fit.multipliers), PreparedRecords(data, free_start=True)
    problem = OutputErrorProblem.from_data(
        records, d, R - 1 - fit.lead - d * N, free_start=True
    )
    delayed, grid = late_outputs(problem, d), records.whole()
    sampled = int(grid.sampled.all(axis=3).sum(axis=(0, 1)).min())
    unknowns, plain = R * nu + len(grid.y) * (d + 1), ordinary_least_squares(delayed)
    warnings: list[Finding] = []
    if sampled - unknowns < _FEW * sampled:
        text = f"a section was sampled {sampled} times for {unknowns} unknowns; record more, take "
        warnings.append(
            Finding("few strides", f"{text}fewer sections, or excite fewer inputs.")
        )
    if fit.doubt:
        warnings.append(
            Finding("drift" if fit.doubt == MAY_DRIFT else "order", f"{fit.doubt}.")
        )
    band = input_band(data)
    for name in fit.feedback:
        text = f"{name} answers earlier residuals of the outputs: fits are biased. {NAME_REFERENCE}"
        warnings.append(Finding("feedback", text))
    warnings += [*_about_excitation(data, fit, band), *_about_outputs(grid, fit)]
    for z, error in zip(fit.multipliers, fit.standard_errors, strict=True):
        if fit.result == Result.OK and z.imag >= 0 and abs(z) + 2 * error > 1:
            text = f"the interval of the multiplier {z:.3g} reaches the unit circle."
            warnings.append(Finding("stability", text))
    if fit.result != Result.OK:
        warnings.append(Finding("no convergence", f"{Result(fit.result).message}."))
    # Correlation in time is no reason to doubt: smoothing and disturbances of the state cause it,
    # and standard errors allow for it. Nor are residuals below a hundredth of the output, in which
    # the test sees the distortion of small pushes if there is little noise.
    p = np.ones(1) if validation is None else validation.independence
    if validation and not validation.independent and validation.fit[p.argmin()] < 99:
        text = f"residuals of the held-out strides depend on the input ({p_value(p.min())}): raise "
        warnings.append(
            Finding("left over", f"{text}`order`, sample faster, or push less.")
        )
    if validation and validation.unexplained:
        text = f"{listed(validation.unexplained)}: the model predicts held-out strides no better "
        warnings.append(
            Finding("no fit", f"{text}than the mean cycle does: it explains nothing.")
        )
    if data.missing > _FEW:
        warnings.append(
            Finding("gaps", f"{100 * data.missing:.0f} % of the samples are missing.")
        )
    for name, count in zip(data.signals, data.spikes, strict=True):
        if count:
            text = f"isolated outliers of {name} that were left out: {count}."
            warnings.append(Finding("spikes", text))
    # Variances decrease with the number of strides beyond that of the unknowns.
    strides = (100, 300, 1000, 3000)
    later = np.array([max(n - (R * nu + d + 1), 0) for n in strides], float)
    with np.errstate(divide="ignore"):
        expected = (
            fit.standard_errors * np.sqrt(max(sampled - unknowns, 1) / later)[:, None]
        )
    warn_of(warnings)
    warnings = [*findings, *slow_sampling(data), *warnings]
    return Advice(tuple(warnings), plain, tuple(band), strides, expected)


def slow_sampling(data: SectionData) -> list[Finding]:
    """Find outputs of which interpolation between samples loses as much as they deviate."""
    text = f"without every second sample, outputs would change by {data.unresolved:.2g} times their"
    finding = Finding(
        "sampling", f"{text} deviations: multipliers may be wrong. Sample faster."
    )
    # (Noise gives up to 1.3, and would be reported below that. Above, wrong fits pass: with 10
    # samples in a cycle, errors were up to four standard errors at 1.6 to 2.1.)
    return [finding] if data.unresolved > 1.5 else []


def undamped(data: SectionData, fit: SeriesFit) -> Iterator[Finding]:
    """Find multipliers of modes that decay so little that they may be tones or drift."""
    cycles = max(len(r.u) for r in data.records) / data.n_sections
    least = max(_DAMPED, _DECAYED ** (1 / cycles))
    for z in fit.multipliers:
        if fit.result == Result.OK and z.imag >= 0 and abs(z) > least:
            text = f"the mode of the multiplier {z:.3g} hardly decays in {cycles:.0f} cycles: look "
            yield Finding(
                "no decay", f"{text}for hum or drift in the spectra of outputs."
            )


def _about_excitation(
    data: SectionData, fit: SeriesFit, band: list[float]
) -> Iterator[Finding]:
    f, power = input_spectrum(data)
    for name, edge, strength in zip(fit.inputs, band, power.T, strict=True):
        for z in (x for x in fit.multipliers if x.imag >= 0):
            at = abs(np.angle(z)) / (2 * np.pi)
            near = np.abs((f[:, None] - [at, -at] + 0.5) % 1 - 0.5).min(axis=1) < 0.1
            if strength[near].max(initial=0) < LEAST_POWER * strength.max():
                text = f"{name} has next to no power at {at:.2f} + k cycles per period, where the "
                yield Finding("weak excitation", f"{text}multiplier {z:.3g} is seen.")
        if edge < WHOLE_BAND * fit.n_sections / 2:
            text = f"transfer functions are determined up to {edge:.3g} cycles per period, where "
            text += f"the power of {name} ends."
            text += " Responses at different phases can hardly be told apart." * (
                edge < 1
            )
            yield Finding("narrow excitation" if edge < 1 else "band", text)


def _about_outputs(grid: CycleGrid, fit: SeriesFit) -> Iterator[Finding]:
    N, ny = grid.y.shape[2:]
    for i, j in combinations(range(ny), 2):
        y, sampled = (x[..., [i, j]].reshape(-1, N, 2) for x in (grid.y, grid.sampled))
        both = np.asarray(sampled.all(axis=2))
        with np.errstate(
            invalid="ignore"
        ):  # of an output that is constant at a section
            matrices = [np.corrcoef(y[both[:, n], n].T) for n in range(N)]
        if np.median(np.nan_to_num(np.abs(matrices)[:, 0, 1])) > _SAME_OUTPUTS:
            text = f"{fit.outputs[i]} and {fit.outputs[j]} carry the same information at sections: "
            yield Finding(
                "outputs", f"{text}cycles between crossings may have smaller errors."
            )


def about_natural_multipliers(result: Any) -> Iterator[Finding]:
    """Limits of a result of `natural_multipliers`."""
    each, high = result.cycles / result.records, result.interval()[0, 1]
    if each < _FEW_CYCLES:
        size = (1 + 3 * abs(result.multipliers[0])) / each
        bias = f"a bias of about {size:.2f} was corrected to first order only."
        yield Finding(
            "few cycles", f"{each:.3g} in each of {result.records} records; {bias}"
        )
    if result.strength < 0.5:
        text = f"earlier sections explain {100 * result.strength:.0f} % of the states' variance."
        yield Finding("weak instruments", text)
    if high >= 1:
        text = f"the interval of the largest modulus reaches {high:.2f}, beyond 1."
        yield Finding("stability", text)
    if result.doubt:
        yield Finding("order", result.doubt)


def about_phase_response(r: Any) -> Iterator[Finding]:
    """Limits of a result of `phase_response`."""
    if r.p_flat > _LEVEL:
        yield Finding(
            "shape", f"a flat curve explains the data as well ({p_value(r.p_flat)})."
        )
    half = np.ptp(r.interval(r.phase), axis=0) / 2
    if half.max() > abs(r.coefficients[0]) / 2:
        worst = int(np.argmax(half))
        text = f"at phase {r.phase[worst]:.2f} the 95 % interval reaches {half[worst]:.2g} to "
        yield Finding("wide", f"{text}either side, more than half of the mean.")
    finest = max(1, round(1 / (np.pi * max(r.jitter, 1e-6))))
    text = f"the jitter of {100 * r.jitter:.2g} % of a cycle hides what is finer than harmonic "
    yield Finding("resolution", f"{text}{finest} at the end of a cycle.")
    if r.excess > 2:
        text = f"residuals of a block of intervals add up to {r.excess:.1f} times the variance of "
        yield Finding(
            "misfit", f"{text}independent errors: the phase model lacks something."
        )
    if abs(r.memory) > _MEMORY:
        text = f"residuals of neighboring intervals are correlated by {r.memory:.2f}: the curve "
        yield Finding(
            "memory",
            f"{text}shows the effect of a push on its own interval, not later.",
        )
    if r.miscounted:
        text = f"{r.miscounted} of {r.intervals} intervals miss the model by half a cycle or more"
        yield Finding(
            "miscounted", f"{text}, as if an event had been missed; they are not used."
        )
    if r.result != Result.OK:
        yield Finding("no convergence", f"{Result(r.result).message}.")
