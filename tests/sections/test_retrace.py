"""Other numbers, same programs."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import compilation

from ..conftest import ISOCHRONS, KINEMATIC, OUTPUTS, no_compilation


def analyze(cycle):
    for family in (ISOCHRONS, KINEMATIC):
        placed = hj.place_sections(cycle, family)
        _ = hj.linearize(cycle, placed, OUTPUTS).multipliers


@pytest.mark.slow
def test_another_hopper_compiles_nothing(monkeypatch):
    """On the host, where no program takes over, whatever other tests have done."""
    monkeypatch.setattr(compilation, "_WORTH_COMPILING", np.inf)
    analyze(hj.find_limit_cycle(hj.models.VerticalHopper(k=10.05)))
    with no_compilation():
        analyze(hj.find_limit_cycle(hj.models.VerticalHopper(k=10.1, M=2.02)))
