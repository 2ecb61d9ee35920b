"""A limit cycle in phase space (paper Fig. 1): `cycle`.

It draws the orbit by charts (`by_chart`), the arrow of its direction, events with their names
(`_events`, `_text`) and bars for sections (`_sections`, `_meetings`). Animations use `plane_of`,
`by_chart` and `at_events`, too.

If a line joins points that a reset separates, look at `by_chart`; if a name covers the orbit, at
the constants and `_text`; if a bar has a wrong direction, at `_meetings`.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from .._core.boundary.checked import checked
from ..engine import kernels
from ..engine.trajectory import Trajectory, observed
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..sections.placed import PlacedSections
from ..systems.structure import Structure
from .look import COLORS, AxesLike, Plot, axis_of, legend_above, panels


CHARTS = [
    COLORS[name] for name in ("blue", "orange", "green", "purple", "sky", "black")
]
"""Colors of the charts of a system."""
# Half of a section's bar, and the distance from its end to its number, in widths of the picture.
_BAR = 0.035
# A name is placed where it covers the fewest points of the orbit. A corner outside of the axes, or
# another name that is covered, counts as much as this many points. Smaller: names lie on ticks
# where the orbit is dense.
_OUTSIDE = 10_000
# Free pixels around a name. More: no place is free in a small picture. Fewer: names touch.
_APART = 4
# Where a name is tried: turned from the way to the center, and at distances in points.
_TURNS = np.pi / 4 * np.array([0, 1, -1, 2, -2, 3, -3, 4])
_DISTANCES = 9, 18
_NUMBER: dict[str, Any] = {
    "fontsize": "x-small",
    "color": "0.35",
    "ha": "center",
    "va": "center",
    "zorder": 6,
    "path_effects": [withStroke(linewidth=2, foreground="white")],
}


@checked
def cycle(
    cycle: LimitCycle,
    x: str | None = None,
    y: str | None = None,
    *,
    sections: PlacedSections | None = None,
    perturbed: Trajectory | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw a limit cycle in the plane of two states or outputs, colored by chart.

    An arrow shows the direction. Events are marked by dots, resets that move the point by dashed
    lines, sections by short bars. A bar lies along the section if this is a curve in the plane (its
    level depends on x and y only), otherwise across the orbit.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `x`, `y`: names of states or outputs. Default: the first two states that every chart has.
    - `sections`: from `hj.sections.place_sections`, drawn as bars; about 8 are numbered. Default:
      None.
    - `perturbed`: a trajectory from `hj.simulate`, drawn over the cycle. Default: None.
    - `ax`: one Axes. Default: a new figure of one column's width.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), states in their units.

    **Raises:** `DefinitionError` for a name that does not exist, sections of another system, a
    cycle that was not found, or if `ax` is not one Axes.

    **Example:**

    ```python
    placed = hj.sections.place_sections(cycle, sections)
    hj.plot.cycle(cycle, "yM", "vM", sections=placed)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.sections.place_sections`.
    """
    cycle.require_found()
    s = cycle.structure
    x, y = plane_of(s, x, y)
    require_same_system(s, sections, perturbed)
    orbit = cycle.trajectory()
    with panels(ax, height=3.0) as axes:
        panel = axes[0, 0]
        if perturbed is not None:
            points = np.array(perturbed(x, y)[1:])
            is_known = np.isfinite(points).all(axis=0)
            begin = points[:, is_known][:, :1]
            panel.plot(*begin, "s", ms=3.5, color=COLORS["red"], zorder=5)
            for line in by_chart(perturbed, x, y).values():
                panel.plot(*line, color=COLORS["red"], lw=0.7, zorder=1)
        look = {"lw": 1.8, "zorder": 3, "solid_capstyle": "butt"}
        for a, line in by_chart(orbit, x, y).items():
            shade = CHARTS[a % len(CHARTS)]
            panel.plot(*line, color=shade, label=s.names[a], **look)
        t, *curve = orbit(x, y)
        points = np.stack(curve, axis=1)
        lowest = np.nanmin(points, axis=0)
        highest = np.nanmax(points, axis=0)
        center = (lowest + highest) / 2
        _arrow(panel, orbit, t, points)
        panel.margins(0.1)
        _events(panel, s, orbit, (x, y), center)
        panel.locator_params(axis="x", nbins=6)
        if sections is not None:
            _sections(panel, s, sections, (x, y), center)
        if perturbed is not None:
            panel.plot(
                [],
                [],
                "s-",
                ms=3.5,
                lw=0.7,
                color=COLORS["red"],
                label="perturbed",
            )
        panel.set(xlabel=axis_of(x), ylabel=axis_of(y))
        legend_above(panel)
    return Plot(axes)


def _arrow(
    ax: Axes,
    orbit: Trajectory,
    t: np.ndarray,
    points: Float[np.ndarray, "p 2"],
) -> None:
    """An arrow of the direction, in the middle of the longest time without events."""
    jumps = orbit.t[orbit.event >= 0]
    ends = np.union1d(jumps, orbit.t[[0, -1]])
    durations = np.diff(ends)
    longest = np.argmax(durations)
    middle = ends[longest] + durations[longest] / 2
    k = int(np.searchsorted(t, middle))
    look = {"arrowstyle": "-|>", "mutation_scale": 16, "color": "black", "lw": 0}
    ax.annotate("", points[k + 1], points[k], arrowprops=look, zorder=6)


def plane_of(s: Structure, x: str | None, y: str | None) -> tuple[str, str]:
    """The names of two states or outputs, by default the first two states that every chart has.

    **Raises:** `DefinitionError` if there are no two such states, and for unknown names.
    """
    everywhere = s.states_everywhere()
    if (x is None or y is None) and len(everywhere) < 2:
        raise DefinitionError(
            "no two states are defined in every chart: give `x` and `y`."
        )
    x = everywhere[0] if x is None else x
    y = next(n for n in everywhere if n != x) if y is None else y
    x, y = s.resolve_outputs((x, y)).names
    return x, y


def require_same_system(
    s: Structure, sections: PlacedSections | None, perturbed: Trajectory | None
) -> None:
    """**Raises:** `DefinitionError` if something is not of the system of a cycle."""
    added: dict[str, Any] = {
        "sections": sections and sections.cycle,
        "perturbed": perturbed,
    }
    for name, other in added.items():
        if other is not None and other.structure.names != s.names:
            raise DefinitionError(
                f"`{name}` and the cycle belong to different systems."
            )


def by_chart(
    trajectory: Trajectory, x: str, y: str
) -> dict[int, Float[np.ndarray, "2 p"]]:
    """The curve in each chart that a trajectory visits, with NaN between its stays."""
    t, chart, _ = trajectory.dense()
    same_time = np.diff(t) == 0
    other_chart = np.diff(chart) != 0
    is_jump = same_time | other_chart
    cuts = np.flatnonzero(is_jump) + 1
    values = trajectory(x, y)[1:]
    curve = np.insert(values, cuts, np.nan, axis=1)
    chart = np.insert(chart, cuts, chart[cuts])
    curves = {}
    for a in np.unique(chart).tolist():
        in_chart = np.where(chart == a, curve, np.nan)
        if np.isfinite(in_chart).all(axis=0).any():
            curves[a] = in_chart
    return curves


def at_events(
    path: Trajectory, *names: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transitions (e,) of the events, and the points (e, n) before and after each."""
    rows = np.flatnonzero(path.event >= 0)
    s = path.structure
    chart_before = path.chart[rows - 1]
    before = observed(s, names, path.t[rows], chart_before, path.before[rows]).T
    chart_after = path.chart[rows]
    after = observed(s, names, path.t[rows], chart_after, path.after[rows]).T
    return path.event[rows], before, after


def _events(ax: Axes, s: Structure, orbit: Trajectory, names, center) -> None:
    """Dots for events, and the name of each transition at its first event."""
    texts: dict[tuple, dict[str, None]] = {}  # names of what happens at a point
    for g, before, after in zip(*at_events(orbit, *names), strict=True):
        if not np.all(np.isfinite([before, after])):
            continue
        _event(ax, before, after)
        name = s.transitions[g].name
        if not any(name in there for there in texts.values()):
            texts.setdefault(tuple(before.round(9)), {})[name] = None
    ax.autoscale_view()
    _names(ax, texts, center)


def _event(ax: Axes, before: np.ndarray, after: np.ndarray) -> None:
    """A dot, and where the reset moves the point, a dashed line to an open dot."""
    rounding = 1e-9 * (1 + np.abs(before))
    if np.any(np.abs(after - before) > rounding):
        reset = np.stack([before, after], axis=1)
        ax.plot(*reset, "--", color="black", lw=0.8, zorder=2)
        ax.plot(*after, "o", ms=4, mfc="white", mec="black", mew=0.8, zorder=5)
    ax.plot(*before, "o", ms=4, color="black", zorder=5)


def _names(ax: Axes, texts: dict[tuple, dict[str, None]], center) -> None:
    """The names of events beside their points, where they cover little of the orbit."""
    solid = [x for x in ax.get_lines() if x.get_linestyle() == "-"]
    lines = [np.asarray(x.get_xydata()) for x in solid]
    drawn = ax.transData.transform(np.vstack(lines))
    boxes: list[Bbox] = []
    # (Long names first: short ones find a place beside them.)
    for point, there in sorted(texts.items(), key=lambda x: -max(map(len, x[1]))):
        boxes.append(_text(ax, "\n".join(there), point, center, drawn, boxes))


def _text(
    ax: Axes, text: str, point, center, drawn: np.ndarray, others: list[Bbox]
) -> Bbox:
    """A text beside `point`, rather towards `center`, that covers the fewest of the pixels drawn
    and no other text.

    **Returns:** its box.
    """
    note: Any = ax.annotate(
        text,
        point,
        xytext=(0, 0),
        textcoords="offset points",
        zorder=6,
        path_effects=[withStroke(linewidth=2, foreground="white")],
    )
    to, at = ax.transData.transform([center, point])
    inwards = np.arctan2(*(to - at)[::-1])

    def covered(place: tuple[float, float]) -> int:
        distance, turn = place
        x = np.cos(inwards + turn)
        y = np.sin(inwards + turn)
        note.set_position((distance * x, distance * y))
        note.set_ha(_side(x, "right", "left"))
        note.set_va(_side(y, "top", "bottom"))
        box = note.get_window_extent()
        outside = 4 - ax.bbox.count_contains(box.corners())
        around = box.padded(_APART)
        bad = outside + around.count_overlaps(others)
        return _OUTSIDE * bad + around.count_contains(drawn)

    covered(min(itertools.product(_DISTANCES, _TURNS), key=covered))
    return note.get_window_extent()


def _side(x: float, below: Any, above: Any) -> Any:
    """How a text is aligned that lies in the direction x from its point."""
    if abs(x) <= 0.35:
        return "center"
    return above if x > 0 else below


def _sections(ax: Axes, s: Structure, placed: PlacedSections, names, center) -> None:
    """A bar at each section, and the numbers of about eight."""
    width, height = ax.get_window_extent().size
    width_of_axes = np.ptp(ax.get_xlim())
    height_of_axes = np.ptp(ax.get_ylim())
    unit = np.array([width_of_axes, height_of_axes * width / height])
    bars = []
    step = max(1, round(placed.n_sections / 8))
    for i, (point, along) in enumerate(_meetings(s, placed, names, unit)):
        first = point - _BAR * along
        last = point + _BAR * along
        bars += [first, last, (np.nan, np.nan)]
        if i % step == 0:  # at the end of the bar that is outside of the loop
            from_center = (point - center) / unit
            outwards = np.sign(along / unit @ from_center) or 1.0
            x, y = point + 2 * _BAR * outwards * along
            ax.text(x, y, str(i), **_NUMBER)
    label = f"sections ({placed.n_sections})"
    ax.plot(*np.transpose(bars), color="0.35", lw=0.8, zorder=4, label=label)


def _meetings(s: Structure, placed: PlacedSections, names, unit) -> Iterator[tuple]:
    """Yield the point of the cycle at each section, and a step of length 1 on the page along the
    section, in the units of the axes."""
    lanes = placed.lanes
    charts = np.asarray(lanes.chart)
    times = np.asarray(lanes.t)
    states = np.asarray(lanes.q)
    points = np.empty((len(charts), 2))
    rates = np.empty((len(charts), 2))
    items = tuple(s.resolve_outputs(names).items)
    for a in np.unique(charts).tolist():
        mask = charts == a
        q = states[: s.dims[a], mask]
        no_input = np.zeros((s.nu, 1))
        at = times[mask], q, no_input
        flow = kernels.field(s, a, *at)[:, 0]
        values = kernels.outputs(s, a, items, *at)
        points[mask], by_time, *by_state = values.transpose(1, 2, 0)
        rates[mask] = by_time
        for slope, rate in zip(by_state, flow, strict=False):
            rates[mask] += slope * rate[:, None]
    for k, normal in enumerate(np.asarray(placed.normal)):
        across = rates[k] / unit
        curve = _normal_in_plane(normal, s.charts[charts[k]].states, names)
        if curve is not None:
            across = curve * unit
        along = np.array([-across[1], across[0]])
        length = np.linalg.norm(along) or 1.0
        yield points[k], unit * along / length


def _normal_in_plane(normal: np.ndarray, states: Any, names: Any) -> np.ndarray | None:
    """The normal of a section that is a curve in the plane of two states; None for others."""
    inside = [1 + states.index(name) for name in names if name in states]
    beyond = np.delete(normal, inside)
    if len(inside) < 2 or not normal.any() or np.abs(beyond).max(initial=0.0) > 1e-12:
        return None
    return normal[inside]
