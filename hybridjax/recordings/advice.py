"""What the data cannot carry, in plain words."""

import textwrap
from collections.abc import Iterator, Sequence
from itertools import combinations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order
from .._core.results import Result
from .._core.text import p_value
from ..errors import DefinitionError
from ..experiments.record import RecordedData
from ..identify.multiplier_estimate import compare_multipliers
from ..identify.series.arx import delayed_outputs, ordinary_least_squares, refuse_order
from ..identify.series.fit import SeriesFit
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import CycleGrid, PreparedRecords
from ..identify.validate import Validation
from .beats.response import PhaseResponse
from .data import SectionData
from .inspection.finding import Finding
from .spectra import input_band, input_spectrum


# Of the samples of a section, the share that the unknowns must leave over. Doubled: more recordings
# are said to have few strides.
_FEW_LEFT_OVER = 0.25
# Of its mean power, what an input has near a multiplier's frequency; less is weak. Doubled: more
# inputs are.
_WEAK_POWER = 0.02
# How near a multiplier's frequency is, in cycles per period. Doubled: power further off counts.
_NEAR = 0.1
# Of all samples, the share that may be missing unsaid. Doubled: recordings with more gaps pass.
_MANY_MISSING = 0.2
# Two outputs say the same if the median of their correlations at the sections is larger. (Not to be
# doubled: it lies below 1.)
_SAME_OUTPUTS = 0.98
# Standard errors by which plain regression must be off before it is said. Doubled: it is said less
# often.
_BIASED = 2
# Of N/2 cycles per period, the highest frequency of all, the share up to which an input must have
# power. Doubled: the edge is named for all inputs.
_WHOLE_BAND = 0.9
# Numbers of strides whose standard errors are foretold.
_STRIDES = (100, 300, 1000, 3000)


@checked
def plain_regression(data: RecordedData, order: Order) -> Complex[np.ndarray, " d"]:
    """Multipliers by least squares on chi y = B u (ARX), which noise in y biases towards zero.

    To see by how much: `fit_series` has no such bias.
    """
    parts = PreparedRecords(data)
    problem = OutputErrorProblem.from_data(parts, order, parts.n_sections, free_start=True)
    return ordinary_least_squares(delayed_outputs(problem, order))


class Advice(eqx.Module):
    """What to know before the numbers of a fit are believed. Printing it shows the warnings.

    **Fields:**

    - `warnings`: sentences; none if nothing speaks against the fit.
    - `plain` (d,): the multipliers that plain regression (ARX) gives, and `bias`, how far they are
      from those of the fit.
    - `band`: for each input the frequency (cycles per period) up to which it had power.
    - `strides`: numbers of strides, and `expected` (k, d): the standard errors of the multipliers
      to be expected with so many like these.
    """

    warnings: tuple[str, ...] = eqx.field(static=True)
    plain: Complex[np.ndarray, " d"]
    bias: float = eqx.field(static=True)
    band: tuple[float, ...] = eqx.field(static=True)
    strides: tuple[int, ...] = eqx.field(static=True)
    expected: Float[np.ndarray, "k d"]

    def __repr__(self) -> str:
        lines = (textwrap.fill(text, 100, subsequent_indent="  ") for text in self.warnings)
        return "\n".join(lines) or "Nothing speaks against the fit."


@checked
def advise(
    data: SectionData,
    fit: SeriesFit,
    validation: Validation | None = None,
    findings: Sequence[Finding] = (),
    curve: PhaseResponse | None = None,
) -> Advice:
    """Look for what makes a fit to recorded data worth less than it says.

    Too few strides for the unknowns, more multipliers than the data carry, inputs without power
    where the multipliers are, outputs that say the same, noise that would bias plain regression,
    intervals that reach the unit circle, an iteration that did not end; and with a `validation` on
    strides that were held out, what it finds left over. The `findings` of an inspection come first;
    last, for events alone, what the data cannot tell of their phase response `curve`.
    """
    N, R, _, nu = fit.numerators.shape
    d = len(fit.multipliers)
    parts = PreparedRecords(data)
    overhang = R - 1 - fit.lead - d * N
    problem = OutputErrorProblem.from_data(parts, d, overhang, free_start=True)
    delayed, grid = delayed_outputs(problem, d), parts.whole()
    sampled = int(grid.sampled.all(axis=3).sum(axis=(0, 1)).min())
    unknown = R * nu + len(grid.y) * (d + 1)
    plain = ordinary_least_squares(delayed)
    bias = float(compare_multipliers(plain, fit.multipliers).max_error)
    band = input_band(data)
    warnings = list(map(repr, findings))
    if sampled - unknown < _FEW_LEFT_OVER * sampled:
        warnings.append(
            f"Few strides: a section was sampled {sampled} times for {unknown} unknowns; "
            "record more, take fewer sections, or excite fewer inputs."
        )
    try:
        refuse_order(delayed, fit.noise / problem.scale)
    except DefinitionError:
        warnings.append(
            f"Order: the data do not carry {d} multipliers. The weakest may be noise alone (or "
            "nearly zero in truth); neither its value nor its interval then means anything."
        )
    warnings += _about_excitation(data, fit, band)
    warnings += _about_outputs(grid, fit)
    if bias > _BIASED * fit.standard_errors.max():
        warnings.append(
            f"Noise: plain regression (ARX) would give {_list(plain)}, off by {bias:.2g}; do not "
            "use it here."
        )
    warnings += _about_the_fit(fit)
    warnings += [] if validation is None else _about_what_is_left(validation)
    if data.missing > _MANY_MISSING:
        warnings.append(f"Gaps: {100 * data.missing:.0f} % of the samples are missing.")
    warnings += [
        f"Spikes: {count} samples of {name} stuck out of all around them, and were left out."
        for name, count in zip(data.signals, data.spikes, strict=True)
        if count
    ]
    warnings += [] if curve is None else curve.warnings
    # Variances go down with the number of strides that the unknowns leave over.
    now = max(sampled - unknown, 1)
    later = np.array([max(n - (R * nu + d + 1), 0) for n in _STRIDES], float)
    with np.errstate(divide="ignore"):
        expected = fit.standard_errors * np.sqrt(now / later)[:, None]
    return Advice(tuple(warnings), plain, bias, tuple(band), _STRIDES, expected)


def _about_excitation(data: SectionData, fit: SeriesFit, band: list[float]) -> Iterator[str]:
    """Whether the inputs had power where the multipliers are seen, and how far up."""
    f, power = input_spectrum(data)
    resonance = np.abs(np.angle(fit.multipliers)) / (2 * np.pi)
    for i, name in enumerate(fit.inputs):
        mean = power[:, i].mean()
        for z, at in zip(fit.multipliers, resonance, strict=True):
            near = np.abs((f - at + 0.5) % 1 - 0.5) < _NEAR
            mirrored = np.abs((f + at + 0.5) % 1 - 0.5) < _NEAR
            if z.imag >= 0 and power[near | mirrored, i].max(initial=0) < _WEAK_POWER * mean:
                yield (
                    f"Weak excitation: {name} has next to no power at the frequencies "
                    f"{at:.2f} + k cycles per period, where the multiplier {z:.3g} is seen."
                )
    for name, edge in zip(fit.inputs, band, strict=True):
        if edge < 1:
            yield (
                f"Narrow excitation: {name} has power only up to {edge:.2g} cycles per period, so "
                "that responses at different phases can hardly be told apart."
            )
        elif edge < _WHOLE_BAND * fit.n_sections / 2:
            yield (
                f"Transfer functions are determined up to f = {edge:.3g} cycles per period only, "
                f"where the power of {name} ends."
            )


def _about_outputs(grid: CycleGrid, fit: SeriesFit) -> Iterator[str]:
    """Whether two of them are one number."""
    y = np.where(grid.sampled, grid.y, np.nan)
    for i, j in combinations(range(y.shape[3]), 2):
        if _correlation(y[..., i], y[..., j]) > _SAME_OUTPUTS:
            yield (
                f"Outputs: where sections are crossed, {fit.outputs[i]} and {fit.outputs[j]} are "
                "two sides of one number, as signals are whose angle is the phase. Cycles from "
                "crossing to crossing (a `Crossing` as the phase, `--crossing`) may make "
                "multipliers much surer."
            )


def _about_the_fit(fit: SeriesFit) -> Iterator[str]:
    """Whether it is stable for sure, and ended."""
    for z, error in zip(fit.multipliers, fit.standard_errors, strict=True):
        if z.imag >= 0 and abs(z) + 2 * error > 1:
            yield f"Stability: the interval of the multiplier {z:.3g} reaches the unit circle."
    if fit.result != Result.OK:
        yield f"The fit did not end: {Result(fit.result).message}."


def _about_what_is_left(validation: Validation) -> Iterator[str]:
    """Whether a model leaves more than noise of strides that it was not fitted to."""
    if not validation.white:
        yield (
            "Left over: what the fit leaves of strides held out is correlated in time "
            f"({p_value(validation.whiteness.min())}). Smoothing does that, and so do disturbances "
            "of the state, and standard errors allow for both; if the multipliers change with "
            "another `bandwidth` or `order`, the model lacks something."
        )
    if not validation.independent:
        yield (
            "Left over: what the fit leaves of strides held out depends on the input "
            f"({p_value(validation.independence.min())}). Few strides for many coefficients do "
            "that, and so do pushes beyond the linear range: record more, or push less; if it "
            "remains, raise the `order`."
        )


def _correlation(x: Float[np.ndarray, "S T N"], y: Float[np.ndarray, "S T N"]) -> float:
    """The modulus of the correlation at each section, the median over the sections."""
    seen = np.isfinite(x) & np.isfinite(y)
    both = np.where(seen, [x, y], 0.0)
    mean = both.sum(axis=(1, 2), keepdims=True) / np.maximum(seen.sum(axis=(0, 1)), 1)
    x, y = np.where(seen, both - mean, 0.0)
    xy, xx, yy = ((a * b).sum(axis=(0, 1)) for a, b in ((x, y), (x, x), (y, y)))
    return float(np.median(np.abs(xy) / np.sqrt(np.maximum(xx * yy, np.finfo(float).tiny))))


def _list(values: Complex[np.ndarray, " d"]) -> str:
    return ", ".join(f"{z:.4f}" for z in values)
