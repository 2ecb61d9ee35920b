"""Limit cycles over parameters: branches (`branch`), and maps of sweeps (`sweep`).

Users and animations call `branch`; the command `hybridjax sweep` calls `sweep`. Markers and colors
may be chosen otherwise, but `_MARKS` must have one for each of the kinds of bifurcations (`KINDS`
in `orbits/branches.py`).

If a stable part is dashed, look at `_parts`; if a height is wrong, at `Branch.largest`; if a mark
is at a wrong place, at the `bifurcations` of the branch. The numbers of a sweep are drawn as they
are: if one is wrong, look at `scale/sweeps.py`.
"""

import itertools
from typing import Any

import numpy as np

from .._core.boundary.checked import checked
from .._core.signal import Signal
from ..errors import DefinitionError
from ..orbits.branches import KINDS, Branch
from ..systems.system import unit_of_parameter
from .look import COLORS, CYCLE, AxesLike, Plot, axis_of, legend_above, panels


_MARKS = dict(
    zip(
        KINDS,
        (("o", "red"), ("D", "orange"), ("s", "green"), ("^", "purple")),
        strict=True,
    )
)


@checked
def branch(
    *branches: Branch, output: str | None = None, ax: AxesLike | None = None
) -> Plot:
    """Draw branches of limit cycles, with marks where their stability changes.

    Stable cycles are drawn by full lines and unstable ones by dashed lines, one color per branch.

    **Arguments:**

    - `branches`: results of `hj.continuation`, all along the same parameter.
    - `output`: name of a state or output, whose largest value on each cycle is drawn. Default: the
      first state of the chart in which the first cycle begins.
    - `ax`: one Axes. Default: a new figure of one column's width.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), parameter and output in their units.

    **Raises:** `DefinitionError` for branches along different parameters, a name that does not
    exist, or if `ax` is not one Axes.

    **Example:**

    ```python
    branch = hj.continuation(cycle, "k", (10.0, 11.0), step=0.5)
    hj.plot.branch(branch, output="yM")
    ```

    **Before:** `hj.continuation`. **After:** `plot.save(path)`.
    """
    names = {b.parameter for b in branches}
    if len(names) != 1:
        raise DefinitionError(
            f"branches in one figure need one parameter, not {sorted(names)}."
        )
    first = branches[0][0]
    chart = int(first.anchor.chart[0])
    name = first.structure.charts[chart].states[0] if output is None else output
    with panels(ax) as axes:
        panel = axes[0, 0]
        shown = set()
        drawn = set()
        for b, color in zip(branches, itertools.cycle(CYCLE)):
            height = b.largest(name)
            for part, stable in _parts(b):
                line = "-" if stable else "--"
                drawn.add(line)
                panel.plot(b.values[part], height[part], line, color=color)
            for p in b.bifurcations:
                marker, tint = _MARKS[p.kind]
                panel.plot(
                    p.value,
                    height[p.index],
                    marker,
                    ms=4.5,
                    mfc="white",
                    mec=COLORS[tint],
                    mew=1.2,
                    zorder=5,
                    label=None if p.kind in shown else p.kind,
                )
                shown.add(p.kind)
        for line, label in (("-", "stable"), ("--", "unstable")):
            if line in drawn:
                panel.plot([], [], line, color=COLORS["gray"], label=label)
        (along,) = names
        parameter = Signal(along, unit_of_parameter(first.system, along))
        (output_name,) = first.structure.resolve_outputs(name).names
        panel.set(xlabel=axis_of(parameter), ylabel=f"largest {axis_of(output_name)}")
        panel.locator_params(axis="x", nbins=6)
        legend_above(panel)
    return Plot(axes)


def _parts(branch: Branch) -> list[tuple[slice, bool]]:
    """Rows from one bifurcation to the next, and whether the cycles between them are stable."""
    cuts = [0, *(p.index for p in branch.bifurcations), len(branch) - 1]
    parts = []
    for a, b in itertools.pairwise(cuts):
        if b > a:
            inside = branch.stable[a + 1 : b]
            if b <= a + 1:
                inside = branch.stable[[a, b]]
            is_stable = bool(np.mean(inside) > 0.5)
            parts.append((slice(a, b + 1), is_stable))
    return parts


def sweep(maps: Any, name: str) -> Plot:
    """Draw a quantity of the dataset of a sweep: a curve over one parameter, or a map over two."""
    with panels(None) as axes:
        quantity = maps[name]
        first = {"x": quantity.dims[0]} if quantity.ndim == 2 else {}
        quantity.plot(ax=axes[0, 0], **first)
        axes[0, 0].set_title("")
    return Plot(axes)
