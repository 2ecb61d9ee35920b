"""Inputs at some sections of the cycle only, and the information at each section."""

import numpy as np
import pytest

import hybridjax as hj

from .conftest import TWO_NOISE


GOAL = hj.designs.Multipliers(harmonics=(-1, 0, 1))
NOISE = {"x": 1e-4, "v": 3e-4}


def test_estimates_are_those_of_the_system_from_the_signal(two, two_usual):
    """Inputs through windows by hand; they have the rms of the signal."""
    window = hj.designs.Window([1, 1, 0, 0, 1, 0])
    u = window.pushes(two_usual)
    assert not u.reshape(-1, 6, 2)[:, [2, 3, 5]].any()
    np.testing.assert_allclose(np.mean(u**2), np.mean(two_usual.inputs() ** 2), rtol=1e-9)
    x0 = two.periodic_states(u, 32)
    y = np.stack([two.simulate(signal, x) for signal, x in zip(u, x0, strict=True)])
    data = hj.ExperimentData(u, y, n_sections=6, periods=32, inputs=two.inputs)
    estimate = hj.estimate_htf(window.with_signal(data, two_usual))
    exact = window.seen_from_signal(two).htf(estimate.f, estimate.harmonics)
    np.testing.assert_allclose(estimate.H, exact.H, atol=1e-9)


def test_the_best_window_is_the_best_of_all_arcs(two, two_usual, optimal_two):
    asked = dict(goal=GOAL, noise=TWO_NOISE, limit={"u0": 0.1, "u1": 0.05})
    choice = hj.designs.choose_window(two, two_usual, **asked, shortest=3)
    weights = [np.isin(np.arange(6), (first + np.arange(3)) % 6) * 1.0 for first in range(6)]
    models = [hj.designs.Window(w).seen_from_signal(two) for w in weights]
    every = [hj.optimal_design(model, two_usual, **asked).criterion for model in models]
    assert choice.plan.criterion == pytest.approx(min(every))
    assert choice.saved == pytest.approx(optimal_two().criterion / min(every)) and choice.saved > 1
    assert choice.certificate.max() < 1.03 and "does the work of" in repr(choice)


def test_windows_are_halved_more_than_once():
    """With one slow state, the sum of B in the window counts, by the root of its length: the best
    half is that from 4 on, and the best two sections lie half before it. (In arcs where an input
    has no effect there is nothing to design.)"""
    B = np.array([0, 0, 0, 0.9, 1, 0.5, 0.5, 0.5])[:, None, None]
    slow = hj.LDTP(np.full((8, 1, 1), 0.99), B, np.ones((8, 1, 1)))
    asked = dict(noise={"y": 0.01}, limit={"u": 0.1})
    choice = hj.designs.choose_window(
        slow, hj.multisine(8, 16, band=(0, 2)), **asked,
        goal=hj.designs.Multipliers(harmonics=0, overhang=0),
    )  # fmt: skip
    assert np.flatnonzero(choice.window.weights).tolist() == [3, 4]
    share = np.array([3.4**2 / 8, 2.5**2 / 4, 1.9**2 / 2, 1.0])
    best = [choice.criterion[choice.length == length].min() for length in (8, 4, 2, 1)]
    np.testing.assert_allclose(best[0] / best, share / share[0], rtol=0.1)
    same = hj.LDTP(np.full((4, 1, 1), 0.8), np.ones((4, 1, 1)), np.ones((4, 1, 1)))
    goal = hj.designs.Multipliers(harmonics=0)
    choice = hj.designs.choose_window(same, hj.multisine(4, 32, band=(0, 2)), goal=goal, **asked)
    assert choice.window is None and choice.saved == 1
    assert "nothing is gained" in repr(choice)


def test_bad_windows(two, two_usual):
    with pytest.raises(hj.DefinitionError, match="different from zero"):
        hj.designs.Window(np.zeros(6))
    with pytest.raises(hj.DefinitionError, match="has 4 sections, the model 6"):
        hj.designs.Window(np.ones(4)).seen_from_signal(two)
    with pytest.raises(hj.DefinitionError, match="has 4 sections, the design 6"):
        hj.designs.Window(np.ones(4)).pushes(two_usual)


@pytest.mark.parametrize("weights", [None, (1.0, -2.0)])
def test_lines_have_the_information_that_the_certificate_says(model, weights):
    """Power times sensitivity, which comes from other equations."""
    usual = hj.multisine(8, periods=32).scaled(0.003)
    goal = hj.designs.Multipliers(weights=weights)
    plan = hj.optimal_design(model, usual, noise=NOISE, goal=goal)
    info = hj.designs.information_map(model, plan.design, noise=NOISE, goal=goal)
    used = plan.power > 0
    share = (plan.power * plan.sensitivity)[used]
    np.testing.assert_array_equal(info.f, plan.frequencies[used])
    by_line, expected = info.share.sum(axis=(0, 2)), share / share.sum()
    np.testing.assert_allclose(by_line, expected, atol=1e-3 * expected.max())
    assert info.share.sum() == pytest.approx(1) and "best section" in repr(info)


def test_information_at_phases():
    """With all harmonics. An output that exists at one section only has its information there;
    where all sections are alike, so is the information."""
    design = hj.multisine(4, periods=32, band=(0, 2))
    for C, harmonics in (([0, 1, 0, 0], (-2, -1, 0, 1)), ([1, 1, 1, 1], 0)):
        model = hj.LDTP(np.full((4, 1, 1), 0.9), np.ones((4, 1, 1)), np.reshape(C, (4, 1, 1)))
        goal = hj.designs.Multipliers(harmonics=harmonics)
        info = hj.designs.information_map(model, design, noise={"y": 1.0}, goal=goal)
        np.testing.assert_allclose(info.share.sum(axis=(0, 1)), np.divide(C, sum(C)), atol=1e-9)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(noise={}), "`noise` names no output"),
        (dict(design=hj.multisine(8, inputs=2)), "must have one input"),
        (dict(goal=hj.designs.Multipliers(estimator="fit_ldtp")), "estimator fit_multipliers"),
        (dict(goal=hj.designs.Multipliers(harmonics=(0, 1))), "symmetric about 0"),
        (dict(design=hj.multisine(8, periods=4)), "frequencies are too few"),
    ],
)
def test_bad_maps(model, change, message):
    given = dict(design=hj.multisine(8, periods=16), noise=NOISE) | change
    with pytest.raises(hj.DefinitionError, match=message):
        hj.designs.information_map(model, **given)
