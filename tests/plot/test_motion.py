"""Animations: frames on the trajectory, feet that stay, loops that close, files, refusals."""

import base64
import dataclasses
import io
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import hybridjax as hj
from hybridjax.plot.pictures import Pictures


@pytest.fixture(scope="module")
def walk():
    return hj.find_limit_cycle(
        hj.models.CompassGait(), section=hj.AtEvent("heelstrike")
    )


def test_states_at_times_lie_on_the_trajectory(walk):
    path = walk.trajectory()
    t, chart, q = path.dense(7)
    once = np.append(np.diff(t) > 0, False)  # at an event both sides have one time
    found = path.at(t[once])
    assert_array_equal(found[0], chart[once])
    assert_allclose(found[1], q[once], rtol=0, atol=1e-12)
    with pytest.raises(hj.errors.DefinitionError, match="times must lie between"):
        path.at([path.t[-1] + 1])


def test_feet_do_not_slide_and_the_loop_closes(walk):
    period = float(walk.period)
    path = walk.trajectory()
    pictures = Pictures(path, period)
    strike = path.t[path.event >= 0][-1]
    around = np.array([strike - 1e-9, strike])
    before, after = pictures.at(around)
    for new, old in (("stance foot", "swing foot"), ("swing foot", "stance foot")):
        assert_allclose(after.points[new], before.points[old], atol=1e-7)
    parts = np.linspace(0.01, 0.9, 20)
    times = path.t[0] + parts * period
    feet = [x.points["stance foot"] for x in pictures.at(times)] + pictures.camera(
        times
    )
    assert_allclose(feet - feet[0], 0, atol=1e-12)
    # A step has the length of the line between the feet.
    step = before.points["swing foot"] - before.points["stance foot"]
    assert_allclose(pictures.stride, step, atol=1e-7)


def test_files_and_refusals(walk, tmp_path):
    motion = hj.plot.animate(walk)
    error = abs(motion.interval * len(motion.times) - float(walk.period))
    assert error < 1e-9
    assert motion.save(tmp_path / "walk.gif").read_bytes().startswith(b"GIF89a")
    page = motion.save(tmp_path / "walk.html").read_text()
    assert "<script>" in page
    assert 'src="http' not in page
    pictures = [
        base64.b64decode(x) for x in re.findall(r"base64,([\w+/=]+)['\"]", page)
    ]
    still, first, *shown = (Image.open(io.BytesIO(x)).convert("RGBA") for x in pictures)
    assert len(shown) == len(motion.times)
    assert first == shown[0]
    for frame, over in zip(motion._frames(107), shown, strict=True):
        assert Image.alpha_composite(still, over) == frame.convert("RGBA")
    with pytest.raises(hj.errors.DefinitionError, match="name it .gif, .html or .mp4"):
        motion.save(tmp_path / "walk.avi")
    with pytest.raises(hj.errors.DefinitionError, match="animate the cycle"):
        hj.plot.animate(walk.trajectory(), perturbed=walk.trajectory())


@pytest.mark.slow
def test_both_halves_of_a_cycle_are_drawn():
    duffing = hj.models.Duffing()
    half = hj.find_limit_cycle(
        hj.systems.Symmetric(duffing, flipped=("x", "v"), half_period=True)
    )
    motion = hj.plot.animate(half)
    span = len(motion.times) * motion.times[1]
    spans = [span, 2 * half.period]
    assert_allclose(spans, float(duffing.period()), rtol=1e-9)


def test_no_input_gives_the_cycle():
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    placed = hj.sections.place_sections(cycle, hj.ClockPhase(4))
    no_pushes = np.zeros((8, 1))
    path = hj.experiments.perturbed_trajectory(placed, no_pushes)
    last = path.at(path.t[-1:])[1]
    first = path.at(path.t[:1])[1]
    end = last - first
    assert_allclose(end, 0, atol=1e-9)
    data = hj.experiments.ExperimentData(
        np.zeros((1, 8, 1)), np.zeros((1, 8, 1)), n_sections=4, periods=2
    )
    motion = hj.plot.animate(cycle, sections=placed, perturbed=data)
    shown = motion.interval * len(motion.times)
    error = abs(shown - 2 * float(cycle.period))
    assert error < 1e-9
    motion.figure.draw_without_rendering()
    for x in motion.figure.axes:
        assert motion.figure.bbox.y1 > x.title.get_tightbbox().y1
    with pytest.raises(hj.errors.DefinitionError, match="and their `sections`"):
        hj.plot.animate(cycle, perturbed=data)
    # Experiments with feedback have their references after the inputs.
    u, r = np.zeros((1, 8, 1)), np.ones((1, 8, 1))
    names = (*cycle.structure.inputs, "r")
    looped = dataclasses.replace(data, u=np.concatenate([u, r], axis=2), inputs=names)
    again = hj.plot.animate(cycle, sections=placed, perturbed=looped)
    assert again.interval * len(again.times) == shown
