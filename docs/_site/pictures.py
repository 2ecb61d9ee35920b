"""Pictures of the home page: `python docs/_site/pictures.py` draws them anew; with the argument
`gallery`, it runs the code of the gallery's pages and draws their thumbnails (two minutes).

A picture holds numbers that it draws, with which a test compares new ones.
"""

import contextlib
import itertools
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from gallery import codes
from matplotlib import pyplot
from PIL import Image

import hybridjax as hj
from hybridjax.engine.trajectory import observed
from hybridjax.plot import Motion
from hybridjax.plot.look import CYCLE, Plot
from hybridjax.plot.motion import to_borders
from hybridjax.plot.pictures import Pictures, drawing_of


IMAGES = Path(__file__).parents[1] / "images"
APEX = hj.Crossing("vM", "falling")
FRAMES = 24  # of a thumbnail


def draw() -> dict[str, Plot]:
    """Plots by the names of their files."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    sections = hj.sections.place_sections(cycle, hj.ClockPhase(32, anchor=APEX))
    model = hj.linearize(cycle, sections, outputs=("yM", "vM"))
    first = hj.multisine(32, periods=32, lines="odd").scaled(rms=0.001)
    force = hj.experiments.random_input(100, 500, 8.0, rms=0.0205, seed=0)
    recording = hj.testing.simulate_recording(
        cycle, force[None], ("yM", "vM"), rate=500
    )
    data = hj.recordings.sample_sections(
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
    gait = hj.find_limit_cycle(
        hj.models.CompassGait(), section=hj.AtEvent("heelstrike")
    )
    return hj.plot.animate(gait)


def thumbnail(cycle: hj.orbits.LimitCycle, plane: list[str]) -> str:
    """An SVG of 160 x 120 in which the mechanism moves; or, of systems without a picture, the
    orbit with a dot that moves along it."""
    motion = hj.plot.animate(cycle)
    pyplot.close(motion.figure)
    path, period = cycle.trajectory(), float(cycle.period)
    times = path.t[0] + np.linspace(0, period, FRAMES, endpoint=False)
    about = f'dur="{max(motion.interval * len(motion.times), 1.0):.3g}s"'
    if drawing_of(cycle.structure, 0) is None:
        names = plane or cycle.structure.states_everywhere()[:2]
        points = np.array(path(*names)[1:]).T
        now = observed(cycle.structure, names, times, *path.at(times)).T
        points, size = spaced(points, 200)
        to = lambda x: 20 + (x - points.min(axis=0)) / size * (120, 80)  # noqa: E731
        shapes = [
            _line("orbit", [to(points)], CYCLE[0]),
            _circle([(*x, 5) for x in to(now)], about),
        ]
        return _svg(shapes)
    pictures = Pictures(path, period)
    scenes, extent = pictures.at(times), np.maximum(pictures.high - pictures.low, 1e-9)
    center, scale = (
        (pictures.low + pictures.high) / 2,
        min(140 / extent[0], 100 / extent[1]),
    )
    to = lambda x: (80, 60) + (x - center) * scale  # noqa: E731
    colors = itertools.cycle(CYCLE[:3])
    shapes = []
    for name in scenes[0].lines:
        lines = [x.lines[name] for x in scenes]
        is_ground = name == "ground"
        if is_ground:
            lines = [to_borders(x, float(extent.max())) for x in lines]
        color = "currentColor" if is_ground else next(colors)
        shapes.append(_line(name, [to(x) for x in lines], color, about))
    for name in scenes[0].circles:
        rows = [x.circles[name] for x in scenes]
        shapes.append(_circle([(*to(x[:2]), x[2] * scale) for x in rows], about))
    return _svg(shapes)


def spaced(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points at equal distances along a line, which do not depend on the steps of a search, and
    the size of the line."""
    size = np.maximum(np.ptp(points, axis=0), 1e-9 * (1 + np.abs(points).max(axis=0)))
    way = np.append(0, np.cumsum(np.hypot(*(np.diff(points, axis=0) / size).T)))
    at = np.linspace(0, way[-1], count)
    return np.stack([np.interp(at, way, x) for x in points.T], axis=1), size


def _svg(shapes: list[str]) -> str:
    size = 'viewBox="0 0 160 120" xmlns="http://www.w3.org/2000/svg"'
    return f'<svg {size}><g transform="matrix(1 0 0 -1 0 120)">{"".join(shapes)}</g></svg>\n'


def _line(name: str, frames: list, color: str, about: str = "") -> str:
    digits = 0 if len(frames) > 1 else 1  # (many frames make large files)
    paths = [
        "M" + " ".join(f"{x:.{digits}f},{y:.{digits}f}" for x, y in z) for z in frames
    ]
    moves = _animated("d", paths, about)
    return f'<path d="{paths[0]}" fill="none" stroke="{color}" stroke-width="2">{moves}</path>'


def _circle(frames: list, about: str) -> str:
    values = [[f"{x:.1f}" for x in column] for column in zip(*frames, strict=True)]
    names = dict(zip(("cx", "cy", "r"), values, strict=True))
    first = " ".join(f'{name}="{column[0]}"' for name, column in names.items())
    moves = "".join(_animated(name, column, about) for name, column in names.items())
    return f'<circle {first} fill="#e3ebf3" stroke="currentColor">{moves}</circle>'


def _animated(name: str, values: list[str], about: str) -> str:
    if len(set(values)) == 1:
        return ""
    how = f'{about} begin="0s" calcMode="discrete" repeatCount="indefinite"'
    return f'<animate attributeName="{name}" values="{";".join(values)}" {how}/>'


def run(name: str) -> tuple[hj.orbits.LimitCycle, list[str]]:
    """The cycle and the plane that the code of a page of the gallery gives."""
    *lines, last = codes()[name][1].splitlines()
    scope: dict = {}
    exec("\n".join(lines), scope)
    return scope["cycle"], re.findall(r', "(\w+)"', last)


def numbers(plot: Plot) -> list[dict]:
    """Of each curve 20 points at equal distances, of marks all, and how far others may be, relative
    to the largest."""
    curves = []
    for line in (line for panel in plot.axes.flat for line in panel.get_lines()):
        points, within = (
            line.get_xydata()[np.isfinite(line.get_xydata()).all(axis=1)],
            1e-6,
        )
        if line.get_label() == "optimal":
            # Rounding shifts power between neighbors: its part up to each frequency is compared.
            f, power = np.linspace(0, 10, 21), np.cumsum(points[:, 1] ** 2)
            points, within = (
                np.stack([f, np.interp(f, points[:, 0], power / power[-1])]).T,
                0.03,
            )
        elif (
            line.get_linestyle() != "None" and line.get_linewidth() and len(points) > 1
        ):
            points = spaced(points, 20)[0]
        rounded = [tuple(float(f"{x:.9g}") for x in point) for point in points]
        curves.append({"points": rounded, "within": within})
    return curves


def drawn(name: str) -> list[dict]:
    """The numbers that a file holds."""
    with Image.open(IMAGES / f"{name}.png") as picture:
        return json.loads(picture.info["Comment"])


def of_pages() -> None:
    """Draw what how-to pages save, with a palette, which takes a third of the size."""
    pages = {
        "find-a-cycle": "cycle",
        "design-experiments": "bode",
        "optimal-designs": "spectrum",
        "identify-from-recordings": "multipliers",
        "populations": "paired",
    }
    for page, name in pages.items():
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            text = (IMAGES.parent / f"how-to/{page}.md").read_text()
            exec("".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), {})
            with Image.open(f"{name}.png") as picture:
                small = picture.convert("RGB").quantize(64)
                small.save(
                    IMAGES / f"{name}.png", optimize=True, dpi=picture.info["dpi"]
                )


def of_motion() -> None:
    """Draw the animation of the page on motion, by its first block."""
    text = (IMAGES.parent / "how-to/motion.md").read_text()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], {})
        shutil.copy("hopper.gif", IMAGES)


def of_page() -> pyplot.Figure:
    """The figure that the page on responses draws."""
    text = (IMAGES.parent / "how-to" / "responses.md").read_text()
    return _figure("".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)))


def of_notebook() -> pyplot.Figure:
    """The figure that the notebook on loops draws."""
    return _figure((IMAGES.parents[1] / "notebooks/in_the_loop.py").read_text())


def _figure(code: str) -> pyplot.Figure:
    scope: dict = {}
    exec(code, scope)
    return scope["figure"]


if __name__ == "__main__":
    matplotlib.use("Agg")
    hj.enable_x64()
    if "gallery" in sys.argv:
        for name in sys.argv[2:] or codes():
            (IMAGES / f"gallery/{name}.svg").write_text(thumbnail(*run(name)))
        sys.exit()
    of_pages()
    of_motion()
    for name, figure in (("converter", of_page()), ("loop", of_notebook())):
        figure.savefig(IMAGES / f"{name}.png", metadata={"Software": None})
    walk().save(IMAGES / "walk.gif")
    for name, plot in draw().items():
        about = {"Comment": json.dumps(numbers(plot)), "Software": None}
        plot.figure.savefig(IMAGES / f"{name}.png", metadata=about)
        pyplot.close(plot.figure)
