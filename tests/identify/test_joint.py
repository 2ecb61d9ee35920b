"""The fit of a linear periodic model itself, and its bound."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hybridjax as hj
from hybridjax.identify.joint.frequency import transfer, transfer_slopes
from hybridjax.identify.periodic import (
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from hybridjax.linear.frequency_response import harmonic_transfer

from .conftest import scaled
from .test_uncertainty import noisy


F = np.linspace(0.03, 2.9, 40)
ONE = np.ones(2)


@pytest.fixture(scope="module")
def model():
    return hj.testing.synthetic_ldtp()


@pytest.fixture(scope="module")
def exact(model):
    """All harmonics, with the variance of errors of 2 %."""
    htf = model.htf(F)
    return with_values(htf, htf.H, 4e-4)


def with_values(htf, H, variance=None):
    if variance is not None:
        variance = np.full(H.shape, variance)
    return dataclasses.replace(htf, H=H, variance=variance)


def shaken(model, rng, size=0.02):
    """Other matrices nearby, in which zeros of the padding stay zero."""

    def parts(m):
        return (m.A, m.B, m.C, m.D)

    return eqx.tree_at(
        parts,
        model,
        tuple(x * (1 + size * rng.normal(size=x.shape)) for x in parts(model)),
    )


@pytest.mark.parametrize("growth", (1.0, 1.4))
def test_the_coordinates_are_as_many_as_there_are_models(model, exact, growth):
    """Entries of all matrices less those of changes of state, and the data show every one; also of
    an unstable system."""
    model = eqx.tree_at(lambda m: m.A, model, growth * model.A)
    is_unstable = np.abs(model.multipliers).max() > 1
    assert is_unstable == (growth > 1)
    coordinates = local_coordinates(PeriodicModel.of(model, ONE), direct=True)
    dims = np.asarray(model.dims)
    after = np.roll(dims, -1)
    by_section = after * dims + after * 2 + 2 * dims + 4
    entries = by_section.sum()
    assert coordinates.size == entries - (dims**2).sum()
    found = transfer(coordinates.model, F, exact.harmonics)
    expected = model.htf(F).H
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    J = np.concatenate(
        [
            s.reshape(len(s), -1)
            for _, s in transfer_slopes(coordinates, F, exact.harmonics)
        ],
        axis=1,
    )
    assert (
        np.linalg.matrix_rank(np.concatenate([J.real, J.imag], axis=1))
        == coordinates.size
    )


@pytest.mark.parametrize("errors", (0, 2))
def test_derivatives_are_those_of_jax(model, errors):
    rng = np.random.default_rng(0)
    matrices = PeriodicModel.of(model, ONE, errors)
    matrices = matrices._replace(
        K=[x + 0.3 * rng.normal(size=x.shape) for x in matrices.K]
    )
    coordinates = local_coordinates(matrices, direct=True)
    step = rng.normal(size=coordinates.size)

    def arrays(m):
        return [  # noqa: E731
            jnp.asarray(getattr(m.to_ldtp(ONE, model.inputs, model.outputs), x))
            for x in "ABCD"
        ]

    here, *ends = map(
        arrays, (coordinates.model, *map(coordinates.moved, (-step, step)))
    )
    change = [
        (b - a) / 2 for a, b in zip(*ends, strict=True)
    ]  # (no terms of third order)
    _, true = jax.jvp(
        lambda *x: harmonic_transfer(*x, jnp.asarray(F)), tuple(here), tuple(change)
    )
    harmonics = (-2, 0, 1)
    slopes = np.concatenate(
        [s for _, s in transfer_slopes(coordinates, F, harmonics)], axis=2
    )
    true = np.asarray(true)[np.array(harmonics)]
    along = np.tensordot(step, slopes, 1)
    np.testing.assert_allclose(along, true, atol=1e-11)
    c, by_step = characteristic_slopes(coordinates)
    np.testing.assert_allclose(
        c, np.poly(np.asarray(model.multipliers)).real[1:], atol=1e-12
    )
    moved = (
        local_coordinates(coordinates.moved(h * step), True) for h in (1e-6, -1e-6)
    )
    ahead, back = (characteristic_slopes(x)[0] for x in moved)
    by_differences = (ahead - back) / 2e-6
    np.testing.assert_allclose(by_step @ step, by_differences, rtol=1e-6)


@pytest.mark.parametrize("variance", (None, 4e-4))
def test_exact_htfs_give_the_exact_model(model, exact, variance):
    htf = with_values(exact, exact.H, variance)
    start = shaken(model, np.random.default_rng(1))
    fit = hj.fit_ldtp(htf, initial=start)
    assert fit.result == hj.errors.Result.OK
    assert "too few dimensions" not in repr(fit)
    assert "too few dimensions" in repr(hj.fit_ldtp(htf, 1).findings)
    dense = model.htf(np.linspace(0.01, 0.49, 97))
    assert "`order` may be too low" in repr(hj.fit_multipliers(dense, 1))
    off = (
        1e-8 if variance is None else 1e-5
    )  # (where they are known, 0.1 standard errors do)
    assert fit.compare(model.multipliers).max_error < off
    error = fit.model.htf(F).error(exact)
    assert np.max(error) < off
    np.testing.assert_allclose(
        fit.htf(F).H, fit.model.htf(F, fit.harmonics).H, atol=1e-12
    )


@pytest.mark.slow
def test_too_few_dimensions_are_named_in_strong_noise(hopper_cycle):
    """20 dB, at which the misfit is 1.6 times the expected one."""
    sections = hj.ClockPhase(8)
    model = hj.linearize(hopper_cycle, sections, ("yM", "vM"))
    design = (
        hj.multisine(8, periods=16, frequencies=(0, 4)).scaled(rms=0.05).realizations(4)
    )
    data = hj.experiments.simulate_experiments(model, design, start="periodic")
    htf = hj.estimate_htf(hj.experiments.add_noise(data, snr=20, seed=0))
    for dims, named in ((2, True), (model.dims, False)):
        findings = repr(hj.fit_ldtp(htf, dims).findings)
        assert ("too few dimensions" in findings) == named


def test_undetermined_responses_have_infinite_variance():
    """Harmonics -1, 0 and 1 of four leave the last one free in part, and the multipliers known."""
    small = scaled(3, (2, 3, 4, 2), 2, 1)
    f = np.arange(1, 40) / 80
    htf = small.htf(f, (-1, 0, 1))
    small_variance = np.full(htf.H.shape, 1e-6)
    draw = noisy(htf, small_variance, np.random.default_rng(0))
    start = shaken(small, np.random.default_rng(1))
    fit = hj.fit_ldtp(draw, initial=start)
    fitted = fit.htf(f, (-2, -1, 0, 1))
    variance = fitted.variance
    assert np.isinf(variance[0]).all()
    assert variance[1:].max() < 1e-6
    assert fit.contains(small.multipliers[:2], 0.999).all()


@pytest.mark.slow
def test_errors_are_as_small_as_the_bound(model, exact):
    """The rms error, the misfit and the coverage of 40 draws, each at the level of 0.1 %."""
    rng = np.random.default_rng(3)
    draws = 40
    bound = hj.identify.cramer_rao(model, exact, estimator="fit_ldtp")
    fits = [
        hj.fit_ldtp(noisy(exact, exact.variance, rng), initial=model)
        for _ in range(draws)
    ]
    error = np.array([fit.coefficients - bound.coefficients for fit in fits])
    information = np.linalg.inv(bound.covariance)
    square = np.einsum("si,ij,sj->", error, information, error)
    below = stats.chi2(2 * draws).cdf(square)
    assert 1e-3 < below < 1 - 1e-3
    cost = sum(fit.cost for fit in fits)
    dof = sum(fit.dof for fit in fits)
    assert 1e-3 < stats.chi2(dof).cdf(cost) < 1 - 1e-3
    inside = [fit.contains(model.multipliers).all() for fit in fits]
    hits = sum(int(x) for x in inside)
    assert stats.binomtest(hits, draws, 0.95).pvalue > 1e-3
    H = np.array([fit.htf(F).H for fit in fits])
    variances = [fit.htf(F).variance for fit in fits]
    variance = np.mean(variances, axis=0)
    apart = np.abs(H - np.asarray(exact.H))
    square = np.mean(apart**2, axis=0)
    ratio = np.mean(square / variance)
    assert abs(ratio - 1) < 0.1
    # Without variances, the residuals give them.
    draw = noisy(exact, exact.variance, np.random.default_rng(4))
    fit = hj.fit_ldtp(with_values(draw, draw.H), initial=model)
    np.testing.assert_allclose(fit.standard_errors, fits[0].standard_errors, rtol=0.2)
    assert fit.cost == pytest.approx(fit.dof)


def test_with_one_section_the_bound_is_that_of_free_numerators():
    """Then both have as many unknowns, and describe the same systems."""
    one = hj.linear.LDTP(
        [[[0.6, 0.3], [-0.4, 0.5]]], [[[1.0], [0.5]]], [[[1.0, -0.3]]], [[[0.2]]]
    )
    f = np.linspace(0.02, 0.48, 30)
    exact = one.htf(f)
    htf = with_values(exact, exact.H, 1e-4)
    free = hj.identify.cramer_rao(one, htf, extra_lags=0)
    joint = hj.identify.cramer_rao(one, htf, estimator="fit_ldtp")
    np.testing.assert_allclose(joint.covariance, free.covariance, rtol=1e-8)
