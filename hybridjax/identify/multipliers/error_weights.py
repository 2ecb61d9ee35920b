"""Values and errors of harmonic transfer functions as fits take them: checked, with weights."""

from bisect import bisect_left

import numpy as np
from jaxtyping import Float, Int

from ...errors import DefinitionError
from ...linear.htf import HTF


# Smallest error that an HTF is supposed to have, relative to the rms of its output: that of
# rounding. Doubled: outputs without noise count half as much beside noisy ones.
ROUNDING = 1e-15
# Alternations between the factors of frequency and of harmonic. Doubled: the same to 6 digits.
_SMOOTHING_SWEEPS = 20


def check_values(htf: HTF) -> Float[np.ndarray, " ny"]:
    """The rms of each output's HTFs.

    **Raises:** `DefinitionError` for NaN, an output that is zero, bad variances.
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
    """One over the standard deviation of real and imaginary part, known or supposed.

    Variances that were estimated with few degrees of freedom are poor weights: they are replaced
    by the nearest product of a factor for each frequency and one for each harmonic, up to its
    sign (which is what white noise and any spectrum of the input give).

    **Arguments:** `rms`: what errors are taken as equal parts of where there are no variances.
    """
    if htf.variance is None:
        return np.broadcast_to(1 / rms[:, None], htf.H.shape)
    variance = np.asarray(htf.variance)
    if htf.scatter is not None:
        variance = _product_of_factors(
            variance, np.asarray(htf.harmonics), np.asarray(htf.scatter.freedom)
        )
    return _roots(variance, rms)


def spectral_weights(
    htf: HTF, rms: Float[np.ndarray, " ny"], variance: Float[np.ndarray, "F ny"]
) -> Float[np.ndarray, "M F ny nu"]:
    """The same where errors of all harmonics and inputs have these variances."""
    return np.broadcast_to(_roots(variance[..., None], rms), htf.H.shape)


def _roots(
    variance: Float[np.ndarray, "... ny _"], rms: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, "... ny _"]:
    return np.sqrt(2 / np.maximum(variance, (ROUNDING * rms[:, None]) ** 2))


def _product_of_factors(
    variance: Float[np.ndarray, "M F ny nu"],
    harmonics: Int[np.ndarray, " M"],
    freedom: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "M F ny nu"]:
    """The product of factors of frequency and harmonic with the same sums (gamma likelihood)."""
    if not variance.all():
        return variance
    _, same = np.unique(np.abs(harmonics), return_inverse=True)
    share = freedom / freedom.sum()
    size = np.ones((same.max() + 1, 1, *variance.shape[2:]))
    for _ in range(_SMOOTHING_SWEEPS):
        by_line = (variance / size[same]).mean(axis=0)
        each = np.tensordot(share, variance / by_line, axes=(0, 1))
        size = np.stack([each[same == k].mean(axis=0) for k in range(len(size))])[:, None]
    return size[same] * by_line


def require_frequencies(htf: HTF, order: int, size: int) -> None:
    """**Raises:** `DefinitionError` for too few frequencies to find numerators of `size`
    coefficients and `order` multipliers."""
    frequencies = len(htf.f)
    if _equations_left(htf, frequencies, size) < order:
        # (2 * size frequencies are enough for all coefficients, and `order` more for the rest.)
        enough = range(2 * size + order + 1)
        needed = bisect_left(enough, order, key=lambda F: _equations_left(htf, F, size))
        raise DefinitionError(
            f"{frequencies} frequencies are too few for numerators of {size} coefficients and "
            f"{order} multipliers: {needed} or more are needed. Measure more, or lower `order` or "
            "`overhang`."
        )


def _equations_left(htf: HTF, frequencies: int, size: int) -> int:
    """Real equations that so many frequencies leave when the numerators are gone."""
    places = {m % htf.n_sections for m in htf.harmonics}
    total = 0
    for m in places:
        if (-m) % htf.n_sections not in places:
            equations, coefficients = 2 * frequencies, 2 * size
        else:  # half of a pair, or a harmonic that is its own mirror image
            equations, coefficients = 2 * frequencies, size
        total += max(equations - coefficients, 0)
    return total * len(htf.outputs) * len(htf.inputs)
