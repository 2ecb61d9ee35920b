"""Animations: the mechanism, its orbit with sections and events, and its multipliers.

`animate` takes the stages in order: what moves (`_motions`), the times of frames (`_tracks`), and
panels that each add *parts* (`_film`): an artist, the function that moves it, and its argument for
each frame. Arguments are computed in advance, so that a frame only moves artists; `Motion` plays
and writes them (`film.py`). A branch has one cycle in each frame, of which trajectory and
multipliers are computed there (`_of_branch`). The explorer uses `portrait`, too.

A new panel is a function that returns parts, called in `_film`. If the speed is wrong, look at
`_pace`; if something is drawn at a wrong time, at `Track.wrapped`; if an event flashes at a wrong
time, at `Track.events`; if the mechanism is at a wrong place, at `pictures.py`.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import pyplot
from matplotlib.animation import FuncAnimation, writers
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath, Positive, SignalNames
from .._core.executor import to_host
from .._core.signal import SECONDS
from .._core.writing import replacing
from ..engine.trajectory import Trajectory, observed
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..orbits.branches import Branch
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..sections.placed import PlacedSections
from ..systems.quotient import Symmetric
from ..systems.structure import Structure
from ..systems.system import Guess, name_of
from .film import BODY, frames, gif, player
from .look import COLORS, CYCLE, axis_of, close_in_notebook, style
from .orbit import (
    CHARTS,
    at_events,
    by_chart,
    cycle as draw_cycle,
    plane_of,
    require_same_system,
)
from .over_parameters import branch as draw_branch
from .pictures import Pictures, drawing_of
from .plane import multipliers as draw_multipliers


# Frames per second. More: larger files. Fewer: motions stutter.
_RATE = 25
_GROUND: dict[str, Any] = {"color": COLORS["gray"], "lw": 1.0, "zorder": 1}
_MARKS: dict[str, Any] = {"marker": [(0, 0), (-3, -4)], "ms": 8}
_LINK: dict[str, Any] = {"lw": 1.6, "zorder": 3, "solid_joinstyle": "round"}
Part = tuple[Artist, Callable[[Any], Any], Sequence[Any] | np.ndarray]
"""An artist, a function that moves it, and its argument for each frame."""
Portrait = Callable[[LimitCycle], list[Artist]]


class Motion(FuncAnimation):
    """An animation of matplotlib that repeats, and shows itself in notebooks.

    **Fields:** `figure`; `times` (n,), the times of the frames since the beginning, in the system's
    unit (for a branch, values of the parameter); `interval`, seconds from one frame to the next.
    """

    def __init__(
        self,
        figure: Figure,
        parts: Sequence[Part],
        times: np.ndarray,
        interval: float,
        title: str,
    ):
        self.figure = figure
        self.times = times
        self.interval = interval
        self._parts = parts
        self._title = title
        self._draw(0)
        # (What windows do by `blit` is one more drawing for files and notebooks.)
        has_window = figure.canvas.required_interactive_framework is not None
        super().__init__(
            figure,
            self._draw,
            frames=len(times),
            interval=1000 * interval,  # type: ignore[arg-type]
            blit=has_window,
            cache_frame_data=False,
        )
        # (Else matplotlib warns of animations that are only saved.)
        self._draw_was_started = True
        close_in_notebook(figure)

    def _draw(self, k: int) -> list[Artist]:
        for _, move, values in self._parts:
            move(values[k])
        return list(dict.fromkeys(artist for artist, *_ in self._parts))

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
                f"cannot write '{path}': name it .gif, .html or .mp4."
            )
        if path.suffix == ".mp4" and not writers.is_available("ffmpeg"):
            raise DefinitionError(
                "an .mp4 needs the program ffmpeg: write a .gif or .html."
            )
        with replacing(path) as new:
            if path.suffix == ".gif":
                new.write_bytes(gif(self._frames(86), self.interval))
            elif path.suffix == ".html":
                new.write_text(self._repr_html_())
            else:
                film = new.with_suffix(".mp4")
                rate = round(1 / self.interval)
                super().save(str(film), writer="ffmpeg", fps=rate, dpi=172)
                film.rename(new)
        return path

    def _frames(self, dpi: float):
        return frames(self.figure, self._draw, len(self.times), dpi)

    def _repr_html_(self) -> str:
        return player(self._frames(107), self.interval, self._title)

    def __repr__(self) -> str:
        return f"Motion({self._title}: {len(self.times)} frames, {self.interval:.3g} s each)"


class Track(NamedTuple):
    """A trajectory to animate."""

    title: str
    color: str
    trajectory: Trajectory
    times: Float[np.ndarray, " n"]
    """Those of its frames. A cycle begins anew after its `period`."""
    period: float = math.inf

    def wrapped(self, t: Any) -> Any:
        """Times of the trajectory."""
        first, last = self.trajectory.t[[0, -1]]
        return np.minimum(first + np.mod(t - first, self.period), last)

    def observed(self, names: Sequence[str], t: Float[np.ndarray, " p"]):
        """States or outputs (n, p) at times."""
        path = self.trajectory
        at = self.wrapped(t)
        return observed(path.structure, names, at, *path.at(at))

    def events(self, flash: float) -> list[list[str]]:
        """Names of the events in so much time before each frame."""
        path = self.trajectory
        rows = np.flatnonzero(path.event >= 0)
        names = [path.structure.transitions[g].name for g in path.event[rows]]
        since = self.times[:, None] - path.t[rows]
        ago = np.mod(since, self.period)
        recent = (ago >= 0) & (ago < flash)
        return [list(itertools.compress(names, row)) for row in recent]


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
) -> Motion:
    """Animate a motion: the mechanism, its orbit in a plane, states over time, and multipliers.

    The mechanism is drawn by the system's method `draw` (`hj.HybridSystem.draw`); a system without
    it has its states over time alone. A dot moves along the orbit, events flash, and the section
    that was passed last is marked. Frames lie on the interpolant of the trajectory, and the last
    frame of a cycle is followed by its first.

    **Arguments:**

    - `motion`: a limit cycle, a trajectory, or a branch, of which each frame is a cycle at another
        value of the parameter. Where `hj.systems.Symmetric(half_period=)` halves a cycle, both
        halves are drawn, with the multipliers of the whole (not beside `sections` or `perturbed`).
    - `x`, `y`: names of states or outputs. Default: the first two states that every chart has.
    - `sections`: from `hj.sections.place_sections`, on this cycle. Default: None.
    - `perturbed`: a motion beside the cycle: a trajectory, from `simulate` or
        `hj.experiments.perturbed_trajectory`; or data of experiments at `sections`: the inputs of
        the first experiment are then applied to the cycle, for four periods. Default: None.
    - `traces`: names of states or outputs that are drawn over time. Default: `x` if the system has
        a picture, else up to four states.
    - `speed`: multiple of real speed. Default: 1. A motion of less than 0.25 s or more than 20 s,
        or without a unit of time, takes 2 s over `speed`.

    **Returns:** `hj.plot.Motion`, an animation of matplotlib, which a notebook shows. Its `times`
    (n,) are in the system's unit of time; its method `save` writes a GIF, an MP4 or a page.

    **Raises:** `DefinitionError` for a name that does not exist, a cycle that was not found, and
    sections or a perturbed motion of another system.

    **Example:**

    ```python
    motion = hj.plot.animate(cycle, "yM", "vM", speed=0.5)
    ```

    **Before:** `hj.find_limit_cycle` or `hj.simulate`. **After:** `motion.save`.
    """
    if isinstance(motion, Branch):
        return _of_branch(motion, x, y, 1 / (_RATE * (speed or 1.0)))
    motion, beside = _motions(motion, sections, perturbed)
    s = motion.structure
    require_same_system(s, sections, beside)
    plane = None
    if len(s.states_everywhere()) > 1 or (x and y):
        plane = plane_of(s, x, y)
    if traces is None:
        traces = _default_traces(s, plane)
    names = s.resolve_outputs(traces).names
    return _film(motion, beside, sections, plane, names, speed)


def _film(
    motion: LimitCycle | Trajectory,
    beside: Trajectory | None,
    sections: PlacedSections | None,
    plane: tuple[str, str] | None,
    names: Sequence[str],
    speed: float | None,
) -> Motion:
    """The animation, of which each panel gives the parts that move."""
    s = motion.structure
    has_picture = drawing_of(s, 0) is not None
    tracks, pace, note = _tracks(motion, beside, speed)
    events = [track.events(0.2 * pace) for track in tracks]
    with style():
        figure, grid = _sheet()
        cells = grid[1, 0] if has_picture else grid[:, 0]
        axes = _column(figure, cells, len(names))
        parts = _traces(axes, tracks, names, events)
        axes[0].set_title(note, loc="right")
        if has_picture:
            cells = grid[0, 0].subgridspec(1, len(tracks))
            for i, track in enumerate(tracks):
                parts += _picture(figure.add_subplot(cells[i]), track)
        multipliers = getattr(motion, "multipliers", ())
        has_circle = len(multipliers) > 0
        if plane is not None:
            place = grid[0, 1] if has_circle else grid[:, 1]
            panel = figure.add_subplot(place)
            _draw_orbit(panel, motion, plane, sections, beside)
            parts += _dots(panel, tracks, plane, events, sections)
        if has_circle:
            _unit_circle(figure.add_subplot(grid[1, 1]), multipliers)
        times = tracks[0].times - tracks[0].times[0]
        interval = (times[1] - times[0]) / pace
        title = f"motion of {name_of(s.system)}"
        return Motion(figure, parts, times, interval, title)


def _default_traces(s: Structure, plane: tuple[str, str] | None) -> Sequence[str]:
    """The first state of the plane beside a picture, up to four states without one."""
    if drawing_of(s, 0) is None:
        return s.state_names()[:4]
    return (plane or s.states_everywhere())[:1]


def _motions(
    motion: Any, sections: Any, perturbed: Any
) -> tuple[LimitCycle | Trajectory, Trajectory | None]:
    """The motion to animate, a cycle as a whole, and the one beside it."""
    is_cycle = isinstance(motion, LimitCycle)
    if is_cycle:
        motion.require_found()
    beside = _beside(motion, sections, perturbed)
    is_alone = sections is None and beside is None
    if not is_alone and not is_cycle:
        raise DefinitionError(
            "`sections` and `perturbed` are for limit cycles: animate the cycle."
        )
    if is_alone and is_cycle:
        motion = _both_halves(motion)
    return motion, beside


def _beside(motion: Any, sections: Any, perturbed: Any) -> Trajectory | None:
    """The motion beside a cycle: of data, that under the first inputs, for four periods."""
    if not isinstance(perturbed, ExperimentData):
        return perturbed
    if sections is None or not isinstance(motion, LimitCycle):
        raise DefinitionError(
            "data of experiments need a limit cycle and their `sections`."
        )
    # (To import it takes a thirtieth of a second.)
    from ..experiments.motion import perturbed_trajectory

    u = perturbed.u[0, : 4 * sections.n_sections]
    # (With feedback, the references follow the inputs of the system.)
    inputs = motion.structure.inputs
    if perturbed.inputs[: len(inputs)] == inputs:
        u = u[:, : len(inputs)]
    return perturbed_trajectory(sections, u)


def _tracks(
    motion: LimitCycle | Trajectory, beside: Trajectory | None, speed: float | None
) -> tuple[list[Track], float, str]:
    """What is animated, units of the system's time in a second of playback, and a note on it."""
    if isinstance(motion, LimitCycle):
        path = motion.trajectory()
        period = float(motion.period)
    else:
        path = motion
        period = math.inf
    longest = beside or path
    length = float(np.ptp(longest.t))
    if beside is None:
        length = min(length, period)
    pace, note = _pace(length, motion.system.time_unit, speed)
    count = max(12, round(length / pace * _RATE))
    times = longest.t[0] + np.linspace(0, length, count, endpoint=False)
    title = "" if beside is None else "cycle"
    tracks = [
        Track(
            title=title,
            color=CYCLE[0],
            trajectory=path,
            times=times,
            period=period,
        )
    ]
    if beside is not None:
        tracks.append(
            Track(
                title="perturbed",
                color=COLORS["red"],
                trajectory=beside,
                times=times,
            )
        )
    return tracks, pace, note


def _column(figure: Figure, cell: Any, count: int) -> list[Axes]:
    """So many Axes one above the other."""
    cells = cell.subgridspec(count, 1, hspace=0.05)
    return [figure.add_subplot(cells[i]) for i in range(count)]


def _draw_orbit(ax: Axes, motion: Any, plane, sections, beside) -> None:
    """The orbit of a limit cycle, with its events and sections, but without a legend."""
    if isinstance(motion, LimitCycle):
        draw_cycle(motion, *plane, sections=sections, perturbed=beside, ax=ax)
        ax.legend([], [])


def _unit_circle(ax: Axes, multipliers: Any) -> None:
    """The multipliers. (A formula as a label would take a twentieth of a second.)"""
    draw_multipliers(multipliers, zoom=False, ax=ax)
    ticks = [-1, 0, 1]
    ax.set(xticks=ticks, yticks=ticks, xlabel="Re λ", ylabel="Im λ")


def _both_halves(cycle: LimitCycle) -> LimitCycle:
    """The cycle of the system itself, where a `Symmetric` with `half_period` has a half of it."""
    s = cycle.structure
    anchor = to_host(cycle.anchor)
    a = int(anchor.chart[0])
    state = anchor.q[: s.dims[a], 0]
    at = Guess(s.names[a], state, anchor.t[0])
    whole = cycle.system.whole(at) if isinstance(cycle.system, Symmetric) else None
    return cycle if whole is None else find_limit_cycle(*whole)


def _sheet() -> tuple[Figure, Any]:
    """A figure and its cells, at fixed places, so that labels find theirs before it is drawn."""
    figure = pyplot.figure(figsize=(5.6, 3.6), dpi=86)
    grid = figure.add_gridspec(
        2,
        2,
        left=0.13,
        right=0.98,
        bottom=0.11,
        top=0.93,
        width_ratios=(1.15, 1),
        height_ratios=(1.4, 1),
        wspace=0.3,
        hspace=0.4,
    )
    return figure, grid


def _pace(length: float, unit: str, speed: float | None) -> tuple[float, str]:
    """Units of the system's time in a second of playback, and a note if that is not real speed."""
    pace = length / 2 * (speed or 1.0)
    seconds = length * SECONDS.get(unit, 0.0)
    if seconds and (speed is not None or 0.25 <= seconds <= 20):
        pace = (speed or 1.0) / SECONDS[unit]
    share = pace / length * seconds
    if not seconds or abs(share - 1) <= 1e-9:
        return pace, ""
    return pace, f"{share:.2g} x real speed"


def _picture(ax: Axes, track: Track) -> list[Part]:
    """The mechanism."""
    pictures = Pictures(track.trajectory, track.period)
    at = track.wrapped(track.times)
    scenes = pictures.at(at)
    size = float(max((pictures.high - pictures.low).max(), 1e-9))
    margin = 0.08 * size
    ax.update_datalim([pictures.low - margin, pictures.high + margin])
    ax.autoscale_view()
    ax.set(
        xticks=[],
        yticks=[],
        aspect="equal",
        adjustable="datalim",
        title=track.title,
    )
    ax.spines[:].set_visible(False)
    (dots,) = ax.plot([], [], "ko", ms=2.5, zorder=5)
    points = []
    for scene in scenes:
        places_of_scene = [_NOWHERE[:2], *scene.points.values()]
        points.append(np.array(places_of_scene).T)
    parts: list[Part] = [(dots, dots.set_data, points)]
    is_simple = len(scenes[0].lines) <= 4
    colors = itertools.cycle(CYCLE[: 3 if is_simple else 1])
    for name in dict.fromkeys(itertools.chain(*(x.lines for x in scenes))):
        lines = [x.lines.get(name, _NOWHERE[None, :2]) for x in scenes]
        if name == "ground":
            lines = [to_borders(line, size) for line in lines]
            marks = _marks(lines, pictures, at, size)
            parts.append(_shape(ax, marks, ls="", **_MARKS, **_GROUND))
            parts.append(_shape(ax, [line.T for line in lines], **_GROUND))
        else:
            shapes = [line.T for line in lines]
            parts.append(_shape(ax, shapes, color=next(colors), **_LINK))
    for name in dict.fromkeys(itertools.chain(*(x.circles for x in scenes))):
        circle = ax.add_patch(Circle((0, 0), 1, fc=BODY, ec="black", lw=0.8, zorder=4))
        places = []
        for x in scenes:
            *center, radius = x.circles.get(name, _NOWHERE)
            places.append({"center": center, "radius": radius})
        parts.append((circle, circle.update, places))
    return parts


_NOWHERE = np.full(3, np.nan)


def _shape(ax: Axes, places: Sequence[Any] | np.ndarray, **look: Any) -> Part:
    """A line that has other places (2, n) in each frame."""
    (line,) = ax.plot([], [], **look)
    return line, line.set_data, places


def to_borders(line: Float[np.ndarray, "k 2"], size: float) -> Float[np.ndarray, "k 2"]:
    """A line with its ends beyond the borders of a picture of this size."""
    ways = line[[0, -1]] - line[[1, -2]]
    lengths = np.linalg.norm(ways, axis=1, keepdims=True)
    beyond = 5 * size * ways / lengths
    begin, end = line[[0, -1]] + beyond
    return np.vstack([begin, line[1:-1], end])


def _marks(
    lines,
    pictures: Pictures,
    at,
    size: float,
) -> list[Float[np.ndarray, "2 n"]]:
    """Places on the ground, at equal distances from one that moves with it."""
    stride = abs(float(pictures.stride[0]))
    spacing = stride / max(1, round(stride / (0.1 * size))) or 0.1 * size
    marks = []
    for line, begin in zip(lines, -pictures.camera(at)[:, 0], strict=True):
        ends = line[[0, -1], 0]
        low, high = np.round(ends / spacing)
        x = begin % spacing + spacing * np.arange(low, high)
        marks.append(np.stack([x, np.interp(x, *line.T)]))
    return marks


def _traces(
    axes: list[Axes],
    tracks: list[Track],
    names: Sequence[str],
    events,
) -> list[Part]:
    """Signals over time, where they are now, and the names of events."""
    times = tracks[0].times - tracks[0].times[0]
    unit = tracks[0].trajectory.system.time_unit
    end = 2 * times[-1] - times[-2]
    fine = np.linspace(0, end, 2000, endpoint=False)
    for track in tracks:
        signals = track.observed(names, track.times[0] + fine)
        for ax, values in zip(axes, signals, strict=True):
            ax.plot(fine, values, color=track.color, lw=0.9)
    text = axes[0].set_title("", loc="left", color=COLORS["red"])
    texts = []
    for together in zip(*events, strict=True):
        distinct = dict.fromkeys(itertools.chain(*together))
        texts.append(", ".join(distinct))
    parts: list[Part] = [(text, text.set_text, texts)]
    for ax, name in zip(axes, names, strict=True):
        ax.set(ylabel=axis_of(name))
        ax.margins(x=0, y=0.1)
        ax.locator_params(axis="y", nbins=4)
        ax.tick_params(labelbottom=ax is axes[-1])
        cursor = ax.axvline(0, color="black", lw=0.8)
        parts.append((cursor, cursor.set_xdata, times[:, None]))
    axes[-1].set_xlabel(f"time ({unit})" if unit else "time")
    return parts


def _dots(ax: Axes, tracks: list[Track], plane, events, sections) -> list[Part]:
    """Dots that move along the orbit, rings at events, and the section that was passed last."""
    ax.set(xlabel=axis_of(plane[0]), ylabel=axis_of(plane[1]))
    ax.locator_params(nbins=5)
    parts = list[Part]()
    ring: Any = {"mfc": "none", "mew": 1.5, "zorder": 7}

    def mark(points: Float[np.ndarray, "n 2"], **look: Any) -> None:
        parts.append(_shape(ax, points[..., None], ls="", marker="o", **look))

    for track, names in zip(tracks, events, strict=True):
        if np.isinf(track.period) and len(tracks) == 1:
            for line in by_chart(track.trajectory, *plane).values():
                ax.plot(*line, color=track.color, lw=0.6, zorder=1)
        points = track.observed(plane, track.times).T
        mark(points, ms=6, mfc=track.color, mec="white", zorder=8)
        at_event = np.array([len(x) > 0 for x in names])
        rings = np.where(at_event[:, None], points, np.nan)
        mark(rings, ms=13, mec=track.color, **ring)
    if sections is not None:
        cycle = tracks[0]
        since = cycle.times[:, None] - sections.lanes.t
        ago = np.mod(since, cycle.period)
        passed = sections.observe(plane)[ago.argmin(axis=1)]
        mark(passed, ms=9, mec=COLORS["green"], **ring)
    return parts


def portrait(
    above: Axes,
    below: Axes,
    s: Structure,
    plane: tuple[str, str],
) -> Portrait:
    """A function that draws a cycle anew in the same Axes: its orbit, colored by chart, dashed if
    it is unstable, its events, and its multipliers."""
    orbits = []
    for color, name in zip(itertools.cycle(CHARTS), s.names, strict=False):
        orbits += above.plot([], [], color=color, lw=1.8, label=name)
    (marks,) = above.plot([], [], "ko", ms=4, zorder=5)
    about: Any = {"xytext": (4, 5), "textcoords": "offset points", "zorder": 6}
    notes = [above.annotate(x.name, (0, 0), **about) for x in s.transitions]
    above.set(xlabel=axis_of(plane[0]), ylabel=axis_of(plane[1]))
    draw_multipliers(np.zeros(1), zoom=False, ax=below)
    points = below.lines[-1]

    def draw(cycle: LimitCycle) -> list[Artist]:
        path = cycle.trajectory()
        curves = by_chart(path, *plane)
        for a, line in enumerate(orbits):
            line.set_data(curves.get(a, ([], [])))
            line.set_linestyle("-" if cycle.is_stable else "--")
        events, ends, _ = at_events(path, *plane)
        marks.set_data(ends.T)
        for g, note in enumerate(notes):
            note.set_visible(g in events)
        curve = np.array(path(*plane)[1:])
        center = (np.nanmin(curve, axis=1) + np.nanmax(curve, axis=1)) / 2
        for g, end in zip(events, ends, strict=True):
            # (The name stands on the side of the center.)
            x, y = np.where(center > end, 5, -5)
            notes[g].set_position((x, y))
            notes[g].set_ha("left" if x > 0 else "right")
            notes[g].set_va("bottom" if y > 0 else "top")
            notes[g].xy = end
        points.set_data(np.real(cycle.multipliers), np.imag(cycle.multipliers))
        return [*orbits, marks, *notes, points]

    return draw


def widened(ax: Axes) -> bool:
    """Whether its curves had left its limits, which are wider now."""
    ax.relim(visible_only=True)
    if all(ax.viewLim.contains(*corner) for corner in ax.dataLim.corners()):
        return False
    ax.margins(0.2)
    ax.autoscale_view()
    return True


def _of_branch(branch: Branch, x: str | None, y: str | None, interval: float) -> Motion:
    """At most 100 cycles of a branch, one after the other."""
    rows = np.linspace(0, len(branch) - 1, 100)
    rows = np.unique(rows.round().astype(int))
    cycles = [branch[int(k)] for k in rows]
    values = branch.values[rows]
    plane = plane_of(cycles[0].structure, x, y)
    with style():
        figure, grid = _sheet()
        left = figure.add_subplot(grid[:, 0])
        above = figure.add_subplot(grid[0, 1])
        below = figure.add_subplot(grid[1, 1])
        draw_branch(branch, output=plane[0], ax=left)
        left.legend()
        cursor = left.axvline(values[0], color="black", lw=0.8)
        draw_cycle = portrait(above, below, cycles[0].structure, plane)
        texts = []
        for value, cycle in zip(values, cycles, strict=True):
            _, *orbit = cycle.trajectory()(*plane)
            above.plot(*orbit, color=COLORS["gray"], lw=0.3, alpha=0.3)
            moved = draw_cycle(cycle)
            widened(below)
            text = f"{branch.parameter} = {value:.4g}"
            texts.append(text if cycle.is_stable else f"{text}, unstable")
        head = above.set_title("", loc="left")
        parts: list[Part] = [(x, lambda _: None, values) for x in moved]
        parts.append((head, head.set_text, texts))
        parts.append((cursor, cursor.set_xdata, values[:, None]))
        parts.append((moved[0], draw_cycle, cycles))
        interval = max(interval, 4 / len(values))
        title = f"branch along {branch.parameter}"
        return Motion(figure, parts, values, interval, title)
