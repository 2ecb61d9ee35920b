"""Fits that are tested on strides to which they were not fitted.

`split` divides records into a part to be fitted and a part to be held out. `Split.best_order` and
`compare_orders` choose the number of multipliers by the errors on the held-out part; `hold_out`
fits the first part and validates the fit on the rest. A quarter is held out, and the constants
limit it for long and short records. Two things must stay: no sample is in both parts, and all
numbers of multipliers are compared on the same records.

If too few strides are tested, look at `split`; if the chosen number is too large or too small, at
`_AS_GOOD` and `_misfit`; if a number is said to need more cycles, at `Split._rough_fit`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order
from .._core.boundary.members import leading_on
from ..errors import DefinitionError
from ..experiments.record import HasRecords, SectionSeries, uninterrupted_records
from ..identify.denominator import Covariance
from ..identify.series.delayed_outputs import late_outputs, total_least_squares
from ..identify.series.fit import SeriesFit, assemble, fit_series, missing_cycles
from ..identify.series.linearization import linearize
from ..identify.series.output_error import OutputErrorProblem, TooFewCycles
from ..identify.series.records import CycleGrid, PreparedRecords
from ..identify.validation import Validation, can_be_compared, validate
from .data import SectionData


# Largest number of cycles from which orders are chosen and held-out fits are made. More: time.
# Fewer: weak multipliers are missed.
_ENOUGH = 1000
# Least number of cycles at the end of a record that are held out. Shorter records are fitted or
# held out as a whole. More: few records are split. Fewer: the held-out part depends on its initial
# condition only.
_SHORTEST_END = 12
# Misfits count as equal if their relative difference is below this. Larger: orders are too small.
# Smaller: noise decides.
_AS_GOOD = 0.02


@leading_on
class HeldOut(NamedTuple):
    """A fit to the first part of each record, tried on the last."""

    fit: SeriesFit
    validation: Validation

    def __repr__(self) -> str:
        return f"{self.fit}\n{self.validation}"


@leading_on
class HeldOutOrders(NamedTuple):
    """How well fits of each order predict held-out cycles. Printing it shows a table.

    **Fields:** `orders` (k,): 1, 2, ..., the largest that could be tried. `errors` (k,): rms errors
    of the predictions, relative to the smallest (a geometric mean over the outputs). `order`: the
    smallest whose error is within 2 % of the smallest.
    """

    orders: Int[np.ndarray, " k"]
    errors: Float[np.ndarray, " k"]
    order: int

    def __index__(self) -> int:
        """The order: functions take a selection as the number."""
        return self.order

    def __repr__(self) -> str:
        rows = ["order  error of held-out cycles (relative)"]
        rows += [
            f"{order:5d}  {error:.3f}"
            for order, error in zip(self.orders, self.errors, strict=True)
        ]
        return "\n".join([*rows, f"order: {self.order}"])


class Split(NamedTuple):
    """Records to be fitted, prepared once for all fits, and records that are held out."""

    early: PreparedRecords
    late: list[SectionSeries]

    def best_order(self, most: int = 4) -> tuple[int, str]:
        """Choose an order; see `select_order`. Return the order; and, if it is the largest that
        could be tried, the reason why larger ones could not be tried."""
        compared, obstacle = self.compare_orders(most)
        return compared.order, obstacle

    def compare_orders(self, most: int) -> tuple[HeldOutOrders, str]:
        """Fit each order up to `most` to the early part, and compare the errors on the late part.
        Return the comparison; and, as `best_order`, the reason why larger ones were not tried."""
        ends = uninterrupted_records(self.late)
        fits: list[SeriesFit] = []
        obstacle = ""
        for order in range(1, most + 1):
            fit, obstacle = self._rough_fit(order)
            if fit is None:
                break
            long = [r for r in ends if can_be_compared(fit, r, free_start=True)]
            if not long:
                cycles = max(len(r.u) for r in ends) / self.early.n_sections
                obstacle = (
                    f"{cycles:.3g} cycles, the longest held-out record, are too few to test order "
                    f"{order}: record longer without gaps."
                )
                break
            fits.append(fit)
            ends = long
        if not fits:
            raise DefinitionError(obstacle)
        grid = CycleGrid.from_records(ends)
        misfits = np.array([_misfit(fit, grid) for fit in fits])
        errors = np.exp(misfits - misfits.min())
        best = 1 + int(np.argmax(misfits <= misfits.min() + _AS_GOOD))
        compared = HeldOutOrders(1 + np.arange(len(fits)), errors, best)
        return compared, obstacle if best == len(fits) else ""

    def _rough_fit(self, order: int) -> tuple[SeriesFit | None, str]:
        """Return a fit to the early part by total least squares or, if it has too few cycles, the
        obstacle."""
        N = self.early.n_sections
        try:
            problem = OutputErrorProblem.from_data(
                self.early, order, N, free_start=True
            )
            start = total_least_squares(late_outputs(problem, order))
            solution = linearize(problem, start)
            missing = missing_cycles(problem, solution, 2 * order + 1)
        except TooFewCycles as error:
            missing = error.missing + order
        if not missing:
            unknown = Covariance.unknown(order)
            return assemble(problem, solution, unknown, False), ""
        cycles = int(self.early.sampled.max())
        # (A quarter of the cycles is for unknowns whose number does not depend on N.)
        sections = max(0.75 * N * cycles / (cycles + missing), 1)
        fewer = f", or take {sections:.0f} sections" if N > 1 else ""
        return None, (
            f"{cycles} cycles (a quarter is held out) are too few for order {order} with {N} "
            f"sections: record {-(-4 * missing // 3)} more{fewer}."
        )

    def fit(self, order: int, references: tuple[str, ...] | None = None) -> HeldOut:
        """Fit the early part and validate the fit on the late part."""
        try:
            fit = fit_series(self.early, order, check=False, references=references)
            return HeldOut(fit, validate(fit, self.late, references=references))
        except DefinitionError as error:
            hint = "A quarter is held out: `fit_series` fits all, without a test."
            raise DefinitionError(f"{error} {hint}") from error


@checked
def hold_out(data: SectionData, order: Order) -> HeldOut:
    """Fit all but the last quarter of every record, and validate the fit on this part.

    If this part of a record would be shorter than twelve cycles, whole records are held out
    instead, a quarter of them. At most the first 1000 cycles of a recording are used.

    **Arguments:**

    - `data`: the data at the sections, result of `sample_sections`.
    - `order`: d, the number of multipliers.

    **Returns:** `hj.recordings.HeldOut`, a pair: `fit`, the `SeriesFit` to the first part, and
    `validation`, its `Validation` on the last.

    **Raises:** `DefinitionError` if too few cycles are left for either.

    **Example:**

    ```python
    fit, validation = hj.recordings.hold_out(result.data, order=2)
    print(validation)
    ```

    **Before:** `hj.recordings.sample_sections`, `hj.select_order`. **After:**
    `hj.recordings.diagnose`.
    """
    return split(data).fit(order)


def split(data: HasRecords) -> Split:
    """Split the records into a part to be fitted, and a quarter to be held out."""
    n_sections = data.records[0].n_sections
    cycles = sum(len(r.u) for r in data.records) / n_sections
    share = min(1.0, _ENOUGH / cycles)
    ends = [round(len(r.u) * share) for r in data.records]
    shortest = _SHORTEST_END * n_sections
    short = [k for k, n in enumerate(ends) if n / 4 < shortest]
    held_out = short[3::4]
    # If all records are short and there are too few to hold one out, all are cut.
    fitted = short if held_out or len(short) < len(ends) else []
    early = []
    late = []
    for k, (record, end) in enumerate(zip(data.records, ends, strict=True)):
        cut = round(end * 0.75)
        if k in held_out:
            cut = 0
        elif k in fitted:
            cut = end
        if cut > 0:
            early.append(record.part(0, cut))
        if cut < end:
            late.append(record.part(cut, end))
    return Split(PreparedRecords(early), late)


def _misfit(fit: SeriesFit, grid: CycleGrid) -> float:
    """Return the mean logarithm of the rms errors of the outputs."""
    error = (fit.predicted(grid, free_start=True) - grid.y) * grid.sampled
    count = grid.sampled.sum(axis=(0, 1, 2))
    square = (error**2).sum(axis=(0, 1, 2)) / count
    return float(np.log(square).mean()) / 2
