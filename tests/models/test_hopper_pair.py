"""Two hoppers with two inputs. Truth: `python benchmarks/circuits_truth.py`."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj


OUTPUTS = ("yM1", "yM2")
SMALL = [2.05187165619280217e-9, 1.16996080957107642e-15]


@pytest.fixture(scope="module")
def placed():
    cycle = hj.find_limit_cycle(hj.models.HopperPair())
    return hj.sections.place_sections(cycle, hj.ClockPhase(16, anchor=0.5))


@pytest.mark.slow
def test_small_multipliers_are_not_dropped(placed):
    cycle = placed.cycle
    assert_allclose(cycle.multipliers[4:].real, SMALL, rtol=1e-6)
    model = hj.linearize(cycle, placed, OUTPUTS)
    assert model.inputs == ("u1", "u2")
    assert len(model.multipliers) == 6
    assert_allclose(model.multipliers[4:].real, SMALL, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("amplitude, accuracy", [(1e-2, 1e-3), (1e-5, 1e-6)])
def test_both_inputs_are_told_apart(placed, amplitude, accuracy):
    """All harmonics from both inputs to both outputs, estimated from a steady start."""
    design = hj.multisine(
        16, 32, (0, 4), amplitude=amplitude, lines="odd", inputs=("u1", "u2")
    )
    data = hj.run_experiments(
        placed.cycle, placed, design, OUTPUTS, start="steady", accuracy=1e-11
    )
    assert data.ok.all(), data.summary()
    estimate = hj.estimate_htf(data, harmonics=(-1, 0, 1))
    ldtp = hj.linearize(placed.cycle, placed, OUTPUTS)
    exact = ldtp.htf(estimate.frequencies, harmonics=(-1, 0, 1))
    assert estimate.H.shape[-2:] == (2, 2)
    assert np.max(estimate.error(exact)) < accuracy
