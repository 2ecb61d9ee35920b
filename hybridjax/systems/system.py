"""`HybridSystem`, the class that users subclass: charts, transitions, inputs, outputs, and perhaps
a clock.

With it are `Output`, `parameter` and `Guess`. `Derived` changes parts of another system, and
`Driven` adds an input that is a function of time. The engine reads systems through `structure.py`;
a system is checked in `check.py`.

Names of attributes and methods are public and must not change. A further method on which results
depend needs a `Part` at the end of this file: otherwise changes of its code may go unnoticed
(`_core/meaning.py`).

If a parameter has a wrong type or loses its derivative, look at `parameter` and `_number`; if a
system from `from_functions` calls its functions wrongly, at `taken_by_position` and
`_with_parameters`; if a stored result is not recognized, at `describe`.
"""

import abc
import contextvars
import copy
import dataclasses
import functools as ft
import inspect
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import require_among
from .._core.boundary.checked import check_fields, checked
from .._core.boundary.containers import Names
from .._core.boundary.kinds import (
    NewNames,
    NewOptionalNames,
    Numbers,
    PositiveScalar,
    Scalar,
)
from .._core.boundary.members import (
    Bound,
    Leading,
    fixed_attribute,
    missing_attribute,
)
from .._core.boundary.values import Reals
from .._core.executor import Definition, is_tracer
from .._core.meaning import Part, current, meaning, parts_by_name, parts_of
from .._core.pieces.description import digest_of, marked
from .._core.precision import real
from .._core.signal import unit_of
from .._core.text import columns, fields, value
from ..errors import DefinitionError
from .chart import Chart, FieldChart, attribute_of
from .drawing import Drawing
from .solver import ByChart, Method, Solver, solvers
from .transition import Scheduled, Transition


@checked
class Output(Definition):
    """A named scalar output z = h(t, q, u).

    **Fields:**

    - `name`: its name in data and plots.
    - `function`: one function (t, q, u) -> number for all charts, or a mapping from chart names to
        such functions. If the output is needed in a chart that is not in the mapping, an error is
        raised.
    - `unit`: its unit, for figures and printed summaries.

    **Example:**

    ```python
    momentum = hj.Output("momentum", lambda t, q, u: hopper.M * q[1], unit="kg m/s")
    print(hj.linearize(cycle, sections, momentum).outputs)
    ```

    **After:** `hj.linearize`, `hj.run_experiments`.
    """

    name: str = eqx.field(static=True)
    function: Callable[..., Any] | Mapping[str, Callable[..., Any]]
    unit: str = eqx.field(static=True, default="")

    __repr__ = fields

    def in_chart(self, name: str) -> Callable[..., Any] | None:
        """The function of a chart, `None` where the output is not defined."""
        if callable(self.function):
            return self.function
        return self.function.get(name)


OutputNames = Annotated[Sequence[str | Output] | str | Output, Names(Output)]
"""States and outputs: one, or several distinct ones; names, or `Output`s in their place."""


Parameter = Float[Array, ""] | float
"""The type of a parameter: an array, made from any number by `parameter`."""


@checked
def parameter(
    default: float | None = None,
    *,
    doc: str = "",
    unit: str = "",
    positive: bool = False,
) -> Any:
    """A physical parameter: a field of a `HybridSystem` that is stored as a floating-point array.

    An array is differentiable, and another value does not cause recompilation; a Python float has
    neither property. Declare it as `k: hj.Parameter = hj.parameter(10.0, unit="N/m")`.

    **Arguments:**

    - `default`: a number. Default: None; the constructor of the system then needs one.
    - `doc`: the meaning, as text. Default: none.
    - `unit`: the unit, as text. Default: none.
    - `positive`: whether zero and negative values raise an error, as for a mass. Default: False.

    **Returns:** a field for the body of a class.

    **Example:**

    ```python
    class Pendulum(hj.HybridSystem):
        length: hj.Parameter = hj.parameter(1.0, unit="m", doc="of the rod", positive=True)
    ```

    **After:** `hj.HybridSystem`.
    """
    metadata = {"doc": doc, "unit": unit, "positive": positive}
    options: dict[str, Any] = {} if default is None else {"default": default}
    converter = _positive_number if positive else _number
    return eqx.field(converter=converter, metadata=metadata, **options)


def unit_of_parameter(system: Any, path: str) -> str:
    """The unit of a parameter, which may be a path with dots to a part of a part; "" if it has
    none."""
    *parts, name = path.split(".")
    for part in parts:
        system = getattr(system, part)
    return type(system).__dataclass_fields__[name].metadata.get("unit", "")


def arrays_of(system: "HybridSystem") -> dict[str, Array]:
    """The arrays of a system by name. Arrays of parts have names with dots."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(system, eqx.is_array))
    arrays = {}
    for path, leaf in leaves:
        names = [str(getattr(x, "name", x)) for x in path]
        arrays[".".join(names)] = leaf
    return arrays


def copies_of(system: "HybridSystem") -> dict[str, Array]:
    """Copies of `arrays_of`. (A buffer that a tree holds twice cannot be donated.)"""

    def copied(x):
        return x if is_tracer(x) else jax.device_put(np.array(x))

    return {name: copied(x) for name, x in arrays_of(system).items()}


def parameters_of(system: "HybridSystem") -> dict[str, Array]:
    """The single floating-point numbers of a system by name."""
    arrays = arrays_of(system).items()
    return {name: x for name, x in arrays if eqx.is_inexact_array(x) and x.shape == ()}


def describe(system: "HybridSystem") -> dict[str, Any]:
    """The class of a system, its numbers by name, and a digest of its code, for stored results."""
    arrays = arrays_of(system).items()
    numbers = {
        name: float(x) if np.ndim(x) == 0 else digest_of(x) for name, x in arrays
    }
    return {
        "class": type(system).__qualname__,
        "numbers": numbers,
        "code": {name: marked(x) for name, x in parts_by_name(system).items()},
    }


def own_fields(system: Any) -> tuple[dataclasses.Field, ...]:
    """The fields of a system or its class that its author wrote: its parameters."""
    return tuple(
        x for x in dataclasses.fields(system) if x.name not in ("solver", "code_digest")
    )


def _number(x: Scalar) -> Array:
    return real(x)


def _positive_number(x: PositiveScalar) -> Array:
    return real(x)


def require_positive(system: "HybridSystem") -> None:
    """**Raises:** `DefinitionError` for a parameter of a system, or of one of several, that must be
    positive and is not. (The constructor does not see values that are traced or put in later.)"""
    for part in jax.tree_util.tree_leaves(
        system, is_leaf=lambda x: isinstance(x, HybridSystem) and x is not system
    ):
        if isinstance(part, HybridSystem):
            require_positive(part)
    for field in own_fields(system):
        value = getattr(system, field.name)
        if not field.metadata.get("positive") or is_tracer(value):
            continue
        wrong = np.asarray(value)[~(np.asarray(value) > 0)]
        if wrong.size:
            name = name_of(system)
            unit = field.metadata.get("unit", "")
            raise DefinitionError(
                f"parameter `{field.name}` of {name} is {wrong.flat[0]:g} {unit}".rstrip()
                + ": it must be positive."
            )


@checked
class Guess(eqx.Module):
    """Where the search for a limit cycle starts: a chart's name, a state there, and a time.

    `after` names the event that has just led to this state. For an autonomous system, the return
    map is then taken right after this event, unless a section is given. For `hj.flow`, where it is
    the start, there may be many states (L, n).

    **Example:**

    ```python
    guess = hj.Guess("flight", (2.0, 1.0, 0.0, 0.0))
    print(hj.find_limit_cycle(hopper, guess).period)
    ```

    **After:** `hj.find_limit_cycle`.
    """

    chart: str = eqx.field(static=True)
    state: Float[Array, "*L n"]
    time: Float[Array, ""]
    after: str | None = eqx.field(static=True, default=None)

    def __init__(
        self,
        chart: str,
        state: Annotated[Numbers, Reals()],
        time: Scalar = 0.0,
        *,
        after: str | None = None,
    ):
        if np.ndim(state) not in (1, 2):
            raise DefinitionError(
                f"Guess: `state` must be of shape (n,), or (L, n) for `hj.flow`, not of shape "
                f"{np.shape(state)}."
            )
        self.chart = chart
        self.state = real(state)
        self.time = real(time)
        self.after = after

    __repr__ = fields


DEFAULT_INPUT = "u"
SECOND_NAME = "input"
"""The name of the input of a system whose author named none, and its name where a state or an
output is called so."""

_being_named: contextvars.ContextVar[tuple[int, ...]] = contextvars.ContextVar(
    "being named", default=()
)


class _DefaultInputs:
    """The inputs of a system whose author named none: one, whose name yields to those of states and
    outputs."""

    def __get__(self, system: "HybridSystem | None", owner: type) -> tuple[str, ...]:
        if system is None or id(system) in _being_named.get():
            return (DEFAULT_INPUT,)
        # (Charts that ask their system for its inputs get the default.)
        token = _being_named.set((*_being_named.get(), id(system)))
        try:
            taken = {output.name for output in system.outputs()}
            for chart in system.charts().values():
                taken.update(chart.states, chart.absent)
        finally:
            _being_named.reset(token)
        return (SECOND_NAME if DEFAULT_INPUT in taken else DEFAULT_INPUT,)


class HybridSystem(Definition, metaclass=Leading):
    """A rhythmic hybrid system (paper Sec. II). Subclass it; its fields are the parameters.

    **Example:**

    ```python
    class Ball(hj.HybridSystem):
        g: hj.Parameter = hj.parameter(9.81)
        restitution: hj.Parameter = hj.parameter(0.7)

        def charts(self):
            return {"flight": Flight(self)}

        def transitions(self):
            bounce = lambda t, q, u: (q[0], -self.restitution * q[1])
            return (
                hj.Transition("bounce", "flight", "flight", lambda t, q, u: q[0], reset=bounce),
            )
    ```

    Every system defines `charts`, and `transitions` if it has events; `period`, `outputs` and
    `guess` are optional. The class attribute `inputs` names the exogenous inputs û. A system
    without inputs has `inputs = ()`. `input_units` gives their units in the same order (none, or
    one for each), and `time_unit` the unit of time. States, inputs and outputs have different
    names. The default of `inputs` is one input `u` (or `input`, if a state or an output is called
    `u`). `solver`, a keyword of every constructor, is the method of integration of all charts, or
    of some by name (`{"stance": hj.systems.Radau()}`); it overrides `Chart.solver`.
    """

    inputs: ClassVar[tuple[str, ...]] = _DefaultInputs()  # type: ignore[assignment]
    input_units: ClassVar[tuple[str, ...]] = ()
    time_unit: ClassVar[str] = ""

    solver: Solver | Method | ByChart | None = eqx.field(
        static=True,
        default=None,
        kw_only=True,
        converter=solvers,
    )

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        for name in ("charts", "transitions", "period", "outputs", "guess", "draw"):
            if not callable(vars(cls).get(name, callable)):
                raise DefinitionError(
                    f"{cls.__name__}: `{name}` must be a method: write `def {name}(self): return "
                    "...`."
                )
        for name in ("charts", "transitions", "outputs"):
            singular = name.removesuffix("s")
            if callable(vars(cls).get(singular)) and name not in vars(cls):
                raise DefinitionError(
                    f"{cls.__name__}: nothing reads the method `{singular}`: call it `{name}`."
                )

    def __new__(cls, *args, **kwargs):
        if cls.__abstractmethods__:
            raise DefinitionError(
                f"{cls.__name__} is a base class without `charts`: `hj.models` has systems, and "
                "`hj.HybridSystem.from_functions(states, field, [(name, guard, reset)])` or a "
                "class with `def charts(self)` makes one."
            )
        check_fields(cls, args, kwargs)
        return super().__new__(cls)

    @abc.abstractmethod
    def charts(self) -> dict[str, Chart]:
        """The charts by name."""

    def transitions(self) -> Sequence[Transition]:
        """The transitions between charts. The order breaks exact ties in time."""
        return ()

    def period(self) -> Any | None:
        """The period of the clock that drives the system, or `None` if it is autonomous.

        Fields, guards, resets and outputs of a clocked system must have this period in t, for all
        values of its parameters. Those of an autonomous one must not depend on t.
        """
        return None

    def outputs(self) -> Sequence[Output]:
        """Outputs that can be asked for by name, besides the states."""
        return ()

    def guess(self) -> Guess | None:
        """The default guess for the search of the limit cycle, or `None`."""
        return None

    def draw(
        self,
        chart: str,
        t: Float[Array, ""],
        q: Mapping[str, Any],
    ) -> Drawing | None:
        """What the system looks like in a chart, for `hj.plot.animate`: a `Drawing`, written for
        one state as a vector field is. `q` holds the states of the chart and the values of those
        that it lacks (`Chart.absent`) by name. `None`, the default: states are drawn over time."""
        return None

    @staticmethod
    @checked
    def from_functions(
        states: NewNames,
        field: Callable[..., Any],
        events: Sequence[tuple[str, Callable[..., Any], Callable[..., Any]]] = (),
        parameters: Mapping[str, float] | None = None,
        *,
        period: str | float | Callable[[Any], Any] | None = None,
        inputs: NewOptionalNames | None = None,
        time_unit: str = "",
        name: str = "System",
    ) -> "HybridSystem":
        """Make a system of one chart, `"main"`, from functions.

        **Arguments:**

        - `states`: names, or units by name, as in `{"y": "m", "v": "m/s"}`.
        - `field`: the vector field, `(t, q, u, p)` -> n numbers. t is the time, q (n,) the state,
          u the inputs. `p.g` is the parameter g. Each function may leave out the last arguments,
          as `(t, q)` -> n numbers.
        - `events`: for each its name, its guard `(t, q, u, p)` -> number, which falls through zero
          at the event, and its reset `(t, q, u, p)` -> state after it.
        - `parameters`: values by name. They can be fitted, swept and differentiated by.
        - `period`: that of the clock which drives the system: a number, the name of a parameter,
          or a function of p. Default: None, no clock.
        - `inputs`: names, or units by name. Default: one, `u`.
        - `time_unit`: unit of time. `name`: the name of the system's class.

        **Returns:** a `HybridSystem`; `system.replace(g=1.6)` has other parameters.

        **Raises:** `DefinitionError` for a parameter that is called like an attribute of systems,
        and for a period that is the name of none.

        **Example:**

        ```python
        ball = hj.HybridSystem.from_functions(
            ("y", "v"),
            lambda t, q, u, p: (q[1], u[0] - p.g),
            [("impact", lambda t, q, u, p: q[0], lambda t, q, u, p: (q[0], -p.e * q[1]))],
            {"g": 9.81, "e": 0.7},
        )
        hj.simulate(ball, hj.Guess("main", (1.0, 0.0)), 2.0)
        ```
        """
        values = dict(parameters or {})
        for parameter_name in values:
            if hasattr(HybridSystem, parameter_name):
                raise DefinitionError(
                    f"`parameters`: systems have another attribute '{parameter_name}': rename the "
                    "parameter."
                )
        if isinstance(period, str):
            require_among("parameter", [period], values, "`period`: ")
        made = _Functions(tuple(states), field, tuple(events), period)
        namespace: dict[str, Any] = {
            "__annotations__": dict.fromkeys(values, Parameter),
            "__doc__": "A system of one chart, made from functions.",
            # (Changes of what these functions read are noticed in classes of users only.)
            "__module__": "__main__",
            "_made_of": made,
            **{key: parameter(value) for key, value in values.items()},
            "charts": lambda self: made.charts(self),
            "transitions": lambda self: made.transitions(self),
            "period": lambda self: made.period_of(self),
            "time_unit": time_unit,
        }
        if inputs is not None:
            named = inputs
            namespace["inputs"] = tuple(map(str, named))
            namespace["input_units"] = tuple(map(unit_of, named))
        made_class = types.new_class(
            name, (HybridSystem,), {}, lambda body: body.update(namespace)
        )
        return made_class()

    def replace(self, **parameters: Any) -> "HybridSystem":
        """Return the system with other parameters: `system.replace(k=9.0)`.

        **Raises:** `DefinitionError` for a name that is no parameter, and for a value that a
        parameter may not have.
        """
        return dataclasses.replace(self, **parameters)

    __getattr__ = missing_attribute
    __setattr__ = fixed_attribute

    def __repr__(self):
        rows = []
        for field in own_fields(self):
            unit, doc = (field.metadata.get(key, "") for key in ("unit", "doc"))
            rows.append(
                (field.name, f"{value(getattr(self, field.name))} {unit}".rstrip(), doc)
            )
        if self.solver is not None:
            rows.append(("solver", repr(self.solver), "how charts are integrated"))
        return type(self).__name__ + columns(rows)


# (For type checkers it is a plain method.)
setattr(HybridSystem, "replace", Bound(HybridSystem.replace))  # noqa: B010


class _Functions(NamedTuple):
    """The functions of which `HybridSystem.from_functions` makes a system."""

    states: tuple[str, ...]
    field: Callable[..., Any]
    events: tuple[tuple[str, Callable[..., Any], Callable[..., Any]], ...]
    period: Any

    def charts(self, system: HybridSystem) -> dict[str, Chart]:
        field = _with_parameters(self.field, system)
        units = tuple(map(unit_of, self.states))
        names = tuple(map(str, self.states))
        return {"main": FieldChart(field, names, units if any(units) else ())}

    def transitions(self, system: HybridSystem) -> list[Transition]:
        transitions = []
        for name, guard, reset in self.events:
            transition = Transition(
                name,
                "main",
                "main",
                guard=_with_parameters(guard, system),
                reset=_with_parameters(reset, system),
            )
            transitions.append(transition)
        return transitions

    def period_of(self, system: HybridSystem) -> Any:
        if callable(self.period):
            return self.period(system)
        if isinstance(self.period, str):
            return getattr(system, self.period)
        return self.period


def _with_parameters(function: Callable[..., Any], system: HybridSystem) -> Callable:
    """Return a function (t, q, u) from one of (t, q, u, p), or of the first of these."""
    count = _count_taken(function)
    return lambda t, q, u: function(*(t, q, u, system)[:count])


def taken_by_position(function: Callable[..., Any]) -> list[str] | None:
    """The names of the arguments that a field, a guard or a reset gets; None where its signature is
    unknown, as of functions in C, or has no end."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return None
    if any(x.kind is x.VAR_POSITIONAL for x in parameters):
        return None
    # (Others with defaults belong to the author, as k in `lambda t, q, k=k: ...`.)
    by_position = [x for x in parameters if x.kind <= x.POSITIONAL_OR_KEYWORD]
    return [x.name for x in by_position if x.default is x.empty or x.name in ("u", "p")]


def _count_taken(function: Callable[..., Any]) -> int:
    """The number of (t, q, u, p) that a function takes."""
    names = taken_by_position(function)
    if names is None:
        return 4
    if len(names) == 3 and names[2] == "p":  # (It would get the inputs.)
        return 4
    return min(max(len(names), 2), 4)


def integrated(system: HybridSystem, solver: Any) -> HybridSystem:
    """The same system, integrated by this solver, or by solvers by the names of charts."""
    other = copy.copy(system)
    object.__setattr__(other, "solver", solvers(solver))
    return current(other)


class Derived(HybridSystem):
    """A system made from another system. Charts, transitions and so on that it does not define are
    those of the other system."""

    system: HybridSystem

    inputs = attribute_of("system", "inputs")
    time_unit = attribute_of("system", "time_unit")
    input_units = attribute_of("system", "input_units")

    def charts(self):
        return self.system.charts()

    def transitions(self):
        return self.system.transitions()

    def period(self):
        return self.system.period()

    def outputs(self):
        return self.system.outputs()

    def draw(self, chart, t, q):
        return self.system.draw(chart, t, q)

    def guess(self):
        return self.system.guess()


class Driven(Derived):
    """`system` with a further input that is a function of time. It is added to the piecewise
    constant input."""

    drive: Callable[[Any], Any]


def name_of(system: HybridSystem) -> str:
    """The name of the class that the user wrote, also of a system that was made of it."""
    while isinstance(system, Derived):
        system = system.system
    return type(system).__name__


@parts_of.register
def _(system: HybridSystem, t: Any, q: Any, u: Any) -> Iterator[Part]:
    charts = system.charts()
    yield Part("the period", str(system.period() is None), system.period)
    names = [tuple(x) for x in (system.inputs, system.input_units, charts)]
    yield Part("the names of inputs and charts", repr((*names, system.time_unit)))
    if system.solver is not None:
        yield Part("the solver", meaning(system.solver))
    if isinstance(system, Driven):
        yield Part("the input", "", ft.partial(system.drive, t))
    if isinstance(system, Derived):  # (of which a part may be left out)
        for part in parts_of(system.system, t, q, u) or ():
            yield part._replace(name=f"{part.name} of the original system")
    inputs = {}
    for name, chart in charts.items():
        used = system.inputs if chart.inputs is None else chart.inputs
        columns = np.array([system.inputs.index(x) for x in used], int)
        inputs[name] = t, q[: len(chart.states)], u[columns]
        yield from _parts_of_chart(name, chart, inputs[name])
    for x in system.transitions():
        yield from _parts_of_transition(x, inputs[x.source])
    for x in system.outputs():
        for name in charts:
            function = x.in_chart(name)
            if function is not None:
                at = ft.partial(function, *inputs[name])
                about = f"the output '{x.name}' in chart '{name}'"
                yield Part(about, repr((x.name, x.unit)), at)


def _parts_of_chart(name: str, chart: Chart, point: tuple) -> Iterator[Part]:
    about = chart.states, chart.units, chart.inputs, sorted(chart.absent)
    yield Part(f"the list of states of chart '{name}'", repr(about))
    yield Part(f"`absent` of chart '{name}'", "", lambda: dict(chart.absent))
    if chart.solver is not None:
        yield Part(f"the solver of chart '{name}'", meaning(chart.solver))
    yield Part(f"the field of chart '{name}'", "", ft.partial(chart.field, *point))


def _parts_of_transition(x: Transition, point: tuple) -> Iterator[Part]:
    kind = f"the transition '{x.name}'"
    yield Part(kind, f"{x.source}, {x.target}, {x.direction}")
    if isinstance(x.guard, Scheduled):
        times = x.guard.period, x.guard.offset
        yield Part(f"the schedule of '{x.name}'", "", lambda: times)
    else:
        yield Part(f"the guard of '{x.name}'", "", ft.partial(x.guard, *point))
    yield Part(f"the reset of '{x.name}'", "", ft.partial(x.reset, *point))
    if x.enabled is not None:
        yield Part(f"`enabled` of '{x.name}'", "", ft.partial(x.enabled, *point))
