"""Designs for several models, any of which may be true."""

import numpy as np
import pytest

import hybridjax as hj

from .conftest import expected_htf


N, NOISE = 4, {"y": 0.02}
GOAL = hj.designs.Multipliers(harmonics=(-1, 0, 1))


def of(angle):
    """A pair of multipliers of modulus 0.9 with this angle."""
    turn = 0.9 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    A = np.array([turn, np.eye(2), [[1, 0.1], [0, 1]], [[1, -0.1], [0, 1]]])
    B = np.array([[1, 0.2], [0.5, -1], [0.3, 0.1], [1, 1]])[..., None]
    return hj.LDTP(A, B, np.array([[1, 0.4], [0.2, 1], [1, -1], [0.5, 0.5]])[:, None])


@pytest.fixture(scope="module")
def usual():
    return hj.multisine(N, 32, band=(0, 2))


def plan(models, usual):
    return hj.optimal_design(models, usual, goal=GOAL, noise=NOISE, limit={"u": 0.1})


def variance(model, design):
    """Of the multipliers, as `multiplier_bound` has it."""
    htf = expected_htf(model, design, NOISE, (-1, 0, 1))
    return np.trace(hj.identify.multiplier_bound(model, htf).multiplier_covariances[0])


def test_the_worst_of_small_numbers(usual):
    """Sixteenth powers of 1e-30 are zero."""
    models = [of(0.8), of(1.6)]
    about = dict(goal=GOAL, limit={"u": 0.1}, robust="worst")
    large, small = (
        hj.optimal_design(models, usual, noise={"y": noise}, **about) for noise in (0.02, 2e-15)
    )
    assert small.saved == pytest.approx(large.saved, rel=0.01)


def test_the_mean_over_models(usual):
    models = [of(0.8), of(1.6), of(2.4)]
    both = plan(models, usual)
    assert both.certificate < 1.03
    mean = np.mean([variance(one, both.design) for one in models])
    assert both.criterion == pytest.approx(mean, rel=1e-3)
    for one in models:
        alone = plan(one, usual)
        assert np.mean([variance(other, alone.design) for other in models]) > 1.2 * mean
        assert variance(one, both.design) > alone.criterion / alone.certificate
    # Where the resonances of all of them are.
    for angle in (0.8, 1.6, 2.4):
        there = np.abs((both.frequencies + 0.5) % 1 - 0.5) - angle / (2 * np.pi)
        assert both.power[np.abs(there) < 0.05].sum() > 0.1 * both.power.sum()


def test_the_worst_of_several_models(usual):
    """Better for the worst one than the mean is, but not than the certificate allows."""
    models = [of(0.8), of(1.6), of(2.4)]
    worst = hj.optimal_design(
        models, usual, goal=GOAL, noise=NOISE, limit={"u": 0.1}, robust="worst"
    )
    mean = plan(models, usual)
    assert worst.certificate < 1.05
    each = [variance(one, worst.design) for one in models]
    assert np.mean(np.power(each, 16)) ** (1 / 16) == pytest.approx(worst.criterion, rel=2e-3)
    assert max(each) < 0.97 * max(variance(one, mean.design) for one in models)
    rng = np.random.default_rng(0)
    for _ in range(5):
        other = hj.multisine(N, 32, band=(0, 2), amplitude=lambda f: rng.exponential(size=f.shape))
        other = other.scaled(0.1)
        assert max(variance(one, other) for one in models) > worst.criterion / worst.certificate


def test_limits_hold_for_each(usual):
    models = [of(0.8), of(2.4)]
    found = hj.optimal_design(models, usual, goal=GOAL, noise=NOISE, limit={"u": 9.0, "y": 0.1})
    rms = []
    for one in models:
        data = hj.experiments.simulate_experiments(one, found.design, start="periodic")
        rms.append(np.sqrt(np.mean(data.y**2)))
    assert max(rms) == pytest.approx(0.1, rel=1e-2)


def test_models_that_differ_are_refused(usual):
    other = hj.testing.synthetic_ldtp()
    with pytest.raises(hj.DefinitionError, match="model 1 has other n_sections than model 0"):
        plan([of(1.0), other], usual)
    with pytest.raises(hj.DefinitionError, match="holds no model"):
        plan([], usual)


def test_draws_have_the_covariance_of_the_fit():
    model, design = of(1.0), hj.multisine(N, 32, band=(0, 2), amplitude=0.05)
    fit = hj.fit_ldtp(expected_htf(model, design, NOISE), model)
    drawn = hj.designs.draws(fit, 400)
    c = np.array([np.poly(one.multipliers).real[1:] for one in drawn])
    np.testing.assert_allclose(
        np.cov(c.T), fit.covariance, atol=0.3 * np.diag(fit.covariance).max()
    )
    assert plan(drawn[:3], design).certificate < 1.03
