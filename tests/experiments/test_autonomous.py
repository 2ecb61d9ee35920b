"""Autonomous systems have no clock: what time-based sections of theirs mean is said."""

import pytest

import hybridjax as hj


def test_clock_sections_of_an_autonomous_system(vanderpol_cycle):
    family = hj.ClockPhase(8, anchor=hj.Crossing("v", "falling"))
    design = hj.multisine(n_sections=8, periods=4, band=(0, 2.0))
    with pytest.raises(hj.DefinitionError, match=r"has no clock.*multiplier of exactly 1.*Kinemat"):
        hj.run_experiments(vanderpol_cycle, family, design, "x")
    # Between such sections the multiplier 1 is there, and makes whole frequencies resonant.
    model = hj.linearize(vanderpol_cycle, family, "x")
    assert abs(model.multipliers[0] - 1) < 1e-9
    with pytest.raises(hj.DefinitionError, match="use sections that depend on the state"):
        model.htf([1.0])
    model.htf([0.5])
