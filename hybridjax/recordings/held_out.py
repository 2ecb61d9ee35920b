"""What a fit predicts that it was not fitted to, and the order that predicts best."""

from typing import NamedTuple

import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order, Probability
from ..errors import DefinitionError
from ..experiments.record import Record, uninterrupted_records
from ..identify.denominator import Denominator
from ..identify.record_simulation import can_be_compared, simulate_record
from ..identify.series.arx import delayed_outputs, total_least_squares
from ..identify.series.fit import SeriesFit, assemble, fit_series
from ..identify.series.linearization import linearize
from ..identify.series.output_error import OutputErrorProblem
from ..identify.series.records import PreparedRecords
from ..identify.validate import Validation, validate
from .data import SectionData


# Cycles to choose an order from, and to try it on. Doubled: both take twice as long, and weaker
# multipliers are seen.
CYCLES_LOOKED_AT = 1000
# Cycles at the end of a record that tell anything beyond how they begin. Doubled: more records are
# fitted, or held out, whole.
_SHORTEST_END = 12
# Relative difference of two misfits that are as good as equal. Doubled: smaller orders are chosen.
_AS_GOOD = 0.02


@checked
def choose_order(data: SectionData, most: Order = 4, share: Probability = 0.25) -> int:
    """The number of multipliers that predicts best what it was not fitted to.

    For each number a first, consistent estimate (total least squares) is made from all but what is
    held out (see `hold_out`), and simulated on that. The smallest number counts whose misfit is
    within 2 % of the best one. Of long recordings the first 1000 cycles are looked at.

    **Raises:** `DefinitionError` if there are too few cycles for one multiplier.
    """
    early, late = _split(data, share)
    parts = PreparedRecords(early)
    rest = uninterrupted_records(late)
    fits = []
    for d in range(1, most + 1):
        problem = OutputErrorProblem.from_data(parts, d, parts.n_sections, free_start=True)
        c = total_least_squares(delayed_outputs(problem, d))
        found = linearize(problem, c)
        if (found.freedom <= 2 * d).any():
            break
        fit = assemble(problem, found, Denominator.of_unknown_accuracy(c))
        long = [r for r in rest if can_be_compared(fit, r, free_start=True)]
        if not long:
            break
        fits, rest = [*fits, fit], long
    if not fits:
        raise DefinitionError(
            f"{data.cycles:.0f} cycles are too few for one multiplier with {data.n_sections} "
            "sections: record more, or take fewer sections."
        )
    misfits = []
    for fit in fits:
        error = np.concatenate([simulate_record(fit, r, free_start=True) - r.y for r in rest])
        misfits.append(float(np.log(np.nanmean(error**2, axis=0)).mean()) / 2)
    return 1 + int(np.argmax(np.array(misfits) <= min(misfits) + _AS_GOOD))


class HeldOut(NamedTuple):
    """A fit to the first part of each record, tried on the rest."""

    fit: SeriesFit
    validation: Validation


@checked
def hold_out(data: SectionData, order: Order, share: Probability = 0.25) -> HeldOut:
    """Fit all but the last `share` of every record, and simulate that.

    Of records whose end would be shorter than twelve cycles, a `share` is held out whole. Of long
    recordings the first 1000 cycles are looked at.

    **Raises:** `DefinitionError` if too few cycles are left for either.
    """
    early, late = _split(data, share)
    fit = fit_series(early, order, check=False)
    return HeldOut(fit, validate(fit, late))


def _split(data: SectionData, share: float) -> tuple[list[Record], list[Record]]:
    enough = min(1.0, CYCLES_LOOKED_AT / data.cycles)
    ends = [round(len(r.u) * enough) for r in data.records]
    short = [k for k, n in enumerate(ends) if n * share < _SHORTEST_END * data.n_sections]
    every = round(1 / share)
    whole = short[every - 1 :: every]
    fitted_whole = short if whole or len(short) < len(ends) else []
    early, late = [], []
    for k, (r, end) in enumerate(zip(data.records, ends, strict=True)):
        cut = 0 if k in whole else end if k in fitted_whole else round(end * (1 - share))
        if cut:
            early.append(r.part(0, cut))
        if cut < end:
            late.append(r.part(cut, end))
    return early, late
