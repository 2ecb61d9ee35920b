"""Sliders: the cycle follows them, is lost with a reason, and is found again."""

import numpy as np
import pytest
from matplotlib import pyplot

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
    pyplot.close("all")


def test_the_widget_sends_pictures():
    pytest.importorskip("anywidget", reason="pip install 'hybridjax[explore]' installs it")
    explorer = hj.explore(hj.models.VanDerPol(), "mu")
    widget = explorer.widget()
    before = widget.picture
    widget.values = {"mu": 1.2}
    assert float(explorer.cycle.system.mu) == 1.2
    assert widget.picture.startswith("data:image/png;base64,") and widget.picture != before
    pyplot.close("all")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((), {}), "name one parameter"),
        ((("stiffness",), {}), "no parameter 'stiffness'"),
        (((), {"ranges": {"mu": (7.0, 9.0)}}), "around its present value"),
    ],
)
def test_what_is_refused(arguments, message):
    names, options = arguments
    with pytest.raises(hj.DefinitionError, match=message):
        hj.explore(hj.models.VanDerPol(), *names, **options)
