"""Optimal designs of the hopper, against bounds and simulations; sequences with their spectrum."""

import dataclasses
import functools

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.identify.multiplier_estimate import MultiplierEstimate

from .conftest import expected_htf, random_designs, total_variance


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


def variance(model, design):
    bound = hj.identify.multiplier_bound(model, with_variance(model, design))
    return total_variance(bound)


def variance_of_coefficients(htf, c, size):
    """Return the bound with complex numerators of the HTFs at f and -f, from all equations."""
    N, f = htf.n_sections, np.asarray(htf.f)
    H, std = np.asarray(htf.H), np.sqrt(np.asarray(htf.variance) / 2)
    both = np.concatenate([f, -f])
    powers = np.exp(-2j * np.pi / N * both[:, None] * np.arange(size))
    delays = np.exp(-2j * np.pi * both[:, None]) ** np.arange(1, len(c) + 1)
    chi = 1 + delays @ c
    information = np.zeros((len(c), len(c)))
    for row, m in enumerate(htf.harmonics):
        mirror = htf.harmonics.index(-m) if -m in htf.harmonics else None
        E = len(f) if mirror is None else 2 * len(f)
        for i, j in np.ndindex(H.shape[2:]):
            ends = [(H[row], std[row])] + (
                [] if mirror is None else [(H[mirror].conj(), std[mirror])]
            )
            h, w = (np.concatenate([x[k][:, i, j] for x in ends]) for k in (0, 1))
            q, _ = np.linalg.qr(powers[:E] / (chi[:E] * w)[:, None])
            slopes = delays[:E] * (h / chi[:E] / w)[:, None]
            left = slopes - q @ (q.conj().T @ slopes)
            information += (left.conj().T @ left).real / (1 if mirror is None else 2)
    return np.linalg.inv(information)


@pytest.mark.parametrize("harmonics", [(-1, 0, 1), (0, 1)])
@pytest.mark.parametrize("color", [0.0, 1.0])
def test_standard_errors_are_the_cramer_rao_bound(model, harmonics, color):
    """Also where the noise of H_m and H_{-m} differs, and without one of them."""
    spectrum = lambda f: 0.02 / np.sqrt(1 + color * f**2)  # noqa: E731
    usual = hj.multisine(8, periods=32).scaled(0.01)
    goal = hj.designs.Multipliers(harmonics=harmonics)
    plan = hj.optimal_design(model, usual, goal=goal, noise={"x": spectrum, "v": 0.06})
    c = np.poly(model.multipliers).real[1:]
    for design, said in ((plan.usual, plan.usual_variances), (plan.design, plan.variances)):
        htf = model.htf(design.frequencies, harmonics)
        f = np.abs((np.asarray(htf.f) + np.array(harmonics)[:, None] + 4) % 8 - 4)
        noise = np.stack([spectrum(f), np.full(f.shape, 0.06)], axis=2)[..., None]
        variance = noise**2 * design.expected_variance()[:, None]
        htf = dataclasses.replace(htf, variance=variance)
        covariance = variance_of_coefficients(htf, c, 3 * 8 + 1)
        bound = MultiplierEstimate(model.multipliers, c, covariance, np.inf)
        np.testing.assert_allclose(said, np.diag(bound.multiplier_covariances[0]), rtol=1e-4)
        same = hj.identify.multiplier_bound(model, htf)
        np.testing.assert_allclose(same.covariance, covariance, rtol=1e-4)


def test_no_other_design_is_better_than_the_certificate_allows(plan, isochron_ldtp):
    """With as much power at the input."""
    assert plan.certificate < 1.04
    shapes = [lambda f: np.exp(-((f - 0.3) ** 2)), lambda f: 1 / (0.1 + f), np.ones_like]
    shapes.append(lambda f: np.sqrt(np.interp(f, plan.frequencies, plan.power) + 1e-9))
    others = [hj.multisine(periods=32, amplitude=f).scaled(plan.usual_rms["u"]) for f in shapes]
    for other in [*others, *random_designs(2, plan.usual_rms["u"], periods=32)]:
        assert variance(isochron_ldtp, other) > plan.criterion / plan.certificate


def test_the_hopper_with_its_input_limited(isochron_ldtp):
    """620 lines. An independent script, with all numerators free and complex (without the relation
    of H_{-m}(-w) to H_m(w)), saves 19.3 of 20.3 strides; deviations are 5.8 times larger."""
    plan = hj.optimal_design(isochron_ldtp)
    assert plan.saved == pytest.approx(19.17, abs=0.3)
    assert 1 <= plan.certificate < 1.03
    assert plan.rms["yM"] / plan.usual_rms["yM"] == pytest.approx(5.83, abs=0.05)
    assert plan.frequencies[np.argmax(plan.power)] == pytest.approx(0.3, abs=0.04)
    assert "one stride does the work of 19" in repr(plan)
    np.testing.assert_allclose(plan.rms["u"], plan.usual_rms["u"])


def test_the_hopper_with_deviations_limited(isochron_ldtp, usual):
    plan = hj.optimal_design(isochron_ldtp, usual, limit="output")
    assert 1 < plan.saved < 1.05 and plan.certificate < 1.03
    assert "nearly optimal" in plan.advice
    assert all(plan.rms[n] <= plan.usual_rms[n] * (1 + 1e-9) for n in ("yM", "vM"))
    both = hj.optimal_design(isochron_ldtp, usual, limit={"u": 0.02, "yM": 0.001}, noise=NOISE)
    assert both.rms["u"] <= 0.02 * (1 + 1e-9) and both.rms["yM"] <= 0.001 * (1 + 1e-9)
    assert both.limited == ("u", "yM") and both.certificate < 1.04


def test_experiments_are_as_promised(plan, isochron_ldtp):
    """Power and deviations are those of the signals themselves, the same in all experiments."""
    u = plan.design.inputs()
    powers = np.mean(u**2, axis=(1, 2))
    np.testing.assert_allclose(powers, plan.rms["u"] ** 2, rtol=1e-3)
    data = hj.experiments.simulate_experiments(isochron_ldtp, plan.design, start="periodic")
    rms = np.sqrt(np.mean(data.y**2, axis=(0, 1)))
    np.testing.assert_allclose(rms, [plan.rms["yM"], plan.rms["vM"]], rtol=1e-3)
    assert plan.strides == plan.usual.cycles(0)
    assert plan.strides_for(plan.standard_errors.max() / 2) == 4 * plan.strides


def test_fits_reach_what_is_promised(model):
    """The plain analysis of a plan, most of whose lines stand in one experiment: their power
    weights them. 16 draws of the noise."""
    noise = {"x": 0.02, "v": 0.06}
    plan = hj.optimal_design(model, hj.multisine(8, periods=32).scaled(0.01), noise=noise)
    data = hj.experiments.simulate_experiments(model, plan.design, start="periodic")
    errors = []
    for seed in range(16):
        noisy = hj.experiments.add_noise(data, std=list(noise.values()), seed=seed)
        fit = hj.fit_multipliers(hj.estimate_htf(noisy, HARMONICS), 2)
        errors.append(fit.compare(model.multipliers).error[0])
    rms = np.sqrt(np.mean(np.square(errors)))
    assert rms == pytest.approx(np.linalg.norm(plan.standard_errors), rel=0.3)


def test_units_and_estimates(isochron_ldtp, usual):
    """Newtons, piconewtons and meganewtons; an estimate in place of the model."""
    a, b, c = (hj.optimal_design(isochron_ldtp, usual.scaled(rms)) for rms in (1e-12, 0.01, 1e6))
    assert a.saved == pytest.approx(b.saved, rel=1e-6) == pytest.approx(c.saved, rel=1e-6)
    assert a.certificate == pytest.approx(b.certificate, rel=1e-6)
    fit = hj.fit_multipliers(with_variance(isochron_ldtp, usual), 2)
    for goal in ("multipliers", hj.designs.Multipliers(0, "modulus")):
        estimated = hj.optimal_design(fit, usual, goal=goal, noise=NOISE)
        assert estimated.saved > 5 and estimated.certificate < 1.1
