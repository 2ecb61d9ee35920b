"""Fits that are tried on strides to which they were not fitted."""

from typing import NamedTuple

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order
from ..errors import DefinitionError
from ..experiments.record import Record, uninterrupted_records
from ..identify.denominator import Covariance
from ..identify.series.fit import SeriesFit, assemble, fit_series, late_outputs, total_least_squares
from ..identify.series.linearization import linearize
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import CycleGrid, PreparedRecords
from ..identify.validate import Validation, can_be_compared, simulate, validate
from .data import SectionData


# Cycles from which orders are chosen and held-out fits are made. More: time. Fewer: weak
# multipliers are missed.
_ENOUGH = 1000
# Fewest cycles at the end of a record that are held out; shorter records are fitted, or held out,
# whole. More: few records are split. Fewer: ends that say no more than their initial condition.
_SHORTEST_END = 12
# Relative difference of misfits that count as equal. Larger: orders are too small. Smaller: noise
# decides.
_AS_GOOD = 0.02


class HeldOut(NamedTuple):
    """A fit to the first part of each record, tried on the last."""

    fit: SeriesFit
    validation: Validation


class Split(NamedTuple):
    """Records to be fitted, prepared once for all fits, and records that are held out."""

    early: PreparedRecords
    late: list[Record]

    def best_order(self, most: int = 4) -> int:
        """Choose an order; see `choose_order`."""
        ends = uninterrupted_records(self.late)
        fits: list[SeriesFit] = []
        N = self.early.n_sections
        for d in range(1, most + 1):
            problem = OutputErrorProblem.from_data(self.early, d, N, free_start=True)
            solution = linearize(problem, total_least_squares(late_outputs(problem, d)))
            if (solution.freedom <= 2 * d).any():
                break
            fit = assemble(problem, solution, Covariance.unknown(d), False)
            long = [r for r in ends if can_be_compared(fit, r, free_start=True)]
            if not long:
                break
            fits, ends = [*fits, fit], long
        if not fits:
            text = f"3/4 of the cycles, {self.early.cycles}, are too few to fit {N} sections"
            raise DefinitionError(f"{text}: record more, or take fewer sections.")
        grid, misfits = CycleGrid.from_records(ends), []
        for fit in fits:
            error = (simulate(fit, grid, free_start=True) - grid.y) * grid.sampled
            square = (error**2).sum(axis=(0, 1, 2)) / grid.sampled.sum(axis=(0, 1, 2))
            misfits.append(float(np.log(square).mean()) / 2)
        return 1 + int(np.argmax(np.array(misfits) <= min(misfits) + _AS_GOOD))

    def fit(self, order: int, reference: tuple[str, ...] | None = None) -> HeldOut:
        """Fit the early part and validate the fit on the late part."""
        try:
            fit = fit_series(self.early, order, check=False, reference=reference)
        except DefinitionError as error:
            hint = f"A quarter is held out: `fit_series(section_data(...), {order})` fits all"
            raise DefinitionError(f"{error} ({hint}, without a test.)") from error
        return HeldOut(fit, validate(fit, self.late, reference=reference))


@checked
def choose_order(data: SectionData) -> int:
    """Return the number of multipliers that predicts held-out strides best.

    For each number, the model is estimated by total least squares (which is consistent) without the
    held-out strides (see `hold_out`), and then simulates these strides. The result is the smallest
    number, up to four, whose misfit is within 2 % of the best. At most the first 1000 cycles of a
    recording are used.

    **Raises:** `DefinitionError` if there are too few cycles for one multiplier.
    """
    return split(data).best_order()


@checked
def hold_out(data: SectionData, order: Order) -> HeldOut:
    """Fit all but the last quarter of every record, and validate the fit on this part.

    If this part of a record would be shorter than twelve cycles, whole records are held out
    instead, a quarter of them. At most the first 1000 cycles of a recording are used.

    **Raises:** `DefinitionError` if too few cycles are left for either.
    """
    return split(data).fit(order)


def split(data: SectionData) -> Split:
    """Split the records into a part to be fitted, and a quarter to be held out."""
    enough = min(1.0, _ENOUGH / data.cycles)
    ends = [round(len(r.u) * enough) for r in data.records]
    short = [k for k, n in enumerate(ends) if n / 4 < _SHORTEST_END * data.n_sections]
    held_out = short[3::4]
    fitted = short if held_out or len(short) < len(ends) else []
    early, late = [], []
    for k, (r, end) in enumerate(zip(data.records, ends, strict=True)):
        cut = 0 if k in held_out else end if k in fitted else round(end * 0.75)
        early += [r.part(0, cut)] if cut else []
        late += [r.part(cut, end)] if cut < end else []
    return Split(PreparedRecords(early), late)
