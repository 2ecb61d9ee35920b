"""The plan of experiments: the host and XLA find the same ways between sections."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core import compilation
from hybridjax.engine.settings import Settings
from hybridjax.experiments import plan
from hybridjax.orbits.return_map import PATIENCE

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
    family = FAMILIES.get(name, hj.ClockPhase(7))
    placed = hj.sections.place_sections(cycle, family)
    settings = Settings(1e-9, 1e-9, PATIENCE, cycle.settings.scale)
    no_input = np.zeros((1, len(cycle.system.inputs)))
    host = plan._try_ways(placed, settings, no_input)
    monkeypatch.setattr(compilation, "WORTH_COMPILING", -1.0)
    xla = plan._try_ways(placed, settings, no_input)

    # Ends are times and states, at the section after each.
    scale = np.asarray(cycle.settings.scale)
    charts = np.asarray(placed.lanes.chart)
    states = scale[charts]
    times = np.full((7, 1), float(cycle.period))
    rows = np.concatenate([times, states], axis=1)
    sizes = np.roll(rows, -1, axis=0)
    sizes = sizes.T[:, None, None]
    assert_allclose(host.ends / sizes, xla.ends / sizes, atol=1e-13)
    # Estimates are differences in which the digits of small ones cancel.
    assert_allclose(host.estimate, xla.estimate, rtol=1e-4, atol=1e-5)
    assert_allclose(host.first, xla.first, rtol=1e-12)
    assert_allclose(host.slack, xla.slack, rtol=1e-12)
    assert_allclose(host.lead, xla.lead, rtol=1e-12)


# Derivatives of the ways from section 0 to 1 and back, and sizes at both.
BACK_AND_FORTH = np.array([[[2.0]], [[0.1]]])


def test_errors_are_followed_from_their_section_on():
    """An error made on the way from section 0 shrinks first, one from section 1 grows first; after
    each turn a fifth is left."""
    errors = np.ones((1, 2, 1))
    all_turns = 1 / (1 - 0.2)
    same_sizes = np.ones((2, 1))
    worst = plan._impact(BACK_AND_FORTH, errors, same_sizes)
    assert_allclose(worst, [[all_turns, 2 * all_turns]], rtol=1e-12)
    larger_at_1 = np.array([[1.0], [100.0]])
    worst = plan._impact(BACK_AND_FORTH, errors, larger_at_1)
    assert_allclose(worst, [[0.1 * all_turns, all_turns]], rtol=1e-12)


@pytest.mark.parametrize(
    "scale, largest", [([1.0, 100.0], 1.375), ([100.0, 1.0], 3.75)]
)
def test_errors_of_all_sections_add_up(scale, largest):
    """x1 = 2 x0 + 1 and x0 = x1 / 10 + 1, once they have."""
    column = np.array(scale)[:, None]
    found = plan._accumulated(BACK_AND_FORTH, np.ones((2, 1)), column)
    assert found == pytest.approx(largest, rel=1e-5)
