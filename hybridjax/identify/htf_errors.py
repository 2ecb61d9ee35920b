r"""Errors of harmonic transfer functions: their weights in fits, known or estimated.

HTFs without variances: noise of the sensors is taken for white. Noise that drives the system passes
it, so that its spectrum has the poles of the system, the same at all harmonics. The errors of an
output are therefore supposed to have the variance $a + b / |\chi|^2$.
"""

from itertools import count

import numpy as np
from jaxtyping import Complex, Float, Int

from ..errors import DefinitionError
from ..linear.htf import HTF
from .denominator import chi
from .descent import Coefficients
from .variable_projection import HTFGroup, misfit_of


# Smallest error that an HTF is supposed to have, relative to the rms of its output: that of
# rounding. Smaller: infinite weights; larger: exact outputs count too little beside noisy ones.
SMALLEST_ERROR = 1e-15


def check_values(htf: HTF) -> Float[np.ndarray, " ny"]:
    """Return the rms of each output's HTFs.

    **Raises:** `DefinitionError` for NaN, an output that is zero, or variances that are no
    positive numbers.
    """
    H = np.asarray(htf.H)
    if not np.isfinite(H).all():
        raise DefinitionError("the HTFs hold NaN or infinity.")
    rms = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1, 3)))
    if (rms == 0).any():
        name = htf.outputs[int(np.argmin(rms))]
        raise DefinitionError(f"the HTFs of {name} are zero: leave this output out.")
    if htf.variance is not None:
        bad = np.argwhere(~(np.isfinite(htf.variance) & (np.asarray(htf.variance) >= 0)))
        if len(bad):
            m, k, i, _ = (int(x) for x in bad[0])
            raise DefinitionError(
                f"the variance of H_{htf.harmonics[m]} of {htf.outputs[i]} at f = "
                f"{float(htf.f[k]):g} is not a positive number; leave this frequency out, or give "
                "HTFs without variances."
            )
    return rms


def error_weights(htf: HTF, rms: Float[np.ndarray, " ny"]) -> Float[np.ndarray, "M F ny nu"]:
    """Return one over the standard deviation of real and imaginary part, known or supposed.

    Variances that were estimated with few degrees of freedom are poor weights: they are replaced
    by the nearest product of a factor for each frequency and one for each harmonic, up to its
    sign (which is the form for white noise and any spectrum of the input).

    **Arguments:** `rms`: errors are taken as equal parts of it where there are no variances.
    """
    if htf.variance is None:
        return np.broadcast_to(1 / rms[:, None], htf.H.shape)
    variance = np.asarray(htf.variance)
    if htf.scatter is not None:
        freedom = np.asarray(htf.scatter.freedom)
        variance = _product_of_factors(variance, np.asarray(htf.harmonics), freedom)
    return weights_of(variance, rms)


def weights_of(
    variance: Float[np.ndarray, "... ny _"], rms: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, "... ny _"]:
    """Return one over the standard deviation of real and imaginary part of these variances."""
    return np.sqrt(2 / np.maximum(variance, (SMALLEST_ERROR * rms[:, None]) ** 2))


def _product_of_factors(
    variance: Float[np.ndarray, "M F ny nu"],
    harmonics: Int[np.ndarray, " M"],
    freedom: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "M F ny nu"]:
    """Return the product of factors of frequency and harmonic with the same sums."""
    if not variance.all():
        return variance
    _, same = np.unique(np.abs(harmonics), return_inverse=True)
    share = freedom / freedom.sum()
    size = np.ones((same.max() + 1, 1, *variance.shape[2:]))
    for _ in range(20):  # more sweeps change nothing in 6 digits
        by_line = (variance / size[same]).mean(axis=0)
        by_harmonic = np.tensordot(share, variance / by_line, axes=(0, 1))
        size = np.stack([by_harmonic[same == k].mean(axis=0) for k in range(len(size))])[:, None]
    return size[same] * by_line


def require_frequencies(htf: HTF, order: int, size: int) -> None:
    """Check that the frequencies determine numerators of `size` coefficients and the multipliers.

    **Raises:** `DefinitionError` for too few.
    """
    harmonics = {m % htf.n_sections for m in htf.harmonics}
    # Half of a pair, or a harmonic that is its own mirror image, has half as many coefficients.
    unknown = [size if -m % htf.n_sections in harmonics else 2 * size for m in harmonics]
    entries = len(htf.outputs) * len(htf.inputs)

    def enough(frequencies: int) -> bool:
        return sum(max(2 * frequencies - k, 0) for k in unknown) * entries >= order

    if not enough(len(htf.f)):
        raise DefinitionError(
            f"{len(htf.f)} frequencies are too few for numerators of {size} coefficients and "
            f"{order} multipliers: {next(filter(enough, count()))} or more are needed. Measure "
            "more, or lower `order` or `overhang`."
        )


def error_spectrum(
    groups: list[HTFGroup], c: Coefficients, f: Float[np.ndarray, " F"], outputs: int
) -> Float[np.ndarray, "F ny"]:
    """Return the variance of the errors of each output, zero where the residual is zero.

    This is a step of scoring towards the largest restricted likelihood (Patterson and Thompson
    1971), from the weights of the groups, which accounts for the fitted numerators.
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
    sizes = np.stack([amounts(*pair) for pair in zip(expected, square, strict=True)])
    return (sizes @ _components(np.exp(-2j * np.pi * f), c)).T


def _components(
    period_delay: Complex[np.ndarray, " E"], c: Coefficients
) -> Float[np.ndarray, "2 E"]:
    """Return the spectra of white noise and of noise that passes the system."""
    return np.stack([np.ones(len(period_delay)), 1 / np.abs(chi(period_delay, c)) ** 2])


def _expected_products(
    group: HTFGroup, c: Coefficients, parts: Float[np.ndarray, "2 E"]
) -> Float[np.ndarray, "2 2"]:
    """Return tr(G_k R G_l R), where R subtracts the best numerators.

    It is the mean of `parts[k]` times the squares of the residuals, for errors with the variances
    `parts[l]`.
    """
    q, _ = group.numerator_space(c)
    rows = np.concatenate([parts, parts], axis=1)[:, : len(q)]
    taken = (np.abs(q) ** 2).sum(axis=1)
    along = [q.conj().T @ (row[:, None] * q) for row in rows]
    both = np.array([[np.vdot(a, b).real for a in along] for b in along])
    return (1 if group.real else 2) * (rows * (1 - 2 * taken) @ rows.T + both)


def amounts(
    expected: Float[np.ndarray, "2 2"], square: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """Return the amounts of two kinds of noise, none of them negative, from two sums of squares.

    **Arguments:** `expected`: the mean contribution of each kind (columns) to each sum.
    """
    both = np.linalg.lstsq(expected, square)[0]
    if both.min() >= 0:
        return both
    only = int(both.argmax())
    return np.where(np.arange(2) == only, square[only] / expected[only, only], 0.0)
