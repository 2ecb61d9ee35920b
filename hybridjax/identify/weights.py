"""The errors of harmonic transfer functions, known or supposed, as weights of fits.

`check_values` comes first in every fit to HTFs, and `error_weights` gives the weights; fits in
`identify` and `fitting` and the designs use both. A wrong weight comes from `_separated`; an HTF
that is refused, from `check_values`. Real and imaginary part have half of the variance each
(`weights_of`); this must stay, since degrees of freedom are counted in real numbers.
Experiments that measure the same lines are weighted by their power, in `spectral_sums.py`.
"""

import numpy as np
from jaxtyping import Complex, Float

from ..errors import DefinitionError
from ..linear.htf import HTF


Entries = Float[np.ndarray, "... ny _"]

# Smallest error that is assumed for an HTF, relative to the rms of its output: a rounding error.
# Smaller: infinite weights. Larger: exact outputs get too little weight compared to noisy ones.
SMALLEST_ERROR = 1e-15


def check_values(htf: HTF) -> Float[np.ndarray, " ny"]:
    """Return the rms of each output's HTFs.

    **Raises:** `DefinitionError` for NaN, an output that is zero, or variances that are no
    positive numbers; or for HTFs of continuous time.
    """
    htf.require_sampled("a fit")
    H = np.asarray(htf.H)
    if not np.isfinite(H).all():
        raise DefinitionError(
            "the HTFs hold NaN or infinity: leave these frequencies out."
        )
    square = np.abs(H) ** 2
    rms = np.sqrt(np.mean(square, axis=(0, 1, 3)))
    if (rms == 0).any():
        name = htf.outputs[int(np.argmin(rms))]
        raise DefinitionError(f"the HTFs of {name} are zero: leave this output out.")
    if htf.variance is not None:
        variance = np.asarray(htf.variance)
        bad = np.argwhere(~(np.isfinite(variance) & (variance >= 0)))
        if len(bad):
            m, k, i, _ = bad[0].tolist()
            raise DefinitionError(
                f"the variance of H_{htf.harmonics[m]} of {htf.outputs[i]} at "
                f"f = {htf.frequencies[k]:g} is not a positive number: leave f out, or measure "
                "several realizations or windows."
            )
    return rms


def error_weights(
    htf: HTF, rms: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, "M F ny nu"]:
    """Return one over the standard deviation of real and imaginary part, known or supposed.

    Variances that were estimated with few degrees of freedom are poor weights: they are replaced by
    the nearest product of two factors: one for each frequency, and one for each modulus of a
    harmonic. (For white noise, variances have this form whatever the spectrum of the input is.) If
    any variance is zero, variances are used as they are.

    **Arguments:** `rms`: rms of each output. Without variances, the standard deviation is assumed
    to be a constant part of the rms, times that of white noise at each line (`line_variances`).
    """
    if htf.variance is None:
        deviation = rms[:, None] * np.sqrt(line_variances(htf))
        return np.broadcast_to(1 / deviation, htf.H.shape)
    variance = np.asarray(htf.variance)
    if htf.variance_dof is not None and variance.all():
        dof = np.asarray(htf.variance_dof.dof)
        variance = _separated(htf.harmonics, variance, dof)
    return weights_of(variance, rms)


def _separated(
    harmonics: tuple[int, ...],
    variance: Float[np.ndarray, "M F ny nu"],
    dof: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "M F ny nu"]:
    """Return the nearest product of two factors: one for each frequency, and one for each modulus
    of a harmonic."""
    _, same = np.unique(np.abs(harmonics), return_inverse=True)
    groups = same.max() + 1
    size = np.ones((groups, 1, *variance.shape[2:]))
    for _ in range(20):  # more sweeps change nothing in 6 digits
        by_line = (variance / size[same]).mean(axis=0)
        relative = variance / by_line
        mean = np.average(relative, axis=1, weights=dof)
        for k in range(len(size)):
            size[k] = mean[same == k].mean(axis=0)
    return size[same] * by_line


def line_variances(htf: HTF) -> Float[np.ndarray, "F 1 nu"]:
    """Return the variances that white noise causes at each frequency and input, relative to their
    mean."""
    if htf.power is None:
        return np.ones((len(htf.frequencies), 1, len(htf.inputs)))
    variance = 1 / np.asarray(htf.power)[:, None]
    return variance / variance.mean()


def weights_of(variance: Entries, rms: Float[np.ndarray, " ny"]) -> Entries:
    """Return one over the standard deviation of real and imaginary part."""
    smallest = (SMALLEST_ERROR * rms[:, None]) ** 2
    return np.sqrt(2 / np.maximum(variance, smallest))


def estimated_noise(largest: float, misfit: float) -> tuple[float, float]:
    r"""Return the mean square of the noise in units of `htf.variance`, and its standard deviation.

    Both are 1 for variances that are known. With $\nu$ complex degrees of freedom $|\varepsilon|^2
    / v$ has Fisher's distribution with 2 and $2 \nu$: its mean is $L = \nu / (\nu - 1)$, its
    standard deviation $L \sqrt{L / (2 - L)}$. The errors of a fit with such weights have $L / (2 -
    L)$ times the covariance that the weights suggest, in the limit of many lines. Pooled weights
    have more degrees of freedom than a single variance. Therefore L is estimated from the misfit of
    a fit, up to its value for $\nu$.

    **Arguments:** `largest`: `largest_misfit` of the HTFs. `misfit`: cost of the fit relative to
    its expected value.

    **Returns:** L, and the deviation in units of L.
    """
    level = float(np.clip(misfit, 1.0, largest))
    spread = np.inf
    if level < 2:
        spread = float(np.sqrt(level / (2 - level)))
    return level, spread


def largest_misfit(htf: HTF) -> float:
    """Return the largest misfit that the scatter of estimated variances can explain."""
    if htf.variance_dof is None:
        return 1.0
    dof = float(np.median(htf.variance_dof.dof))
    return dof / (dof - 1) if dof > 1 else np.inf


def neighbor_correlation(
    error: Complex[np.ndarray, "M F ny nu"],
    values: Complex[np.ndarray, "M F ny nu"],
    f: Float[np.ndarray, " F"],
) -> float:
    """Return the correlation of errors at neighboring frequencies. Errors that are rounding errors
    of the `values` count as zero."""
    ordered = error[:, np.argsort(f)]
    later = ordered[:, 1:]
    earlier = ordered[:, :-1]
    products = later * earlier.conj()
    neighbors = np.real(products).mean()
    square = (np.abs(error) ** 2).mean()
    power = (np.abs(values) ** 2).mean()
    rounding = np.finfo(float).eps * power
    return float(neighbors / np.maximum(square, rounding))


def are_alike(correlation: float, dof: float) -> bool:
    """Test whether errors are correlated more than by chance, and strongly: the model is then too
    simple."""
    return correlation > max(0.1, 5 / np.sqrt(dof))
