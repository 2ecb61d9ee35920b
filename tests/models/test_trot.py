"""Feet that land together: derivatives by order, from `python benchmarks/trot_truth.py`."""

import numpy as np
import pytest

import hybridjax as hj


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cycle():
    return hj.find_limit_cycle(hj.models.TrottingQuadruped(thrust=1.0), throw=False)


# Of the rates of heave and pitch by height and pitch; the rest is the identity. By what the foot
# that is first does, the coupling changes its sign.
LET_GO = [[1.528341, 0.235829], [0.0, 2.5]]
LAND = [[-2.390006, -0.195003], [0.0, -2.5]]


def test_each_order_of_the_feet_has_its_derivative(cycle):
    assert cycle.result == hj.Result.COINCIDENCE
    found = sorted(hj.coincidences(cycle), key=lambda x: x.time)
    np.testing.assert_allclose([x.time for x in found], [0.48890534976601, 0.79608769379953])
    for both, expected in zip(found, (LET_GO, LAND), strict=True):
        assert not both.commute and len(both.orders) == 2
        for order, derivative in zip(both.orders, both.derivatives, strict=True):
            sign = 1 if order[0].startswith("hind") else -1
            whole = np.eye(4)
            whole[1::2, ::2] = expected * np.array([[1, sign], [1, 1]])
            np.testing.assert_allclose(derivative, whole, atol=1e-6)
