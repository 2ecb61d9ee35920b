"""The information about the denominator in `fit_multipliers`, with all numerators free."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from ..errors import DefinitionError
from ..identify.denominator import chi
from ..identify.htf_errors import check_values, error_weights, require_frequencies
from ..identify.variable_projection import powers_basis
from ..linear.htf import HTF
from .candidates import Measured
from .criterion import Channel


# Decimal digits to which the errors of two entries must agree (up to a factor) to be treated
# together. One digit less: fewer channels, with errors that are off by as much.
_EQUAL_WEIGHTS = 9


def coefficients(order: int, n_sections: int, overhang: int | None) -> int:
    """Return how many coefficients each numerator has."""
    return order * n_sections + (n_sections if overhang is None else overhang) + 1


def denominator_channels(
    htfs: Iterable[Measured], c: Float[np.ndarray, " d"], overhang: int | None
) -> tuple[Channel, ...]:
    """Return the measurements with their derivatives by the coefficients c of the denominator.

    **Raises:** `DefinitionError` if the HTFs have too few frequencies, or harmonics that are not
    symmetric about 0.
    """
    channels = []
    for htf, cosine, _ in htfs:
        size = coefficients(len(c), htf.n_sections, overhang)
        require_frequencies(htf, len(c), size)
        channels += _channels(htf, cosine, c, size)
    return tuple(channels)


def require_symmetric(harmonics: tuple[int, ...], n_sections: int) -> None:
    """**Raises:** `DefinitionError` for harmonics that are not symmetric about 0."""
    if {(-m) % n_sections for m in harmonics} != {m % n_sections for m in harmonics}:
        raise DefinitionError(
            f"the harmonics of `goal` must be symmetric about 0, not {harmonics}."
        )


def _channels(
    htf: HTF, cosine: Int[np.ndarray, " F"], c: Float[np.ndarray, " d"], size: int
) -> list[Channel]:
    r"""Return H delayed by 1 to d periods and divided by the denominator's modulus, and the part of
    it that numerators of so many coefficients can explain.

    From $dH = dB/\chi - H\, d\chi/\chi$ at z and at 1/z, with a channel for all entries whose
    errors depend on the frequency in the same way.

    Where H_m and H_{-m} are different, sum and difference of H_m(w) and H_m(-w) = conj H_{-m}(w)
    are explained by cosines and sines times the coefficients of B_m, whose real and imaginary parts
    are thereby apart: with the same real equations as those of the real B_0. This requires errors
    of the same size in both; otherwise all four equations are taken together.
    """
    N, f = htf.n_sections, np.asarray(htf.f)
    require_symmetric(htf.harmonics, N)
    weight = dict(zip(htf.harmonics, error_weights(htf, check_values(htf))[..., 0], strict=True))
    delay = np.exp(-2j * np.pi * f)
    size_of_chi = np.abs(chi(delay, c))
    delayed = delay ** np.arange(1, len(c) + 1)[:, None] / size_of_chi
    slope = {
        m: weight[m] * H[:, :, 0] * delayed[..., None]
        for m, H in zip(htf.harmonics, np.asarray(htf.H), strict=True)
    }  # (delays, F, ny)
    angle = 2 * np.pi / N * f[:, None] * np.arange(size)
    cosines, sines = np.cos(angle), np.sin(angle)
    powers = np.concatenate([cosines, -sines])
    groups: dict[bytes, tuple[np.ndarray, list[np.ndarray]]] = {}

    def add(basis: np.ndarray, factor: np.ndarray, *entries: tuple[np.ndarray, ...]) -> None:
        # (Only the shape of the factors counts: numerators take any size.)
        shape = factor / factor.max()
        key = np.round(shape, _EQUAL_WEIGHTS).tobytes()
        if key not in groups:
            shape = shape / np.tile(size_of_chi, len(shape) // len(f))
            groups[key] = powers_basis(basis)[0] * shape[:, None], []
        groups[key][1].extend(np.concatenate(parts, axis=1).T for parts in entries)

    for m in htf.harmonics:
        if m < 0 and -m in weight:
            continue
        for i in range(len(htf.outputs)):
            h, w = slope[m][..., i], weight[m][:, i]
            if 2 * m % N == 0:
                add(powers, np.tile(w, 2), (h.real, h.imag))
                continue
            mirror, v = slope[-m][..., i], weight[-m][:, i]
            if np.allclose(v, w, rtol=10.0**-_EQUAL_WEIGHTS, atol=0):
                even, odd = (h + mirror.conj()) / 2**0.5, (h - mirror.conj()) / 2**0.5
                add(powers, np.tile(w, 2), (even.real, odd.imag), (even.imag, -odd.real))
                continue
            both = [[cosines, sines], [-sines, cosines], [cosines, -sines], [-sines, -cosines]]
            parts = h.real, h.imag, mirror.real, mirror.imag
            add(np.block(both), np.concatenate([w, w, v, v]), parts)
    return [
        Channel(
            np.tile(cosine, len(basis) // len(f)),
            basis,
            np.stack(entries, axis=2).reshape(len(basis), -1),
        )
        for basis, entries in groups.values()
    ]
