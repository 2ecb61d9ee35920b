"""What one wants to know, against fits, closed forms and another optimizer."""

import numpy as np
import pytest
from scipy.optimize import minimize

import hybridjax as hj

from .conftest import expected_htf


N, NOISE = 4, {"y": 0.02}


@pytest.fixture(scope="module")
def model():
    """Two real multipliers."""
    A = np.array([np.eye(2), [[0.9, 0.1], [0.0, 0.5]], [[1, 0], [0.2, 1]], np.diag([0.7, -0.6])])
    rng = np.random.default_rng(1)
    return hj.LDTP(A, rng.normal(size=(N, 2, 1)), rng.normal(size=(N, 1, 2)))


@pytest.fixture(scope="module")
def usual():
    return hj.multisine(N, 16, band=(0, 2), amplitude=0.1)


def test_transfer_functions_in_a_band(model, usual):
    """Their mean variance is that which `fit_ldtp` says."""
    goal = hj.designs.FrequencyResponse((0.2, 0.8), wanted=(0, 1))
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    assert plan.names == ("H_0 of y", "H_1 of y")
    assert plan.certificate < 1.03
    f = 0.2 + 0.6 * (np.arange(200) + 0.5) / 200
    size = (np.abs(model.htf(f, (0, 1)).H) ** 2).mean(axis=1).sum()
    for design, said in ((plan.usual, plan.usual_variances), (plan.design, plan.variances)):
        fit = hj.fit_ldtp(expected_htf(model, design, NOISE), model, direct=False)
        variance = fit.htf(f, (0, 1)).variance.mean(axis=1)[:, 0, 0] / size
        np.testing.assert_allclose(said, variance, rtol=0.02)
    near = hj.optimal_design(
        model, usual, goal=hj.designs.FrequencyResponse((1.6, 1.9)), noise=NOISE
    )
    assert near.power @ near.frequencies > plan.power @ plan.frequencies


def test_an_impulse_response_is_its_spectrum(model, usual):
    """By Parseval's theorem the whole response is known as well as all transfer functions in the
    whole band."""
    goal = hj.designs.ImpulseResponse(100)
    impulse = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    goal = hj.designs.FrequencyResponse((0.0, 2.0), wanted=(-2, -1, 0, 1))
    spectrum = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    assert impulse.names == ("response of y",)
    assert impulse.usual_criterion == pytest.approx(spectrum.usual_criterion, rel=1e-6)
    short = hj.optimal_design(model, usual, goal=hj.designs.ImpulseResponse(3), noise=NOISE)
    assert short.certificate < 1.03
    assert (
        np.abs(short.power / short.power.sum() - impulse.power / impulse.power.sum()).max() > 0.01
    )


def misfit(model, design, fewer, harmonics):
    """Of the best model with fewer multipliers, as `fit_multipliers` finds it."""
    fit = hj.fit_multipliers(expected_htf(model, design, NOISE, harmonics), fewer, check=False)
    return fit.cost


def test_the_choice_of_an_order(model, usual):
    fewer, harmonics = 1, (-1, 0, 1)
    goal = hj.designs.Order(fewer, harmonics=harmonics)
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    assert plan.certificate < 1.03 and plan.saved > 1.2
    for design, said in ((plan.usual, plan.usual_criterion), (plan.design, plan.criterion)):
        assert 1 / said == pytest.approx(misfit(model, design, fewer, harmonics), rel=0.02)
    rng = np.random.default_rng(0)
    for _ in range(5):
        other = hj.multisine(N, 16, band=(0, 2), amplitude=lambda f: rng.exponential(size=f.shape))
        other = other.scaled(plan.usual_rms["u"])
        assert misfit(model, other, fewer, harmonics) < plan.certificate / plan.criterion


@pytest.mark.filterwarnings("ignore:Values in x were outside bounds")  # SLSQP of older SciPy
def test_the_choice_of_an_order_by_another_optimizer(model):
    """Sequential quadratic programming, with a numerical gradient of the misfit."""
    from hybridjax.designs.candidates import Candidates
    from hybridjax.designs.noise import make_noise
    from hybridjax.designs.questions.order import about_order

    few = hj.multisine(N, 8, band=(0, 2))
    cosines = Candidates.of(few)
    goal = hj.designs.Order(0, harmonics=0)
    question = about_order(goal, model, cosines, make_noise(model, NOISE, {}))
    start = cosines.power_of(few)
    plan = hj.optimal_design(
        model, few, goal=goal, noise=NOISE, limit={"u": float(np.sqrt(start.sum()))}
    )
    other = minimize(
        lambda p: -1e-3 / question.answer(p).criterion, start, method="SLSQP",
        bounds=[(1e-9, 1)] * len(start),
        constraints=[{"type": "ineq", "fun": lambda p: start.sum() - p.sum()}],
        options={"ftol": 1e-10, "maxiter": 40},
    )  # fmt: skip
    best = -1e-3 / other.fun
    assert best * (1 - 1e-3) < plan.criterion < best * plan.certificate * 1.001


def test_a_sum_with_weights(model, usual):
    """The c-criterion: its variance is the quadratic form of the covariance."""
    harmonics = (-1, 0, 1)
    goal = hj.designs.Multipliers(weights=(1.0, -2.0), harmonics=harmonics)
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    bound = hj.identify.multiplier_bound(model, expected_htf(model, plan.usual, NOISE, harmonics))
    one, other = bound.multipliers.real
    gradient = -np.vander([one, other], 2) / np.array([[one - other], [other - one]])
    w = np.array([1.0, -2.0]) @ gradient
    assert plan.usual_criterion == pytest.approx(w @ bound.covariance @ w, rel=1e-6)
    assert plan.names == (f"+1 {one:.4g} -2 {other:.4g}",) and plan.certificate < 1.03


@pytest.mark.parametrize(
    "goal, message",
    [
        (hj.designs.Order(2), "2 multipliers are not fewer than the model's 2"),
        (hj.designs.FrequencyResponse((1.0, 3.0)), "must lie within 0 and 2"),
        (hj.designs.Multipliers(weights=(1.0,)), "must be 2 numbers: one for each of"),
    ],
)
def test_bad_goals(model, usual, goal, message):
    if isinstance(goal, hj.designs.Multipliers | hj.designs.Order):
        goal = type(goal)(**(vars(goal) | {"harmonics": (-1, 0, 1)}))
    with pytest.raises(hj.DefinitionError, match=message):
        hj.optimal_design(model, usual, goal=goal, noise=NOISE)


def test_goals_of_nothing():
    with pytest.raises(hj.DefinitionError, match="must not all be zero"):
        hj.designs.Multipliers(weights=(0.0, 0.0))
    with pytest.raises(hj.DefinitionError, match="must rise"):
        hj.designs.FrequencyResponse((1.0, 0.5))
