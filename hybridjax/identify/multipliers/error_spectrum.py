r"""The spectrum of the errors of harmonic transfer functions that come without variances.

Noise of the sensors is taken for white. Noise that drives the system passes it: its spectrum has
the poles of the system, at all harmonics the same. So the errors of an output are supposed to have
the variance $a + b / |\chi|^2$, with a and b from what numerators leave of them.
"""

import numpy as np
from jaxtyping import Float, Inexact

from ..descent import Coefficients
from .denominator import chi
from .variable_projection import HTFGroup, misfit_of


def error_spectrum(
    groups: list[HTFGroup], c: Coefficients, f: Float[np.ndarray, " F"], outputs: int
) -> Float[np.ndarray, "F ny"]:
    """The variance of the errors of each output, zero where nothing is left of them.

    A step of scoring towards the largest restricted likelihood (Patterson and Thompson 1971), from
    the weights of the groups, which allows for what numerators take.
    """
    square, expected = np.zeros((outputs, 2)), np.zeros((outputs, 2, 2))
    for group in groups:
        parts = _components(group.period_delay, c) * group.weight**2
        size = group.scale**2 / 2
        residual = (misfit_of(group, c).residual ** 2).sum(axis=0)
        products = _expected_products(group, c, parts)
        for k, i in enumerate(group.channel[:, 0]):
            square[i] += size[k] * (parts @ residual[:, k])
            expected[i] += size[k] ** 2 * products
    found = np.stack([amounts(*pair) for pair in zip(expected, square, strict=True)])
    return (found @ _components(np.exp(-2j * np.pi * f), c)).T


def _components(
    period_delay: Inexact[np.ndarray, " E"], c: Coefficients
) -> Float[np.ndarray, "2 E"]:
    """The spectra of white noise and of noise that passes the system."""
    return np.stack([np.ones(len(period_delay)), 1 / np.abs(chi(period_delay, c)) ** 2])


def _expected_products(
    group: HTFGroup, c: Coefficients, parts: Float[np.ndarray, "2 E"]
) -> Float[np.ndarray, "2 2"]:
    """tr(G_k R G_l R), where R takes away what numerators explain: `parts[k]` times the squares of
    what they leave of errors with the variances `parts[l]`, on average."""
    q, _ = group.numerator_space(c)
    rows = np.concatenate([parts, parts], axis=1)[:, : len(q)]
    taken = (np.abs(q) ** 2).sum(axis=1)
    along = [q.conj().T @ (row[:, None] * q) for row in rows]
    both = np.array([[np.vdot(a, b).real for a in along] for b in along])
    return (1 if group.real else 2) * (rows * (1 - 2 * taken) @ rows.T + both)


def amounts(
    expected: Float[np.ndarray, "2 2"], square: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """How much there is of two kinds of noise, none of it negative, from two sums of squares.

    **Arguments:** `expected`: what each kind (columns) adds to each sum on average.
    """
    both = np.linalg.lstsq(expected, square)[0]
    if both.min() >= 0:
        return both
    only = int(both.argmax())
    return np.where(np.arange(2) == only, square[only] / expected[only, only], 0.0)
