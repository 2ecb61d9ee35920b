"""Numbers of a fit that have an order, with standard errors: of multipliers, and of the period."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np

from ..._core.signal import unit_of
from ...errors import DefinitionError
from ...identify.multiplier_estimate import MultiplierEstimate
from ..identification import Identification


Quantity = Literal["modulus", "angle", "coefficients", "period"]
Fit: TypeAlias = MultiplierEstimate | Identification
_UNITS = {"angle": "rad", "period": "s"}


def measured(
    fits: Sequence[Fit], subjects: Sequence[str], quantities: Sequence[Quantity]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, str]]:
    """Return values, standard errors and units by name.

    **Raises:** `DefinitionError` for fits without covariance, or that cannot be compared.
    """
    estimates = list(map(fit_of, fits))
    first = _signals(estimates[0])
    for subject, fit in zip(subjects, estimates, strict=True):
        if not np.isfinite(fit.covariance).all():
            raise DefinitionError(
                f"the fit of subject '{subject}' has no covariance: record more strides, or leave "
                "the subject out."
            )
        if _signals(fit) != first:
            raise DefinitionError(
                f"the fit of subject '{subject}' is of {_signals(fit)}, but that of "
                f"'{subjects[0]}' is of {first}: use the same outputs, in the same units."
            )
    values, errors = {}, {}
    for name in quantities:
        rows = [_of(name, x, fit, s) for x, fit, s in zip(fits, estimates, subjects, strict=True)]
        widths = [len(value) for value, _ in rows]
        if len(set(widths)) > 1:
            other = next(i for i, n in enumerate(widths) if n != widths[0])
            raise DefinitionError(
                f"orders differ: {widths[0]} multipliers of subject '{subjects[0]}' and "
                f"{widths[other]} of '{subjects[other]}', so their coefficients cannot be "
                "averaged: give all fits the same `order`, or take the modulus."
            )
        for k in range(widths[0]):
            label = f"c{k + 1}" if name == "coefficients" else name
            values[label], errors[label] = (np.array([row[i][k] for row in rows]) for i in (0, 1))
    return values, errors, {name: _UNITS.get(name, "") for name in values}


def fit_of(source: Fit) -> MultiplierEstimate:
    return source.fit if isinstance(source, Identification) else source


def _signals(fit: MultiplierEstimate) -> str:
    names = getattr(fit, "outputs", ())
    return ", ".join(f"{x} ({unit_of(x)})" if unit_of(x) else str(x) for x in names)


def _of(name: Quantity, source: Fit, fit: MultiplierEstimate, subject: str):
    """Return the values and standard errors of one fit."""
    if name == "coefficients":
        return fit.coefficients, np.sqrt(np.diag(fit.covariance))
    if name == "period":
        if not isinstance(source, Identification):
            raise DefinitionError("'period' needs results of `identify_recording`, not fits.")
        periods = np.concatenate(source.phase.periods)
        periods = periods[np.isfinite(periods)]
        return [periods.mean()], [periods.std(ddof=1) / np.sqrt(len(periods))]
    # The upper one of a conjugate pair.
    leading = fit.multipliers[0]
    z = complex(leading.real, abs(leading.imag))
    covariance = fit.multiplier_covariances[0]
    sign = -1.0 if leading.imag < 0 else 1.0
    covariance = covariance * np.outer([1, sign], [1, sign])
    if name == "modulus":
        slope = np.array([z.real, z.imag]) / abs(z)
        return [abs(z)], [np.sqrt(slope @ covariance @ slope)]
    if z.imag == 0:
        raise DefinitionError(
            f"the leading multiplier of subject '{subject}' is real, so its angle has no standard "
            "error: take the modulus or the coefficients."
        )
    slope = np.array([-z.imag, z.real]) / abs(z) ** 2
    return [np.angle(z)], [np.sqrt(slope @ covariance @ slope)]
