r"""The matrices of a linear periodic model as unknowns, as `fit_ldtp` has them.

They are taken in the local coordinates of `fit_ldtp`, in combinations for which the information of
the usual design is the identity; those that it does not show are left out.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from ...identify.htf_errors import check_values, error_weights
from ...identify.joint.characteristic import characteristic_slopes
from ...identify.joint.coordinates import LocalCoordinates, local_coordinates
from ...identify.joint.frequency import transfer_slopes
from ...identify.joint.periodic_model import PeriodicModel
from ...identify.series.realization import realize
from ...linear.frequency_response import Harmonics
from ...linear.ldtp import LDTP
from ..candidates import Candidates
from ..noise import Noise
from ..signals import Model
from .measured import Measured, measured
from .question import Question
from .sensitivities import DirectSensitivities


# Periods of the impulse response from which a minimal model is made, and the lags at least.
# Doubled: states that are seen later, and half as well, count.
_PERIODS, _LAGS = 4, 17
# Combinations that the usual design shows less than that, relative to the one it shows best, are
# rounding errors. Doubled: combinations that are shown 1.4 times better count as not shown.
_SINGULAR = 1e-13
# The part of a wanted variance that combinations which are not shown may have, at the least.
# Doubled: standard errors may be 5 % too small instead of 2.5 %.
_MISSED = 0.05


class LDTPUnknowns(NamedTuple):
    """d combinations of the P local coordinates, and what each cosine says of them."""

    coordinates: LocalCoordinates
    scale: Float[np.ndarray, " seen"]
    """Of the measured outputs."""
    sensitivities: DirectSensitivities
    size: Float[np.ndarray, " P"]
    """One over the unit of each coordinate, in which"""
    values: Float[np.ndarray, " P"]
    vectors: Float[np.ndarray, "P P"]
    """are the eigenvalues and eigenvectors of the usual information."""

    def characteristic(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n P"]]:
        """The coefficients of the polynomial of the multipliers, and their derivatives."""
        return characteristic_slopes(self.coordinates)

    def question(
        self,
        wanted: Float[np.ndarray, "rows P"],
        names: tuple[str, ...],
        criterion: str,
        part: Int[np.ndarray, " rows"] | None = None,
    ) -> Question:
        """**Arguments:** `wanted`, derivatives by the coordinates; `part`, the wanted quantity that
        each row belongs to, if its variance is a sum over several.

        **Raises:** `DefinitionError` if the usual design does not show it.
        """
        kept = _shown(self.values)
        turned = wanted / self.size @ self.vectors
        least = np.maximum(self.values, _SINGULAR * self.values[-1])
        of = np.arange(len(wanted)) if part is None else part
        everything, missed = (
            np.bincount(of, (turned[:, some] ** 2 / least[some]).sum(axis=1))
            for some in (slice(None), ~kept)
        )
        if (missed > _MISSED * everything).any():
            raise DefinitionError(
                "the usual design does not show what `goal` asks for: measure more harmonics or "
                "lines."
            )
        unknowns = tuple(f"combination {k} of the matrices" for k in range(kept.sum()))
        wanted = turned[:, kept] / np.sqrt(self.values[kept])
        return Question(self.sensitivities, wanted, names, unknowns, criterion, part)


def ldtp_unknowns(
    model: Model,
    cosines: Candidates,
    harmonics: Harmonics | None,
    noise: Noise,
    power: Float[np.ndarray, " K"],
) -> LDTPUnknowns:
    """**Arguments:** `power` of the usual design.

    **Raises:** `DefinitionError` for a model that is no `LDTP`.
    """
    if not isinstance(model, LDTP):
        raise DefinitionError(
            "a goal of `fit_ldtp` needs a model with matrices: an `LDTP`, such as `fit.model` of "
            "`fit_ldtp` or what `hj.identify.realize` gives."
        )
    lags = max(_PERIODS * model.n_sections, _LAGS - 1) + 1
    response = np.asarray(model.impulse_response(lags))[:, :, noise.seen]
    seen = list(measured(model, cosines, harmonics, noise))
    scale = np.sqrt(np.mean([check_values(one.htf) ** 2 for one in seen], axis=0))
    direct = bool(response[:, 0].any())
    coordinates = local_coordinates(PeriodicModel.of(realize(response), scale), direct)
    P = coordinates.size
    gram = np.zeros((P, P))
    for lines, rows in _rows(coordinates, seen, scale):
        rows *= np.sqrt(power[lines])[:, None, None]
        gram += _flat(rows) @ _flat(rows).T
    size = np.sqrt(np.diag(gram))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(gram / size / size[:, None])
    kept = _shown(values)
    turn = (vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]).T
    candidate, slopes = [], []
    for lines, rows in _rows(coordinates, seen, scale):
        candidate.append(np.repeat(lines, rows.shape[2]))
        slopes.append(turn @ _flat(rows))
    sensitivities = DirectSensitivities(np.concatenate(candidate), np.concatenate(slopes, axis=1))
    return LDTPUnknowns(coordinates, scale, sensitivities, size, values, vectors)


def _shown(values: Float[np.ndarray, " P"]):
    return values > _SINGULAR * values[-1]


def _rows(
    coordinates: LocalCoordinates,
    seen: list[Measured],
    scale: Float[np.ndarray, " seen"],
) -> Iterator[tuple[Int[np.ndarray, " lines"], Float[np.ndarray, "lines P rows"]]]:
    """Derivatives of all that some cosines measure, in units of its standard deviation at power
    1."""
    for htf, here, channel in seen:
        weight = error_weights(htf, scale)[..., 0] * scale
        for some, slopes in transfer_slopes(coordinates, np.asarray(htf.f), htf.harmonics):
            rows = slopes[..., channel] * weight[:, some]
            rows = np.ascontiguousarray(rows.transpose(2, 0, 1, 3))
            yield here[some], rows.reshape(*rows.shape[:2], -1).view(float)


def _flat(rows: Float[np.ndarray, "lines P rows"]) -> Float[np.ndarray, "P lines*rows"]:
    return rows.swapaxes(0, 1).reshape(rows.shape[1], -1)
