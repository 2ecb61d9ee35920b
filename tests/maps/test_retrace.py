"""Other numbers, same programs."""

import hybridjax as hj

from ..conftest import ISOCHRONS, KINEMATIC, OUTPUTS, no_compilation


def analyze(cycle):
    for family in (ISOCHRONS, KINEMATIC):
        placed = hj.place_sections(cycle, family)
        _ = hj.linearize(cycle, placed, OUTPUTS).multipliers


def test_another_hopper_compiles_nothing(hopper_cycle, isochron_ldtp, kinematic_ldtp):
    for numbers in ({"k": 10.05}, {"k": 10.07, "M": 2.01}):
        analyze(hj.find_limit_cycle(hj.models.VerticalHopper(**numbers)))
    with no_compilation():
        analyze(hj.find_limit_cycle(hj.models.VerticalHopper(k=10.1, M=2.02)))
