r"""Criteria of `fit_ldtp`, whose unknowns are the matrices of a linear periodic model.

`criteria.py` calls `ldtp_matrices` and `response_criterion`. Unknowns are the local coordinates of
`fit_ldtp`, in those combinations for which the information of the usual design is the identity.
Combinations that the usual design does not determine are left out.

If bounds are too small, look at the combinations that were left out (`_MISSED`); if they are wrong,
compare `_rows` with differences of the HTFs. If a goal is refused as not determined, look at
`Matrices.criterion`. The coordinates must stay those of `fit_ldtp`, of which these are the bounds.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..identify.descent import NormalEquations, Spread
from ..identify.joint.frequency import transfer, transfer_slopes
from ..identify.periodic import LocalCoordinates, PeriodicModel, local_coordinates
from ..identify.realization import default_horizon, realized
from ..identify.weights import check_values, error_weights
from ..linear.frequency_response import Harmonics, check_harmonics
from ..linear.ldtp import LDTP
from .candidates import Candidates, Measured, Model, Noise, Powers, measured_htfs
from .criterion import Channel, LinearCriterion
from .goals import ResponseGoal


# Combinations that are left out may contribute this part of a wanted variance. Larger: standard
# errors are too small by half of this part. Smaller: goals are rejected for rounding errors.
_MISSED = 0.05
# Frequencies of a band at which its mean is taken. Fewer: the mean of a resonant curve is off.
# More: longer computation.
_POINTS = 64


class Matrices(NamedTuple):
    """Combinations of the P local coordinates, and their uncertainty."""

    coordinates: LocalCoordinates
    channel: Channel
    """Derivatives by those combinations that the usual design determines."""
    spread: Spread
    """Uncertainty of the coordinates with the usual design."""

    def criterion(
        self,
        wanted: Float[np.ndarray, "rows P"],
        names: tuple[str, ...],
        part: Int[np.ndarray, " rows"],
    ) -> LinearCriterion:
        """Return the criterion of functions with these derivatives by the coordinates.

        **Arguments:** `part`: as in `LinearCriterion`.

        **Raises:** `DefinitionError` if the usual design does not determine them.
        """
        variances = [((wanted @ root) ** 2).sum(axis=1) for root in self.spread]
        shown, hidden = (np.bincount(part, x) for x in variances)
        if (hidden > _MISSED * (shown + hidden)).any():
            raise DefinitionError(
                "`design` does not determine the `goal`: add harmonics or lines."
            )
        wanted = wanted @ self.spread.root
        unknowns = tuple(
            f"combination {k} of the matrices" for k in range(wanted.shape[1])
        )
        return LinearCriterion(
            names=names,
            unknowns=unknowns,
            channels=(self.channel,),
            wanted=wanted,
            part=part,
        )


def ldtp_matrices(
    model: Model,
    cosines: Candidates,
    harmonics: Harmonics | None,
    noise: Noise,
    power: Powers,
) -> Matrices:
    """Return the unknown matrices of a minimal model.

    **Arguments:** `power` of the usual design.

    **Raises:** `DefinitionError` for a model that is no `LDTP`.
    """
    if not isinstance(model, LDTP):
        raise DefinitionError(
            "a goal of `fit_ldtp` needs an `LDTP`: the `model` of a fit of `fit_ldtp` or "
            "`fit_series`."
        )
    lags = 2 * default_horizon(model.n_sections) + 1
    response = np.asarray(model.impulse_response(lags))[:, :, noise.outputs]
    htfs = list(measured_htfs(model, cosines, harmonics, noise))
    squares = [check_values(measured.htf) ** 2 for measured in htfs]
    scale = np.sqrt(np.mean(squares, axis=0))
    direct = bool(response[:, 0].any())
    coordinates = local_coordinates(PeriodicModel.of(realized(response), scale), direct)
    gram = np.zeros((coordinates.size, coordinates.size))
    for lines, rows in _rows(coordinates, htfs, scale):
        amplitude = np.sqrt(power[lines])[:, None, None]
        flat = _flat(rows * amplitude)
        gram += flat @ flat.T
    spread = NormalEquations(gram, np.zeros(len(gram))).spread()
    cosine = []
    slopes = []
    for lines, rows in _rows(coordinates, htfs, scale):
        cosine.append(np.repeat(lines, rows.shape[2]))
        slopes.append(spread.root.T @ _flat(rows))
    channel = Channel(np.concatenate(cosine), np.concatenate(slopes, axis=1).T)
    return Matrices(coordinates, channel, spread)


def _rows(
    coordinates: LocalCoordinates, htfs: list[Measured], scale: Float[np.ndarray, " ny"]
) -> Iterator[tuple[Int[np.ndarray, " lines"], Float[np.ndarray, "lines P rows"]]]:
    """Yield derivatives of the measurements of some cosines, in units of their standard deviations
    at power 1."""
    for htf, cosines, channel, unit in htfs:
        f = np.asarray(htf.frequencies)
        weight = unit * error_weights(htf, scale)[..., 0] * scale
        for chunk, slopes in transfer_slopes(coordinates, f, htf.harmonics):
            rows = slopes[..., channel] * weight[:, chunk]
            rows = np.ascontiguousarray(rows.transpose(2, 0, 1, 3))
            lines, P = rows.shape[:2]
            rows = rows.reshape(lines, P, -1).view(float)
            yield cosines[chunk], rows


def _flat(rows: Float[np.ndarray, "lines P rows"]) -> Float[np.ndarray, "P lines*rows"]:
    return rows.swapaxes(0, 1).reshape(rows.shape[1], -1)


def response_criterion(
    goal: ResponseGoal,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Powers,
) -> LinearCriterion:
    """Return the criterion of transfer functions in a band.

    **Raises:** `DefinitionError` for a band beyond N/2, and in the cases of `ldtp_matrices`.
    """
    N = cosines.n_sections
    low, high = goal.frequencies
    if high > N / 2:
        raise DefinitionError(
            f"`frequencies` must lie within 0 and {N / 2:g}, not {goal.frequencies}."
        )
    harmonics = check_harmonics(goal.quantities, N)
    matrices = ldtp_matrices(model, cosines, goal.harmonics, noise, power)
    f = low + (high - low) * (np.arange(_POINTS) + 0.5) / _POINTS
    H = transfer(matrices.coordinates.model, f, harmonics)
    parts = [part for _, part in transfer_slopes(matrices.coordinates, f, harmonics)]
    slopes = np.concatenate(parts, axis=2)
    square = (np.abs(H) ** 2).mean(axis=1)
    size = np.sqrt(square.sum(axis=0))  # (ny, nu)
    slopes = np.stack([np.real(slopes), np.imag(slopes)], axis=3)
    slopes = slopes / size / np.sqrt(_POINTS)
    names = []
    for m, i, u in itertools.product(harmonics, noise.outputs, model.inputs):
        name = f"H_{m} of {model.outputs[i]}"
        names.append(name if len(model.inputs) == 1 else f"{name} from {u}")
    each = slopes.transpose(1, 4, 5, 2, 3, 0)
    each = each.reshape(len(names), -1, matrices.coordinates.size)
    # (Rows of a quantity are combined to as few as possible, with the same sum of squares up to
    # rounding.)
    _, values, vectors = np.linalg.svd(each, full_matrices=False)
    largest = values[:, :1] ** 2
    kept = values**2 > np.finfo(float).eps * largest
    rows = []
    for s, v, k in zip(values, vectors, kept, strict=True):
        rows.append(s[k, None] * v[k])
    lengths = [len(x) for x in rows]
    part = np.repeat(np.arange(len(rows)), lengths)
    return matrices.criterion(np.concatenate(rows), tuple(names), part)
