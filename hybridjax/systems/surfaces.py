"""Sliding: motion along a surface at which the vector field jumps, where the fields of both sides
point towards the surface.

`filippov` returns the charts (two sides, and a `SlidingChart`) and the transitions between them.
The field of sliding is the combination of both fields that is tangent to the surface
(`SlidingChart.field`). The order must stay: the first chart is above the surface, and `rates` has
its rate first.

If a state slides that should cross, or the reverse, look at the conditions `held` and `borne`, and
at the signs of `SlidingChart.rates`; if pushes have a wrong effect, at `SlidingChart.returned`.

A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, 1988; V. I. Utkin,
Sliding Modes in Control and Optimization, 1992.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .._core.boundary.checked import checked
from ..errors import DefinitionError
from .chart import Chart, DerivedChart
from .structure import as_vector
from .transition import Direction, Transition


class FilippovParts(NamedTuple):
    """Charts and transitions that `filippov` makes."""

    charts: dict[str, Chart]
    """The two given charts, and the chart of sliding."""
    transitions: list[Transition]
    """Transitions between these three charts."""


@checked
def filippov(
    charts: Mapping[str, Chart],
    surface: Callable[[Any, Any], Any],
    name: str = "slides",
) -> FilippovParts:
    """Return charts and transitions of a system whose vector field jumps at a surface.

    Let a and b be the rates of h in the fields f_a (where h > 0) and f_b (where h < 0). A state
    that reaches the surface h = 0 crosses it if the field of the other side leads away from the
    surface: b < 0 for a state from above, a > 0 for a state from below. Otherwise it slides along
    the surface with the field f = (b f_a - a f_b) / (b - a), until a rises, or b falls, through
    zero. Friction, relays and switches without memory are of this kind.

    **Arguments:**

    - `charts`: two charts with the same states, by name: first the one in which h > 0, then the one
      in which h < 0. Their fields must extend smoothly beyond the surface.
    - `surface`: the function h(t, q), which returns a number.
    - `name`: name of the chart of sliding, which has the same states. Default:
      "slides".

    **Returns:** `FilippovParts`: `charts` by name, and `transitions`, for the methods of the same
    names of a `HybridSystem`.

    **Raises:** `DefinitionError` if the charts are not two with the same states and inputs.

    **Example:**

    ```python
    class Drift(hj.Chart):
        states = ("x",)
        speed: float
        def field(self, t, q, u):
            return (self.speed,)

    sides = {"above": Drift(-1.0), "below": Drift(3.0)}
    parts = hj.systems.filippov(sides, lambda t, q: q[0])
    print(parts.charts, parts.transitions)
    ```

    **Before:** `hj.Chart`. **After:** `hj.HybridSystem`.
    """
    if len(charts) != 2:
        raise DefinitionError(
            f"filippov takes two charts, above and below, not {len(charts)}."
        )
    (above, f), (below, g) = charts.items()
    if f.states != g.states or f.inputs != g.inputs:
        raise DefinitionError(
            f"charts '{above}' and '{below}' need the same states and inputs."
        )
    middle = SlidingChart(f, g, surface)

    def height(t, q, u):
        return surface(t, q)

    def up(t, q, u):
        return middle.rates(t, q, u)[0]

    def down(t, q, u):
        return middle.rates(t, q, u)[1]

    def held(t, q, u):
        return down(t, q, u) >= 0

    def borne(t, q, u):
        return up(t, q, u) <= 0

    def no(predicate):
        return lambda t, q, u: ~predicate(t, q, u)

    def event(source, target, guard, sense: Direction = "falling", enabled=None):
        return Transition(
            f"{source} to {target}", source, target, guard, sense, enabled=enabled
        )

    transitions = [
        event(above, name, height, enabled=held),
        event(above, below, height, enabled=no(held)),
        event(below, name, height, "rising", enabled=borne),
        event(below, above, height, "rising", enabled=no(borne)),
        event(name, above, up, "rising"),
        event(name, below, down),
    ]
    return FilippovParts({**charts, name: middle}, transitions)


class SlidingChart(DerivedChart):
    """Motion along the surface, above which is the `chart`."""

    below: Chart
    surface: Callable[[Any, Any], Any]

    def fields(self, t, q, u):
        """The fields (n,) above and below."""
        return [as_vector(chart.field(t, q, u)) for chart in (self.chart, self.below)]

    def rates(self, t, q, u):
        """Rates of the surface's function along the fields above and below: a and b of
        `filippov`."""
        t = jnp.asarray(t, float)
        q = jnp.asarray(q, float)

        def along(f):
            rates = (jnp.ones_like(t), f)
            return jax.jvp(self.surface, (t, q), rates)[1]

        return [along(f) for f in self.fields(t, q, u)]

    def field(self, t, q, u):
        f, g = self.fields(t, q, u)
        a, b = self.rates(t, q, u)
        return (b * f - a * g) / (b - a)

    def returned(self, t, q, u):
        """Derivative (n, n) of the state, once it is back on the surface, by a small push. (From
        either side, the state returns along the direction f_a - f_b.)"""
        f, g = self.fields(t, q, u)
        a, b = self.rates(t, q, u)
        t = jnp.asarray(t, float)
        q = jnp.asarray(q, float)
        normal = jax.grad(self.surface, 1)(t, q)
        back = jnp.outer(f - g, normal) / (a - b)
        return jnp.eye(len(f)) - back
