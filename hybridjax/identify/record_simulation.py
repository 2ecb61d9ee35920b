"""Outputs of a model for the inputs of a record, with the best initial condition and drift."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..experiments.record import Record
from ..linear.ldtp import LDTP
from .joint.noise import Predictor
from .series.fit import SeriesFit
from .series.records import (
    count_cycles,
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
    if isinstance(model, Predictor):
        return model.predict(record, free_start)
    if isinstance(model, SeriesFit):
        return _simulate_fit(model, record, free_start)
    return _simulate_ldtp(model, record, free_start)


def _simulate_fit(fit: SeriesFit, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
    N, R, ny, nu = fit.numerators.shape
    n, first_section, T = len(record.u), record.first_section, count_cycles(record)
    u, y = np.zeros((1, T * N, nu)), np.full((T * N, ny), np.nan)
    rows = slice(first_section, first_section + n)
    u[0, rows], y[rows] = record.u, record.y
    v = divide_by_chi(fit.coefficients, u.reshape(1, T, N, nu))
    y, out = y.reshape(T, N, ny), np.zeros((T, N, ny))
    # As in the fit, earlier inputs act on so many cycles without a model.
    free = min(_free_cycles(fit), T) if free_start else 0
    drift = drift_waves(record)
    for k in range(N):
        b = fit.numerators[k].transpose(0, 2, 1).reshape(R * nu, ny)
        out[:, k] = lagged_inputs(v, k, R, fit.lead)[0] @ b
        starts = start_responses(fit.coefficients, np.array([int(k < first_section)]), T, free)[0]
        unknown = np.concatenate([starts, drift], axis=1)
        for i in range(ny):
            out[:, k, i] += _explained(unknown, y[:, k, i] - out[:, k, i])
    return out.reshape(T * N, ny)[rows]


def _explained(unknown: Float[np.ndarray, "n m"], x: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return the combination of columns that is closest to x where x is not NaN."""
    sampled = np.isfinite(x)
    if not unknown.shape[1] or not sampled.any():
        return np.zeros(len(x))
    return unknown @ np.linalg.lstsq(unknown[sampled], x[sampled])[0]


def _free_cycles(fit: SeriesFit) -> int:
    """Return the cycles at the start of a record on which earlier inputs act without a model."""
    N, R = fit.numerators.shape[:2]
    d = len(fit.coefficients)
    return d + -(-(R - 1 - fit.lead - d * N) // N)


def _simulate_ldtp(model: LDTP, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
    first = record.first_section
    out = np.asarray(model.simulate(record.u, first_section=first))
    if free_start:
        states = jnp.eye(model.A.shape[-1])[: int(model.dims[first])]
        silence = jnp.zeros_like(jnp.asarray(record.u))
        free = jax.vmap(lambda x0: model.simulate(silence, x0, first))(states)
        free = np.moveaxis(np.asarray(free), 0, -1)
        both = np.concatenate([(record.y - out)[..., None], free], axis=2)
        both[np.isnan(record.y)] = np.nan
        both = both - _drift_in(both, record)
        sampled = np.isfinite(record.y)
        # Outputs in units of their size, so that none is neglected.
        size = np.sqrt(np.nanmean(record.y**2, axis=0)) if sampled.any() else 1.0
        weight = np.broadcast_to(1 / np.where(size > 0, size, 1.0), record.y.shape)[sampled]
        rows = both[sampled] * weight[:, None]
        out = out + free @ np.linalg.lstsq(rows[:, 1:], rows[:, 0])[0]
    return out + _drift_in((record.y - out)[..., None], record)[..., 0]


def _drift_in(x: Float[np.ndarray, "n ny m"], record: Record) -> Float[np.ndarray, "n ny m"]:
    """Return the drift that is closest to x, section by section."""
    out = np.zeros_like(x)
    waves = drift_waves(record)
    cycle, section = np.divmod(record.first_section + np.arange(len(x)), record.n_sections)
    for n in range(record.n_sections):
        rows = section == n
        for k in np.ndindex(x.shape[1:]):
            out[(rows, *k)] = _explained(waves[cycle[rows]], x[(rows, *k)])
    return out
