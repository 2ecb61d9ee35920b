r"""The variance of a quantity of interest as a function of the powers of the cosines.

With powers p and errors of variance 1 at p = 1, the information about the unknowns $\theta$ is
$J = \sum_k p_k F_k^T F_k$, and the variances of linear functions of $\theta$ are those of the
Cramer-Rao bound. Unknowns of no interest (numerators) are projected out: then F depends on p, and
is the part of the derivatives that numerators do not explain.

Every criterion $\Psi$ is convex in the powers, and halved where these are doubled. Of several
models, the mean of r-th powers $(\frac{1}{J} \sum_j \Psi_j^r)^{1/r}$ has both properties for any
$r \ge 1$, so that the certificate holds. With r = 1 it is the mean. With a large r it is hardly
less than the largest one, by a factor of $J^{-1/r}$ at most.
"""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..identify.variable_projection import powers_basis
from .candidates import Kept, Powers


# An unknown is lost where an eigenvalue of the scaled information is below this. Larger: goals with
# a large but finite variance are rejected. Smaller: variances are rounding errors.
_SINGULAR = 1e-12


class Bound(NamedTuple):
    """The Cramer-Rao bound with some powers."""

    variances: Float[np.ndarray, " g"]
    """Variances of the quantities of interest."""
    sensitivity: Powers
    """Minus the derivative of the criterion by the power of each cosine."""
    criterion: float
    """In units of a variance: convex in the powers, and half as large for twice the powers."""


class Criterion(eqx.Module):
    """A function of the powers that a design minimizes."""

    names: eqx.AbstractVar[tuple[str, ...]]
    """Names of the quantities of interest."""

    @abc.abstractmethod
    def bound(self, power: Powers) -> Bound:
        """Return the bound with these powers, all positive.

        **Raises:** `DefinitionError` that names the unknowns that are not identifiable.
        """

    @abc.abstractmethod
    def only(self, kept: Kept) -> "Criterion":
        """Return the criterion where only these cosines are applied."""


class Channel(NamedTuple):
    """Measurements with the same E real equations, two or four for each cosine."""

    cosine: Int[np.ndarray, " E"]
    """The candidate that each equation belongs to."""
    basis: Float[np.ndarray, "E r"]
    """Orthonormal basis of the part that numerators can explain, at power 1."""
    slopes: Float[np.ndarray, "E n"]
    """Derivatives in units of standard deviations, for several entries: those by the first unknown
    for all entries, then those by the second, ..."""


def only_channels(channels: Sequence[Channel], kept: Kept) -> tuple[Channel, ...]:
    """Return the channels where only these cosines are applied, which are numbered anew."""
    reduced = []
    for channel in channels:
        rows = np.flatnonzero(np.isin(channel.cosine, kept))
        if len(rows):
            basis = channel.basis[rows]
            basis = powers_basis(basis)[0] if basis.shape[1] else basis
            number = np.searchsorted(kept, channel.cosine[rows])
            reduced.append(Channel(number, basis, channel.slopes[rows]))
    return tuple(reduced)


class Information(NamedTuple):
    """Derivatives of all measurements by d unknowns."""

    channels: tuple[Channel, ...]
    unknowns: tuple[str, ...]

    @classmethod
    def direct(
        cls,
        cosine: Int[np.ndarray, " rows"],
        slopes: Float[np.ndarray, "d rows"],
        unknowns: tuple[str, ...],
    ) -> "Information":
        """Return that of unknowns on which all measurements depend directly, without numerators."""
        return cls((Channel(cosine, np.zeros((len(cosine), 0)), slopes.T),), unknowns)

    @property
    def cosine(self) -> Int[np.ndarray, " rows"]:
        """The cosine that each row of `rows` belongs to."""
        entries = [channel.slopes.shape[1] // len(self.unknowns) for channel in self.channels]
        pairs = zip(self.channels, entries, strict=True)
        return np.concatenate([np.repeat(channel.cosine, n) for channel, n in pairs])

    def rows(self, power: Powers) -> Float[np.ndarray, "d rows"]:
        """Return derivatives with these powers, less the part that numerators explain."""
        parts = []
        for channel in self.channels:
            weight = np.sqrt(power)[channel.cosine, None]
            slopes = weight * channel.slopes
            if channel.basis.shape[1]:
                q, _ = np.linalg.qr(weight * channel.basis)
                slopes -= q @ (q.T @ slopes)
            parts.append(slopes.reshape(len(slopes), len(self.unknowns), -1).swapaxes(0, 1))
        return np.concatenate([x.reshape(len(x), -1) for x in parts], axis=1)


class LinearCriterion(Criterion):
    """The sum of the variances of linear functions of unknowns."""

    names: tuple[str, ...]
    information: Information
    wanted: Float[np.ndarray, "rows d"]
    """Derivatives of the functions by the unknowns."""
    part: Int[np.ndarray, " rows"] | None = None
    """The quantity that a row belongs to, whose variance is the sum over its rows; None: each
    quantity has one row."""

    def only(self, kept: Kept) -> "LinearCriterion":
        reduced = self.information._replace(channels=only_channels(self.information.channels, kept))
        return LinearCriterion(self.names, reduced, self.wanted, self.part)

    def bound(self, power: Powers) -> Bound:
        rows = self.information.rows(power)
        half = _root(rows @ rows.T, self.information.unknowns)
        spread = self.wanted @ half
        influence = spread @ half.T @ rows
        variances = (spread**2).sum(axis=1)
        squares = np.bincount(self.information.cosine, (influence**2).sum(axis=0), len(power))
        criterion = float(variances.sum())
        if self.part is not None:
            variances = np.bincount(self.part, variances)
        return Bound(variances, squares / power, criterion)


class Average(Criterion):
    """The mean of r-th powers of the criteria of several models."""

    names: tuple[str, ...]
    each: tuple[Criterion, ...]
    exponent: float
    """r."""

    def bound(self, power: Powers) -> Bound:
        bounds = [criterion.bound(power) for criterion in self.each]
        criteria = np.array([bound.criterion for bound in bounds])
        top = criteria.max()
        mean = top * np.mean((criteria / top) ** self.exponent) ** (1 / self.exponent)
        share = (criteria / mean) ** (self.exponent - 1) / len(criteria)
        variances = share @ np.array([bound.variances for bound in bounds]) / share.sum()
        return Bound(variances, share @ np.array([x.sensitivity for x in bounds]), float(mean))

    def only(self, kept: Kept) -> "Average":
        return Average(self.names, tuple(x.only(kept) for x in self.each), self.exponent)


def _root(
    information: Float[np.ndarray, "d d"], unknowns: tuple[str, ...]
) -> Float[np.ndarray, "d d"]:
    """Return R with R R^T the inverse of the information."""
    size = np.sqrt(np.diag(information))
    lost = np.flatnonzero(~(size > 0))
    if len(lost):
        raise DefinitionError(f"the data do not depend on {unknowns[lost[0]]} at all.")
    values, vectors = np.linalg.eigh(information / size / size[:, None])
    if not values[0] > _SINGULAR:
        direction = vectors[:, 0] / size
        largest = np.abs(direction).max()
        named = zip(direction, unknowns, strict=True)
        parts = [f"{x:+.2g} {name}" for x, name in named if abs(x) > 1e-3 * largest]
        raise DefinitionError(f"the data do not identify this combination: {' '.join(parts)}.")
    return vectors / np.sqrt(values) / size[:, None]
