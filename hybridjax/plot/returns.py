"""`return_map`: the return map of one coordinate, with its cobweb.

States are drawn on a line through the cycle, along an eigenvector of the map (`_Line.through`), and
flow for one period (`_Line.next`, by `sections/maps.py`). The constants set what is drawn; the
slope in the legend is the multiplier of the cycle and does not depend on them. If the dashed
tangent does not touch the map, compare `_jacobian` with the cycle's multipliers; if the map has
gaps, states did not return within `_PATIENCE` periods.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.values import Whole
from .._core.signal import unit_of, with_unit
from ..errors import DefinitionError
from ..orbits.crossing import AtEvent, Crossing, SectionLike, as_section
from ..orbits.cycle import LimitCycle
from ..sections.families import ClockPhase
from ..sections.maps import SectionMap, arrivals, section_map
from ..sections.place import place_sections
from ..sections.placed import PlacedSections
from .look import COLORS, AxesLike, Plot, legend_above, panels


# States from which the map is drawn. Fewer: corners show in a curved map. More: time, a period of
# simulation for each.
_STATES = 41
# The map is drawn this far to both sides of the cycle, as a part of the coordinate's largest value
# on the cycle. Smaller: every map looks like its tangent. Larger: some states do not return.
_REACH = 0.2
# Largest imaginary part of a multiplier that counts as real, relative to its modulus. Smaller:
# rounding makes double multipliers complex. Larger: deviations that turn slowly are drawn as if
# they did not.
_REAL = 1e-6
# Step of the differences that give the eigenvector, in largest values of the states. Smaller:
# rounding. Larger: the curvature of the map.
_STEP = 1e-5
# Periods after which a state that has not returned is left out. Fewer: slow returns are gaps. More:
# time.
_PATIENCE = 3.0
# Smallest part of a deviation, in magnitudes of the states, that a coordinate must show. Smaller:
# errors of the map are drawn.
_SHOWN = 1e-6


@checked
def return_map(
    cycle: LimitCycle,
    coordinate: str | None = None,
    *,
    section: SectionLike | None = None,
    range: tuple[float, float] | None = None,
    start: float | None = None,
    iterates: Annotated[int, Whole(1, 1000)] = 10,
    cobweb: bool = True,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw a coordinate after one period against the same coordinate before, and its cobweb.

    The drawn states lie on a line through the cycle, along the eigenvector of the largest real
    multiplier, so that the slope of the map at the cycle is this multiplier. In a map with one
    dimension the line holds all states. The cobweb has the iterates of one state under the whole
    map: they approach the cycle if the slope is between -1 and 1.

    **Arguments:**

    - `cycle`: result of `hj.find_limit_cycle`.
    - `coordinate`: the name of a state. Default: the one that changes most along the line, relative
      to its largest value on the cycle.
    - `section`: where the coordinate is taken, a `Crossing` or the name of an event that the cycle
      meets once a period. Default: the section of the search, or the phase of the clock at the
      anchor.
    - `range`: the lowest and the highest value that are drawn, (low, high), in the coordinate's
      unit. Default: a fifth of its largest value on the cycle to both sides.
    - `start`: the first value of the cobweb. Default: near the upper end of the range.
    - `iterates`: number of periods in the cobweb, which ends where it leaves the range. Default:
      10.
    - `cobweb`: whether to draw it. Default: True.
    - `ax`: one Axes. Default: a new figure of one column's width.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), both axes in the coordinate's unit. The map has
    gaps at states from which the section is not reached again.

    **Raises:** `DefinitionError` for a name that is no state on the section, a cycle without a real
    multiplier, or a coordinate that does not change; `ComputationError` if the section is not met
    once a period.

    **Example:**

    ```python
    wheel = hj.find_limit_cycle(hj.models.RimlessWheel())
    hj.plot.return_map(wheel).save("cobweb.png")
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.sections.section_map`.
    """
    placed = place_sections(cycle, _section(cycle, section))
    line = _Line.through(placed, coordinate)
    low, high = line.around(range)
    values = np.linspace(low, high, _STATES)
    following = line.next(line.states(values))[line.place]
    with panels(ax, height=3.6) as axes:
        panel = axes[0, 0]
        panel.plot([low, high], [low, high], color=COLORS["gray"], lw=0.7)
        panel.plot(values, following, lw=1.4, label="return map")
        if cobweb:
            first = line.fixed + 0.9 * (high - line.fixed) if start is None else start
            path = line.cobweb(first, iterates, (low, high))
            panel.plot(*path, color=COLORS["orange"], lw=0.9, label=f"from {first:.4g}")
        sides = np.array([-0.3, 0.3])
        near = line.fixed + sides * (high - low) / 2
        tangent = line.fixed + line.multiplier * (near - line.fixed)
        label = f"slope {line.multiplier:.4g}: multiplier"
        panel.plot(near, tangent, "--", color=COLORS["red"], lw=1.2, label=label)
        panel.plot(line.fixed, line.fixed, "o", color="black", ms=4, label="cycle")
        name = line.name
        panel.set(
            xlabel=with_unit(f"{name} in cycle n", unit_of(name)),
            ylabel=with_unit(f"{name} in cycle n + 1", unit_of(name)),
            aspect="equal",
        )
        panel.locator_params(nbins=6)
        legend_above(panel, columns=2)
    return Plot(axes)


def _section(
    cycle: LimitCycle, section: SectionLike | None
) -> ClockPhase | list[Crossing | AtEvent]:
    """Return the section on which the map is drawn."""
    if section is not None:
        return [as_section(section)]
    if cycle.base is not None:
        return [cycle.base]
    phase = float(cycle.anchor.t[0]) / float(cycle.period)
    return ClockPhase(1, anchor=phase)


class _Line(NamedTuple):
    """States on a section along one eigenvector of the return map."""

    returns: SectionMap
    names: Sequence[str]
    place: int
    """The index of the coordinate."""
    direction: Float[np.ndarray, " n"]
    """The change of the state per change of the coordinate."""
    multiplier: float
    scale: float
    """The largest value of the coordinate on the cycle."""

    @classmethod
    def through(cls, placed: PlacedSections, coordinate: str | None) -> "_Line":
        """**Raises:** `DefinitionError` for another coordinate, and without a real multiplier."""
        cycle = placed.cycle
        chart = int(np.asarray(placed.lanes.chart)[0])
        names = placed.structure().states(chart)
        if coordinate is not None and coordinate not in names:
            raise DefinitionError(
                f"return_map: `coordinate` must be a state on the section, {', '.join(names)}, not "
                f"{coordinate!r}."
            )
        returns = section_map(cycle, placed, 0, 0)
        scales = np.array([cycle.scale[name] for name in names])
        multiplier = _largest_real(cycle)
        values, vectors = np.linalg.eig(_jacobian(returns, scales))
        nearest = int(np.argmin(np.abs(values - multiplier)))
        vector = np.real(vectors[:, nearest])
        parts = np.abs(vector) / scales
        largest = int(np.argmax(parts))
        index = largest
        if coordinate is not None:
            index = list(map(str, names)).index(coordinate)
        if parts[index] < _SHOWN * parts[largest]:
            raise DefinitionError(
                f"return_map: `{names[index]}` does not change along the eigenvector: take "
                f"`coordinate='{names[largest]}'`."
            )
        return cls(
            returns,
            names,
            index,
            vector / vector[index],
            multiplier,
            float(scales[index]),
        )

    @property
    def name(self) -> str:
        return self.names[self.place]

    @property
    def fixed(self) -> float:
        """The coordinate of the cycle."""
        return float(self.returns.fixed_point[self.place])

    def around(self, range: tuple[float, float] | None) -> tuple[float, float]:
        """Return the ends of what is drawn.

        **Raises:** `DefinitionError` for a range that does not hold the cycle.
        """
        if range is None:
            reach = _REACH * self.scale
            return self.fixed - reach, self.fixed + reach
        low, high = range
        if not low < self.fixed < high:
            raise DefinitionError(
                f"return_map: `range` must contain the cycle, {self.name} = {self.fixed:.6g}; got "
                f"({low:.6g}, {high:.6g})."
            )
        return low, high

    def states(self, values: Float[np.ndarray, " L"]) -> Float[np.ndarray, "n L"]:
        """Return the states on the line with these values of the coordinate."""
        cycle = np.asarray(self.returns.fixed_point)
        since = values - self.fixed
        return cycle[:, None] + np.outer(self.direction, since)

    def next(self, states: Float[np.ndarray, "n L"]) -> Float[np.ndarray, "n L"]:
        """Return the states after one period, NaN if the section is not reached."""
        return np.asarray(arrivals(self.returns, states, _PATIENCE).q)

    def cobweb(
        self, value: float, iterates: int, within: tuple[float, float]
    ) -> tuple[list[float], list[float]]:
        """Return the corners of a cobweb, from the diagonal to the map and back."""
        state = self.states(np.array([value]))
        x = [value]
        y = [value]
        for _ in range(iterates):
            state = self.next(state)
            now = x[-1]
            after = float(state[self.place, 0])
            if not within[0] <= after <= within[1]:
                break
            x += [now, after]
            y += [after, after]
        return x, y


def _jacobian(
    returns: SectionMap, scales: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Return the Jacobian of the map by central differences: it gives a direction to draw."""
    cycle = np.asarray(returns.fixed_point)
    changes = np.diag(_STEP * scales)
    starts = cycle[:, None] + np.hstack([changes, -changes])
    ends = np.asarray(arrivals(returns, starts, _PATIENCE).q)
    ahead, behind = np.hsplit(ends, 2)
    return (ahead - behind) / (2 * _STEP * scales)


def _largest_real(cycle: LimitCycle) -> float:
    """**Raises:** `DefinitionError` for a cycle without a real multiplier."""
    multipliers = cycle.multipliers
    modulus = np.abs(multipliers)
    is_real = np.abs(np.imag(multipliers)) <= _REAL * modulus
    if not is_real.any():
        raise DefinitionError(
            "return_map: the cycle has no real multiplier. Deviations turn from period to period, "
            "so that one coordinate alone does not determine the next one: draw "
            "`hj.plot.multipliers(cycle)`."
        )
    # (They are sorted by modulus.)
    return float(np.real(multipliers[is_real][0]))
