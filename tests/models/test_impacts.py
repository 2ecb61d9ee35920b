"""Impacts: the truth is from `python benchmarks/chain_truth.py` and `trot_truth.py`."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.engine.events import keep_pace

from ..conftest import DATA


TRUTH = json.loads((DATA / "bouncing_chain.json").read_text())
# Of the rates of heave and pitch by height and pitch; the rest is the identity. By what the foot
# that is first does, the coupling changes its sign.
LET_GO = [[1.528341, 0.235829], [0.0, 2.5]]
LAND = [[-2.390006, -0.195003], [0.0, -2.5]]


@pytest.mark.parametrize(
    "n", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 5, 10))]
)
def test_the_cycle_and_its_multipliers(n):
    cycle = hj.find_limit_cycle(hj.models.BouncingChain(n=n))
    truth = TRUTH[str(n)]
    state = list(cycle.state.values())
    assert_allclose(state, truth["state"], atol=1e-12)
    multipliers = np.array(truth["multipliers"]) @ [1, 1j]
    differences = np.abs(multipliers[:, None] - cycle.multipliers)
    from_found = differences.min(axis=0)
    assert from_found.max() < 1e-12, "each that was found is a true one"
    from_true = differences.min(axis=1)
    assert from_true.max() < 1e-12, "each true one was found"

    events = cycle.trajectory().events
    times, masses = zip(*truth["impacts"], strict=True)
    assert_allclose([event.time for event in events], times)
    names = [event.name for event in events]
    assert names == [f"impact {i}" for i in masses]


@pytest.mark.slow
def test_events_that_coincide_neither_graze_nor_accumulate():
    cycle = hj.find_limit_cycle(hj.models.TrottingQuadruped())
    assert len(cycle.trajectory(2.0).events) == 8
    pace = np.array([[0.0], [np.inf], [0.0], [0.0]])
    event = np.ones(1, bool)
    for moved in [1.0, 0.0] * 9:
        times = np.array([moved])
        pace, zeno = keep_pace(pace, times, event, ~event, 2.0, 2)
        assert not zeno


@pytest.mark.slow
def test_each_order_of_the_feet_has_its_derivative():
    cycle = hj.find_limit_cycle(hj.models.TrottingQuadruped(thrust=1.0), throw=False)
    assert cycle.result == hj.errors.Result.SIMULTANEOUS
    let_go, land = sorted(cycle.simultaneous_events(), key=lambda both: both.time)
    assert_allclose(let_go.time, 0.48890534976601)
    assert_allclose(land.time, 0.79608769379953)
    for both, size in ((let_go, LET_GO), (land, LAND)):
        assert not both.commute
        assert len(both.orders) == 2
        for order, derivative in zip(both.orders, both.derivatives, strict=True):
            sign = 1 if order[0].startswith("hind") else -1
            expected = np.eye(4)
            signs = np.array([[1, sign], [1, 1]])
            expected[1::2, ::2] = size * signs
            assert_allclose(derivative, expected, atol=1e-6)
