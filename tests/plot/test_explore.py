"""Sliders: the cycle follows them, is lost with a reason, and is found again."""

import base64
import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

import hybridjax as hj


def test_a_slider_moves_the_cycle_loses_it_and_finds_it_again():
    explorer = hj.explore(hj.models.RimlessWheel(), "slope")
    explorer.move({"slope": 0.1})
    expected = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.1))
    np.testing.assert_allclose(explorer.cycle.period, expected.period, rtol=1e-10)
    explorer.move({"slope": 0.001})  # too flat to roll
    assert explorer.message.startswith("The cycle is lost at slope = 0.0")
    assert 0.001 < float(explorer.cycle.system.slope) <= 0.1
    explorer.move({"slope": 0.1})
    assert explorer.message == ""
    np.testing.assert_allclose(explorer.cycle.period, expected.period, rtol=1e-10)


def test_an_event_passes_the_phase_at_which_the_clock_begins():
    explorer = hj.explore(hj.models.VerticalHopper(), "k")
    explorer.move({"k": 14.4})  # (at 10 it is in flight, here in stance)
    assert explorer.message == "" and float(explorer.cycle.system.k) == 14.4


def test_the_widget_sends_pictures():
    pytest.importorskip(
        "anywidget", reason="pip install 'hybridjax[explore]' installs it"
    )
    explorer = hj.explore(hj.models.VanDerPol(), "mu")
    widget = explorer.widget()
    before = widget.answer
    widget.asked = {"values": {"mu": 1.2}, "gain": False, "number": 1}
    assert float(explorer.cycle.system.mu) == 1.2
    assert (
        widget.answer["number"] == 1 and widget.answer["picture"] != before["picture"]
    )
    # Only what moves is drawn anew, and the picture is that of the whole figure.
    with io.BytesIO(base64.b64decode(widget.answer["picture"].split(",")[1])) as file:
        sent = np.asarray(Image.open(file).convert("RGB")).astype(int)
    canvas = FigureCanvasAgg(explorer.figure)
    for artist in explorer.figure.findobj():
        artist.set_animated(False)
    canvas.draw()
    assert np.mean(np.abs(sent - np.asarray(canvas.buffer_rgba())[..., :3]) > 64) < 1e-3


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ((), {}, "name one parameter"),
        (("stiffness",), {}, "no parameter 'stiffness'"),
        ((), {"ranges": {"mu": (7.0, 9.0)}}, "must enclose its value, 1"),
    ],
)
def test_what_is_refused(names, options, message):
    with pytest.raises(hj.DefinitionError, match=message):
        hj.explore(hj.models.VanDerPol(), *names, **options)
