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
    assert_allclose(list(cycle.state.values()), truth["state"], atol=1e-12)
    apart = np.abs(
        (np.array(truth["multipliers"]) @ [1, 1j])[:, None] - cycle.multipliers
    )
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1e-12
    events = cycle.trajectory().events
    expected = [t for t, _ in truth["impacts"]]
    assert_allclose([e.time for e in events], expected)
    assert [e.name for e in events] == [f"impact {i}" for _, i in truth["impacts"]]


def test_events_that_coincide_neither_graze_nor_accumulate():
    cycle = hj.find_limit_cycle(hj.models.TrottingQuadruped())
    assert len(cycle.trajectory(2.0).events) == 8
    pace = np.array([[0.0], [np.inf], [0.0], [0.0]])
    event = np.ones(1, bool)
    for moved in [1.0, 0.0] * 9:
        pace, zeno = keep_pace(pace, np.array([moved]), event, ~event, 2.0)
        assert not zeno


@pytest.mark.slow
def test_each_order_of_the_feet_has_its_derivative():
    cycle = hj.find_limit_cycle(hj.models.TrottingQuadruped(thrust=1.0), throw=False)
    assert cycle.result == hj.Result.COINCIDENCE
    found = sorted(hj.coincidences(cycle), key=lambda x: x.time)
    assert_allclose([x.time for x in found], [0.48890534976601, 0.79608769379953])
    for both, expected in zip(found, (LET_GO, LAND), strict=True):
        assert not both.commute
        assert len(both.orders) == 2
        for order, derivative in zip(both.orders, both.derivatives, strict=True):
            sign = 1 if order[0].startswith("hind") else -1
            whole = np.eye(4)
            whole[1::2, ::2] = expected * np.array([[1, sign], [1, 1]])
            assert_allclose(derivative, whole, atol=1e-6)
