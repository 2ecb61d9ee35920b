"""Optimal designs of the hopper, against bounds and simulations; sequences with their spectrum."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .conftest import expected_htf


NOISE = {"yM": 1e-4, "vM": 3e-4}
HARMONICS = (-2, -1, 0, 1, 2)
with_variance = functools.partial(expected_htf, noise=NOISE, harmonics=HARMONICS)


@pytest.fixture(scope="module")
def usual():
    """Fewer lines than the paper's, to save time."""
    return hj.multisine(periods=32, amplitude=0.003)


@pytest.fixture(scope="module")
def plan(isochron_ldtp, usual):
    return hj.optimal_design(isochron_ldtp, usual, noise=NOISE)


def test_standard_errors_are_the_cramer_rao_bound(plan, isochron_ldtp):
    """That of `cramer_rao`; for any weights of H_m and H_{-m}."""
    for design, said in (
        (plan.usual, plan.usual_variances),
        (plan.design, plan.variances),
    ):
        htf = with_variance(isochron_ldtp, design)
        bound = hj.identify.cramer_rao(isochron_ldtp, htf)
        assert_allclose(said, bound.standard_errors[:1] ** 2, rtol=2e-3)
        unequal = dataclasses.replace(
            htf, variance=(htf.variance.T * (1 + 1e-6 * np.arange(5))).T
        )
        other = hj.identify.cramer_rao(isochron_ldtp, unequal)
        assert_allclose(other.covariance, bound.covariance, rtol=2e-3)


def test_the_hopper_with_its_input_limited(isochron_ldtp):
    """620 lines. An independent script, with all numerators free and complex (without the relation
    of H_{-m}(-w) to H_m(w)), saves 19.3 of 20.3 strides; deviations are 5.8 times larger."""
    plan = hj.optimal_design(isochron_ldtp)
    assert plan.saved == pytest.approx(19.17, abs=0.3)
    assert 1 <= plan.certificate < 1.03
    gain = plan.rms["yM"] / plan.usual_rms["yM"]
    assert gain == pytest.approx(5.83, abs=0.05)
    strongest = plan.frequencies[np.argmax(plan.power)]
    assert strongest == pytest.approx(0.3, abs=0.04)
    assert (
        f"cycle of this design replaces {plan.saved:.2g} with equal amplitudes."
        in repr(plan)
    )
    assert re.search(
        r"cycles +1280 +1280\n  standard error of -0.249\+0.6993j", repr(plan)
    )
    assert_allclose(plan.rms["u"], plan.usual_rms["u"])


def test_the_hopper_with_deviations_limited(isochron_ldtp, usual):
    plan = hj.optimal_design(isochron_ldtp, usual, limit="output")
    assert 1 < plan.saved < 1.05
    assert plan.certificate < 1.03
    assert plan.advice.endswith("limited, equal amplitudes are nearly optimal.")
    for n in ("yM", "vM"):
        allowed = plan.usual_rms[n] * (1 + 1e-9)
        assert plan.rms[n] <= allowed
    both = hj.optimal_design(
        isochron_ldtp, usual, limit={"u": 0.02, "yM": 0.001}, noise=NOISE
    )
    assert both.rms["u"] <= 0.02 * (1 + 1e-9)
    assert both.rms["yM"] <= 0.001 * (1 + 1e-9)
    assert both.limited == ("u", "yM")
    assert both.certificate < 1.04


def test_experiments_are_as_promised(plan, isochron_ldtp):
    """Power and deviations are those of the signals themselves, the same in all experiments."""
    powers = np.mean(plan.design.signals() ** 2, axis=(1, 2))
    assert_allclose(powers, plan.rms["u"] ** 2, rtol=1e-3)
    data = hj.experiments.simulate_experiments(
        isochron_ldtp, plan.design, start="periodic"
    )
    squares = data.y**2
    rms = np.sqrt(np.mean(squares, axis=(0, 1)))
    promised = [plan.rms["yM"], plan.rms["vM"]]
    assert_allclose(rms, promised, rtol=1e-3)
    assert plan.cycles == plan.usual.cycles(0)
    half = plan.standard_errors.max() / 2
    assert plan.cycles_for(half) == 4 * plan.cycles


def test_fits_reach_what_is_promised(model):
    """The plain analysis of a plan, most of whose lines stand in one experiment: their power
    weights them. 16 draws of the noise."""
    noise = {"x": 0.02, "v": 0.06}
    design = hj.multisine(8, periods=32)
    plan = hj.optimal_design(model, design.scaled(0.01), noise=noise)
    data = hj.experiments.simulate_experiments(model, plan.design, start="periodic")
    errors = []
    for seed in range(16):
        std = list(noise.values())
        noisy = hj.experiments.add_noise(data, std=std, seed=seed)
        fit = hj.fit_multipliers(hj.estimate_htf(noisy, HARMONICS), 2)
        errors.append(fit.compare(model.multipliers).error[0])
    rms = np.sqrt(np.mean(np.square(errors)))
    expected = np.linalg.norm(plan.standard_errors)
    assert rms == pytest.approx(expected, rel=0.3)


@pytest.mark.slow
def test_units_and_estimates(isochron_ldtp, usual):
    """Forces of 1e-16, 0.01 and 1e6; an estimate in place of the model."""
    a, b, c = (
        hj.optimal_design(isochron_ldtp, usual.scaled(rms))
        for rms in (1e-16, 0.01, 1e6)
    )
    assert (
        a.saved == pytest.approx(b.saved, rel=1e-6) == pytest.approx(c.saved, rel=1e-6)
    )
    assert (a.certificate, a.criterion) == pytest.approx(
        (b.certificate, b.criterion), rel=1e-6
    )
    fit = hj.fit_multipliers(with_variance(isochron_ldtp, usual), 2)
    for goal in ("multipliers", hj.designs.MultiplierGoal(0, "modulus")):
        estimated = hj.optimal_design(fit, usual, goal=goal, noise=NOISE)
        assert estimated.saved > 5
        assert estimated.certificate < 1.1
