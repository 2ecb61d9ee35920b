import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .test_plots import labeled


def test_cycle_with_sections_and_a_perturbed_trajectory(hopper_cycle, placed_kinematic):
    lanes = placed_kinematic.lanes
    push = [0.03, 0, 0, 0]
    state = np.asarray(lanes.q[:, 0])
    start = state + push
    perturbed = hj.simulate(
        hopper_cycle.system, "flight", start, 2.0, time=float(lanes.t[0])
    )
    ax = hj.plot.cycle(hopper_cycle, sections=placed_kinematic, perturbed=perturbed).ax
    assert ax.get_xlabel() == "yM (m)"
    assert ax.get_ylabel() == "vM (m/s)"
    assert set(labeled(ax)) == {"stance", "flight", "sections (32)", "perturbed"}

    arrow, *texts = ax.texts
    x, v = arrow.xy
    from_x, _ = arrow.xyann
    assert (x - from_x) * v > 0, "x moves as its velocity says"
    assert v < -1, "both events lie above"
    written = [text.get_text() for text in texts]
    numbers = ["0", "4", "8", "12", "16", "20", "24", "28"]
    assert written == ["touchdown", "liftoff", *numbers]


def test_names_of_events_keep_apart(hopper_cycle):
    """In the small picture of an animation both events lie above."""
    figure = hj.plot.animate(hopper_cycle).figure
    (ax,) = [x for x in figure.axes if x.get_xlabel() == "yM (m)"]
    written = [x for x in ax.texts if x.get_text() in ("liftoff", "touchdown")]
    first, second = (x.get_window_extent() for x in written)
    assert not first.padded(3).overlaps(second)


@pytest.mark.slow
def test_a_cycle_that_was_not_found_is_refused():
    far = hj.Guess("flight", (1e3, 30.0, 1.0, 5.0))
    failed = hj.find_limit_cycle(hj.models.VerticalHopper(), far, throw=False)
    for function in (hj.plot.cycle, hj.orbits.LimitCycle.simultaneous_events):
        with pytest.raises(
            hj.errors.DefinitionError, match="the search for this cycle failed"
        ):
            function(failed)


def test_resets_that_jump_are_dashed(hopper_cycle):
    ax = hj.plot.cycle(hopper_cycle, "ym", "vm").ax
    (jump,) = [x for x in ax.get_lines() if x.get_linestyle() == "--"]
    touchdown = hopper_cycle.trajectory().events[1].before
    expected = [[0, touchdown["vm"]], [0, 0]]
    assert_allclose(jump.get_xydata(), expected, atol=1e-12)


def test_bars_lie_on_their_sections(hopper_cycle, placed_kinematic):
    """Rays from the center of the kinematic phase, in equal angles."""
    ax = hj.plot.cycle(hopper_cycle, sections=placed_kinematic).ax
    drawn = labeled(ax)["sections (32)"].get_xydata()
    paths = drawn.reshape(32, 3, 2)
    bars = paths[:, :2]  # the third point is a gap
    middles = bars.mean(axis=1).T
    assert_allclose(middles, placed_kinematic.lanes.q[:2], atol=1e-9)
    scaled = (bars - [1.9, 0.0]) / [0.3, 1.9]
    x, y = np.moveaxis(scaled, 2, 0)
    angle = np.unwrap(np.arctan2(y, x), axis=0)
    assert_allclose(angle[:, 0], angle[:, 1], atol=1e-9)
    turns = np.diff(angle[:, 0])
    assert_allclose(turns, -2 * np.pi / 32, atol=1e-9)


def test_autonomous_cycle_with_sections_across_it(vanderpol_cycle):
    placed = hj.sections.place_sections(vanderpol_cycle, hj.ClockPhase(6))
    ax = hj.plot.cycle(vanderpol_cycle, "v", sections=placed).ax
    assert ax.get_xlabel() == "v"
    assert ax.get_ylabel() == "x"
    drawn = labeled(ax)["sections (6)"].get_xydata()
    paths = drawn.reshape(6, 3, 2)
    bars = paths[:, :2]
    middles = bars.mean(axis=1).T
    assert_allclose(middles, placed.lanes.q[::-1], atol=1e-9)
