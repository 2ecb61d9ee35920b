"""What a fit predicts that it was not fitted to, and the order that predicts best."""

from typing import NamedTuple

import numpy as np

from ..errors import DefinitionError
from ..identify.series.fit import SeriesFit, fit_series, quick_fit
from ..identify.series.layout import Record, lay_out, pieces_of
from ..identify.series.prediction import predict
from ..identify.series.regression import delayed_outputs, initial, linearize, set_up
from ..identify.series.validation import Validation, validate
from .data import SectionData


# Cycles to choose an order from, and to try it on. Doubled: both take twice as long, and weaker
# multipliers are seen.
CYCLES_LOOKED_AT = 1000
# Relative difference of two misfits that are as good as equal. Doubled: smaller orders are chosen.
_AS_GOOD = 0.02


def choose_order(data: SectionData, most: int = 4, share: float = 0.25) -> int:
    """The number of multipliers that predicts best what it was not fitted to.

    For each number a first, consistent estimate (total least squares) is made from all but the last
    `share` of every record, and simulated on the rest. The smallest number counts whose misfit is
    within 2 % of the best one. Of long recordings the first 1000 cycles are looked at.

    **Raises:** `DefinitionError` if there are too few cycles for one multiplier.
    """
    early, late = _split(data, share)
    layout = lay_out(early)
    rest = pieces_of(late).pieces
    misfits = []
    for d in range(1, most + 1):
        problem = set_up(layout, d, layout.y.shape[2], False)
        c = initial(delayed_outputs(problem, d))
        found = linearize(problem, c)
        if (found.freedom <= 2 * d).any():
            break
        fit = quick_fit(problem, c, found, layout)
        error = np.concatenate([predict(fit, p, True) - p.y for p in rest])
        misfits.append(float(np.log(np.nanmean(error**2, axis=0)).mean()) / 2)
    if not misfits:
        raise DefinitionError(
            f"{data.cycles:.0f} cycles are too few for one multiplier with {data.n_sections} "
            "sections: record more, or take fewer sections."
        )
    return 1 + int(np.argmax(np.array(misfits) <= min(misfits) + _AS_GOOD))


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
    enough = min(1.0, CYCLES_LOOKED_AT / data.cycles)
    for r in data.records:
        end = round(len(r.u) * enough)
        cut = round(end * (1 - share))
        early.append(_part(r, slice(0, cut)))
        late.append(_part(r, slice(cut, end)))
    return early, late


def _part(record: Record, rows: slice) -> Record:
    start = (record.start + rows.start) % record.n_sections
    return Record(
        record.u[rows],
        record.y[rows],
        n_sections=record.n_sections,
        start=start,
        inputs=record.inputs,
        outputs=record.outputs,
        lead=record.lead,
        drift=record.drift,
    )
