"""Pictures of the home page: `python docs/_site/pictures.py` draws them anew.

A picture holds numbers that it draws, with which a test compares new ones.
"""

import json
import re
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot
from PIL import Image

import hybridjax as hj
from hybridjax.plot import Motion
from hybridjax.plot.look import Plot


IMAGES = Path(__file__).parents[1] / "images"
APEX = hj.Crossing("vM", "falling")


def draw() -> dict[str, Plot]:
    """Plots by the names of their files."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    sections = hj.place_sections(cycle, hj.ClockPhase(32, anchor=APEX))
    model = hj.linearize(cycle, sections, outputs=("yM", "vM"))
    first = hj.multisine(32, periods=32, lines="odd").scaled(rms=0.001)
    force = hj.testing.random_force(100, 500, 8.0, rms=0.0205, seed=0)
    recording = hj.testing.simulate_recording(cycle, force[None], ("yM", "vM"), rate=500)
    data = hj.recordings.section_data(
        recording, APEX, inputs="u", outputs=("yM", "vM"), n_sections=16
    )
    fit = hj.fit_series(data, order=2)
    return {
        "model": hj.plot.cycle(cycle, "yM", "vM", sections=sections),
        "recording": hj.plot.multipliers(cycle, {"from the recording": fit}),
        "plan": hj.plot.spectrum(hj.optimal_design(model, first), model),
    }


def walk() -> Motion:
    """The animation below the first sentence."""
    gait = hj.find_limit_cycle(hj.models.CompassGait(), section=hj.AtEvent("heelstrike"))
    return hj.plot.animate(gait)


def numbers(plot: Plot) -> list[list[float]]:
    """Sum and sum of squares of each curve's values."""
    curves = [line.get_ydata() for panel in plot.axes.flat for line in panel.get_lines()]
    return [[float(f"{x:.6g}") for x in (np.nansum(y), np.nansum(np.square(y)))] for y in curves]


def drawn(name: str) -> list[list[float]]:
    """The numbers that a file holds."""
    with Image.open(IMAGES / f"{name}.png") as picture:
        return json.loads(picture.info["Comment"])


def of_page() -> pyplot.Figure:
    """The figure that the page on responses draws."""
    text = (IMAGES.parent / "how-to" / "responses.md").read_text()
    page: dict = {}
    exec("".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), page)
    return page["figure"]


if __name__ == "__main__":
    matplotlib.use("Agg")
    hj.enable_x64()
    of_page().savefig(IMAGES / "converter.png", metadata={"Software": None})
    walk().save(IMAGES / "walk.gif")
    for name, plot in draw().items():
        about = {"Comment": json.dumps(numbers(plot)), "Software": None}
        plot.figure.savefig(IMAGES / f"{name}.png", metadata=about)
        pyplot.close(plot.figure)
