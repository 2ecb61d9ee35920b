"""Tests of residuals, section by section: their correlations in time and with inputs."""

from collections.abc import Sequence
from itertools import compress, repeat

import numpy as np
from jaxtyping import Bool, Float
from scipy import special, stats

from ..._core.findings import Finding
from ..descent import ROUNDING
from .output_error import RANK
from .records import CycleGrid, Signals, lagged_inputs


Root = Float[np.ndarray, "S T ny r"]
"""A root of the covariance of errors of a section."""
ByOutput = Float[np.ndarray, " ny"]

# Samples of a section, below which its correlations are not tested. Fewer: their distribution is
# not normal; more: short records cannot be validated.
FEWEST_SAMPLES = 8
# Probability with which a misfit that counts as visible is detected. Larger: models are called
# better tested than they are; smaller: misfits that are detected as a rule count as invisible.
_POWER = 0.8
# Probability that noise alone counts as an answer, of inputs to earlier outputs, or of outputs to a
# reference at the same section. Smaller: controllers and weak feed-through pass. Larger: open loops
# are refused.
ANSWER = 1e-3
# Advice where inputs answer residuals.
FOR_WHITE_NOISE = (
    "the fit is biased; name their `reference`, or pass noise='innovations'"
)
FOR_GIVEN_D = (
    "D is biased by a controller that answers at once; name their `reference`, or give a guess "
    "with D = 0"
)
FOR_ZERO_D = "D = 0 was taken; if outputs answer inputs at the same section, name their `reference`"
UNSEEN = Finding(
    "feedback",
    "outputs are correlated with inputs at the same section, so D was fitted: if a controller "
    "causes the correlation, D is biased (then name its `reference`, or give a guess with D = 0).",
)


def whitened(error: Signals, spread: Sequence[Root]) -> Signals:
    """Return residuals that are white if the noise is, whatever errors a fit to other data has.

    **Arguments:** `spread`: for each section, a root of the covariance of these errors, for noise
    of variance one. Residuals are divided by the root of the sum of both covariances.
    """
    error = error.copy()
    for n, root in enumerate(spread):
        for i in range(error.shape[3]):
            at = np.isfinite(error[:, :, n, i])
            left, s, _ = np.linalg.svd(root[:, :, i][at], full_matrices=False)
            error[at, n, i] -= left @ (
                (left.T @ error[at, n, i]) * (1 - 1 / np.sqrt(1 + s**2))
            )
    return error


def whiteness_test(
    error: Signals, lags: int
) -> tuple[Float[np.ndarray, "N lags ny"], ByOutput]:
    """Return correlations of residuals with earlier ones, section by section, and p-values."""
    S, T, N, ny = error.shape
    size = np.sqrt(np.nanmean(error**2, axis=(0, 1)))
    scaled = (error / np.where(size > 0, size, 1.0)).reshape(S, T * N, ny)
    z = np.zeros((N, lags, ny))
    tested = np.zeros((N, lags, ny), bool)
    for k in range(lags):
        product = np.full(scaled.shape, np.nan)
        product[:, k + 1 :] = scaled[:, k + 1 :] * scaled[:, : -k - 1]
        product = product.reshape(error.shape)
        count = np.isfinite(product).sum(axis=(0, 1))
        z[:, k] = np.nansum(product, axis=(0, 1)) / np.sqrt(np.maximum(count, 1))
        tested[:, k] = count >= FEWEST_SAMPLES
    # The mean over the sections of each lag, and the deviations from it: independent.
    z = z * tested
    count = tested.sum(axis=0)
    pooled = z.sum(axis=0) ** 2 / np.maximum(count, 1)
    deviations = (z**2).sum(axis=(0, 1)) - pooled.sum(axis=0)
    degrees = (count > 0).sum(axis=0)
    p = stats.chi2.sf(pooled.sum(axis=0), degrees)
    if N > 1:
        p = np.minimum(p, stats.chi2.sf(deviations, count.sum(axis=0) - degrees))
        p = -np.expm1(2 * np.log1p(-p))
    return z, p


def independence_test(
    u: Float[np.ndarray, "S T N nu"],
    error: Signals,
    lags: int,
    level: float,
    spread: Sequence[Root] = (),
) -> tuple[Float[np.ndarray, "N lags ny nu"], ByOutput, ByOutput]:
    """Test the part of residuals that present and past inputs explain, section by section.

    **Arguments:** `error`: NaN where the inputs of so many lags are not known. `spread`: for each
    section, a root of the covariance that errors of a fit to other data have, for noise of
    variance one. Default: no errors.

    **Returns:** the correlations with the inputs, the p-values, and the smallest visible misfits,
    in standard deviations of the noise, for tests of this level. A misfit of rms r times the noise
    makes F ratios of n samples noncentral, by $n r^2$. The power is that of one F ratio with the
    degrees of freedom of all sections, which is 1 to 4 % too optimistic.
    """
    S, T, N, ny = error.shape
    nu = u.shape[3]
    z = np.zeros((N, lags, ny, nu))
    deviates = np.zeros(ny)
    tested = np.zeros(ny)
    degrees = np.zeros((2, ny))
    by_fits = np.zeros(ny)
    for n, root in zip(
        range(N), spread or repeat(np.zeros((S, T, ny, 0))), strict=False
    ):
        past = lagged_inputs(u, n, lags, 0)
        for i in range(ny):
            present = np.isfinite(error[:, :, n, i])
            U = past[present]
            r = error[:, :, n, i][present]
            count = int(present.sum())
            if count < FEWEST_SAMPLES or not r.any():
                continue
            size = np.sqrt((U**2).sum(axis=0) * (r @ r) / count)
            U = U / np.where(size > 0, size, 1.0)  # inputs have units of their own
            rows = np.column_stack([r, root[:, :, i][present]])
            along, *by_fit = (U.T @ rows).T
            variance = 1 + np.sum(np.square(by_fit), axis=0) * (r @ r) / count
            variance /= 1 + (rows[:, 1:] ** 2).sum() / count
            z[n, :, i] = (along / np.sqrt(variance)).reshape(lags, nu)
            left, s, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, s > RANK * s[0]][:, : count // 2]
            # Explained against unexplained part: an F ratio, as its Gaussian deviate.
            a = left.shape[1]
            b = count - left.shape[1]
            inside = ((left.T @ rows) ** 2).sum(axis=0)
            outside = (rows**2).sum(axis=0) - inside
            by_fit = inside[1:].sum()
            p = stats.f.sf(
                inside[0] / (a + by_fit) * (b + outside[1:].sum()) / outside[0], a, b
            )
            by_fits[i] += by_fit
            deviates[i] += stats.norm.isf(np.clip(p, 1e-300, 1 - 1e-16))
            degrees[:, i] += a, b
            tested[i] += 1
    p = stats.norm.sf(deviates / np.sqrt(np.maximum(tested, 1)))
    shift = special.ncfdtrinc(*degrees, 1 - _POWER, special.fdtri(*degrees, 1 - level))
    shift *= 1 + by_fits / np.maximum(degrees[0], 1)
    return z, p, np.sqrt(shift / np.maximum(degrees.sum(axis=0), 1))


def is_exact(grid: CycleGrid, error: Signals) -> Bool[np.ndarray, " ny"]:
    """Return whether the residuals of each output are only rounding, and tell nothing."""
    left, size = (np.sqrt(np.nansum(x**2, axis=(0, 1, 2))) for x in (error, grid.y))
    return left <= 1e3 * ROUNDING * size  # (iterations leave as much of exact data)


def about_misfit(
    outside: CycleGrid, grid: CycleGrid, error: Signals, innovations: bool
) -> list[Finding]:
    """Return a finding if residuals depend on inputs of the period before them.

    **Arguments:** `outside`: the inputs that do not respond to outputs. `error`: the residuals of
    `grid`, NaN where an output was not sampled.
    """
    N, ny = error.shape[2:]
    late = np.where((grid.age > N)[..., None], error, np.nan)
    _, p, _ = independence_test(outside.u, late, N, ANSWER)
    if not ((p < ANSWER / ny) & ~is_exact(grid, error)).any():
        return []
    noise = "" if innovations else ", noise='innovations'"
    text = (
        "residuals depend on the inputs, so multipliers may be wrong by more than their standard "
        f"errors: give more dimensions{noise}, or another guess."
    )
    return [Finding("left over", text)]


def about_answers(
    grid: CycleGrid, error: Signals, inputs: tuple[str, ...], remedy: str
) -> list[Finding]:
    """Return a finding if inputs answer earlier residuals, as by a controller."""
    if is_exact(grid, error).all():
        return []
    names = ", ".join(compress(inputs, feedback_test(grid, error) < ANSWER))
    if not names:
        return []
    text = f"inputs answer earlier residuals, as by a controller ({names}): {remedy}."
    return [Finding("feedback", text)]


def feedback_test(grid: CycleGrid, error: Signals) -> Float[np.ndarray, " nu"]:
    """Test whether inputs answer residuals of a model of the outputs at earlier sections.

    The part of each input that its own past does not explain is regressed on these residuals: it
    is white for any spectrum of the input, so that residuals may be colored.

    **Returns:** p-values; small ones show a controller at work.
    """
    S, T, N, nu = grid.u.shape
    lags = 2
    late = np.zeros((S, T * N, error.shape[3]))
    late[:, 1:] = np.nan_to_num(error).reshape(S, T * N, -1)[:, :-1]
    new = np.full(grid.u.shape, np.nan)
    for n in range(N):
        rows = grid.inside[:, :, n] & (grid.age[:, :, n] > lags + 1)
        past = lagged_inputs(grid.u, n, lags + 1, 0)[rows][:, nu:]
        u = grid.u[:, :, n][rows]
        new[:, :, n][rows] = u - past @ np.linalg.lstsq(past, u)[0]
    return independence_test(late.reshape(error.shape), new, lags, ANSWER)[1]
