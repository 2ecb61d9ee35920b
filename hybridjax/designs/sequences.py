r"""Random sequences with the spectrum of a design.

A Gaussian sequence may have any spectrum. The sign of a Gaussian sequence with the correlation
$\rho$ has the correlation $\frac{2}{\pi} \arcsin \rho$ (Van Vleck and Middleton, Proc. IEEE 54,
1966). So for a binary sequence the one of the Gaussian is $\sin(\frac{\pi}{2} \rho)$, where this is
a correlation at all; else its spectrum is negative somewhere, where it is taken as zero, and the
binary sequence has another spectrum than was wanted, which is given.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.text import fields


class RandomInput(eqx.Module):
    """A random input for a recording.

    **Fields:** `u` (n, nu), at the sections, from section 0 on; `power` (K,), the mean square that
    such sequences have around each cosine of the plan.
    """

    u: Float[np.ndarray, "n nu"]
    power: Float[np.ndarray, " K"]

    def __repr__(self) -> str:
        return fields(self)


def random_sequence(
    lines: Int[np.ndarray, " K"],
    channels: Int[np.ndarray, " K"],
    power: Float[np.ndarray, " K"],
    shape: tuple[int, int, int, int],
    kind: Literal["gaussian", "binary"],
    seed: int,
) -> RandomInput:
    """**Arguments:** `lines` j, so that f = j / P; `shape`: N, P, the number of cycles and that of
    inputs."""
    N, P, cycles, nu = shape
    rng, length = np.random.default_rng(seed), N * cycles
    # Each line has the frequencies of the sequence that are nearest to it.
    nearest = np.rint(np.arange(length // 2 + 1) * P / cycles).astype(int)
    u, found = np.zeros((length, nu)), np.zeros(len(power))
    for i in range(nu):
        here = np.flatnonzero((channels == i) & (power > 0))
        if not len(here):
            continue
        wanted = np.zeros(max(nearest.max(), lines.max()) + 1)
        wanted[lines[here]] = power[here] / np.maximum(
            np.bincount(nearest, minlength=len(wanted))[lines[here]], 1
        )
        spectrum = wanted[nearest]
        spectrum[[0, -1]] = 0.0
        spectrum *= power[here].sum() / spectrum.sum()
        if kind == "gaussian":
            u[:, i] = _gaussian(spectrum, length, rng)
        else:
            total = spectrum.sum()
            hidden = _correlation(np.sin(np.pi / 2 * _correlation(spectrum / total)), back=True)
            hidden = np.maximum(hidden, 0.0)
            rho = _correlation(hidden / hidden.sum())
            u[:, i] = np.sqrt(total) * np.sign(_gaussian(hidden, length, rng))
            clipped = 2 / np.pi * np.arcsin(np.clip(rho, -1, 1))
            spectrum = total * _correlation(clipped, back=True)
        own = channels == i
        found[own] = np.bincount(nearest, spectrum, len(wanted))[lines[own]]
    return RandomInput(u, found)


def _gaussian(
    spectrum: Float[np.ndarray, " n"], length: int, rng: np.random.Generator
) -> Float[np.ndarray, " length"]:
    """With these mean squares at the frequencies of its discrete Fourier transform."""
    z = rng.normal(size=(2, len(spectrum))) * np.sqrt(spectrum)
    return np.fft.irfft((z[0] + 1j * z[1]) * length / 2, length)


def _correlation(values: Float[np.ndarray, " n"], back: bool = False) -> Float[np.ndarray, " n"]:
    """Correlation at lags 0 to L/2 from mean squares at frequencies, or back."""
    inner = values.copy()
    inner[1:-1] /= 2
    length = 2 * (len(values) - 1)
    if not back:
        return np.fft.irfft(inner * length, length)[: len(values)]
    spectrum = np.fft.rfft(np.concatenate([values, values[-2:0:-1]])).real / length
    spectrum[1:-1] *= 2
    return spectrum
