r"""The variance of a quantity of interest as a function of the powers of the cosines.

With powers p and errors of variance 1 at p = 1, the information about the unknowns $\theta$ is $J =
\sum_k p_k F_k^T F_k$, and the variances of linear functions of $\theta$ are those of the Cramer-Rao
bound. Unknowns of no interest (numerators) are projected out. F is then the part of the derivatives
that numerators do not explain, and depends on p.

Every criterion $\Psi$ is convex in the powers, and twice the powers give half the criterion. For
several models, the mean of r-th powers $(\frac{1}{J} \sum_j \Psi_j^r)^{1/r}$ has both properties
for any $r \ge 1$, so that the certificate holds. With r = 1 it is the mean. With a large r it is
nearly the largest one: it is smaller by a factor of $J^{-1/r}$ at most.

The search calls `Criterion.bound(power)`, which returns a `Bound`: variances, sensitivities and the
criterion. If the sensitivities are not the derivatives of the criterion, the search fails: test
these first. If an unknown is refused that the data determine, look at `_root`; if variances are too
large, at `Channel.rows`, which takes out what numerators explain. A new criterion must be convex
and halved by twice the powers, too.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..identify.descent import ROUNDING
from ..identify.variable_projection import powers_basis
from .candidates import Kept, Powers


class Bound(NamedTuple):
    """The Cramer-Rao bound with some powers."""

    variances: Float[np.ndarray, " g"]
    """Variances of the quantities of interest."""
    sensitivity: Powers
    """Minus the derivative of the criterion by the power of each cosine."""
    criterion: float
    """In units of a variance: convex in the powers, and half as large for twice the powers."""


class Channel(NamedTuple):
    """Measurements with the same E real equations, two or four for each cosine."""

    cosine: Int[np.ndarray, " E"]
    """The candidate that each equation belongs to."""
    slopes: Float[np.ndarray, "E n"]
    """Derivatives in units of standard deviations. The columns are, for all entries, the
    derivatives by the first unknown, then those by the second, and so on."""
    basis: Float[np.ndarray, "E r"] | None = None
    """Orthonormal basis of the part that numerators can explain, at power 1; None: measurements
    depend on the unknowns directly, without numerators."""

    def only(self, kept: Kept) -> "Channel":
        """Return the channel if only these cosines are applied. They get new numbers."""
        rows = np.flatnonzero(np.isin(self.cosine, kept))
        basis = None if self.basis is None else self.basis[rows]
        basis = powers_basis(basis)[0] if basis is not None and basis.size else basis
        return Channel(
            np.searchsorted(kept, self.cosine[rows]), self.slopes[rows], basis
        )

    def rows(self, power: Powers, unknowns: int) -> Float[np.ndarray, "d rows"]:
        """Return derivatives with these powers, less the part that numerators explain."""
        weight = np.sqrt(power)[self.cosine, None]
        slopes = weight * self.slopes
        if self.basis is not None:
            q, _ = np.linalg.qr(weight * self.basis)
            slopes -= q @ (q.T @ slopes)
        return (
            slopes.reshape(len(slopes), unknowns, -1)
            .swapaxes(0, 1)
            .reshape(unknowns, -1)
        )


class LinearCriterion(eqx.Module):
    """The sum of the variances of linear functions of unknowns, for one model."""

    names: tuple[str, ...]
    """Names of the quantities of interest."""
    unknowns: tuple[str, ...]
    channels: tuple[Channel, ...]
    wanted: Float[np.ndarray, "rows d"]
    """Derivatives of the functions by the unknowns."""
    part: Int[np.ndarray, " rows"]
    """The quantity that a row belongs to. (The variance of a quantity is the sum over its rows.)"""

    def only(self, kept: Kept) -> "LinearCriterion":
        channels = (channel.only(kept) for channel in self.channels)
        return dataclasses.replace(
            self, channels=tuple(x for x in channels if len(x.cosine))
        )

    def bound(self, power: Powers) -> Bound:
        """Return the bound of this model with these powers; see `Criterion.bound`."""
        d = len(self.unknowns)
        rows = np.concatenate(
            [channel.rows(power, d) for channel in self.channels], axis=1
        )
        cosine = [np.repeat(x.cosine, x.slopes.shape[1] // d) for x in self.channels]
        half = _root(rows @ rows.T, self.unknowns)
        spread = self.wanted @ half
        influence = spread @ half.T @ rows
        variances = (spread**2).sum(axis=1)
        squares = np.bincount(
            np.concatenate(cosine), (influence**2).sum(axis=0), len(power)
        )
        return Bound(
            np.bincount(self.part, variances), squares / power, float(variances.sum())
        )


class Criterion(eqx.Module):
    """The function of the powers that a design minimizes: the mean of r-th powers of the criteria
    of one or several models."""

    each: tuple[LinearCriterion, ...]
    exponent: float = 1.0
    """r."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities of interest."""
        return self.each[0].names

    def bound(self, power: Powers) -> Bound:
        """Return the bound with these powers, all positive.

        **Raises:** `DefinitionError` that names the unknowns that are not identifiable.
        """
        bounds = [criterion.bound(power) for criterion in self.each]
        criteria = np.array([bound.criterion for bound in bounds])
        top = criteria.max()
        mean_power = np.mean((criteria / top) ** self.exponent)
        mean = top * mean_power ** (1 / self.exponent)
        share = (criteria / mean) ** (self.exponent - 1) / len(criteria)
        variances = (
            share @ np.array([bound.variances for bound in bounds]) / share.sum()
        )
        return Bound(
            variances, share @ np.array([x.sensitivity for x in bounds]), float(mean)
        )

    def only(self, kept: Kept) -> "Criterion":
        """Return the criterion where only these cosines are applied."""
        return Criterion(tuple(x.only(kept) for x in self.each), self.exponent)


def _root(
    matrix: Float[np.ndarray, "d d"], unknowns: tuple[str, ...]
) -> Float[np.ndarray, "d d"]:
    """Return R with R R^T the inverse of the information."""
    size = np.sqrt(np.diag(matrix))
    lost = np.flatnonzero(~(size > 0))
    if len(lost):
        raise DefinitionError(
            f"{unknowns[lost[0]]} changes no response: drop it or add an output."
        )
    scaled = matrix / size / size[:, None]
    values, vectors = np.linalg.eigh(scaled)
    # (Relative to the largest one, for combinations of matrices.)
    if not values[0] > ROUNDING:
        direction = vectors[:, 0] / size
        largest = np.abs(direction).max()
        named = zip(direction, unknowns, strict=True)
        along = " ".join(
            f"{x:+.2g} {name}" for x, name in named if abs(x) > 1e-3 * largest
        )
        raise DefinitionError(
            f"no response changes along {along}: fix one, or add an output."
        )
    return vectors / np.sqrt(values) / size[:, None]
