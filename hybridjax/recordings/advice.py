"""Reasons to doubt a fit to recorded data, and how many strides a better one needs."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.results import Result
from .._core.text import p_value
from ..errors import DefinitionError
from ..identify.multiplier_estimate import compare_multipliers
from ..identify.series.arx import delayed_outputs, ordinary_least_squares, refuse_order
from ..identify.series.fit import SeriesFit
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import CycleGrid, PreparedRecords
from ..identify.validate import Validation
from .beats.response import PhaseResponse
from .data import WHOLE_BAND, SectionData, input_band, input_spectrum
from .findings import Finding, print_findings


# Fraction of the samples of a section beyond the number of unknowns, below which strides are few.
# Larger: long recordings are called short. Smaller: fits with next to no freedom pass.
_FEW_LEFT_OVER = 0.25
# Power of an input within 0.1 cycles per period of a multiplier's frequency, relative to its mean,
# below which it is weak. Larger: colored inputs are called weak. Smaller: multipliers that the
# input hardly excites pass.
_WEAK_POWER = 0.02
# Fraction of missing samples that is reported. Larger: incomplete recordings pass. Smaller: every
# real one is reported.
_MANY_MISSING = 0.2
# Correlation of two outputs at a section that makes them redundant. Larger: nearly equal ones
# pass. Smaller: outputs that share most of a response are reported.
_SAME_OUTPUTS = 0.98
# Numbers of strides for which standard errors are predicted.
_STRIDES = (100, 300, 1000, 3000)


class Advice(eqx.Module):
    """Reasons to doubt a fit. Printing it shows the warnings.

    **Fields:**

    - `warnings`: findings about the data and the fit; none if there is no reason for doubt.
    - `plain` (d,): the multipliers from plain regression (ARX). `bias`: their distance from those
      of the fit.
    - `band`: for each input the frequency (cycles per period) up to which it had power.
    - `strides`: numbers of strides. `expected` (k, d): the standard errors of the multipliers that
      so many strides like these would give.
    """

    warnings: tuple[Finding, ...]
    plain: Complex[np.ndarray, " d"]
    bias: float = eqx.field(static=True)
    band: tuple[float, ...] = eqx.field(static=True)
    strides: tuple[int, ...] = eqx.field(static=True)
    expected: Float[np.ndarray, "k d"]

    def __repr__(self) -> str:
        return print_findings(self.warnings) or "Nothing speaks against the fit."


@checked
def advise(
    data: SectionData,
    fit: SeriesFit,
    validation: Validation | None = None,
    findings: Sequence[Finding] = (),
    curve: PhaseResponse | None = None,
) -> Advice:
    """List the reasons to doubt a fit to recorded data.

    They are: too few strides for the unknowns, more multipliers than the data support, inputs
    without power at the frequencies of the multipliers, redundant outputs, noise that would bias
    plain regression, confidence intervals that reach the unit circle, an iteration that did not
    converge, gaps and spikes.

    **Arguments:** `data`: the data at the sections. `fit`: the result of `fit_series`.
    `validation`: a validation on held-out strides, whose tests are reported. `findings`: findings
    of an inspection, which come first. `curve`: the phase response curve of events alone, whose
    warnings come last. Default: None.
    """
    return collect_advice(data, PreparedRecords(data), fit, validation, findings, curve)


def collect_advice(
    data: SectionData,
    records: PreparedRecords,
    fit: SeriesFit,
    validation: Validation | None,
    findings: Sequence[Finding],
    curve: PhaseResponse | None,
) -> Advice:
    """Collect the advice on a fit to the data; `records`: those of the data."""
    N, R, _, nu = fit.numerators.shape
    d = len(fit.multipliers)
    problem = OutputErrorProblem.from_data(records, d, R - 1 - fit.lead - d * N, free_start=True)
    delayed, grid = delayed_outputs(problem, d), records.whole()
    sampled = int(grid.sampled.all(axis=3).sum(axis=(0, 1)).min())
    unknowns = R * nu + len(grid.y) * (d + 1)
    plain = ordinary_least_squares(delayed)
    bias = float(compare_multipliers(plain, fit.multipliers).max_error)
    warnings = list(findings)
    if sampled - unknowns < _FEW_LEFT_OVER * sampled:
        warnings.append(
            Finding(
                "few strides",
                f"a section was sampled {sampled} times for {unknowns} unknowns; record more, take "
                "fewer sections, or excite fewer inputs.",
            )
        )
    try:
        refuse_order(delayed, fit.noise / problem.scale)
    except DefinitionError:
        warnings.append(
            Finding(
                "order",
                f"the data do not carry {d} multipliers. The weakest may be noise alone (or nearly "
                "zero in truth); neither its value nor its interval then means anything.",
            )
        )
    band = input_band(data)
    warnings += [*_about_excitation(data, fit, band), *_about_outputs(grid, fit)]
    if bias > 2 * fit.standard_errors.max():
        values = ", ".join(f"{z:.4f}" for z in plain)
        text = f"plain regression (ARX) would give {values}, off by {bias:.2g}; do not use it here."
        warnings.append(Finding("noise", text))
    warnings += _about_the_fit(fit)
    warnings += () if validation is None else _about_residuals(validation)
    if data.missing > _MANY_MISSING:
        warnings.append(Finding("gaps", f"{100 * data.missing:.0f} % of the samples are missing."))
    for name, count in zip(data.signals, data.spikes, strict=True):
        if count:
            text = f"{count} samples of {name} stuck out of all around them, and were left out."
            warnings.append(Finding("spikes", text))
    warnings += () if curve is None else curve.warnings
    # Variances decrease with the number of strides beyond that of the unknowns.
    now = max(sampled - unknowns, 1)
    later = np.array([max(n - (R * nu + d + 1), 0) for n in _STRIDES], float)
    with np.errstate(divide="ignore"):
        expected = fit.standard_errors * np.sqrt(now / later)[:, None]
    return Advice(tuple(warnings), plain, bias, tuple(band), _STRIDES, expected)


def _about_excitation(data: SectionData, fit: SeriesFit, band: list[float]) -> Iterator[Finding]:
    f, power = input_spectrum(data)
    for i, name in enumerate(fit.inputs):
        for z in fit.multipliers:
            at = abs(np.angle(z)) / (2 * np.pi)
            near = [np.abs((f - x + 0.5) % 1 - 0.5) < 0.1 for x in (at, -at)]
            strongest = power[near[0] | near[1], i].max(initial=0)
            if z.imag >= 0 and strongest < _WEAK_POWER * power[:, i].mean():
                yield Finding(
                    "weak excitation",
                    f"{name} has next to no power at the frequencies {at:.2f} + k cycles per "
                    f"period, where the multiplier {z:.3g} is seen.",
                )
    for name, edge in zip(fit.inputs, band, strict=True):
        if edge < 1:
            yield Finding(
                "narrow excitation",
                f"{name} has power only up to {edge:.2g} cycles per period, so that responses at "
                "different phases can hardly be told apart.",
            )
        elif edge < WHOLE_BAND * fit.n_sections / 2:
            yield Finding(
                "band",
                f"transfer functions are determined up to f = {edge:.3g} cycles per period only, "
                f"where the power of {name} ends.",
            )


def _about_outputs(grid: CycleGrid, fit: SeriesFit) -> Iterator[Finding]:
    y = np.where(grid.sampled, grid.y, np.nan)
    for i, j in combinations(range(y.shape[3]), 2):
        if _correlation(y[..., i], y[..., j]) > _SAME_OUTPUTS:
            yield Finding(
                "outputs",
                f"where sections are crossed, {fit.outputs[i]} and {fit.outputs[j]} are two sides "
                "of one number, as signals are whose angle is the phase. Cycles from crossing to "
                "crossing (a `Crossing` as the phase, `--crossing`) may make the standard errors "
                "of multipliers much smaller.",
            )


def _correlation(x: Float[np.ndarray, "S T N"], y: Float[np.ndarray, "S T N"]) -> float:
    """Return the median over sections of the modulus of the correlation."""
    finite = np.isfinite(x) & np.isfinite(y)
    both = np.where(finite, [x, y], 0.0)
    mean = both.sum(axis=(1, 2), keepdims=True) / np.maximum(finite.sum(axis=(0, 1)), 1)
    x, y = np.where(finite, both - mean, 0.0)
    xy, xx, yy = ((a * b).sum(axis=(0, 1)) for a, b in ((x, y), (x, x), (y, y)))
    return float(np.median(np.abs(xy) / np.sqrt(np.maximum(xx * yy, np.finfo(float).tiny))))


def _about_the_fit(fit: SeriesFit) -> Iterator[Finding]:
    for z, error in zip(fit.multipliers, fit.standard_errors, strict=True):
        if z.imag >= 0 and abs(z) + 2 * error > 1:
            text = f"the interval of the multiplier {z:.3g} reaches the unit circle."
            yield Finding("stability", text)
    if fit.result != Result.OK:
        yield Finding("no convergence", f"{Result(fit.result).message}.")


def _about_residuals(validation: Validation) -> Iterator[Finding]:
    if not validation.white:
        yield Finding(
            "left over",
            "residuals of the held-out strides are correlated in time "
            f"({p_value(validation.whiteness.min())}). Smoothing does that, and so do disturbances "
            "of the state, and standard errors allow for both; if the multipliers change with "
            "another `bandwidth` or `order`, the model lacks something.",
        )
    if not validation.independent:
        yield Finding(
            "left over",
            "residuals of the held-out strides depend on the input "
            f"({p_value(validation.independence.min())}). Few strides for many coefficients do "
            "that, and so do pushes beyond the linear range: record more, or push less; if it "
            "remains, raise the `order`.",
        )
