"""Outputs of a model for the inputs of a record, from the start and with the drift that fit it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...experiments.record import Record
from ...linear.ldtp import LDTP
from ..joint.noise import Predictor
from ..series.fit import SeriesFit
from ..series.records import (
    count_cycles,
    divide_by_chi,
    drift_waves,
    lagged_inputs,
    start_responses,
)


# Samples for each unknown of its start and drift, which a record must have more of to say anything
# of a model. Doubled: records twice as long are left out.
_SAMPLES_PER_UNKNOWN = 3


def can_be_compared(model: LDTP | SeriesFit | Predictor, record: Record, free_start: bool) -> bool:
    """Whether a record says more than where it started and how it drifts, which are fitted to it:
    short pieces agree with any model."""
    N, ny = record.n_sections, record.y.shape[1]
    unknown = N * ny * drift_waves(record).shape[1]
    if free_start and isinstance(model, SeriesFit):
        unknown += N * ny * _free_cycles(model)
    elif free_start:
        unknown += int(model.dims[record.first_section])
    return int(np.isfinite(record.y).sum()) > _SAMPLES_PER_UNKNOWN * unknown


def simulate_record(
    model: LDTP | SeriesFit | Predictor, record: Record, free_start: bool
) -> Float[np.ndarray, "n ny"]:
    """The outputs that a model predicts: a `Predictor` one step ahead, others without looking at
    them.

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
    n, first_section = len(record.u), record.first_section
    T = count_cycles(record)
    u, y = np.zeros((1, T * N, nu)), np.full((T * N, ny), np.nan)
    rows = slice(first_section, first_section + n)
    u[0, rows], y[rows] = record.u, record.y
    v = divide_by_chi(fit.coefficients, u.reshape(1, T, N, nu))
    y, out = y.reshape(T, N, ny), np.zeros((T, N, ny))
    # As in the fit: what came before acts on so many cycles on its own.
    free = _free_cycles(fit) if free_start else 0
    drift = drift_waves(record)
    for k in range(N):
        b = fit.numerators[k].transpose(0, 2, 1).reshape(R * nu, ny)
        out[:, k] = lagged_inputs(v, k, R, fit.lead)[0] @ b
        first = np.array([int(k < first_section)])
        starts = start_responses(fit.coefficients, first, T, min(free, T))[0]
        unknown = np.concatenate([starts, drift], axis=1)
        for i in range(ny):
            seen = np.isfinite(y[:, k, i])
            if unknown.shape[1] and seen.any():
                left = (y[:, k, i] - out[:, k, i])[seen]
                out[:, k, i] += unknown @ np.linalg.lstsq(unknown[seen], left)[0]
    return out.reshape(T * N, ny)[rows]


def _free_cycles(fit: SeriesFit) -> int:
    """At the start of a record, the cycles on which what came before acts on its own."""
    N, R = fit.numerators.shape[:2]
    d = len(fit.coefficients)
    return d + -(-(R - 1 - fit.lead - d * N) // N)


def _simulate_ldtp(model: LDTP, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
    first = record.first_section
    forced = np.asarray(model.simulate(record.u, first_section=first))
    left = (record.y - forced)[..., None]
    if not free_start:
        return forced + _drift_in(left, record)[..., 0]
    d = int(model.dims[first])
    silence = jnp.zeros_like(jnp.asarray(record.u))
    states = jnp.eye(model.A.shape[-1])[:d]
    free = jax.vmap(lambda x0: model.simulate(silence, x0, first))(states)
    free = np.moveaxis(np.asarray(free), 0, -1)
    both = np.concatenate([left, free], axis=2)
    both = both - _drift_in(both, record)
    seen = np.isfinite(record.y)
    # Outputs in units of their size, so that none is neglected.
    size = np.sqrt(np.nanmean(record.y**2, axis=0, where=seen)) if seen.any() else 1.0
    weight = np.broadcast_to(1 / np.where(size > 0, size, 1.0), record.y.shape)[seen]
    x0 = np.linalg.lstsq(both[seen][:, 1:] * weight[:, None], both[seen][:, 0] * weight)[0]
    out = forced + free @ x0
    return out + _drift_in((record.y - out)[..., None], record)[..., 0]


def _drift_in(x: Float[np.ndarray, "n ny m"], record: Record) -> Float[np.ndarray, "n ny m"]:
    """The drift that explains most of x at the samples of a record, section by section."""
    out = np.zeros_like(x)
    waves = drift_waves(record)
    cycle, section = np.divmod(record.first_section + np.arange(len(x)), record.n_sections)
    for n, i in np.ndindex(record.n_sections, x.shape[1]):
        rows = section == n
        seen = rows & np.isfinite(record.y[:, i])
        if waves.shape[1] and seen.any():
            out[rows, i] = waves[cycle[rows]] @ np.linalg.lstsq(waves[cycle[seen]], x[seen, i])[0]
    return out
