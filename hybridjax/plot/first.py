"""The figure of each type of result that one would ask for first: `result.plot()`.

`Showable.plot` (`_core/showable.py`) calls `draw`, which chooses a figure by the type of a result.
The figure of a new type is registered with `draw.register`: of systems and cycles here, of data and
fits in `first_of_data.py`. That file must be imported by `draw` alone, since it imports more than a
first cycle needs.

If a result has no figure or the wrong one, look at its line here or there; if a curve is wrong, at
the function in that line; if time series are, at `rows`.
"""

import functools
import importlib
from typing import Any

import numpy as np

from .._core.boundary.values import with_article
from .._core.showable import Showable
from .._core.signal import with_unit
from ..engine.trajectory import Trajectory
from ..errors import DefinitionError
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.branches import Branch
from ..orbits.cycle import LimitCycle
from ..orbits.flow import Flow
from ..orbits.limit_cycles import LimitCycles
from ..sections.placed import PlacedSections
from . import frequency, orbit, plane
from .look import COLORS, COLUMN, CYCLE, AxesLike, Plot, axis_of, panels
from .over_parameters import branch


@functools.singledispatch
def draw(result: Showable, *args: Any, **options: Any) -> Plot:
    """Draw a result.

    **Raises:** `DefinitionError` for a type that has no figure.
    """
    importlib.import_module("hybridjax.plot.first_of_data")
    drawing = draw.dispatch(type(result))
    if drawing is draw.dispatch(object):
        raise DefinitionError(
            f"there is no figure of {with_article(type(result).__name__)}: print it, or draw its "
            "fields."
        )
    return drawing(result, *args, **options)


draw.register(LimitCycle, orbit.cycle)
draw.register(Branch, branch)
draw.register(HTF, frequency.bode)
draw.register(LDTP, plane.multipliers)


@draw.register
def _(result: LimitCycles, **options: Any) -> Plot:
    found = result.multipliers[np.isfinite(result.multipliers)]
    return plane.multipliers(found, **options)


@draw.register
def _(result: PlacedSections, *names: str, **options: Any) -> Plot:
    return orbit.cycle(result.cycle, *names, sections=result, **options)


@draw.register
def _(result: Trajectory, *names: str, ax: AxesLike | None = None) -> Plot:
    """States (or the named states and outputs) against time; events are dotted lines."""
    names = names or _states(result)
    t, *values = result(*names)
    labels = result.structure.resolve_outputs(names).names
    plot = rows(t, dict(zip(labels, values, strict=True)), ax)
    unit = result.system.time_unit
    for panel in plot.axes[:, 0]:
        for event in result.events:
            panel.axvline(event.time, color=COLORS["gray"], lw=0.5, ls=":")
    plot.axes[-1, 0].set_xlabel(with_unit("time", unit))
    return plot


@draw.register
def _(result: Flow, *names: str, ax: AxesLike | None = None) -> Plot:
    """The same, of a single flow."""
    return draw(result.require_trajectory(), *names, ax=ax)


def _states(trajectory: Trajectory) -> tuple[str, ...]:
    """Return the states of all charts in which a trajectory is."""
    charts = [trajectory.structure.charts[a] for a in np.unique(trajectory.chart)]
    return tuple(dict.fromkeys(name for chart in charts for name in chart.states))


def rows(t: np.ndarray, signals: dict[Any, Any], ax: AxesLike | None) -> Plot:
    """Draw signals against time, one row for each."""
    size = {"width": COLUMN, "height": 0.5 + 0.85 * len(signals)}
    with panels(ax, len(signals), 1, **size, sharex=True) as axes:
        for panel, (name, values) in zip(axes[:, 0], signals.items(), strict=True):
            panel.plot(t, values, lw=0.7, color=CYCLE[0])
            panel.set_ylabel(axis_of(name))
            panel.margins(x=0)
    return Plot(axes)
