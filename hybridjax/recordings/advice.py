"""What the data cannot carry, in plain words."""

from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.results import Result
from ..errors import DefinitionError
from ..experiments.record import Record, RecordedData, uninterrupted_records
from ..identify.multipliers.compare import compare_multipliers
from ..identify.multipliers.denominator import Denominator
from ..identify.series.arx import (
    delayed_outputs,
    ordinary_least_squares,
    refuse_order,
    total_least_squares,
)
from ..identify.series.cycle_grid import CycleGrid
from ..identify.series.fit import assemble, fit_series
from ..identify.series.output_error import OutputErrorProblem, linearize
from ..identify.series.series_fit import SeriesFit
from ..identify.series.simulation import simulate_record
from ..identify.series.validation import Validation, validate
from .sampling import SectionData
from .spectra import input_band, input_spectrum


_FEW = 0.25  # of the samples of a section left over by the unknowns: fewer are few
_WEAK = 0.02  # of its mean power: an input this weak near a multiplier's frequency tells little
_LOST = 0.2  # of all samples
_ALIKE = 0.98  # median of the correlations of two outputs at the sections: they say the same
ENOUGH = 1000  # cycles to choose an order from, and to try it on
_TIE = 0.02  # relative difference of misfits that are as good as equal


def plain_regression(data: RecordedData, order: int) -> Complex[np.ndarray, " d"]:
    """Multipliers by least squares on chi y = B u (ARX), which noise in y biases towards zero.

    To see by how much: `fit_series` has no such bias.
    """
    grid = CycleGrid.from_data(data)
    problem = OutputErrorProblem.from_grid(grid, order, grid.n_sections, free_start=True)
    return ordinary_least_squares(delayed_outputs(problem, order))


def choose_order(data: SectionData, most: int = 4, share: float = 0.25) -> int:
    """The number of multipliers that predicts best what it was not fitted to.

    For each number a first, consistent estimate (total least squares) is made from all but the last
    `share` of every record, and simulated on the rest. The smallest number counts whose misfit is
    within 2 % of the best one. Of long recordings the first 1000 cycles are looked at.

    **Raises:** `DefinitionError` if there are too few cycles for one multiplier.
    """
    early, late = _split(data, share)
    grid = CycleGrid.from_data(early)
    rest = uninterrupted_records(late)
    misfits = []
    for d in range(1, most + 1):
        problem = OutputErrorProblem.from_grid(grid, d, grid.n_sections, free_start=True)
        c = total_least_squares(delayed_outputs(problem, d))
        found = linearize(problem, c)
        if (found.freedom <= 2 * d).any():
            break
        fit = assemble(grid, problem, found, Denominator.of_unknown_accuracy(c))
        error = np.concatenate([simulate_record(fit, r, free_start=True) - r.y for r in rest])
        misfits.append(float(np.log(np.nanmean(error**2, axis=0)).mean()) / 2)
    if not misfits:
        raise DefinitionError(
            f"{data.cycles:.0f} cycles are too few for one multiplier with {data.n_sections} "
            "sections: record more, or take fewer sections."
        )
    return 1 + int(np.argmax(np.array(misfits) <= min(misfits) + _TIE))


class HeldOut(NamedTuple):
    """A fit to the first part of each record, tried on the rest."""

    fit: SeriesFit
    validation: Validation


def hold_out(data: SectionData, order: int, share: float = 0.25) -> HeldOut:
    """Fit all but the last `share` of every record, and simulate that.

    Of long recordings the first 1000 cycles are looked at.

    **Raises:** `DefinitionError` if too few cycles are left for either.
    """
    if not 0 < share < 1:
        raise DefinitionError(f"share must lie between 0 and 1, not {share}.")
    early, late = _split(data, share)
    fit = fit_series(early, order, check=False)
    return HeldOut(fit, validate(fit, late))


def _split(data: SectionData, share: float) -> tuple[list[Record], list[Record]]:
    early, late = [], []
    enough = min(1.0, ENOUGH / data.cycles)
    for r in data.records:
        end = round(len(r.u) * enough)
        cut = round(end * (1 - share))
        early.append(r.part(0, cut))
        late.append(r.part(cut, end))
    return early, late


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
        return "\n".join(self.warnings) or "Nothing speaks against the fit."


def advise(data: SectionData, fit: SeriesFit) -> Advice:
    """Look for what makes a fit to recorded data worth less than it says.

    Too few strides for the unknowns, more multipliers than the data carry, inputs without power
    where the multipliers are, outputs that say the same, noise that would bias plain regression,
    intervals that reach the unit circle, an iteration that did not end.
    """
    found = []
    N, R, _, nu = fit.numerators.shape
    d = len(fit.multipliers)
    grid = CycleGrid.from_data(data)
    sampled = np.isfinite(grid.y).all(axis=3).sum(axis=(0, 1)).min()
    unknown = R * nu + len(grid.y) * (d + 1)
    if sampled - unknown < _FEW * sampled:
        found.append(
            f"Few strides: a section was sampled {sampled} times for {unknown} unknowns; "
            "record more, take fewer sections, or excite fewer inputs."
        )
    overhang = R - 1 - fit.lead - d * N
    problem = OutputErrorProblem.from_grid(grid, d, overhang, free_start=True)
    delayed = delayed_outputs(problem, d)
    try:
        refuse_order(delayed.rescale(fit.noise / problem.scale))
    except DefinitionError:
        found.append(
            f"Order: the data do not carry {d} multipliers. The weakest may be noise alone (or "
            "nearly zero in truth); neither its value nor its interval then means anything."
        )
    f, power = input_spectrum(data)
    resonance = np.abs(np.angle(fit.multipliers)) / (2 * np.pi)
    for i, name in enumerate(fit.inputs):
        mean = power[:, i].mean()
        for m, at in zip(fit.multipliers, resonance, strict=True):
            near = np.abs((f - at + 0.5) % 1 - 0.5) < 0.1
            mirrored = np.abs((f + at + 0.5) % 1 - 0.5) < 0.1
            if m.imag >= 0 and power[near | mirrored, i].max(initial=0) < _WEAK * mean:
                found.append(
                    f"Weak excitation: {name} has next to no power at the frequencies "
                    f"{at:.2f} + k cycles per period, where the multiplier {m:.3g} is seen."
                )
    band = input_band(data)
    for name, edge in zip(fit.inputs, band, strict=True):
        if edge < 1:
            found.append(
                f"Narrow excitation: {name} has power only up to {edge:.2g} cycles per period, so "
                "that responses at different phases can hardly be told apart."
            )
        elif edge < 0.9 * N / 2:
            found.append(
                f"Transfer functions are determined up to f = {edge:.3g} cycles per period only, "
                f"where the power of {name} ends."
            )
    for i, j in combinations(range(grid.y.shape[3]), 2):
        if _correlation(grid.y[..., i], grid.y[..., j]) > _ALIKE:
            found.append(
                f"Outputs: where sections are crossed, {fit.outputs[i]} and {fit.outputs[j]} are "
                "two sides of one number, as signals are whose angle is the phase. Cycles from "
                "crossing to crossing (`CrossingPhase`, `--crossing`) may make multipliers "
                "much surer."
            )
    plain = ordinary_least_squares(delayed)
    bias = float(compare_multipliers(plain, fit.multipliers).max_error)
    if bias > 2 * fit.standard_errors.max():
        found.append(
            f"Noise: plain regression (ARX) would give {_list(plain)}, off by {bias:.2g}; do not "
            "use it here."
        )
    for z, error in zip(fit.multipliers, fit.standard_errors, strict=True):
        if z.imag >= 0 and abs(z) + 2 * error > 1:
            found.append(
                f"Stability: the interval of the multiplier {z:.3g} reaches the unit circle."
            )
    if fit.result != Result.OK:
        found.append(f"The fit did not end: {Result(fit.result).message}.")
    if data.missing > _LOST:
        found.append(f"Gaps: {100 * data.missing:.0f} % of the samples are missing.")
    strides = (100, 300, 1000, 3000)
    now = max(sampled - unknown, 1)
    later = np.array([max(n - (R * nu + d + 1), 0) for n in strides], float)
    with np.errstate(divide="ignore"):
        expected = fit.standard_errors * np.sqrt(now / later)[:, None]
    return Advice(tuple(found), plain, bias, tuple(band), strides, expected)


def _correlation(x: Float[np.ndarray, "S T N"], y: Float[np.ndarray, "S T N"]) -> float:
    """Its modulus, the median over the sections."""
    seen = np.isfinite(x) & np.isfinite(y)
    both = np.where(seen, [x, y], 0.0)
    mean = both.sum(axis=(1, 2), keepdims=True) / np.maximum(seen.sum(axis=(0, 1)), 1)
    x, y = np.where(seen, both - mean, 0.0)
    xy, xx, yy = ((a * b).sum(axis=(0, 1)) for a, b in ((x, y), (x, x), (y, y)))
    return float(np.median(np.abs(xy) / np.sqrt(np.maximum(xx * yy, np.finfo(float).tiny))))


def _list(values) -> str:
    return ", ".join(f"{z:.4f}" for z in values)
