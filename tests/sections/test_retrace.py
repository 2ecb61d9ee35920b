"""Other numbers, same programs."""

import pytest

import hybridjax as hj

from ..conftest import ISOCHRONS, KINEMATIC, OUTPUTS, no_compilation


def analyze(cycle):
    for family in (ISOCHRONS, KINEMATIC):
        placed = hj.place_sections(cycle, family)
        _ = hj.linearize(cycle, placed, OUTPUTS).multipliers


@pytest.mark.slow
def test_another_hopper_compiles_nothing():
    def run(**parameters):
        analyze(hj.find_limit_cycle(hj.models.VerticalHopper(**parameters)))

    with no_compilation(after=lambda: run(k=10.05)):
        run(k=10.1, M=2.02)
