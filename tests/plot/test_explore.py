"""Sliders: the cycle follows them, is lost with a reason, and is found again."""

import base64
import importlib
import io
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from numpy.testing import assert_allclose
from PIL import Image

import hybridjax as hj


@pytest.mark.slow
def test_a_slider_moves_the_cycle_loses_it_and_finds_it_again():
    explorer = hj.explore(hj.models.RimlessWheel(), "slope")
    explorer.move({"slope": 0.1})
    expected = hj.find_limit_cycle(hj.models.RimlessWheel(slope=0.1))
    assert_allclose(explorer.cycle.period, expected.period, rtol=1e-10)
    explorer.move({"slope": 0.001})  # too flat to roll
    assert explorer.message.startswith("The cycle is lost at slope = 0.0")
    found = float(explorer.cycle.system.slope)
    assert explorer.message.endswith(f"The picture is that at slope = {found:.4g}.")
    colors = {ax.get_facecolor() for ax in explorer.figure.axes}
    assert colors == {to_rgba("0.88")}
    assert 0.001 < float(explorer.cycle.system.slope) <= 0.1
    explorer.move({"slope": 0.1})
    assert explorer.message == ""
    new_colors = {ax.get_facecolor() for ax in explorer.figure.axes}
    assert new_colors == {to_rgba("white")}
    assert_allclose(explorer.cycle.period, expected.period, rtol=1e-10)


@pytest.mark.slow
def test_an_event_passes_the_phase_at_which_the_clock_begins():
    explorer = hj.explore(hj.models.VerticalHopper(), "k")
    explorer.move({"k": 14.4})  # (at 10 it is in flight, here in stance)
    assert explorer.message == ""
    assert float(explorer.cycle.system.k) == 14.4


@pytest.mark.slow
def test_the_widget_sends_pictures():
    pytest.importorskip(
        "anywidget", reason="pip install 'hybridjax[explore]' installs it"
    )
    explorer = hj.explore(hj.models.VanDerPol(), "mu")
    widget = explorer.widget()
    before = widget.answer
    widget.asked = {"values": {"mu": 1.2}, "gain": False, "number": 1}
    assert float(explorer.cycle.system.mu) == 1.2
    assert widget.answer["number"] == 1
    assert widget.answer["picture"] != before["picture"]
    # Only what moves is drawn anew, and the picture is that of the whole figure.
    encoded = widget.answer["picture"].split(",")[1]
    with io.BytesIO(base64.b64decode(encoded)) as file:
        pixels = np.asarray(Image.open(file).convert("RGB"))
        sent = pixels.astype(int)
    canvas = FigureCanvasAgg(explorer.figure)
    for artist in explorer.figure.findobj():
        artist.set_animated(False)
    canvas.draw()
    canvas_pixels = np.asarray(canvas.buffer_rgba())
    drawn = canvas_pixels[..., :3]
    differs = np.abs(sent - drawn) > 64
    error = np.mean(differs)
    assert error < 1e-3


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ((), {}, "name one parameter"),
        (("stiffness",), {}, "no parameter 'stiffness'"),
        ((), {"ranges": {"mu": (7.0, 9.0)}}, "must enclose its value, 1"),
    ],
)
def test_what_is_refused(names, options, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.explore(hj.models.VanDerPol(), *names, **options)


@pytest.mark.slow
def test_a_window_marks_the_picture_while_it_searches(monkeypatch):
    explorer = hj.explore(hj.models.VanDerPol(), "mu")
    seen = []
    drawn = explorer.figure.canvas.draw

    def draw():
        face = explorer.figure.axes[0].get_facecolor()
        gray = face == to_rgba("0.88")
        seen.append((explorer.figure.get_suptitle(), gray))
        drawn()

    monkeypatch.setattr(explorer.figure.canvas, "draw", draw)
    explorer._slide("mu", 1.3)
    assert seen[0] == ("Searching for the cycle at mu = 1.3.", True)
    assert float(explorer.cycle.system.mu) == 1.3
    assert explorer.message == ""
    assert explorer.figure.axes[0].get_facecolor() == to_rgba("white")


@pytest.mark.slow  # (It waits for a browser, which other tests delay.)
def test_a_picture_of_other_values_than_the_sliders_is_marked(tmp_path):
    """The page without a kernel: an answer comes a second after a slider has moved."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip("there is no Chromium here: its packages are called 'chromium'")
    page = tmp_path / "page.html"
    code = importlib.import_module("hybridjax.plot.explore")._PAGE.replace(
        "export default { render };", ""
    )
    page.write_text(
        f"""<div id="el"></div><pre id="log"></pre><script>{code}
const answer = {{ sliders: [["k", "k", 0, 2]], values: {{ k: 1 }}, gain: true, picture: "" }};
const state = {{ asked: {{ values: {{ k: 1 }} }}, answer }}, heard = [];
const model = {{
  get: (x) => state[x], set: (x, y) => {{ state[x] = y; }}, save_changes: () => {{}},
  on: (_, f) => heard.push(f),
}};
const el = document.getElementById("el");
render({{ model, el }});
const log = () => {{
  const [image, note] = [el.querySelector("img"), el.querySelector("img + div")];
  const words = [getComputedStyle(image).opacity, note.textContent || "nothing"];
  document.getElementById("log").textContent += words.join(": ") + "\\n";
}};
log();
const slider = el.querySelector("input");
slider.value = 1.5;
slider.dispatchEvent(new Event("input", {{ bubbles: true }}));
setTimeout(log, 900);
setTimeout(() => {{
  state.answer = {{ ...state.answer, values: {{ k: 1.5 }} }};
  heard.forEach((f) => f());
  log();
}}, 1000);
</script>"""
    )
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")
    profile = f"--user-data-dir={tmp_path}/new"
    budget = "--virtual-time-budget=1500"
    run = [browser, *options, profile, budget, "--dump-dom", page.as_uri()]
    shown = subprocess.run(run, capture_output=True, text=True, timeout=120).stdout
    log = shown.split('<pre id="log">')[1]
    lines = log.split("</pre>")[0].splitlines()
    searching = "0.25: searching for the cycle; the picture is that before"
    assert lines == ["1: nothing", searching, "1: nothing"]
