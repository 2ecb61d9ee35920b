"""Stiff cycles against numbers from elsewhere: `python benchmarks/stiff_truth.py` prints them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj


m = hj.models
RISING = hj.Crossing("v", "rising")

# Period, largest value of the first state (at the section), logarithm of the multiplier.
PLANAR = {
    "van der Pol, mu = 100": (
        lambda: m.VanDerPol(100.0, solver=hj.systems.Radau()),
        hj.Crossing("v", "falling"),
        162.83707109237002,
        2.001318681177219,
        -28997.98845728604,
    ),
    "van der Pol, mu = 1000": (
        lambda: m.VanDerPol(1000.0, solver=hj.systems.Radau()),
        hj.Crossing("v", "falling"),
        1614.401125808362,
        2.0000729660025987,
        -2886973.413087638,
    ),
    "FitzHugh-Nagumo, eps = 0.01": (
        lambda: m.FitzHughNagumo(0.01),
        RISING,
        2.2664798709184097,
        1.979875977597529,
        -307.861545527702,
    ),
    "FitzHugh-Nagumo, eps = 0.001": (
        lambda: m.FitzHughNagumo(0.001),
        RISING,
        2.0236220375464753,
        1.9983293349844484,
        -3042.5861564245006,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANAR)
def test_relaxation_oscillations(name):
    make, section, period, top, logarithm = PLANAR[name]
    cycle = hj.find_limit_cycle(make(), section=section)
    assert float(cycle.period) == pytest.approx(period, rel=1e-9)
    t, x = cycle.trajectory()(next(iter(cycle.state)))
    if "x" in cycle.state:
        at_top = cycle.state["x"]
    else:
        at_top = _top(cycle, t[np.argmax(x)])
    assert at_top == pytest.approx(top, rel=1e-9)
    assert cycle.log_multipliers == pytest.approx([logarithm], rel=1e-6)
    assert cycle.is_stable


def _top(cycle, near):
    """The largest v, where w is on the nullcline of v: the cycle's next crossing of that."""

    def level(t, q):
        cubic = q[0] - q[0] ** 3 / 3
        return cubic - q[1] + 0.5

    falls = hj.sections.SectionList([hj.Crossing(level, "falling")])
    placed = hj.sections.place_sections(cycle, falls)
    return float(placed.lanes.q[0, 0])


@pytest.mark.slow
def test_the_hopper_on_a_compliant_ground():
    """With default settings; mpmath gives 20 digits."""
    cycle = hj.find_limit_cycle(m.CompliantHopper())
    state = [
        1.9651439811723552967,
        1.8755349450317062059,
        -7.3255629625297901e-5,
        0.0016616904927162742,
    ]
    states = np.array(list(cycle.state.values()))
    scales = list(cycle.scale.values())
    found = states / scales
    scale = np.array(list(cycle.scale.values()))
    expected = state / scale
    assert_allclose(found, expected, atol=1e-11)
    z = -0.24885118328047069434 + 0.69922500780850327787j
    pair = [z, z.conjugate()]
    assert_allclose(cycle.multipliers[:2], pair, atol=1e-12)
    assert cycle.multipliers[2] == pytest.approx(1.6159409134125691e-4, abs=1e-14)
    model = hj.linearize(cycle, hj.ClockPhase(16))
    pair_of_model = [z, z.conjugate()]
    assert_allclose(model.multipliers[:2], pair_of_model, atol=1e-10)
