"""Where experiments learn, against sensitivities, and where it is known by construction."""

import numpy as np
import pytest

import hybridjax as hj


NOISE = {"x": 1e-4, "v": 3e-4}


@pytest.mark.parametrize("weights", [None, (1.0, 0.0), (1.0, -2.0)])
def test_lines_have_the_information_that_the_certificate_says(model, weights):
    """Power times sensitivity, which comes from other equations."""
    usual = hj.multisine(8, periods=32).scaled(0.003)
    goal = hj.designs.Multipliers(weights=weights)
    plan = hj.optimal_design(model, usual, noise=NOISE, goal=goal)
    found = hj.designs.information_map(model, plan.design, noise=NOISE, goal=goal)
    used = plan.power > 0
    share = (plan.power * plan.sensitivity)[used]
    np.testing.assert_array_equal(found.f, plan.frequencies[used])
    np.testing.assert_allclose(
        found.share.sum(axis=(0, 2)), share / share.sum(), atol=1e-3 * share.max() / share.sum()
    )
    assert found.share.sum() == pytest.approx(1)
    assert "x" in repr(found) and "best section" in found._repr_html_()


def decaying(C):
    """One state, four sections, measured by C[n]."""
    return hj.LDTP(np.full((4, 1, 1), 0.9), np.ones((4, 1, 1)), np.reshape(C, (4, 1, 1)))


def test_phases():
    """With all harmonics. What is measured at one section only is learnt there; where all sections
    are alike, so is what is learnt."""
    design = hj.multisine(4, periods=32, band=(0, 2))
    goal = hj.designs.Multipliers(harmonics=(-2, -1, 0, 1))
    one = hj.designs.information_map(decaying([0, 1, 0, 0]), design, noise={"y": 1.0}, goal=goal)
    np.testing.assert_allclose(one.share.sum(axis=(0, 1)), [0, 1, 0, 0], atol=1e-9)
    goal = hj.designs.Multipliers(harmonics=0)
    same = hj.designs.information_map(decaying([1, 1, 1, 1]), design, noise={"y": 1.0}, goal=goal)
    np.testing.assert_allclose(same.share.sum(axis=(0, 1)), 0.25, rtol=1e-9)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(noise={"z": 1.0}), "`noise` names 'z'; the outputs are x, v"),
        (dict(noise={}), "`noise` names no output"),
        (dict(design=hj.multisine(8, inputs=2)), "must have one input"),
        (dict(goal=hj.designs.Multipliers(estimator="fit_ldtp")), "for fit_multipliers only"),
        (dict(goal=hj.designs.Multipliers(harmonics=(0, 1))), "symmetric about 0"),
        (dict(design=hj.multisine(8, periods=4)), "frequencies are too few"),
    ],
)
def test_bad_input(model, change, message):
    given = dict(design=hj.multisine(8, periods=16), noise=NOISE) | change
    with pytest.raises(hj.DefinitionError, match=message):
        hj.designs.information_map(model, **given)
