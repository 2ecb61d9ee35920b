"""Outputs of a model for the inputs of a record, with the best initial condition and drift."""

import numpy as np
from jaxtyping import Float

from ..experiments.record import Record
from ..linear.ldtp import LDTP
from .joint.model import PeriodicModel
from .joint.noise import Predictor
from .series.fit import SeriesFit
from .series.output_error import SectionRegression
from .series.records import (
    CycleGrid,
    divide_by_chi,
    drift_waves,
    lagged_inputs,
    start_responses,
)


# Samples for each unknown of its initial condition and drift, which a record must exceed. Fewer:
# short records agree with any model; more: records that could be compared are left out.
_SAMPLES_PER_UNKNOWN = 3


def can_be_compared(model: LDTP | SeriesFit | Predictor, record: Record, free_start: bool) -> bool:
    """Test whether a record has samples beyond those that fit its initial condition and drift."""
    N, ny = record.n_sections, record.y.shape[1]
    unknown = N * ny * drift_waves(record).shape[1]
    if free_start:
        unknown += (
            N * ny * _free_cycles(model)
            if isinstance(model, SeriesFit)
            else int(model.dims[record.first_section])
        )
    return int(np.isfinite(record.y).sum()) > _SAMPLES_PER_UNKNOWN * unknown


def simulate_record(
    model: LDTP | SeriesFit | Predictor, record: Record, free_start: bool
) -> Float[np.ndarray, "n ny"]:
    """Return the outputs of a model: a `Predictor` one step ahead, others from inputs alone.

    **Arguments:** `record`, without unknown inputs. `free_start`: from the state that fits the
    record best, or from zero. A drift that the record announces is estimated in either case.
    """
    if isinstance(model, SeriesFit):
        return _simulate_fit(model, record, free_start)
    if isinstance(model, LDTP):
        # Outputs in units of their size, so that none is neglected.
        square = np.ma.masked_invalid(record.y**2).mean(axis=0).filled(0.0)
        S = np.diag(np.where(square > 0, square, 1.0))
        plain = PeriodicModel.of(model, np.ones(len(S)))
        model = Predictor(plain, np.stack([S] * model.n_sections), model.inputs, model.outputs)
    return model.predict(record, free_start)


def _simulate_fit(fit: SeriesFit, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
    N, R, ny, nu = fit.numerators.shape
    grid = CycleGrid.from_records([record])
    v, T = divide_by_chi(fit.coefficients, grid.u), grid.u.shape[1]
    # As in the fit, earlier inputs act on so many cycles without a model.
    free = min(_free_cycles(fit), T) if free_start else 0
    out = np.zeros((T, N, ny))
    for n, i in np.ndindex(N, ny):
        forced = lagged_inputs(v, n, R, fit.lead) @ fit.numerators[n, :, i].reshape(R * nu, 1)
        starts = start_responses(fit.coefficients, grid.first[:, n], T, free)
        unknown, none = np.concatenate([starts, grid.drift], axis=2), grid.drift[:, :, :0]
        regression = SectionRegression.make(forced, unknown, none, grid.sampled[:, :, n, i])
        y, sampled = grid.y[:, :, n, i], grid.sampled[:, :, n, i]
        error = regression.residual(np.ones(1), y).reshape(y.shape)
        out[:, n, i] = np.where(sampled, y - error, regression.response(np.ones(1), y))[0]
    return out.reshape(T * N, ny)[record.first_section :][: len(record.u)]


def _free_cycles(fit: SeriesFit) -> int:
    """Return the cycles at the start of a record on which earlier inputs act without a model."""
    N, R = fit.numerators.shape[:2]
    d = len(fit.coefficients)
    return d + -(-(R - 1 - fit.lead - d * N) // N)
