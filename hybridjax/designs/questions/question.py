"""What is asked of the data, and what powers of the cosines tell about it."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from .sensitivities import Sensitivities


# An unknown is lost where an eigenvalue of the scaled information is below this. Ten times more:
# goals known that much less well count as unseen.
_SINGULAR = 1e-12

# Part of a sum of squares, in units of the usual errors, that is left out to have fewer rows. Ten
# times more: variances are smaller by as little as it is.
_NEGLIGIBLE = 1e-8


class Answer(NamedTuple):
    """What some powers tell."""

    variances: Float[np.ndarray, " g"]
    """Of the wanted quantities."""
    sensitivity: Float[np.ndarray, " K"]
    """By which an increase of the power of a cosine lowers the criterion."""
    criterion: float
    """In units of a variance: convex in the powers, and half as large for twice the powers."""


class AbstractQuestion(eqx.Module):
    """What is asked of the data."""

    names: eqx.AbstractVar[tuple[str, ...]]
    """Of the wanted quantities."""

    @abc.abstractmethod
    def answer(self, power: Float[np.ndarray, " K"]) -> Answer:
        """**Arguments:** `power`, all positive.

        **Raises:** `DefinitionError` that names what the data cannot see.
        """

    @abc.abstractmethod
    def only(self, some: Int[np.ndarray, " k"]) -> "AbstractQuestion":
        """Where only these cosines are applied."""


class Question(AbstractQuestion):
    """Linear functions of unknowns, of which the covariance is the inverse of the information."""

    sensitivities: Sensitivities
    wanted: Float[np.ndarray, "rows d"]
    """Derivatives by the unknowns."""
    names: tuple[str, ...]
    unknowns: tuple[str, ...]
    criterion: str
    """"A", the sum of variances, or "D", the volume of the ellipsoid."""
    part: Int[np.ndarray, " rows"] | None = None
    """The wanted quantity that a row belongs to, whose variance is the sum over its rows; None:
    each has one."""

    def only(self, some: Int[np.ndarray, " k"]) -> "Question":
        return eqx.tree_at(lambda q: q.sensitivities, self, self.sensitivities.only(some))

    def answer(self, power: Float[np.ndarray, " K"]) -> Answer:
        rows = self.sensitivities.at(power)
        half = _root(rows @ rows.T, self.unknowns)
        spread = self.wanted @ half
        influence = spread @ half.T @ rows
        variances = (spread**2).sum(axis=1)
        if self.criterion == "D":
            covariance = spread @ spread.T
            influence = np.linalg.solve(np.linalg.cholesky(covariance), influence)
            criterion = float(np.exp(np.linalg.slogdet(covariance)[1] / len(covariance)))
        else:
            criterion = float(variances.sum())
        if self.part is not None:
            variances = np.bincount(self.part, variances)
        squares = np.bincount(self.sensitivities.candidate, (influence**2).sum(axis=0), len(power))
        if self.criterion == "D":
            squares = squares * criterion / len(influence)
        return Answer(variances, squares / power, criterion)


def weighted(
    wanted: Float[np.ndarray, "g d"], names: tuple[str, ...], weights: tuple[float, ...] | None
) -> tuple[Float[np.ndarray, "k d"], tuple[str, ...]]:
    """The sum of the wanted quantities with weights, or without weights themselves.

    **Raises:** `DefinitionError` for another number of weights.
    """
    if weights is None:
        return wanted, names
    if len(weights) != len(names):
        raise DefinitionError(
            f"`weights` of the goal must be {len(names)} numbers: one for each of "
            f"{', '.join(names)}."
        )
    text = " ".join(f"{w:+.3g} {name}" for w, name in zip(weights, names, strict=True) if w)
    return np.array([weights]) @ wanted, (text,)


def fewer_rows(question: Question) -> Question:
    """The same with as few rows of each wanted quantity as have the same sum of squares."""
    rows, part = [], []
    for k in range(len(question.names)):
        _, values, vectors = np.linalg.svd(question.wanted[question.part == k], full_matrices=False)
        square = values**2
        kept = np.cumsum(square[::-1])[::-1] > _NEGLIGIBLE * square.sum()
        rows.append(vectors[kept] * values[kept, None])
        part.append(np.full(kept.sum(), k))
    changed = np.concatenate(rows), np.concatenate(part)
    return eqx.tree_at(lambda q: (q.wanted, q.part), question, changed)


def _root(
    information: Float[np.ndarray, "d d"], unknowns: tuple[str, ...]
) -> Float[np.ndarray, "d d"]:
    """R with R R^T the inverse of the information."""
    size = np.sqrt(np.diag(information))
    unseen = np.flatnonzero(~(size > 0))
    if len(unseen):
        raise DefinitionError(f"the data cannot see {unknowns[unseen[0]]} at all.")
    values, vectors = np.linalg.eigh(information / size / size[:, None])
    if not values[0] > _SINGULAR:
        parts = [
            f"{x:+.2g} {name}"
            for x, name in zip(vectors[:, 0] / size, unknowns, strict=True)
            if abs(x) > 1e-3 * np.abs(vectors[:, 0] / size).max()
        ]
        raise DefinitionError(f"the data cannot see this combination: {' '.join(parts)}.")
    return vectors / np.sqrt(values) / size[:, None]
