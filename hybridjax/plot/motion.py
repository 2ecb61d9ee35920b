"""Animations: the mechanism, its orbit with sections and events, and its multipliers."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib import pyplot
from matplotlib.animation import FuncAnimation, writers
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, FilePath, Positive, SignalNames
from .._core.results import Result
from .._core.writing import replacing
from ..engine.trajectory import Trajectory, observed
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.motion import perturbed_trajectory
from ..orbits.continuation import Branch
from ..orbits.cycle import LimitCycle
from ..sections.placed import PlacedSections
from ..systems.structure import Structure
from .film import BODY, frames, gif, player
from .look import COLORS, CYCLE, axis_of, close_in_notebook, style
from .orbit import CHARTS, cycle as draw_cycle, pieces, plane_of
from .over_parameters import branch as draw_branch
from .pictures import Pictures, drawing_of
from .plane import multipliers as draw_multipliers


# Small labels, close to small panels.
_SMALL: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 6),
    **dict.fromkeys(("axes.labelsize", "axes.titlesize"), 7),
    **dict.fromkeys(("xtick.major.pad", "ytick.major.pad", "axes.labelpad", "axes.titlepad"), 1),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2),
}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
Draw = Callable[[int], Sequence[Artist]]
"""A function that draws frame k, and returns what it has moved."""
Portrait = Callable[[LimitCycle], list[Artist]]


class Motion(FuncAnimation):
    """An animation of matplotlib that repeats, and shows itself in notebooks.

    **Fields:** `figure`; `times` (n,), those of its frames since the begin, in the system's unit
    (of a branch, values of the parameter); `interval`, seconds from one frame to the next.
    """

    def __init__(self, figure: Figure, draw: Draw, times: np.ndarray, interval: float, title: str):
        self.figure, self.times, self.interval = figure, times, interval
        self._draw, self._title = draw, title
        draw(0)
        # (What windows do by `blit` is one more drawing for files and notebooks.)
        options: Any = {"blit": figure.canvas.required_interactive_framework is not None}
        options |= {"frames": len(times), "interval": 1000 * interval, "cache_frame_data": False}
        super().__init__(figure, draw, **options)
        self._draw_was_started = True  # else matplotlib warns of animations that are only saved
        close_in_notebook(figure)

    @checked
    def save(self, path: FilePath) -> Path:  # type: ignore[override]
        """Write a file: a `.gif`, a page that needs no other file (`.html`), or an `.mp4` where the
        program ffmpeg is.

        **Raises:** `DefinitionError` for other suffixes, without ffmpeg, and if the file cannot be
        written.
        """
        path = Path(path)
        if path.suffix not in (".gif", ".html", ".mp4"):
            raise DefinitionError(
                f"cannot write '{path}': an animation is written as .gif, .html or .mp4."
            )
        if path.suffix == ".mp4" and not writers.is_available("ffmpeg"):
            raise DefinitionError("an .mp4 needs the program ffmpeg: write a .gif or .html.")
        with replacing(path) as new:
            if path.suffix == ".gif":
                new.write_bytes(gif(self._frames(100)[1:], self.interval))
            elif path.suffix == ".html":
                new.write_text(self._repr_html_())
            else:
                film = new.with_suffix(".mp4")
                super().save(str(film), writer="ffmpeg", fps=round(1 / self.interval), dpi=200)
                film.rename(new)
        return path

    def _frames(self, dpi: float):
        return frames(self.figure, self._draw, len(self.times), dpi)

    def _repr_html_(self) -> str:
        still, *images = self._frames(150)
        return player(still, images, self.interval, self._title)


class Track(NamedTuple):
    """A trajectory to animate, and its times at all frames."""

    title: str
    trajectory: Trajectory
    period: float | None
    """Of a cycle."""
    times: Float[np.ndarray, " n"]
    flash: float
    """Time for which an event is shown."""

    def events(self, k: int) -> list[str]:
        """Names of the events just before frame k."""
        path = self.trajectory
        rows = np.flatnonzero(path.event >= 0)
        ago = self.times[k] - path.t[rows]
        ago = ago if self.period is None else np.mod(ago, self.period)
        names = [path.structure.transitions[g].name for g in path.event[rows]]
        return [name for name, x in zip(names, ago, strict=True) if 0 <= x < self.flash]


@checked
def animate(
    motion: LimitCycle | Trajectory | Branch,
    x: str | None = None,
    y: str | None = None,
    *,
    sections: PlacedSections | None = None,
    perturbed: Trajectory | ExperimentData | None = None,
    traces: SignalNames | None = None,
    speed: Positive | None = None,
    fps: Count = 25,
) -> Motion:
    """Animate a motion: the mechanism, its orbit in a plane, states over time, and multipliers.

    The mechanism is drawn by the system's method `draw` (`hj.HybridSystem.draw`); a system without
    it has its states over time alone. A dot moves along the orbit, events flash, and the section
    that was passed last is marked. Frames lie on the interpolant of the trajectory, and the last
    frame of a cycle is followed by its first.

    **Arguments:**

    - `motion`: a limit cycle, a trajectory, or a branch, of which each frame is a cycle at another
        value of the parameter.
    - `x`, `y`: names of states or outputs. Default: the first two states that every chart has.
    - `sections`: from `place_sections`, on this cycle.
    - `perturbed`: a motion beside the cycle: a trajectory, from `simulate` or
        `hj.experiments.perturbed_trajectory`; or data of experiments at `sections`, of which the
        inputs of the first are applied, to the cycle, for four periods.
    - `traces`: names of states or outputs that are drawn over time. Default: `x` if the system has
        a picture, else up to four states.
    - `speed`: multiple of real speed. Default: 1. A motion of less than 0.25 s or more than 20 s,
        or without a unit of time, takes 2 s over `speed`.
    - `fps`: frames per second. Default: 25.

    **Returns:** an animation of matplotlib, which a notebook shows. Its method `save` writes a GIF,
    an MP4 or a page.

    **Raises:** `DefinitionError` for a name that does not exist, a cycle that was not found, and
    sections or a perturbed motion of another system.
    """
    if isinstance(motion, Branch):
        return _of_branch(motion, x, y, 1 / fps / (speed or 1.0))
    cycle = motion if isinstance(motion, LimitCycle) else None
    if isinstance(perturbed, ExperimentData):
        if cycle is None or sections is None:
            raise DefinitionError("data of experiments need a limit cycle and their `sections`.")
        perturbed = perturbed_trajectory(sections, perturbed.u[0, : 4 * sections.n_sections])
    _require(cycle, motion.structure, sections, perturbed)
    s, unit = motion.structure, motion.system.time_unit
    everywhere, has_picture = s.states_everywhere(), drawing_of(s, 0) is not None
    plane = plane_of(s, x, y) if len(everywhere) > 1 or (x and y) else None
    default = (plane or everywhere)[:1] if has_picture else s.state_names()[:4]
    names = s.resolve_outputs(default if traces is None else traces).names
    path = motion.trajectory(1 + 1e-6) if isinstance(motion, LimitCycle) else motion
    period = None if cycle is None else float(cycle.period)
    last = path if perturbed is None else perturbed
    length = period if period and perturbed is None else float(np.ptp(last.t))
    pace = _pace(length, unit, speed)
    times = np.linspace(0, length, max(12, round(length / pace * fps)), endpoint=False)
    phase = last.t[0] + times - path.t[0]
    at = path.t[0] + (np.mod(phase, period) if period else phase)
    tracks = [Track("cycle" if perturbed else "", path, period, at, 0.2 * pace)]
    if perturbed is not None:
        tracks.append(Track("perturbed", perturbed, None, last.t[0] + times, 0.2 * pace))
    with style(), matplotlib.rc_context(_SMALL):
        figure, grid = _sheet()
        draws: list[Draw] = []
        if has_picture:
            cells, shape = grid[0, 0].subgridspec(1, len(tracks)), 1.5 / len(tracks)
            draws += [
                _picture(figure.add_subplot(cells[i]), x, shape) for i, x in enumerate(tracks)
            ]
        cells = (grid[1, 0] if has_picture else grid[:, 0]).subgridspec(len(names), 1, hspace=0.05)
        axes = [figure.add_subplot(cells[i]) for i in range(len(names))]
        draws.append(_traces(axes, tracks, names, times))
        axes[0].set_title(_label(pace, unit), fontsize=6, loc="right")
        has_circle = cycle is not None and len(cycle.multipliers) > 0
        if plane is not None:
            panel = figure.add_subplot(grid[0, 1] if has_circle else grid[:, 1])
            draws.append(_orbit(panel, cycle, tracks, plane, sections))
        if has_circle:
            panel = figure.add_subplot(grid[1, 1])
            draw_multipliers(cycle, zoom=False, ax=panel)
            panel.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1])
        draw: Draw = lambda k: [artist for part in draws for artist in part(k)]  # noqa: E731
        title = f"motion of {type(s.system).__name__}"
        return Motion(figure, draw, times, length / pace / len(times), title)


def _require(cycle: LimitCycle | None, s: Structure, sections, perturbed) -> None:
    """**Raises:** `DefinitionError`, as `animate`."""
    if cycle is not None and cycle.result != Result.OK:
        reason = Result(int(cycle.result)).message
        raise DefinitionError(f"a cycle that was not found cannot be animated ({reason}).")
    added = {"sections": sections and sections.cycle, "perturbed": perturbed}
    for name, other in added.items():
        if other is not None and cycle is None:
            raise DefinitionError(f"`{name}` is for a limit cycle: animate the cycle.")
        if other is not None and other.structure.names != s.names:
            raise DefinitionError(f"`{name}` and the cycle belong to different systems.")


def _sheet() -> tuple[Figure, Any]:
    """A figure and its cells, at fixed places, so that labels find theirs before it is drawn."""
    figure = pyplot.figure(figsize=(4.8, 3.1), dpi=100)
    borders: dict[str, float] = {"left": 0.1, "right": 0.98, "bottom": 0.11, "top": 0.96}
    ratios: Any = {"width_ratios": (1.15, 1), "height_ratios": (1.4, 1)}
    return figure, figure.add_gridspec(2, 2, **borders, **ratios, wspace=0.3, hspace=0.3)


def _pace(length: float, unit: str, speed: float | None) -> float:
    """Units of the system's time in a second of playback."""
    real = length * _SECONDS.get(unit, 0.0)
    if real and (speed is not None or 0.25 <= real <= 20):
        return (speed or 1.0) / _SECONDS[unit]
    return length / 2 * (speed or 1.0)


def _label(pace: float, unit: str) -> str:
    real = pace * _SECONDS.get(unit, 0.0)
    return f"{real:.2g} x real speed" if real and abs(real - 1) > 1e-9 else ""


def _picture(ax: Axes, track: Track, shape: float) -> Draw:
    """The mechanism, in a picture of this width over height."""
    pictures = Pictures(track.trajectory, track.period)
    scenes, size = pictures.at(track.times), float(max(*(pictures.high - pictures.low), 1e-9))
    extent, center = pictures.high - pictures.low, (pictures.high + pictures.low) / 2
    height = 1.16 * max(extent[0] / shape, extent[1]) or 1.0
    x, y = np.outer(center, [1, 1]) + np.outer([shape, 1], [-height / 2, height / 2])
    ax.set(xlim=x, ylim=y, xticks=[], yticks=[], aspect="equal")
    ax.spines[:].set_visible(False)
    ax.set_title(track.title)
    shapes: dict[str, Any] = {}
    lines = [name for name in scenes[0].lines if name != "ground"]
    colors = itertools.cycle(CYCLE[: 3 if len(lines) <= 3 else 1])
    gray: dict[str, Any] = {"color": COLORS["gray"], "lw": 1.0, "zorder": 1}
    for name in scenes[0].lines:
        look = {"color": next(colors), "lw": 1.6, "zorder": 3} if name in lines else gray
        (shapes[name],) = ax.plot([], [], solid_joinstyle="round", **look)
    for name, (x, y, radius) in scenes[0].circles.items():
        circle = Circle((x, y), radius, fc=BODY, ec="black", lw=0.8, zorder=4)
        shapes[name] = ax.add_patch(circle)
    (marks,), (dots,) = ax.plot([], [], **gray), ax.plot([], [], "ko", ms=2.5, zorder=5)
    stride = abs(float(pictures.stride[0]))
    spacing = stride / max(1, round(stride / (0.1 * size))) or 0.1 * size

    def draw(k: int) -> list[Artist]:
        scene = scenes[k]
        for name, line in scene.lines.items():
            if name == "ground":
                line = to_borders(line, size)
                marks.set_data(*_marks(line, scene.ground[0], spacing, size))
            shapes[name].set_data(*line.T)
        for name, (x, y, radius) in scene.circles.items():
            shapes[name].set(center=(x, y), radius=radius)
        if scene.points:
            dots.set_data(*np.stack([*scene.points.values()]).T)
        return [marks, *shapes.values(), dots]

    return draw


def to_borders(line: Float[np.ndarray, "k 2"], size: float) -> Float[np.ndarray, "k 2"]:
    """A line with its ends beyond the borders of a picture of this size."""
    first, last = line[0] - line[1], line[-1] - line[-2]
    ends = [x + 5 * size * way / np.hypot(*way) for x, way in ((line[0], first), (line[-1], last))]
    return np.vstack([ends[0], line[1:-1], ends[1]])


def _marks(line, begin: float, spacing: float, size: float) -> Float[np.ndarray, "2 n"]:
    """Short strokes below the ground, at equal distances from the one that moves with it."""
    x = begin % spacing + spacing * np.arange(*np.round(line[[0, -1], 0] / spacing))
    y, gap = np.interp(x, *line.T), np.full_like(x, np.nan)
    rows = (x, x - 0.03 * size, gap), (y, y - 0.04 * size, gap)
    return np.array([np.stack(row, axis=1).ravel() for row in rows])


def _traces(axes: list[Axes], tracks: list[Track], names: Sequence[str], times) -> Draw:
    """Signals over time, where they are now, and the names of events."""
    span, unit = 2 * times[-1] - times[-2], tracks[0].trajectory.system.time_unit
    cursors = []
    for ax, name in zip(axes, names, strict=True):
        for track, color in zip(tracks, (CYCLE[0], COLORS["red"]), strict=False):
            t, values = track.trajectory(name)
            once, begin = t - t[0] < (track.period or np.inf), t[0] - track.times[0]
            for shift in np.arange(begin, span, track.period or span):
                ax.plot(shift + (t - t[0])[once], values[once], color=color, lw=0.9)
        ax.set(xlim=(0, span), ylabel=axis_of(name))
        ax.margins(y=0.1)
        ax.locator_params(axis="y", nbins=4)
        ax.tick_params(labelbottom=ax is axes[-1])
        cursors.append(ax.axvline(0, color="black", lw=0.8))
    axes[-1].set_xlabel(f"time ({unit})" if unit else "time")
    text = axes[0].set_title("", loc="left", color=COLORS["red"])

    def draw(k: int) -> list[Artist]:
        text.set_text(", ".join(dict.fromkeys(name for x in tracks for name in x.events(k))))
        for cursor in cursors:
            cursor.set_xdata([times[k], times[k]])
        return [*cursors, text]

    return draw


def _orbit(
    ax: Axes,
    cycle: LimitCycle | None,
    tracks: list[Track],
    plane: tuple[str, str],
    sections: PlacedSections | None,
) -> Draw:
    """The orbit with its sections, dots that move along it, and rings at events."""
    if cycle is not None:
        draw_cycle(cycle, *plane, sections=sections, ax=ax)
        ax.legend([], [])
    for track in tracks if cycle is None else tracks[1:]:
        for _, x, y in pieces(track.trajectory, *plane):
            ax.plot(x, y, color=COLORS["red"] if track.title else CYCLE[0], lw=0.6, zorder=1)
    ax.set(xlabel=axis_of(plane[0]), ylabel=axis_of(plane[1]))
    ax.locator_params(nbins=5)
    places, dots, rings = [], [], []
    for track, color in zip(tracks, (CYCLE[0], COLORS["red"]), strict=False):
        path = track.trajectory
        states = path.at(track.times)
        places.append(observed(path.structure, plane, track.times, *states).T)
        dots += ax.plot([], [], "o", ms=6, mfc=color, mec="white", zorder=8)
        rings += ax.plot([], [], "o", ms=13, mfc="none", mec=color, mew=1.5, zorder=7)
    (bar,) = ax.plot([], [], "o", ms=9, mfc="none", mec=COLORS["green"], mew=1.4, zorder=6)
    marks = np.zeros((0, 3))
    if sections is not None:
        marks = np.column_stack([sections.lanes.t, sections.observe(plane)])

    def draw(k: int) -> list[Artist]:
        for track, points, dot, ring in zip(tracks, places, dots, rings, strict=True):
            dot.set_data(*points[[k]].T)
            ring.set_data(*points[[k]].T if track.events(k) else ([], []))
        if len(marks):
            ago = np.mod(tracks[0].times[k] - marks[:, 0], tracks[0].period or np.inf)
            bar.set_data(*marks[[int(np.argmin(ago))], 1:].T)
        return [bar, *rings, *dots]

    return draw


def portrait(above: Axes, below: Axes, s: Structure, plane: tuple[str, str]) -> Portrait:
    """A function that draws a cycle anew in the same Axes: its orbit, colored by chart, dashed if
    it is unstable, its events, and its multipliers."""
    colors = zip(itertools.cycle(CHARTS), s.names, strict=False)
    orbits = [above.plot([], [], color=color, lw=1.8, label=name)[0] for color, name in colors]
    (marks,) = above.plot([], [], "ko", ms=4, zorder=5)
    about: Any = {"xytext": (4, 5), "textcoords": "offset points", "zorder": 6}
    notes = [above.annotate(x.name, (np.nan, np.nan), **about) for x in s.transitions]
    above.set(xlabel=axis_of(plane[0]), ylabel=axis_of(plane[1]))
    draw_multipliers(np.zeros(1), zoom=False, ax=below)
    points = below.lines[-1]

    def draw(cycle: LimitCycle) -> list[Artist]:
        path = cycle.trajectory(1 + 1e-6)  # with an event at the very end of a period
        parts, gap = pieces(path, *plane), np.full((2, 1), np.nan)
        for a, line in enumerate(orbits):
            line.set_data(np.hstack([gap, *(x for b, *xy in parts if b == a for x in (xy, gap))]))
            line.set_linestyle("-" if cycle.stable else "--")
        rows = np.flatnonzero(path.event >= 0)
        ends = observed(s, plane, path.t[rows], path.chart[rows - 1], path.before[rows])
        marks.set_data(ends)
        for note in notes:
            note.set_visible(False)
        for g, end in zip(path.event[rows], ends.T, strict=True):
            notes[g].set_visible(True)
            notes[g].xy = end
        points.set_data(cycle.multipliers.real, cycle.multipliers.imag)
        far = 1.1 * float(np.abs(cycle.multipliers).max(initial=1.0))
        if far > below.get_xlim()[1]:
            below.set(xlim=(-far, far), ylim=(-far, far))
        return [*orbits, marks, *notes, points]

    return draw


def _of_branch(branch: Branch, x: str | None, y: str | None, interval: float) -> Motion:
    """At most 100 cycles of a branch, one after the other."""
    rows = np.unique(np.linspace(0, len(branch) - 1, 100).round().astype(int))
    cycles, values = [branch[int(k)] for k in rows], branch.values[rows]
    plane = plane_of(cycles[0].structure, x, y)
    with style(), matplotlib.rc_context(_SMALL):
        figure, grid = _sheet()
        left, above, below = (figure.add_subplot(x) for x in (grid[:, 0], grid[0, 1], grid[1, 1]))
        draw_branch(branch, output=plane[0], ax=left)
        left.legend()
        cursor = left.axvline(values[0], color="black", lw=0.8)
        draw_cycle = portrait(above, below, cycles[0].structure, plane)
        for cycle in cycles:
            above.plot(
                *cycle.trajectory(1 + 1e-6)(*plane)[1:], color=COLORS["gray"], lw=0.3, alpha=0.3
            )
            draw_cycle(cycle)
        text = above.set_title("", loc="left")

        def draw(k: int) -> list[Artist]:
            cursor.set_xdata([values[k], values[k]])
            unstable = "" if cycles[k].stable else ", unstable"
            text.set_text(f"{branch.parameter} = {values[k]:.4g}{unstable}")
            return [*draw_cycle(cycles[k]), cursor, text]

        interval = max(interval, 4 / len(values))
        return Motion(figure, draw, values, interval, f"branch along {branch.parameter}")
