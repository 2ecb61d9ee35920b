"""`Chart`: one mode of a hybrid system, with its own states and its own vector field.

Users subclass `Chart`; `FieldChart` makes a chart from a function, and `DerivedChart` changes parts
of another chart. The engine reads charts through `structure.py`. The names of attributes are public
and must not change; a further attribute needs a line in `DerivedChart`, too, and in
`_parts_of_chart` (`system.py`), which notices changes. If a chart of a user is refused, look at
`Chart.__new__` and `_require_names`; if a derived chart lacks an attribute, at `DerivedChart`.
"""

import abc
import dataclasses
import inspect
import operator
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._core.boundary.values import show
from .._core.signal import signals
from .._core.text import listed
from ..errors import DefinitionError
from .solver import Method, Solver


class Chart(eqx.Module):
    """One chart V_a of a hybrid system (paper Sec. II): named states and a smooth field.

    Subclass it, name the states, and write the field for a single state; the package batches, pads
    and differentiates it.

    **Example:**

    ```python
    class Flight(hj.Chart):
        states = ("y", "v")
        units = ("m", "m/s")
        ball: "Ball"

        def field(self, t, q, u):
            y, v = q
            return v, -self.ball.g
    ```

    Class attributes:

    - `states`: the names of the states, in the order in which they stand in `q`.
    - `units`: units of the states, in the same order, for figures and printed summaries; none, or
        one for each.
    - `inputs`: the names of the system's inputs that this chart uses (the map g_a of the paper), in
        the order in which they stand in `u`. The chart ignores other inputs. `None` means all.
    - `solver`: how the chart is integrated: a Runge-Kutta method of diffrax with an error estimate,
        or `hj.systems.Radau()`. `None` means the explicit pair of order 7, for charts that are not
        stiff. A `solver` of the system overrides it.
    - `absent`: values of states that this chart lacks but outputs and sections may use, e.g.
        `{"ym": 0.0, "vm": 0.0}` for a foot at rest on the ground.
    """

    states: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]] = ()
    inputs: ClassVar[tuple[str, ...] | None] = None
    absent: ClassVar[Mapping[str, float]] = {}
    solver: ClassVar[Solver | Method | None] = None

    def __new__(cls, *args: Any, **options: Any):
        # (States are a class attribute; `FieldChart` has them as a field, and `DerivedChart` as a
        # property.)
        fields = {field.name for field in dataclasses.fields(cls)}
        is_named = hasattr(cls, "states") or "states" in fields
        if is_named and not cls.__abstractmethods__:
            if "states" not in fields:
                _require_names(cls)
            return super().__new__(cls)
        name = "YourChart" if cls is Chart else cls.__name__
        raise DefinitionError(
            f"a chart is a class with `states` and `field`: write `class {name}(hj.Chart): states "
            "= ('y', 'v')` and in it `def field(self, t, q, u): ...`; "
            "`hj.HybridSystem.from_functions(states, field, events)` makes a system of one chart."
        )

    @abc.abstractmethod
    def field(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        u: Float[Array, " l"],
    ) -> Any:
        """The vector field dq/dt = f(t, q, u), eq. (2).

        It should extend smoothly a little beyond the chart's guards, since integration steps end
        beyond a guard before the crossing is located.

        **Returns:** n numbers, as an array or a tuple.
        """

    def __repr__(self):
        states = listed(signals(self.states, self.units))
        return f"{type(self).__name__}({states})"


def _require_names(cls: type) -> None:
    """**Raises:** `DefinitionError` for `states` of a class that are no sequence of names."""
    states = inspect.getattr_static(cls, "states")
    is_sequence = isinstance(states, tuple | list)
    if is_sequence and all(isinstance(name, str) for name in states):
        return
    if not isinstance(states, property):
        meant = (states,) if isinstance(states, str) else ("y", "v")
        raise DefinitionError(
            f"`states` of {cls.__name__} must be a tuple of names, such as {meant}, not "
            f"{show(states)}."
        )


class FieldChart(Chart):
    """A chart whose field is a function (t, q, u), such as a method of its system."""

    # (Checkers of types object that fields take the place of class attributes.)
    function: Callable[..., Any]
    states: tuple[str, ...] = eqx.field(static=True)  # type: ignore[misc]
    units: tuple[str, ...] = eqx.field(static=True)  # type: ignore[misc]
    solver: Any = eqx.field(static=True)  # type: ignore[misc]
    absent: Mapping[str, float] = eqx.field(default_factory=dict)  # type: ignore[misc]

    def __init__(self, function, states, units=(), solver=None, absent=None):
        self.function = function
        self.states = states
        self.units = units
        self.solver = solver
        self.absent = absent or {}

    def field(self, t, q, u):
        return self.function(t, q, u)


def attribute_of(part: str, name: str) -> Any:
    """A property that reads the attribute `name` of the object's attribute `part`."""
    return property(operator.attrgetter(f"{part}.{name}"))


class DerivedChart(Chart):
    """A chart made from another chart. Attributes that it does not define are those of the other
    chart."""

    chart: Chart
    states = attribute_of("chart", "states")
    units = attribute_of("chart", "units")
    inputs = attribute_of("chart", "inputs")
    absent = attribute_of("chart", "absent")
    solver = attribute_of("chart", "solver")
