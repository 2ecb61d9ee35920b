"""Multipliers with errors: efficient, and with regions that hold what they promise."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import hybridjax as hj
from hybridjax.identify.denominator import multipliers_of
from hybridjax.identify.multiplier_estimate import MultiplierEstimate
from hybridjax.identify.variable_projection import error_spectrum, group_htf
from hybridjax.identify.weights import weights_of

from .conftest import scaled


def noisy(htf, variance, rng, correlation=0.0):
    """HTFs with circular errors; a share of them is common to all harmonics and outputs."""
    parts = [
        rng.normal(size=htf.H.shape) + 1j * rng.normal(size=htf.H.shape)
        for _ in range(2)
    ]
    own = parts[0]
    common = parts[1][:1, :, :1]
    of_own = np.sqrt(1 - correlation) * own
    of_common = np.sqrt(correlation) * common
    error = of_own + of_common
    return with_variance(
        htf, np.asarray(htf.H) + np.sqrt(variance / 2) * error, variance
    )


def with_variance(htf, H, variance, dof=None):
    variance_dof = None if dof is None else hj.linear.VarianceDof(dof)
    return dataclasses.replace(htf, H=H, variance=variance, variance_dof=variance_dof)


@pytest.fixture(scope="module")
def small():
    """The small system and its HTFs."""
    model = scaled(3, (2, 3, 4, 2), 2, 1)
    return model, model.htf(np.linspace(0.01, 1.99, 80))


@pytest.fixture(scope="module")
def variance(small):
    """Not the same for all frequencies, harmonics and outputs."""
    rng = np.random.default_rng(9)
    sizes = np.array([1.0, 0.3, 2.0, 0.3])
    harmonic = sizes[:, None, None, None]
    exponents = rng.uniform(-0.5, 0.5, 80)
    line = 10 ** exponents[:, None, None]
    outputs = np.array([1.0, 3.0])
    return 1e-2 * harmonic * line * outputs[:, None]


def covered(hits, runs, level=0.95):
    """Consistent with the level by a two-sided binomial test of level 0.1 %."""
    return stats.binomtest(hits, runs, level).pvalue > 1e-3


@pytest.mark.parametrize("correlation, errors", [(0, "variance"), (0.7, "residuals")])
def test_regions_cover_and_errors_reach_the_bound(correlation, errors, small, variance):
    """Errors that are common to all harmonics, too: the residuals know."""
    model, htf = small
    true = model.multipliers
    runs = 60
    bound = hj.identify.cramer_rao(
        model, with_variance(htf, htf.H, variance)
    ).standard_errors
    draws = (
        noisy(htf, variance, np.random.default_rng(k), correlation) for k in range(runs)
    )
    fits = [hj.fit_multipliers(draw, 2, covariance=errors) for draw in draws]
    hits = sum(fit.contains(true).all() for fit in fits)
    assert covered(hits, runs)
    squares = [fit.compare(true).error ** 2 for fit in fits]
    rms = np.sqrt(np.mean(squares, axis=0))
    variances = [fit.standard_errors**2 for fit in fits]
    said = np.sqrt(np.mean(variances, axis=0))
    np.testing.assert_allclose(said, rms, rtol=0.25)
    if not correlation:
        np.testing.assert_allclose(rms, bound, rtol=0.25)
        dof = np.sqrt(2 * fits[0].dof * runs)
        excess = sum(fit.cost - fit.dof for fit in fits)
        assert abs(excess) < 4 * dof


@pytest.mark.slow
def test_variances_from_few_experiments_are_good_enough_weights(small, variance):
    (model, htf) = small
    square = np.zeros(2)
    for seed in range(25):
        rng = np.random.default_rng(seed)
        data = noisy(htf, variance, rng)
        rough = variance * rng.gamma(2.0, 0.5, variance.shape)
        dof_of_each = np.full(80, 2.0)
        estimated = with_variance(htf, data.H, rough, dof_of_each)
        fit = hj.fit_multipliers(estimated, 2)
        raw = hj.fit_multipliers(with_variance(htf, data.H, rough), 2)
        square += [f.compare(model.multipliers).error[0] ** 2 for f in (fit, raw)]
    exact = with_variance(htf, htf.H, variance)
    bound = hj.identify.cramer_rao(model, exact)
    ratio = np.sqrt(square / 25) / bound.standard_errors[0]
    assert ratio[0] < 1.2 < ratio[1]


def test_without_variances_the_misfit_tells(small):
    """One output is a hundred times as noisy, which nobody said."""
    model, htf = small
    by_output = np.array([1e-2, 1.0])
    variance = np.broadcast_to(by_output[:, None], htf.H.shape)
    said = hj.identify.cramer_rao(
        model, with_variance(htf, htf.H, variance)
    ).standard_errors
    data = noisy(htf, variance, np.random.default_rng(0))
    blind = hj.fit_multipliers(with_variance(htf, data.H, None), 2)
    np.testing.assert_allclose(blind.standard_errors, said, rtol=0.3)
    assert blind.contains(model.multipliers, 0.999).all()


def test_the_spectrum_of_errors_is_found(small):
    """On average, of each output and at each frequency, whatever it was supposed to be."""
    model, htf = small
    f = np.asarray(htf.frequencies)
    c = np.poly(model.multipliers).real[1:]
    polynomial = np.append(1, c)[::-1]
    delay = np.exp(-2j * np.pi * f)
    chi = np.polyval(polynomial, delay)
    white = np.array([3e-3, 1e-2])
    colored = np.array([1e-2, 2e-3])
    gain = np.abs(chi[:, None]) ** 2
    true = white + colored / gain
    line = np.linspace(1e-3, 4e-3, 160)
    guessed = line.reshape(80, 2, 1)
    supposed = weights_of(guessed, np.ones(2))
    supposed = np.broadcast_to(supposed, htf.H.shape)
    rng = np.random.default_rng(0)
    inputs = htf.H.shape[3]
    lines = rng.uniform(0.1, 2, (80, 1, inputs))
    by_line = true[..., None] * lines
    variance = np.broadcast_to(by_line, htf.H.shape)
    found = []
    for seed in range(50):
        groups = group_htf(
            noisy(htf, variance, np.random.default_rng(seed)), supposed, 13
        )
        found.append(error_spectrum(groups, c, f, lines, 2))
    mean = np.mean(found, axis=0)
    np.testing.assert_allclose(mean, variance[0], rtol=0.06)


@pytest.fixture(scope="module")
def pair_and_real():
    """An estimate of a conjugate pair and a real multiplier."""
    true = np.array([0.6 + 0.3j, 0.6 - 0.3j, -0.4])
    rng = np.random.default_rng(1)
    square = rng.normal(size=(3, 3))
    return MultiplierEstimate(
        true, np.poly(true).real[1:], 1e-6 * square @ square.T, np.inf
    ), rng


@pytest.mark.slow
def test_first_order_covariances_and_regions(pair_and_real):
    """Against the roots of coefficients drawn at random."""
    estimate, rng = pair_and_real
    true = estimate.multipliers
    c = estimate.coefficients
    np.testing.assert_allclose(multipliers_of(c), true, rtol=1e-12)  # in this order
    draws = rng.multivariate_normal(c, estimate.covariance, size=2000)
    roots = np.array([np.roots([1, *draw]) for draw in draws])
    distances = np.abs(roots[:, :, None] - true)
    pick = np.argmin(distances, axis=1)
    roots = np.take_along_axis(roots, pick, axis=1)
    for i in range(3):
        real = roots[:, i].real
        imaginary = roots[:, i].imag
        parts = np.stack([real, imaginary])
        found = estimate.multiplier_covariances[i]
        np.testing.assert_allclose(np.cov(parts), found, rtol=0.1, atol=1e-7)
    squares = np.abs(roots - true) ** 2
    radius = np.sqrt(np.mean(squares, axis=0))
    np.testing.assert_allclose(estimate.standard_errors, radius, rtol=0.05)
    # The border of the first-order region has the distance of the exact one.
    for i, degrees, dof in ((0, 2, 1e9), (2, 1, 1e9), (0, 2, 9), (2, 1, 9)):
        border = dataclasses.replace(estimate, covariance_dof=dof).ellipse(i, 0.9)
        if degrees == 1:
            ends = [np.argmin(border.real), np.argmax(border.real)]
            border = border[ends].real
        left = dof - degrees + 1  # Hotelling's distribution
        ratio = stats.f(degrees, left).ppf(0.9)
        quantile = degrees * dof / left * ratio
        np.testing.assert_allclose(estimate.distance(border), quantile, rtol=0.05)
    # The share of draws that a region around the truth holds.
    held = [
        MultiplierEstimate(true, draw, estimate.covariance, np.inf).contains(true)
        for draw in draws
    ]
    hits = np.sum(held, axis=0)
    assert np.all([covered(n, 2000) for n in hits])
