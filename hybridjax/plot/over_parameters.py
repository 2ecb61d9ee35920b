"""Limit cycles over parameters: branches, and maps of sweeps."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from .._core.boundary.values import show
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
      first state of the chart in which the cycle begins.
    - `ax`: one Axes. Default: a new figure of one column's width.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), parameter and output in their units.

    **Raises:** `DefinitionError` for branches along different parameters, a name that does not
    exist, or if `ax` is not one Axes.

    **Example:**

    ```python
    branch = hj.continuation(cycle, "k", (10.0, 11.0), step=0.5)
    hj.plot.branch(branch, output="yM")
    ```

    **Before:** `hj.continuation`. **After:** `hj.plot.save`.
    """
    names = {b.parameter for b in branches}
    if len(names) != 1:
        raise DefinitionError(
            f"branches in one figure need one parameter, not {sorted(names)}."
        )
    with panels(ax) as axes:
        panel = axes[0, 0]
        shown = set()
        drawn = set()
        for b, color in zip(branches, itertools.cycle(CYCLE)):
            first = b[0].structure.charts[int(b[0].anchor.chart[0])].states[0]
            name = first if output is None else output
            height = b.largest(name)
            for part, stable in _parts(b):
                line = "-" if stable else "--"
                drawn.add(line)
                panel.plot(b.values[part], height[part], line, color=color)
            for p in b.points:
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
        parameter = Signal(
            b.parameter, unit_of_parameter(branches[0][0].system, b.parameter)
        )
        (output_name,) = branches[0][0].structure.resolve_outputs(name).names
        panel.set(xlabel=axis_of(parameter), ylabel=f"largest {axis_of(output_name)}")
        panel.locator_params(axis="x", nbins=6)
        legend_above(panel)
    return Plot(axes)


def _parts(branch: Branch) -> list[tuple[slice, bool]]:
    """Rows from one marked point to the next, and whether the cycles between them are stable."""
    cuts = [0, *(p.index for p in branch.points), len(branch) - 1]
    parts = []
    for a, b in itertools.pairwise(cuts):
        if b > a:
            inside = branch.stable[a + 1 : b]
            if b <= a + 1:
                inside = branch.stable[[a, b]]
            is_stable = bool(np.mean(inside) > 0.5)
            parts.append((slice(a, b + 1), is_stable))
    return parts


@checked
def sweep(
    maps: Any, name: str = "spectral_radius", *, ax: AxesLike | None = None
) -> Plot:
    """Draw a quantity of a sweep: a curve over one parameter, or a map over two.

    **Arguments:**

    - `maps`: the dataset that `hj.sweep` returns.
    - `name`: the quantity. Default: "spectral_radius".
    - `ax`: one Axes. Default: a new figure of one column's width.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1).

    **Raises:** `DefinitionError` if the dataset has no such quantity over one or two parameters, or
    if `ax` is not one Axes.

    **Example:**

    ```python
    maps = hj.sweep(hopper, {"k": np.linspace(9, 11, 5)})
    hj.plot.sweep(maps, "spectral_radius")
    ```

    **Before:** `hj.sweep`. **After:** `hj.plot.save`.
    """
    if not isinstance(getattr(maps, "data_vars", None), Mapping):
        raise DefinitionError(
            f"`maps` must be the dataset that `hj.sweep` returns, not {show(maps)}."
        )
    drawable = [
        str(key) for key, values in maps.data_vars.items() if 1 <= values.ndim <= 2
    ]
    require_among("map", [name], drawable, "over one or two parameters ")
    with panels(ax) as axes:
        quantity = maps[name]
        quantity.plot(
            ax=axes[0, 0], **({"x": quantity.dims[0]} if quantity.ndim == 2 else {})
        )
        axes[0, 0].set_title("")
    return Plot(axes)
