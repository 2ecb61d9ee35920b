r"""What each cosine says of the unknowns, per unit of its power.

With powers p and errors of variance 1 at p = 1, the information about the unknowns $\theta$ is
$J = \sum_k p_k F_k^T F_k$. Unknowns that nobody asks for (numerators) are projected out: then F
depends on p, and is what they leave of the derivatives.
"""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from ...identify.denominator import chi
from ...identify.htf_errors import check_values, error_weights, require_frequencies
from ...identify.variable_projection import powers_basis
from ...linear.htf import HTF
from .measured import Measured


# Decimal digits to which the errors of two entries must agree (up to a factor) to be treated
# together. One digit less: fewer channels, with errors that are off by as much.
_EQUAL_WEIGHTS = 9


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
    """HTFs of one input with the same E real equations (two for each cosine, or four)."""

    cosine: Int[np.ndarray, " E"]
    """The candidate that each equation belongs to."""
    basis: Float[np.ndarray, "E r"]
    """Of what numerators can explain, at power 1."""
    slopes: Float[np.ndarray, "E n"]
    """By c, of n entries: those of c_1 for all, then those of c_2, ... (Equations come in pairs of
    blocks, real and imaginary parts of the same.)"""


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
        return self.of(only_channels(self.channels, some), self.order)

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
    seen: list[Measured], c: Float[np.ndarray, " d"], overhang: int | None
) -> DenominatorSensitivities:
    """**Raises:** `DefinitionError` if the HTFs cannot tell the multipliers, or harmonics are not
    symmetric about 0.
    """
    channels = []
    for htf, cosine, _ in seen:
        size = len(c) * htf.n_sections + (htf.n_sections if overhang is None else overhang) + 1
        require_frequencies(htf, len(c), size)
        channels += channels_of(htf, cosine, c, size, range(1, len(c) + 1))
    return DenominatorSensitivities.of(channels, len(c))


def channels_of(
    htf: HTF,
    cosine: Int[np.ndarray, " F"],
    c: Float[np.ndarray, " d"],
    size: int,
    delays: Sequence[int],
) -> list[Channel]:
    r"""H delayed by some periods and divided by the denominator's modulus, and what numerators of
    so many coefficients can explain of that.

    From $dH = dB/\chi - H\, d\chi/\chi$ at z and at 1/z, with a channel for all entries whose
    errors depend on the frequency in the same way.

    Where H_m and H_{-m} are different, sum and difference of H_m(w) and H_m(-w) = conj H_{-m}(w)
    are explained by cosines and sines times the coefficients of B_m, whose real and imaginary parts
    are thereby apart: with the same real equations as those of the real B_0. This needs errors of
    the same size in both; otherwise all four equations are taken together.

    **Raises:** `DefinitionError` for harmonics that are not symmetric about 0.
    """
    N, f = htf.n_sections, np.asarray(htf.f)
    if not all((-m) % N in {k % N for k in htf.harmonics} for m in htf.harmonics):
        raise DefinitionError(
            f"the harmonics of `goal` must be symmetric about 0, not {htf.harmonics}."
        )
    weight = dict(zip(htf.harmonics, error_weights(htf, check_values(htf))[..., 0], strict=True))
    delay = np.exp(-2j * np.pi * f)
    size_of_chi = np.abs(chi(delay, c))
    delayed = delay ** np.array(delays)[:, None] / size_of_chi
    slope = {
        m: weight[m] * H[:, :, 0] * delayed[..., None]
        for m, H in zip(htf.harmonics, np.asarray(htf.H), strict=True)
    }  # (delays, F, ny)
    angle = 2 * np.pi / N * f[:, None] * np.arange(size)
    powers = np.concatenate([np.cos(angle), -np.sin(angle)])
    groups: dict[bytes, tuple[np.ndarray, list[np.ndarray]]] = {}

    def add(basis, factor, entries):
        # (Only the shape of the factors counts: numerators take any size.)
        shape = factor / factor.max()
        key = np.round(shape, _EQUAL_WEIGHTS).tobytes()
        if key not in groups:
            shape = shape / np.tile(size_of_chi, len(shape) // len(f))
            groups[key] = powers_basis(basis)[0] * shape[:, None], []
        groups[key][1].extend(entries)

    for m in htf.harmonics:
        if m < 0 and -m in weight:
            continue
        for i in range(len(htf.outputs)):
            here, w = slope[m][..., i], weight[m][:, i]
            if 2 * m % N == 0:
                add(powers, np.tile(w, 2), [_parts(here.real, here.imag)])
                continue
            mirror, v = slope[-m][..., i], weight[-m][:, i]
            if np.allclose(v, w, rtol=10.0**-_EQUAL_WEIGHTS, atol=0):
                even, odd = (here + mirror.conj()) / 2**0.5, (here - mirror.conj()) / 2**0.5
                both = _parts(even.real, odd.imag), _parts(even.imag, -odd.real)
                add(powers, np.tile(w, 2), both)
                continue
            entry = _parts(here.real, here.imag, mirror.real, mirror.imag)
            add(_both_parts(powers), np.concatenate([w, w, v, v]), [entry])
    return [
        Channel(
            np.tile(cosine, len(basis) // len(f)),
            basis,
            np.stack(entries, axis=2).reshape(len(basis), -1),
        )
        for basis, entries in groups.values()
    ]


def _parts(*parts: Float[np.ndarray, "d F"]) -> Float[np.ndarray, "E d"]:
    """Real equations, those of one part after those of the other."""
    return np.concatenate(parts, axis=1).T


def _both_parts(powers: Float[np.ndarray, "E R"]) -> Float[np.ndarray, "2*E 2*R"]:
    """What real and imaginary parts of the coefficients of B_m make of H_m and of H_{-m}."""
    cosine, sine = np.split(powers, 2)
    return np.block([[cosine, -sine], [sine, cosine], [cosine, sine], [sine, -cosine]])


def only_channels(channels: Sequence[Channel], some: Int[np.ndarray, " k"]) -> list[Channel]:
    """Where only these cosines are applied; they are counted anew."""
    left = []
    for one in channels:
        kept, number = _renumbered(one.cosine, some)
        if len(kept):
            basis, _ = powers_basis(one.basis[kept])
            left.append(Channel(number, basis, one.slopes[kept]))
    return left


def _renumbered(
    candidate: Int[np.ndarray, " rows"], some: Int[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " kept"], Int[np.ndarray, " kept"]]:
    """The rows of some candidates, and their places among these (which ascend)."""
    kept = np.flatnonzero(np.isin(candidate, some))
    return kept, np.searchsorted(some, candidate[kept])
