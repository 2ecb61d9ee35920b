"""The plan of experiments: the host and XLA find the same ways between sections."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core import compilation
from hybridjax.engine.settings import Settings
from hybridjax.experiments import plan
from hybridjax.sections.place import PATIENCE

from ..conftest import APEX


KINEMATIC = hj.KinematicPhase(7, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
PLANE = hj.KinematicPhase(7, position="x", velocity="v")
FAMILIES = {"VanDerPol": PLANE, "VerticalHopper": KINEMATIC}
MODELS = (
    "VanDerPol",
    "VerticalHopper",
    "BuckConverter",
    "CompassGait",
    "PaddleJuggler",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_host_and_program_try_the_same_ways(name, monkeypatch):
    cycle = hj.find_limit_cycle(getattr(hj.models, name)())
    placed = hj.place_sections(cycle, FAMILIES.get(name, hj.ClockPhase(7)))
    settings = Settings(1e-9, 1e-9, PATIENCE, cycle.settings.scale)
    sizes = np.asarray(cycle.settings.scale)[np.asarray(placed.lanes.chart)]
    scale = np.concatenate([np.full((7, 1), float(cycle.period)), sizes], axis=1)
    host = plan._try_ways(placed, settings, np.zeros((1, len(cycle.system.inputs))))
    monkeypatch.setattr(compilation, "WORTH_COMPILING", -1.0)
    xla = plan._try_ways(placed, settings, np.zeros((1, len(cycle.system.inputs))))
    after = np.roll(scale, -1, axis=0).T[:, None, None]
    assert_allclose(host.ends / after, xla.ends / after, atol=1e-13)
    # Estimates are differences in which the digits of small ones cancel.
    assert_allclose(host.estimate, xla.estimate, rtol=1e-4, atol=1e-5)
    for one in ("first", "slack", "lead"):
        assert_allclose(getattr(host, one), getattr(xla, one), rtol=1e-12)


# Derivatives of the ways from section 0 to 1 and back, and sizes at both.
BACK_AND_FORTH = np.array([[[2.0]], [[0.1]]])


def test_errors_are_followed_from_their_section_on():
    """An error made on the way from section 0 shrinks first, one from section 1 grows first; after
    each turn a fifth is left."""
    errors = np.ones((1, 2, 1))
    worst = plan._impact(BACK_AND_FORTH, errors, np.ones((2, 1)))
    assert_allclose(worst, [[1 / (1 - 0.2), 2 / (1 - 0.2)]], rtol=1e-12)
    worst = plan._impact(BACK_AND_FORTH, errors, np.array([[1.0], [100.0]]))
    assert_allclose(worst, [[0.1 / (1 - 0.2), 1 / (1 - 0.2)]], rtol=1e-12)


@pytest.mark.parametrize(
    "scale, largest", [([1.0, 100.0], 1.375), ([100.0, 1.0], 3.75)]
)
def test_errors_of_all_sections_add_up(scale, largest):
    """x1 = 2 x0 + 1 and x0 = x1 / 10 + 1, once they have."""
    found = plan._accumulated(BACK_AND_FORTH, np.ones((2, 1)), np.array(scale)[:, None])
    assert found == pytest.approx(largest, rel=1e-5)
