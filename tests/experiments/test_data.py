"""Experiment data: simulation of linear models, summaries, bad records."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.experiments.data import Simulated

from ..linear.conftest import blocks_at_random, simulate_blocks


BLOCKS = blocks_at_random(3, (2, 3, 1, 2), ny=2, nu=2)
DESIGN = hj.multisine(
    n_sections=4,
    periods=5,
    frequencies=(0, 2.0),
    inputs=("a", "b"),
)


@pytest.fixture(scope="module")
def model():
    return hj.linear.LDTP.from_blocks(*BLOCKS, inputs=("a", "b"))


def test_simulation_from_the_cycle_is_the_definition(model):
    data = hj.experiments.simulate_experiments(model, DESIGN, discard=3)
    assert data.u.shape == (DESIGN.experiments, 8 * 4, 2)
    for u, y in zip(data.u, data.y, strict=True):
        _, expected = simulate_blocks(BLOCKS, u, np.zeros(2))
        assert_allclose(y, expected, atol=1e-14)
    assert data.inputs == ("a", "b")
    assert data.outputs == ("y0", "y1")
    expected_summary = f"{DESIGN.experiments}/{DESIGN.experiments} ok"
    assert data.summary() == expected_summary
    for start, cycles in (("cycle", 25), ("periodic", 5)):
        data = hj.experiments.simulate_experiments(model, DESIGN, start=start)
        assert data.u.shape[1] == cycles * 4
    unstable = hj.linear.LDTP(
        2 * np.ones((4, 1, 1)),
        np.ones((4, 1, 2)),
        np.ones((4, 2, 1)),
        inputs=("a", "b"),
    )
    with pytest.raises(hj.errors.DefinitionError, match="the model is unstable"):
        hj.experiments.simulate_experiments(unstable, DESIGN)


def test_failed_experiments_are_named():
    y = np.ones((80, 84 * 32, 1))
    y[17, 41 * 32 + 21 :] = np.nan
    result = np.zeros(80, int)
    failed_at = np.full(80, -1)
    result[17] = hj.errors.Result.SECTION_MISSED
    failed_at[17] = 41 * 32 + 21
    usual = dict(n_sections=32, periods=64, result=result)
    data = hj.experiments.ExperimentData(
        np.ones_like(y), y, **usual, simulated=Simulated(failed_at)
    )
    assert data.summary() == (
        "79/80 ok; #17: section 21, cycle 41: the section was not crossed within the time allowed"
    )
    assert data.ok.sum() == 79
    assert not data.ok[17]
    assert "79/80 ok" in repr(data)
    result[:8] = hj.errors.Result.BLOW_UP
    assert (
        hj.experiments.ExperimentData(np.ones_like(y), y, **usual)
        .summary()
        .endswith("and 4 more")
    )


def test_pairs_keep_the_causes_and_delays_of_a_plant():
    u = np.array([[1.0], [-1.0]] * 2)[..., None] * np.ones((4, 8, 1))
    codes = hj.errors.Result
    result = [codes.OK, codes.PLANT_STOPPED, codes.OK, codes.OK]
    late = np.arange(32.0).reshape(4, 8)
    about = dict(n_sections=4, periods=2)
    simulated = Simulated(
        np.array([-1, 3, -1, -1]), late=late, causes=("", "it fell", "", "")
    )
    data = hj.experiments.ExperimentData(
        u, u, result=result, simulated=simulated, **about
    )
    odd = data.odd_part()
    assert odd.summary() == "1/2 ok; #0: section 3, cycle 0: it fell"
    assert_allclose(odd.simulated.late, np.maximum(late[::2], late[1::2]))
    # Without a simulation there is none, as for measured data.
    measured = hj.experiments.ExperimentData(u, u, **about)
    assert measured.odd_part().simulated is None
