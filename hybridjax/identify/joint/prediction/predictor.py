"""Predictions one step ahead."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...._core.arguments import require_same
from ....errors import DefinitionError
from ....experiments.record import Record
from ....linear.ldtp import LDTP
from ...series.records import CycleGrid
from ..periodic_model import PeriodicModel
from .problem import SeriesProblem
from .series_part import SeriesPart


# Periods after which the gain of a filter that still changes is refused, and the change of a
# covariance, relative to the standard deviations, that is the last. Doubled: noise that is seen
# half as well; a digit less.
_MOST_PERIODS, _SETTLED = 10_000, 1e-12


class Predictor(NamedTuple):
    """A model in innovation form, in the units of the outputs."""

    model: PeriodicModel
    S: Float[np.ndarray, "N ny ny"]
    """Covariances of the innovations."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def n_sections(self) -> int:
        return self.model.n_sections

    @property
    def dims(self) -> list[int]:
        return self.model.dims

    @classmethod
    def of(cls, model: LDTP, noise: LDTP) -> "Predictor":
        """Of outputs that are those of a model and noise.

        **Raises:** `DefinitionError` if these do not fit together, or an output has no noise of its
        own.
        """
        require_same("model and noise", model, noise, ("n_sections", "outputs"))
        ones = np.ones(len(model.outputs))
        own, other = PeriodicModel.of(model, ones), PeriodicModel.of(noise, ones)
        K, S = _innovations(other)
        both = PeriodicModel(
            A=[_diagonal(a, b) for a, b in zip(own.A, other.A, strict=True)],
            B=[np.pad(b, [(0, len(k)), (0, 0)]) for b, k in zip(own.B, K, strict=True)],
            C=[np.concatenate(pair, axis=1) for pair in zip(own.C, other.C, strict=True)],
            D=own.D,
            K=[np.pad(k, [(len(b), 0), (0, 0)]) for b, k in zip(own.B, K, strict=True)],
        )
        return cls(both, S, model.inputs, model.outputs)

    def predict(self, record: Record, free_start: bool) -> Float[np.ndarray, "n ny"]:
        """The outputs expected at each sample, given those before it."""
        part = SeriesPart.of(CycleGrid.from_records([record]), np.ones(len(self.outputs)))
        path = SeriesProblem([part], self.S, True, free_start, 0).path(self.model, part)
        expected = [
            x @ C.T + u @ D.T
            for x, C, u, D in zip(path.x, self.model.C, part.u, self.model.D, strict=True)
        ]
        expected = np.where(part.seen, part.y - np.stack(path.error), np.stack(expected))
        rows = slice(record.first_section, record.first_section + len(record.u))
        return np.moveaxis(expected[:, 0], 0, 1).reshape(-1, len(self.outputs))[rows]


def _diagonal(a, b):
    return np.block([[a, np.zeros((len(a), b.shape[1]))], [np.zeros((len(b), a.shape[1])), b]])


def _innovations(noise: PeriodicModel):
    """Kalman's gain and the covariance of the innovations, section by section, in the steady
    state: the periodic Riccati equation, iterated (Bittanti and Colaneri 2009).

    From the covariance of states that nobody observes, so that all numbers are in the units of
    states and outputs, whatever these are.
    """
    P = _unobserved(noise)
    unit, S = np.sqrt(np.diag(P)), np.zeros((noise.n_sections, *noise.D[0].shape[:1] * 2))
    for _ in range(_MOST_PERIODS):
        before, known, K, S = P, S, [], []
        for A, B, C, D in zip(noise.A, noise.B, noise.C, noise.D, strict=True):
            S.append(C @ P @ C.T + D @ D.T)
            if not np.linalg.eigvalsh(S[-1])[0] > 0:
                raise DefinitionError(
                    "the outputs have no noise of their own at a section: give each some, however "
                    "small, by an input of its own in `noise.D`."
                )
            K.append(np.linalg.solve(S[-1], (A @ P @ C.T + B @ D.T).T).T)
            left = A - K[-1] @ C
            entering = B - K[-1] @ D
            P = left @ P @ left.T + entering @ entering.T
        S = np.stack(S)
        sizes = np.sqrt(np.diagonal(S, axis1=1, axis2=2))
        if _settled(P, before, unit) and _settled(S, known, sizes):
            return K, S
    raise DefinitionError("the noise has no steady state: give a stable model of it.")


def _unobserved(noise: PeriodicModel) -> Float[np.ndarray, "d d"]:
    """Covariance of a state that was zero, after as many periods as it has coordinates: what noise
    ever reaches, it has reached by then."""
    P = np.zeros((noise.dims[0], noise.dims[0]))
    for _ in range(noise.dims[0]):
        for A, B in zip(noise.A, noise.B, strict=True):
            P = A @ P @ A.T + B @ B.T
    return P


def _settled(now, before, unit) -> bool:
    """Whether covariances are what they were before, in units of standard deviations."""
    limit = _SETTLED * unit[..., :, None] * unit[..., None, :]
    return bool((np.abs(now - before) <= limit).all())
