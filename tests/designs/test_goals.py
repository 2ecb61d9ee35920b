"""Quantities of interest, against fits, bounds, closed forms and another optimizer."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .conftest import TWO_NOISE, expected_htf, random_designs, total_variance


N = 4
NOISE = {"y": 0.02}
GOAL = hj.designs.MultiplierGoal(harmonics=(-1, 0, 1))


@pytest.fixture(scope="module")
def model():
    """Two real multipliers."""
    A = np.array(
        [
            [[1.0, 0.0], [0.0, 1.0]],
            [[0.9, 0.1], [0.0, 0.5]],
            [[1.0, 0.0], [0.2, 1.0]],
            [[0.7, 0.0], [0.0, -0.6]],
        ]
    )
    rng = np.random.default_rng(1)
    B = rng.normal(size=(N, 2, 1))
    C = rng.normal(size=(N, 1, 2))
    return hj.linear.LDTP(A, B, C)


@pytest.fixture(scope="module")
def usual():
    return hj.multisine(N, 16, frequencies=(0, 2), amplitude=0.1)


def test_transfer_functions_in_a_band(model, usual):
    """Their mean variance is that of `fit_ldtp`."""
    goal = hj.designs.ResponseGoal((0.2, 0.8), quantities=(0, 1))
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    assert plan.names == ("H_0 of y", "H_1 of y")
    assert plan.certificate < 1.03
    f = 0.2 + 0.6 * (np.arange(200) + 0.5) / 200
    H = model.htf(f, (0, 1)).H
    power = np.abs(H) ** 2
    size = power.mean(axis=1).sum()

    def require_variances(design, said):
        fit = hj.fit_ldtp(expected_htf(model, design, NOISE), initial=model)
        htf = fit.htf(f, (0, 1))
        variance = htf.variance[:, :, 0, 0]
        assert_allclose(said, variance.mean(axis=1) / size, rtol=0.02)

    require_variances(plan.usual, plan.usual_variances)
    require_variances(plan.design, plan.variances)


@pytest.mark.parametrize("harmonics", [None, (-1, 0, 1)])
def test_multipliers_by_fit_ldtp(two, two_usual, optimal_two, harmonics):
    """Standard errors are those of `cramer_rao`, which sums up all information; no other design is
    better than the certificate allows."""
    goal = hj.designs.MultiplierGoal(estimator="fit_ldtp", harmonics=harmonics)
    plan = optimal_two(goal=goal, limit={"u0": 0.1, "u1": 0.1})
    assert plan.certificate < 1.03
    bound = hj.identify.cramer_rao(
        two, expected_htf(two, plan.usual, TWO_NOISE, harmonics), estimator="fit_ldtp"
    )
    assert_allclose(plan.usual_variances.sum(), total_variance(bound), rtol=1e-5)
    for other in random_designs(3, 0.1, 6, 32, frequencies=(0, 3), inputs=two.inputs):
        bound = hj.identify.cramer_rao(
            two, expected_htf(two, other, TWO_NOISE, harmonics), estimator="fit_ldtp"
        )
        assert total_variance(bound) > plan.criterion / plan.certificate
    assert (
        optimal_two(limit={"u0": 0.1, "u1": 0.1}).usual_criterion > plan.usual_criterion
    )
    only = hj.optimal_design(two, two_usual, goal=goal, noise={"y1": 0.02})
    assert only.usual_criterion > plan.usual_criterion


def test_multipliers_keep_the_numbers_of_the_model():
    """Three multipliers, the first of which no input excites."""
    A = np.diag([0.9, 0.6, 0.3])
    ones = np.array([0.0, 1.0, 1.0])
    model = hj.linear.LDTP(
        np.stack([A, np.eye(3)]), np.stack([ones, ones])[..., None], np.ones((2, 1, 3))
    )
    usual = hj.multisine(2, 32, frequencies=(0, 1))

    def plan(which):
        goal = hj.designs.MultiplierGoal(which, estimator="fit_ldtp")
        return hj.optimal_design(model, usual, goal=goal, noise={"y": 0.01})

    assert plan(1).names == ("0.6",)
    assert plan(2).names == ("0.3",)
    with pytest.raises(
        hj.errors.DefinitionError, match=r"no input excites.*multiplier 0\.9"
    ):
        plan(0)


def test_bad_goals(model, usual):
    second = [[0.5, 0.01], [0, 0.5 + 1e-9]]
    close = np.array([np.eye(2), second])
    B = np.ones((2, 2, 1))
    C = np.ones((2, 1, 2))
    double = hj.linear.LDTP(close, B, C)
    M = hj.designs.MultiplierGoal
    walker = hj.models.SimplestWalker()
    at = hj.AtEvent("heelstrike")
    short = hj.find_limit_cycle(walker, walker.short_gait(), section=at)
    cases = (
        (model, hj.designs.ParameterGoal(short, at, "slope"), "a stable `cycle`"),
        (model, hj.designs.ResponseGoal((1.0, 3.0)), "must lie within 0 and 2"),
        (double, M(harmonics=0), "is double"),
    )
    for system, goal, message in cases:
        design = (
            usual if system.n_sections == N else hj.multisine(2, 32, frequencies=(0, 1))
        )
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.optimal_design(system, design, goal=goal, noise=NOISE)


def with_angle(angle):
    """Return a model with a pair of multipliers of modulus 0.9 and this angle."""
    c = np.cos(angle)
    s = np.sin(angle)
    A = np.array(
        [
            [[0.9 * c, -0.9 * s], [0.9 * s, 0.9 * c]],
            [[1.0, 0.0], [0.0, 1.0]],
            [[1.0, 0.1], [0.0, 1.0]],
            [[1.0, -0.1], [0.0, 1.0]],
        ]
    )
    B = np.array(
        [
            [1, 0.2],
            [0.5, -1],
            [0.3, 0.1],
            [1, 1],
        ]
    )
    C = np.array(
        [
            [1, 0.4],
            [0.2, 1],
            [1, -1],
            [0.5, 0.5],
        ]
    )
    by_input = B[:, :, None]
    by_state = C[:, None]
    return hj.linear.LDTP(A, by_input, by_state)


def variance(model, design):
    """Return that of the multipliers by `cramer_rao`."""
    htf = expected_htf(model, design, NOISE, (-1, 0, 1))
    return total_variance(hj.identify.cramer_rao(model, htf))


@pytest.fixture(scope="module")
def three():
    """Models that differ in the angle of their multipliers."""
    return [with_angle(0.8), with_angle(1.6), with_angle(2.4)]


@pytest.mark.parametrize("robust, exponent", [("mean", 1), ("worst", 16)])
def test_several_models(robust, exponent, three):
    """The certificate bounds all designs for the mean of powers, and standard errors of 1e-15 have
    no effect (their 16th powers are zero)."""
    usual = hj.multisine(N, 32, frequencies=(0, 2))
    about = dict(goal=GOAL, limit={"u": 0.1}, robust=robust)
    plan = hj.optimal_design(three, usual, noise=NOISE, **about)
    assert plan.certificate < 1.05

    def mean(design):
        variances = [variance(model, design) for model in three]
        powers = np.power(variances, exponent)
        return np.mean(powers) ** (1 / exponent)

    assert mean(plan.design) == pytest.approx(plan.criterion, rel=2e-3)
    for other in random_designs(5, 0.1, N, 32, frequencies=(0, 2)):
        assert mean(other) > plan.criterion / plan.certificate
    for_one = hj.optimal_design(
        three[0], usual, noise=NOISE, goal=GOAL, limit={"u": 0.1}
    )
    assert mean(for_one.design) > 1.2 * plan.criterion
    almost_exact = hj.optimal_design(three, usual, noise={"y": 2e-15}, **about)
    assert almost_exact.saved == pytest.approx(plan.saved, rel=0.05)


def test_limits_hold_for_each_of_several_models(three):
    usual = hj.multisine(N, 32, frequencies=(0, 2))
    limit = {"u": 9.0, "y": 0.1}
    plan = hj.optimal_design(three, usual, goal=GOAL, noise=NOISE, limit=limit)
    rms = []
    for model in three:
        data = hj.experiments.simulate_experiments(model, plan.design, start="periodic")
        square = np.mean(data.y**2)
        rms.append(np.sqrt(square))
    assert max(rms) == pytest.approx(0.1, rel=1e-2)


def test_several_models_that_do_not_fit_together(three):
    usual = hj.multisine(N, 32, frequencies=(0, 2))
    with pytest.raises(
        hj.errors.DefinitionError, match="model 1 and model 0 have different n_sections"
    ):
        hj.optimal_design([three[0], hj.testing.synthetic_ldtp()], usual)
    larger = 1.1 * three[1].A
    unstable = dataclasses.replace(three[1], A=larger)
    with pytest.raises(hj.errors.DefinitionError, match="model 1 is unstable"):
        hj.optimal_design([three[0], unstable], usual)
    with pytest.raises(hj.errors.DefinitionError, match="not an empty list"):
        hj.optimal_design([], usual)


@pytest.mark.slow
def test_draws_have_the_covariance_of_the_fit():
    model = with_angle(1.0)
    design = hj.multisine(N, 32, frequencies=(0, 2), amplitude=0.05)
    fit = hj.fit_ldtp(expected_htf(model, design, NOISE), initial=model)
    coefficients = []
    for draw in hj.designs.draw_models(fit, 400):
        coefficients.append(np.poly(draw.multipliers).real[1:])
    covariance = np.cov(np.transpose(coefficients))
    tolerance = 0.3 * fit.covariance.max()
    assert_allclose(covariance, fit.covariance, atol=tolerance)


@pytest.mark.slow
def test_physical_parameters():
    """Their standard errors with the usual design are those of `fit_model`'s sensitivities."""
    cycle = hj.find_limit_cycle(hj.models.Duffing())
    sections = hj.ClockPhase(8, anchor=hj.Crossing("x", "falling"))
    model = hj.linearize(cycle, sections, outputs=("x", "v"))
    usual = hj.multisine(8, periods=16).scaled(0.001)
    free = ("damping", "amplitude")
    harmonics = (-1, 0, 1)
    goal = hj.designs.ParameterGoal(cycle, sections, free, harmonics=harmonics)
    plan = hj.optimal_design(model, usual, goal=goal, noise={"x": 1e-4})
    assert plan.certificate < 1.03
    assert plan.saved > 10

    exact = model.htf(usual.frequencies, harmonics)
    H = exact.H[:, :, :1]
    by_line = usual.expected_variance(1e-4)
    variance = np.broadcast_to(by_line[:, None], H.shape)
    htf = hj.linear.HTF(
        exact.frequencies, H, harmonics, 8, exact.inputs, "x", variance=variance
    )
    observed = hj.fitting.ObservedHTF(htf, sections)
    S = hj.fitting.identifiability(
        cycle.system, observed, free, guess=cycle
    ).sensitivity
    covariance = np.linalg.inv(S.T @ S)
    bound = np.sqrt(np.diag(covariance))
    assert_allclose(plan.usual_standard_errors, bound, rtol=1e-6)
