"""Limit cycles and multipliers of the models, against numbers from elsewhere.

They were computed apart from this package, with DOP853 and mpmath to 34 digits, or follow from the
closed forms that the models give as `exact`. Both to 1e-9, relative to the largest.
"""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj


m = hj.models


class Case(NamedTuple):
    system: hj.HybridSystem
    section: object
    state: dict[str, float]
    """At the section, or for a clocked system at the guess's phase of the clock."""
    period: float
    multipliers: list[complex]
    guess: hj.Guess | None = None
    accuracy: float = 1e-9
    """Of the multipliers that are compared with, relative to the largest."""


def pair(z):
    return [z, np.conj(z)]


CASES = {
    "wheel, 8 spokes": lambda: Case(
        m.RimlessWheel(),
        hj.AtEvent("impact"),
        {"w": 0.349754367432510},
        3.24030513899839,
        [0.5],
    ),
    "walker, long gait": lambda: Case(
        m.SimplestWalker(),
        hj.AtEvent("heelstrike"),
        {"th": 0.200310900544247, "w": -0.199832473004952, "p": -0.0158229999483094},
        3.88246375285137,
        pair(-0.190099841065888 + 0.557598776682068j),
    ),
    "walker, short gait": lambda: Case(
        m.SimplestWalker(),
        hj.AtEvent("heelstrike"),
        {"th": 0.193937369810182, "w": -0.203866927442007, "p": -0.0151442608531916},
        3.09610586807816,
        [4.00386435892970, 0.459589589797671],
        m.SimplestWalker().short_gait(),
    ),
    "compass gait": lambda: Case(
        m.CompassGait(),
        hj.AtEvent("heelstrike"),
        {
            "n": -0.323388558058650,
            "s": 0.218668802938991,
            "vn": -0.377373948907194,
            "vs": -1.09238358988360,
        },
        0.734346391158719,
        [*pair(-0.199726126830030 + 0.544476062094737j), 0.131572624077177],
    ),
    # benchmarks/walkers_truth.py: multipliers by differences.
    "walker with a torso": lambda: Case(
        m.TorsoWalker(),
        hj.AtEvent("touchdown"),
        {"w1": 0.93945818569188, "w2": -0.276319085413138, "w3": 2.038552874507603},
        0.8253089285135,
        [0.558921496182006, 2.129597704e-06, 5.85308700e-07, 4.9e-09, 0.0],
        accuracy=1e-7,
    ),
    "biped": lambda: Case(
        m.FiveLinkBiped(),
        hj.AtEvent("touchdown"),
        {
            "shin": -0.07545793171395,
            "torso": 0.200392979580986,
            "shin_rate": 4.014488848102268,
            "swing_thigh_rate": 1.64573353402656,
            "swing_shin_rate": 1.111805909135972,
        },
        0.25946315221826,
        [
            0.9365565991540,
            0.2106146374910,
            0.01714336047405,
            *pair(0.005638528689762 + 0.004702903938051j),
            0.004783922552855,
            0.001857583000819,
            0.001466407402454,
            4.28e-07,
        ],
        accuracy=1e-7,
    ),
    "Hopf": lambda: Case(
        m.HopfOscillator(),
        hj.Crossing("y", "rising"),
        {"x": 0.1**0.5},
        1.0,
        [0.818730753077982],
    ),
    "buck, 20 V": lambda: Case(
        m.BuckConverter(),
        None,
        {"v": 11.9695115388150, "i": 0.591571935915189},
        400e-6,
        pair(-0.691894155835222 + 0.447746968999235j),
    ),
    # benchmarks/circuits_truth.py
    "Cuk": lambda: Case(
        m.CukConverter(),
        None,
        {},
        1e-4,
        [
            *pair(0.847302228159268509 + 0.427350687398246989j),
            -0.694479389634475538,
            0.643345392432610566,
        ],
    ),
    "Chua": lambda: Case(
        m.ChuaCircuit(),
        hj.AtEvent("in from the right"),
        {"y": -0.353955823706872261, "z": -1.30745627116776352},
        2.24999942882252869,
        [-0.677312642613658609, -0.0195673404468831832],
    ),
    "two hoppers": lambda: Case(
        m.HopperPair(),
        None,
        {
            "yM1": 1.97213079107715757,
            "vM1": 1.90755607902683041,
            "yM2": 1.60275702526714838,
            "ym2": 0.551874314166019861,
            "vm2": -2.70537524360854137,
        },
        1.0,
        [
            *pair(-0.439196992225001708 + 0.611321029449368104j),
            *pair(-0.248558676124545596 + 0.697949554160020074j),
            2.05187165619280217e-9,
            1.16996080957107642e-15,
        ],
    ),
    # benchmarks/neurons_truth.py
    "Izhikevich": lambda: Case(
        m.IzhikevichNeuron(),
        None,
        {"v": -74.45966208977282, "w": -4.641986302955417},
        40.0,
        [0.48958210923116263, -1.5695975926619675e-11],
    ),
    "AdEx": lambda: Case(
        m.AdExNeuron(),
        None,
        {"v": -52.90902649296591, "w": 350.66438388017474},
        40.0,
        [0.7474603512727481, 0.17911718353685366],
    ),
    # benchmarks/trot_truth.py: multipliers by differences.
    "trot": lambda: Case(
        m.TrottingQuadruped(),
        None,
        {"y": 0.376873156491, "v": -0.971912849051},
        1.0,
        [
            *pair(-0.08768800113731487 + 0.4750481690903344j),
            *pair(0.18391330048481577 + 0.35828647799688856j),
        ],
        accuracy=1e-7,
    ),
    "flap, 12": lambda: Case(
        m.RotorFlap(), None, {}, 2 * np.pi, [-0.0215994758114450, -0.00373617944596341]
    ),
    "Mathieu, 0.25": lambda: Case(
        m.Mathieu(delta=0.25, epsilon=0.1),
        None,
        {"x": 0.0},
        2 * np.pi,
        [-0.728150761133001, -0.390866230632208],
    ),
}


# The others compile for as long again.
QUICK = {"wheel, 8 spokes", "compass gait", "buck, 20 V"}


def marks(name):
    return [] if name in QUICK else [pytest.mark.slow]


@pytest.mark.parametrize("name", [pytest.param(x, marks=marks(x)) for x in CASES])
def test_cycle_and_multipliers(name):
    case = CASES[name]()
    cycle = hj.find_limit_cycle(case.system, case.guess, section=case.section)
    assert_allclose(cycle.period, case.period, rtol=1e-9)
    for state, value in case.state.items():
        assert_allclose(cycle.state[state], value, rtol=1e-9, atol=1e-12)
    size = np.max(np.abs(case.multipliers))
    assert_allclose(
        cycle.multipliers, case.multipliers, rtol=0, atol=case.accuracy * size
    )


@pytest.mark.slow
def test_where_no_section_is_met_again_one_is_asked_for():
    wheel = m.RimlessWheel()
    angle = float(wheel.slope - wheel.alpha)
    after_impact = hj.Guess("swing", (angle, 0.45))
    with pytest.raises(
        hj.errors.ComputationError, match=r"section=AtEvent\('impact'\)"
    ):
        hj.find_limit_cycle(wheel, after_impact)
    cycle = hj.find_limit_cycle(wheel, after_impact, section=hj.AtEvent("impact"))
    assert_allclose(cycle.multipliers, [wheel.exact()[1]], rtol=1e-9)
    # A guess that says so is enough, and is where Newton's method starts.
    said = hj.Guess("swing", after_impact.state, after="impact")
    again = hj.find_limit_cycle(wheel, said)
    assert again.base.name == "impact"
    assert float(again.anchor.t[0]) == 0
    assert_allclose(again.multipliers, cycle.multipliers, rtol=1e-9)
