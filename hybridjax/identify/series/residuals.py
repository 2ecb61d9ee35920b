"""Tests of residuals, section by section: correlations in time and with inputs.

`hj.validate` calls `whiteness_test` and `independence_test` for data that were not fitted, and
`whitened` to take the errors of the fit into account. Fits call `about_misfit`, `is_distorted` and
`about_answers` for residuals of the same data. If a good model is rejected, look at `whitened`; if
feedback is reported where there is none, at `feedback_test`.
"""

from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special, stats

from ..._core.findings import Finding
from ..denominator import fading
from ..descent import ROUNDING, Coefficients, positive
from .output_error import RANK
from .records import (
    CycleGrid,
    Signals,
    delay_cycles,
    divide_by_chi,
    lagged_inputs,
)


Root = Float[np.ndarray, "S T ny r"]
"""A root of the covariance of errors of a section."""
ByOutput = Float[np.ndarray, " ny"]

# Least number of samples of a section for a test of correlations. Fewer: their distribution is not
# normal. More: short records cannot be validated.
FEWEST_SAMPLES = 8
# Probability with which a misfit that counts as visible is detected. Larger: models are called
# better tested than they are; smaller: misfits that are detected as a rule count as invisible.
_POWER = 0.8
# Probability that noise alone counts as a response: of inputs to earlier outputs, or of outputs to
# a reference at the same section. Smaller: controllers and weak feed-through pass. Larger: open
# loops are refused.
ANSWER = 1e-3
# Level of the test whether residuals of a fit to the same data are white. (A fit makes residuals
# whiter: with white noise, none of 120 p-values was below 1 %.) Larger: white noise gives a
# finding. Smaller: weak process noise passes, and standard errors are too small.
_COLORED = 0.01
# Residuals are also compared with inputs of other cycles, shifted by this many whole numbers of
# cycles. The dependence on inputs of the same cycle must exceed that on the shifted ones by a
# number of standard deviations. More shifts: time. More standard deviations: a model with too few
# dimensions passes. Fewer: noise counts as too few dimensions.
_SHIFTS = 8
_ALONE = 4.0
# Residuals are distortion if they follow products of responses at this level, by more than this
# part of their squares. Larger level, smaller part: right fits get a finding, and wider intervals.
# Smaller level, larger part: distortion passes, and standard errors are too small.
_DISTORTED = 3e-3
_LEAST_DISTORTION = 0.08
# Residuals below this part of the responses are those of no sensor. Larger: intervals of recordings
# with little noise are too wide. Smaller: those of simulated recordings are too small.
_QUIET = 0.01
# The largest number of patterns of a cycle of which products are taken, the number of shifts that
# are compared, and the fewest cycles. More patterns: slow responses are lost among others. Fewer
# shifts or cycles: the level is not held.
_PATTERNS = 2
_SHIFTED_CYCLES = 100
_FEWEST_CYCLES = 40
# Share of the products that a shift gives again if inputs repeat. Higher: they seem to explain by
# chance what they do explain. Lower: too few shifts are left.
_REPEATED = 0.3
# Least number of shifts from which the distribution by chance is known.
_FEWEST_SHIFTS = 15
# Advice if inputs respond to residuals.
FOR_WHITE_NOISE = (
    "the fit is biased; name their `references`, or pass noise='innovations'"
)
FOR_GIVEN_D = (
    "D is biased by a controller that answers at once; name their `references`, or give an "
    "`initial` model with D = 0"
)
FOR_ZERO_D = (
    "D = 0 was taken; if outputs answer inputs at the same section, name their "
    "`references`"
)
_OF_PRODUCTS = (
    "residuals follow products of earlier responses, as nonlinear distortion does"
)
# The finding of fits whose standard errors are for errors that do not depend on the inputs, and of
# fits whose standard errors are those of a jackknife.
DISTORTED = Finding(
    "distortion",
    f"{_OF_PRODUCTS}: standard errors may be too small by a factor of two. Push less: errors by "
    "distortion fall in proportion.",
)
WIDENED = Finding(
    "distortion",
    f"{_OF_PRODUCTS}, so standard errors are those of a jackknife, if larger. Push less: errors by "
    "distortion fall in proportion.",
)
UNSEEN = Finding(
    "feedback",
    "outputs are correlated with inputs at the same section, so D was fitted: if a controller "
    "causes the correlation, D is biased (then name its `references`, or give an `initial` model "
    "with D = 0).",
)


def whitened(error: Signals, spread: Sequence[Root]) -> Signals:
    """Return residuals that are white if the noise is white, with the errors of a fit to other data
    taken into account.

    **Arguments:** `spread`: for each section, a square root of the covariance of these errors, for
    noise of variance one. Residuals are divided by the root of the sum of both covariances.
    """
    error = error.copy()
    for n, root in enumerate(spread):
        for i in range(error.shape[3]):
            sampled = np.isfinite(error[:, :, n, i])
            of_output = root[:, :, i][sampled]
            left, size, _ = np.linalg.svd(of_output, full_matrices=False)
            along = left.T @ error[sampled, n, i]
            widening = np.sqrt(1 + size**2)
            excess = 1 - 1 / widening
            error[sampled, n, i] -= left @ (along * excess)
    return error


def whiteness_test(
    error: Signals, lags: int
) -> tuple[Float[np.ndarray, "N lags ny"], ByOutput]:
    """Return correlations of residuals with earlier ones, section by section, and p-values."""
    S, T, N, ny = error.shape
    square = np.nanmean(error**2, axis=(0, 1))
    size = np.sqrt(square)
    relative = error / positive(size)
    scaled = relative.reshape(S, T * N, ny)
    z = np.zeros((N, lags, ny))
    tested = np.zeros((N, lags, ny), bool)
    for k in range(lags):
        product = np.full(scaled.shape, np.nan)
        now = scaled[:, k + 1 :]
        before = scaled[:, : -k - 1]
        product[:, k + 1 :] = now * before
        by_section = product.reshape(error.shape)
        samples = np.isfinite(by_section).sum(axis=(0, 1))
        total = np.nansum(by_section, axis=(0, 1))
        tested[:, k] = samples >= FEWEST_SAMPLES
        deviation = np.sqrt(np.maximum(samples, 1))
        z[:, k] = tested[:, k] * total / deviation
    # For each lag, two independent statistics: the mean over the sections, and the deviations from
    # it.
    sections = tested.sum(axis=0)
    square_of_sum = z.sum(axis=0) ** 2
    by_lag = square_of_sum / np.maximum(sections, 1)
    pooled = by_lag.sum(axis=0)
    deviations = (z**2).sum(axis=(0, 1)) - pooled
    degrees = (sections > 0).sum(axis=0)
    p = stats.chi2.sf(pooled, degrees)
    if N > 1:
        # (One section has no deviations from the mean.)
        p_deviations = stats.chi2.sf(deviations, sections.sum(axis=0) - degrees)
        # The p-value of the smaller of two p-values.
        smaller = np.minimum(p, p_deviations)
        p = -np.expm1(2 * np.log1p(-smaller))
    return z, p


def independence_test(
    u: Float[np.ndarray, "S T N nu"],
    error: Signals,
    lags: int,
    level: float,
    spread: Sequence[Root] = (),
) -> tuple[Float[np.ndarray, "N lags ny nu"], ByOutput, ByOutput]:
    """Test the part of residuals that present and past inputs explain, section by section.

    **Arguments:** `error`: residuals; NaN where some of the lagged inputs are not known. `spread`:
    for each section, a square root of the covariance of the errors of a fit to other data, for
    noise of variance one. Default: no errors.

    **Returns:** the correlations with the inputs, the p-values, and the smallest visible misfits,
    in standard deviations of the noise, for tests of this level. A misfit of rms r times the noise
    makes F ratios of n samples noncentral, by $n r^2$. The power is computed for one F ratio with
    the degrees of freedom of all sections, and is 1 to 4 % too large.
    """
    S, T, N, ny = error.shape
    z = np.zeros((N, lags, ny, u.shape[3]))
    deviates = np.zeros(ny)
    tested = np.zeros(ny)
    degrees = np.zeros((2, ny))
    by_fits = np.zeros(ny)
    no_spread = [np.zeros((S, T, ny, 0))] * N
    roots = spread or no_spread
    for n, root in enumerate(roots):
        past = lagged_inputs(u, n, lags, 0)
        for i in range(ny):
            present = np.isfinite(error[:, :, n, i])
            residual = error[:, :, n, i][present]
            if len(residual) < FEWEST_SAMPLES or not residual.any():
                continue
            root_of_output = root[:, :, i][present]
            test = _regressed(past[present], residual, root_of_output)
            z[n, :, i] = test.correlation.reshape(lags, u.shape[3])
            deviates[i] += test.deviate
            degrees[:, i] += test.degrees
            by_fits[i] += test.by_fit
            tested[i] += 1
    number = np.maximum(tested, 1)
    p = stats.norm.sf(deviates / np.sqrt(number))
    critical = special.fdtri(*degrees, 1 - level)
    shift = special.ncfdtrinc(*degrees, 1 - _POWER, critical)
    shift *= 1 + by_fits / np.maximum(degrees[0], 1)
    samples = np.maximum(degrees.sum(axis=0), 1)
    return z, p, np.sqrt(shift / samples)


class _Regressed(NamedTuple):
    """Residuals at a section, regressed on inputs."""

    correlation: Float[np.ndarray, " columns"]
    deviate: float
    """The Gaussian deviate of the F ratio of the explained to the unexplained part."""
    degrees: tuple[int, int]
    """Degrees of freedom of both parts."""
    by_fit: float
    """The explained part of errors of a fit to other data."""


def _regressed(
    inputs: Float[np.ndarray, "samples columns"],
    residual: Float[np.ndarray, " samples"],
    root: Float[np.ndarray, "samples r"],
) -> _Regressed:
    samples = len(residual)
    variance = residual @ residual / samples
    size = np.sqrt((inputs**2).sum(axis=0) * variance)
    inputs = inputs / positive(size)  # inputs have units of their own
    along_fit = inputs.T @ root
    spread = 1 + (along_fit**2).sum(axis=1) * variance
    spread /= 1 + (root**2).sum() / samples
    correlation = inputs.T @ residual / np.sqrt(spread)
    left, values, _ = np.linalg.svd(inputs, full_matrices=False)
    kept = values > RANK * values[0]
    independent = left[:, kept]
    left = independent[:, : samples // 2]
    explained = ((left.T @ residual) ** 2).sum()
    by_fit = ((left.T @ root) ** 2).sum()
    unexplained = (residual**2).sum() - explained
    degrees = left.shape[1], samples - left.shape[1]
    left_by_fit = (root**2).sum() - by_fit
    per_degree = explained / (degrees[0] + by_fit)
    ratio = per_degree * (degrees[1] + left_by_fit) / unexplained
    tail = stats.f.sf(ratio, *degrees)
    p = np.clip(tail, 1e-300, 1 - 1e-16)
    return _Regressed(
        correlation=correlation,
        deviate=float(stats.norm.isf(p)),
        degrees=degrees,
        by_fit=float(by_fit),
    )


def is_exact(grid: CycleGrid, error: Signals) -> Bool[np.ndarray, " ny"]:
    """Return whether the residuals of each output are rounding errors only, so that they cannot be
    tested."""
    square = np.nansum(error**2, axis=(0, 1, 2))
    left = np.sqrt(square)
    square_of_outputs = (grid.y**2).sum(axis=(0, 1, 2))
    size = np.sqrt(square_of_outputs)
    return left <= 1e3 * ROUNDING * size  # (iterations leave as much of exact data)


def is_quiet(grid: CycleGrid, error: Signals, predicted: Signals) -> bool:
    """Return whether residuals are smaller than those of any sensor, though larger than rounding
    errors.

    Then they are distortion by nonlinearity, too small a part of the responses to be found in them
    by `is_distorted`. This is so for simulated recordings without noise.

    **Arguments:** `error`, `predicted` outputs, on `grid`.
    """
    tested = ~is_exact(grid, error)
    if not tested.any():
        return False
    left = np.nansum(error**2, axis=(0, 1, 2))
    # (Declared drift is no response.)
    by_cycle = predicted.reshape(*predicted.shape[:2], -1)
    drift = grid.drift @ (np.linalg.pinv(grid.drift) @ by_cycle)
    response = (by_cycle - drift).reshape(predicted.shape)
    of_responses = np.where(grid.sampled, response, 0.0)
    size = (of_responses**2).sum(axis=(0, 1, 2))
    return bool((left < _QUIET**2 * size)[tested].all())


def about_misfit(
    outside: CycleGrid, grid: CycleGrid, error: Signals, innovations: bool, direct: bool
) -> list[Finding]:
    """Return a finding if residuals depend on inputs of the period before, or on other residuals.

    Residuals that are correlated in time may seem to depend on inputs that are also correlated in
    time. They then seem to depend on inputs of other cycles as much. Therefore both dependences are
    compared.

    **Arguments:** `outside`: the inputs that do not respond to outputs. `error`: the residuals of
    `grid`, NaN where an output was not sampled. `innovations`: whether the fit has process noise.
    `direct`: whether it has a D. Without D, inputs at the section of a residual are left out, since
    a controller may have made them from the output.
    """
    S, T, N, ny = error.shape
    is_late = (grid.age > N)[..., None]
    late = np.where(is_late, error, np.nan)
    inputs = outside.u
    if not direct:
        shape = (S, T * N, inputs.shape[3])
        earlier = np.zeros(shape)
        in_order = inputs.reshape(S, T * N, -1)
        earlier[:, 1:] = in_order[:, :-1]
        inputs = earlier.reshape(inputs.shape)
    _, p, _ = independence_test(inputs, late, N, ANSWER)
    tested = ~is_exact(grid, error)
    depends = (p < ANSWER / ny) & tested
    _, p_white = whiteness_test(error, N)
    is_colored = bool(((p_white < _COLORED / ny) & tested).any())
    if is_colored and depends.any():
        depends &= _deviates_of(p) > _of_other_cycles(inputs, late) + _ALONE
    if depends.any():
        noise = "" if innovations else ", noise='innovations'"
        text = (
            "residuals depend on the inputs, so multipliers may be wrong by more than their "
            f"standard errors: give more dimensions{noise}, or another `initial` model."
        )
        return [Finding("left over", text)]
    if is_colored and innovations:
        text = (
            "errors one step ahead are correlated in time, so standard errors may be too small: "
            "give more dimensions, which colored noise needs."
        )
        return [Finding("colored noise", text)]
    if is_colored:
        text = (
            "residuals are correlated in time, as noise makes them that drives the system, so "
            "standard errors are too small: pass noise='innovations'."
        )
        return [Finding("process noise", text)]
    return []


def _deviates_of(p: ByOutput) -> ByOutput:
    """Return Gaussian deviates of p-values."""
    return stats.norm.isf(np.clip(p, 1e-300, 1 - 1e-16))


def _of_other_cycles(inputs: Signals, error: Signals) -> ByOutput:
    """Return the mean deviate by which residuals seem to depend on the inputs of other cycles."""
    cycles = error.shape[1]
    shifts = np.linspace(0.2, 0.8, _SHIFTS) * cycles
    deviates = []
    for shift in np.unique(shifts.astype(int)):
        moved = np.roll(inputs, shift, axis=1)
        lags = error.shape[2]
        _, p, _ = independence_test(moved, error, lags, ANSWER)
        deviates.append(_deviates_of(p))
    return np.mean(deviates, axis=0)


def is_distorted(
    grid: CycleGrid, error: Signals, predicted: Signals, c: Coefficients
) -> bool:
    """Return whether residuals follow products of earlier responses, as nonlinearity makes them.

    Such residuals depend on the inputs, and multipliers err together with them, by more than any
    residuals show that are independent of the inputs. Distortion adds up in the slowest modes:
    therefore only those patterns of a cycle count in which the responses are largest, and products
    that are filtered by 1 / chi. Curved sensors distort single samples, which does no such harm:
    products of the same cycle are left out. Residuals of neighboring cycles are correlated, so that
    chance explains more of them: all are filtered, by their lag-one correlation (Cochrane and
    Orcutt 1949).

    **Arguments:** `error`, `predicted` outputs, on `grid`. `c`: the coefficients of chi.
    """
    # (Beside residuals that are rounding errors, those of the other outputs would not be seen.)
    tested = ~is_exact(grid, error)
    if not tested.any():
        return False
    kept = np.asarray(grid.inside.any(axis=2))
    if kept.sum() < _FEWEST_CYCLES:
        return False
    grid = grid._replace(sampled=grid.sampled[..., tested])
    error = error[..., tested]
    predicted = predicted[..., tested]
    left = np.where(grid.sampled, error, 0.0)
    square = (left**2).sum(axis=(0, 1, 2)) / np.maximum(
        grid.sampled.sum(axis=(0, 1, 2)), 1
    )
    noise = positive(np.sqrt(square))
    response = np.where(grid.inside[..., None], predicted, 0.0) / noise
    S, T, N, ny = response.shape
    by_cycle = response.reshape(S, T, N * ny)
    _, _, patterns = np.linalg.svd(by_cycle[kept], full_matrices=False)
    patterns = patterns[: min(len(c), _PATTERNS)].T
    now = _products(by_cycle @ patterns)
    now = np.where(kept[..., None], now - now[kept].mean(axis=0), 0.0)
    earlier = divide_by_chi(fading(c), delay_cycles(now, 1))
    dynamic = _without_sensors(grid, left / noise, response)
    rest = dynamic.reshape(S, T, N * ny) @ patterns
    correlation = _lag_one(rest)
    rest, earlier, now = (
        x - correlation * delay_cycles(x, 1) for x in (rest, earlier, now)
    )
    share, by_chance = _explained(rest[kept], earlier[kept], now[kept])
    if len(by_chance) < _FEWEST_SHIFTS:
        return False
    mean = by_chance.mean()
    variance = positive(by_chance.var())
    # (Sums of squares are distributed like a multiple of chi squared.)
    p = stats.gamma.sf(share, mean**2 / variance, scale=variance / mean)
    return bool(p <= _DISTORTED and share - mean >= _LEAST_DISTORTION)


def _lag_one(x: Float[np.ndarray, "S T k"]) -> float:
    """Return the correlation of cycles with those before."""
    before = x[:, :-1]
    square = (before**2).sum()
    return float((x[:, 1:] * before).sum() / positive(square))


def _products(x: Float[np.ndarray, "*rows k"]) -> Float[np.ndarray, "*rows K"]:
    i, j = np.triu_indices(x.shape[-1])
    return x[..., i] * x[..., j]


def _without_sensors(grid: CycleGrid, left: Signals, response: Signals) -> Signals:
    """Return residuals without what products of the outputs at their own sample explain, as curved
    sensors make it."""
    out = left.copy()
    for n, i in np.ndindex(left.shape[2:]):
        sampled = grid.sampled[:, :, n, i]
        static = _products(response[:, :, n])[sampled]
        columns = np.concatenate([np.ones((len(static), 1)), static], axis=1)
        e = left[:, :, n, i][sampled]
        by_static, *_ = np.linalg.lstsq(columns, e)
        out[:, :, n, i][sampled] = e - columns @ by_static
    return out


def _explained(
    rest: Float[np.ndarray, "cycles d"],
    products: Float[np.ndarray, "cycles K"],
    others: Float[np.ndarray, "cycles K"],
) -> tuple[float, Float[np.ndarray, " shifts"]]:
    """Return the share of squares that products explain beyond others, and that which they explain
    when they are shifted by whole numbers of cycles. (Shifts by which inputs repeat are left out:
    they give the same products again.)"""
    others = others / positive(np.abs(others).max(axis=0))
    products = products / positive(np.abs(products).max(axis=0))
    known, _ = np.linalg.qr(np.concatenate([np.ones((len(rest), 1)), others], axis=1))
    rest = rest - known @ (known.T @ rest)
    rest = rest / positive(np.sqrt((rest**2).sum(axis=0)))
    basis, _ = np.linalg.qr(products - known @ (known.T @ products))
    cycles, d = rest.shape
    shifts = np.unique(np.linspace(0.1, 0.9, _SHIFTED_CYCLES) * cycles // 1).astype(int)

    def share(shift: int) -> float:
        return float(((np.roll(basis, shift, axis=0).T @ rest) ** 2).sum() / d)

    def repeats(shift: int) -> bool:
        overlap = np.roll(basis, shift, axis=0).T @ basis
        return float((overlap**2).sum() / len(overlap)) > _REPEATED

    by_chance = [share(shift) for shift in shifts if not repeats(shift)]
    return share(0), np.array(by_chance)


def about_answers(
    grid: CycleGrid, error: Signals, inputs: tuple[str, ...], remedy: str
) -> list[Finding]:
    """Return a finding if inputs respond to earlier residuals, as a controller does."""
    if is_exact(grid, error).all():
        return []
    answers = feedback_test(grid, error) < ANSWER
    names = ", ".join(compress(inputs, answers))
    if not names:
        return []
    text = f"inputs answer earlier residuals, as by a controller ({names}): {remedy}."
    return [Finding("feedback", text)]


def feedback_test(grid: CycleGrid, error: Signals) -> Float[np.ndarray, " nu"]:
    """Test whether inputs respond to residuals of a model of the outputs at earlier sections.

    The part of each input that its own past does not explain is regressed on these residuals. This
    part is white whatever the spectrum of the input is, so that the test also holds for colored
    residuals.

    **Returns:** p-values; small ones show a controller at work.
    """
    S, T, N, nu = grid.u.shape
    lags = 2
    shape = (S, T * N, error.shape[3])
    earlier = np.zeros(shape)
    known = np.nan_to_num(error)
    in_order = known.reshape(S, T * N, -1)
    earlier[:, 1:] = in_order[:, :-1]
    new = np.full(grid.u.shape, np.nan)
    for n in range(N):
        is_late = grid.age[:, :, n] > lags + 1
        whole = grid.inside[:, :, n] & is_late
        lagged = lagged_inputs(grid.u, n, lags + 1, 0)
        past = lagged[whole][:, nu:]
        u = grid.u[:, :, n][whole]
        by_past, *_ = np.linalg.lstsq(past, u)
        explained = past @ by_past
        new[:, :, n][whole] = u - explained
    in_sections = earlier.reshape(error.shape)
    _, p, _ = independence_test(in_sections, new, lags, ANSWER)
    return p
