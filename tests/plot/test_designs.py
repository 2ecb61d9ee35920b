"""Figures of designs show what they say."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj


MODEL = hj.LDTP(np.full((4, 1, 1), 0.9), np.ones((4, 1, 1)), np.ones((4, 1, 1)))
USUAL = hj.multisine(4, 16, band=(0, 2.0))
GOAL = hj.designs.Multipliers(harmonics=0)
ASKED = dict(noise={"y": 1e-3}, goal=GOAL)


@pytest.fixture(scope="module")
def plan():
    return hj.optimal_design(MODEL, USUAL, **ASKED)


def test_the_spectrum_of_a_design(plan):
    above, below = hj.plot.spectrum(plan, MODEL).axes[:, 0]
    f = np.unique(plan.frequencies)
    H = np.abs(np.asarray(MODEL.htf(f, 0).H)[0, :, 0, 0])
    assert_allclose(above.get_lines()[0].get_ydata(), H / H.max())
    usual, optimal = below.get_lines()
    measured = np.sum(np.square(optimal.get_ydata()) / 2)
    assert_allclose(measured, plan.power.sum())
    assert_allclose(usual.get_ydata(), np.sqrt(2 * plan.usual_power))
    assert below.get_ylabel() == "amplitude, rms\nover experiments"
    legend = [x.get_text() for x in below.get_legend().get_texts()]
    assert legend == [plan.usual_name, "optimal"] == ["equal amplitudes", "optimal"]
    with pytest.raises(
        hj.DefinitionError, match="not the one that the plan was made for"
    ):
        hj.plot.spectrum(plan, hj.testing.synthetic_ldtp())


def test_what_strides_buy(plan):
    study = hj.designs.Study(USUAL, 1, 1e-9, goal=GOAL)
    data = hj.experiments.simulate_experiments(MODEL, USUAL, start="periodic")
    studied = study.add(hj.experiments.add_noise(data, std=1e-3))
    # (More of them than there are colors.)
    others = {f"there {k}": studied for k in range(8)}
    ax = hj.plot.strides(plan, {"here": [studied, studied]} | others).ax
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert lines["here"].get_xdata() == studied.strides
    assert lines["here"].get_ydata() == np.linalg.norm(studied.standard_errors)
    equal = lines["equal amplitudes"]
    at = np.interp(
        np.log(USUAL.cycles(0)), np.log(equal.get_xdata()), np.log(equal.get_ydata())
    )
    assert np.exp(at) == pytest.approx(np.linalg.norm(plan.usual_standard_errors))
    with pytest.raises(hj.DefinitionError, match="without a block"):
        hj.plot.strides(plan, {"here": study})
