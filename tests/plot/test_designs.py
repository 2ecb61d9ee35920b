"""Figures of designs show what they say."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj


ONES = np.ones((4, 1, 1))
DECAY = np.full((4, 1, 1), 0.9)
MODEL = hj.linear.LDTP(DECAY, ONES, ONES)
USUAL = hj.multisine(4, 16, frequencies=(0, 2.0))
GOAL = hj.designs.MultiplierGoal(harmonics=0)
ASKED = dict(noise={"y": 1e-3}, goal=GOAL)


@pytest.fixture(scope="module")
def plan():
    return hj.optimal_design(MODEL, USUAL, **ASKED)


def test_the_spectrum_of_a_design(plan):
    axes = hj.plot.spectrum(plan, MODEL).axes
    above, below = axes[:, 0]
    f = np.unique(plan.frequencies)
    htf = MODEL.htf(f, 0)
    response = np.asarray(htf.H)
    H = response[0, :, 0, 0]
    modulus = np.abs(H)
    (drawn,) = above.get_lines()
    assert_allclose(drawn.get_ydata(), modulus / modulus.max())

    usual, optimal = below.get_lines()
    power = np.square(optimal.get_ydata()) / 2
    assert_allclose(power.sum(), plan.power.sum())
    amplitude = np.sqrt(2 * plan.usual_power)
    assert_allclose(usual.get_ydata(), amplitude)
    assert below.get_ylabel() == "amplitude, rms\nover experiments"
    assert plan.usual_name == "equal amplitudes"
    legend = [text.get_text() for text in below.get_legend().get_texts()]
    assert legend == ["equal amplitudes", "optimal"]
    with pytest.raises(
        hj.errors.DefinitionError, match="not the one that the plan was made for"
    ):
        hj.plot.spectrum(plan, hj.testing.synthetic_ldtp())


def test_what_strides_buy(plan):
    study = hj.designs.SequentialDesign(USUAL, 1, 1e-9, goal=GOAL)
    data = hj.experiments.simulate_experiments(MODEL, USUAL, start="periodic")
    noisy = hj.experiments.add_noise(data, std=1e-3)
    studied = study.add(noisy)
    more_than_colors = {f"there {k}": studied for k in range(8)}
    studies = {"here": [studied, studied], **more_than_colors}
    ax = hj.plot.standard_errors(plan, studies).ax
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert lines["here"].get_xdata() == studied.cycles
    assert lines["here"].get_ydata() == np.linalg.norm(studied.standard_errors)

    strides, errors = lines["equal amplitudes"].get_data()
    of_usual = np.log(USUAL.cycles(0))
    log_strides = np.log(strides)
    log_error = np.interp(of_usual, log_strides, np.log(errors))
    expected = np.linalg.norm(plan.usual_standard_errors)
    assert np.exp(log_error) == pytest.approx(expected)
    with pytest.raises(hj.errors.DefinitionError, match="without a block"):
        hj.plot.standard_errors(plan, {"here": study})
