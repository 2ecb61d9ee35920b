r"""What each cosine says of the unknowns, per unit of its power.

With powers p and errors of variance 1 at p = 1, the information about the unknowns $\theta$ is
$J = \sum_k p_k F_k^T F_k$. Unknowns that nobody asks for (numerators) are projected out: then F
depends on p, and is what they leave of the derivatives.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..identify.multipliers.denominator import chi
from ..identify.multipliers.error_weights import check_values, error_weights, require_frequencies
from ..identify.multipliers.variable_projection import powers_basis
from ..linear.htf import HTF


class Sensitivities(eqx.Module):
    """Derivatives of what is measured, in units of its standard deviation."""

    candidate: eqx.AbstractVar[Int[np.ndarray, " rows"]]
    """The cosine that each row belongs to."""

    @abc.abstractmethod
    def at(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, "d rows"]:
        """By the d unknowns, with these powers, all positive; the sum of squares of a cosine's rows
        is its share of the information."""

    @abc.abstractmethod
    def only(self, some: Int[np.ndarray, " k"]) -> "Sensitivities":
        """Where only these cosines are applied; they are counted anew."""


class DirectSensitivities(Sensitivities):
    """Of unknowns on which the HTFs depend directly: `slopes` at power 1."""

    candidate: Int[np.ndarray, " rows"]
    slopes: Float[np.ndarray, "d rows"]

    def at(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, "d rows"]:
        return np.sqrt(power)[self.candidate] * self.slopes

    def only(self, some: Int[np.ndarray, " k"]) -> "DirectSensitivities":
        kept, number = _renumbered(self.candidate, some)
        return DirectSensitivities(number, self.slopes[:, kept])


class Channel(NamedTuple):
    """All HTFs of one input: E real equations (two for each cosine)."""

    cosine: Int[np.ndarray, " E"]
    """The candidate that each equation belongs to."""
    basis: Float[np.ndarray, "E r"]
    """Of what numerators can explain, at power 1."""
    slopes: Float[np.ndarray, "E n"]
    """By c, of n entries: those of c_1 for all, then those of c_2, ..."""


class DenominatorSensitivities(Sensitivities):
    """Of the coefficients c of the denominator, as `fit_multipliers` finds them: all numerators
    are unknown."""

    candidate: Int[np.ndarray, " rows"]
    channels: tuple[Channel, ...]
    order: int

    @classmethod
    def of(cls, channels: list[Channel], order: int) -> "DenominatorSensitivities":
        entries = [one.slopes.shape[1] // order for one in channels]
        each = [np.repeat(one.cosine, n) for one, n in zip(channels, entries, strict=True)]
        return cls(np.concatenate(each), tuple(channels), order)

    def only(self, some: Int[np.ndarray, " k"]) -> "DenominatorSensitivities":
        channels = []
        for one in self.channels:
            kept, number = _renumbered(one.cosine, some)
            if len(kept):
                basis, _ = powers_basis(one.basis[kept])
                channels.append(Channel(number, basis, one.slopes[kept]))
        return self.of(channels, self.order)

    def at(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, "d rows"]:
        left = []
        for one in self.channels:
            weight = np.sqrt(power)[one.cosine, None]
            q, _ = np.linalg.qr(weight * one.basis)
            slopes = weight * one.slopes
            slopes -= q @ (q.T @ slopes)
            left.append(np.moveaxis(slopes.reshape(len(slopes), self.order, -1), 1, 0))
        return np.concatenate([x.reshape(self.order, -1) for x in left], axis=1)


def denominator_sensitivities(
    htfs: list[HTF],
    cosines: list[Int[np.ndarray, " F"]],
    c: Float[np.ndarray, " d"],
    overhang: int | None,
) -> DenominatorSensitivities:
    """From the exact HTFs of each input (alone) with the variances that power 1 gives, and which
    of the candidates their frequencies are.

    **Raises:** `DefinitionError` if they cannot tell the multipliers, or harmonics are not
    symmetric about 0.
    """
    channels = []
    for htf, cosine in zip(htfs, cosines, strict=True):
        size = len(c) * htf.n_sections + (htf.n_sections if overhang is None else overhang) + 1
        require_frequencies(htf, len(c), size)
        channels.append(_channel(htf, cosine, c, size))
    return DenominatorSensitivities.of(channels, len(c))


def _channel(
    htf: HTF, cosine: Int[np.ndarray, " F"], c: Float[np.ndarray, " d"], size: int
) -> Channel:
    r"""From $dH = dB/\chi - H\, d\chi/\chi$ at z and at 1/z.

    Where H_m and H_{-m} are different, sum and difference of H_m(w) and H_m(-w) = conj H_{-m}(w)
    are explained by cosines and sines times the coefficients of B_m, whose real and imaginary parts
    are thereby apart: with the same real equations as those of the real B_0.
    """
    N, f = htf.n_sections, np.asarray(htf.f)
    weight = error_weights(htf, check_values(htf))
    weighted = dict(zip(htf.harmonics, np.asarray(htf.H) * weight, strict=True))
    if not all((-m) % N in {k % N for k in weighted} for m in weighted):
        raise DefinitionError(
            f"the harmonics of `goal` must be symmetric about 0, not {htf.harmonics}."
        )
    delay = np.exp(-2j * np.pi * f)
    size_of_chi = np.abs(chi(delay, c))
    columns = []
    for j in range(1, len(c) + 1):
        for m, H in weighted.items():
            if m < 0 and -m in weighted:
                continue
            slope = H[:, :, 0] * (delay**j / size_of_chi)[:, None]
            if m == 0 or 2 * m % N == 0:
                columns.append(np.concatenate([slope.real, slope.imag]))
                continue
            mirror = (weighted[-m][:, :, 0] * (delay**j / size_of_chi)[:, None]).conj()
            even, odd = (slope + mirror) / np.sqrt(2), (slope - mirror) / np.sqrt(2)
            columns.append(np.concatenate([even.real, odd.imag]))
            columns.append(np.concatenate([even.imag, -odd.real]))
    angle = 2 * np.pi / N * f[:, None] * np.arange(size)
    basis, _ = powers_basis(np.concatenate([np.cos(angle), -np.sin(angle)]))
    basis = basis / np.concatenate([size_of_chi, size_of_chi])[:, None]
    return Channel(np.concatenate([cosine, cosine]), basis, np.concatenate(columns, axis=1))


def _renumbered(
    candidate: Int[np.ndarray, " rows"], some: Int[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " kept"], Int[np.ndarray, " kept"]]:
    """The rows of some candidates, and their places among these (which ascend)."""
    kept = np.flatnonzero(np.isin(candidate, some))
    return kept, np.searchsorted(some, candidate[kept])
