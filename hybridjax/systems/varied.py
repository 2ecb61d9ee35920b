"""Parameters by name, and parameters as inputs: a system whose inputs are added to them."""

import dataclasses
import operator
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._core.arguments import require_among
from .._core.executor import Array
from .chart import Chart, FieldChart
from .structure import Structure
from .system import Derived, HybridSystem, parameters_of
from .transition import Scheduled


def parameter_of(system: HybridSystem, parameter: str) -> Array:
    """The parameter of that name.

    **Raises:** `DefinitionError` if there is none.
    """
    numbers = parameters_of(system)
    require_among("parameter", [parameter], numbers, f"{type(system).__name__}: ")
    return numbers[parameter]


def with_parameters(system: HybridSystem, values: Mapping[str, Any]) -> HybridSystem:
    """The system with other values of some parameters."""
    where = lambda x: [operator.attrgetter(name)(x) for name in values]  # noqa: E731
    return eqx.tree_at(where, system, [jnp.asarray(x, float) for x in values.values()])


class Varied(Derived):
    """`system`, whose one input is added to a parameter; its own inputs are zero."""

    input_units: ClassVar[tuple[str, ...]] = ()
    parameter: str = eqx.field(static=True)

    def __init__(self, system: HybridSystem, parameter: str):
        parameter_of(system, parameter)
        self.system, self.parameter, self.solver = system, parameter, system.solver

    @property
    def inputs(self) -> tuple[str, ...]:  # type: ignore[override]  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self.parameter,)

    def at(self, change: Array) -> HybridSystem:
        """The system after a change of the parameter."""
        value = parameter_of(self.system, self.parameter)
        return with_parameters(self.system, {self.parameter: value + change})

    def charts(self):
        return {name: self._chart(name, x) for name, x in self.system.charts().items()}

    def _chart(self, name: str, x: Chart):
        still = jnp.zeros(self._size(name))
        field = lambda t, q, u: self.at(u[0]).charts()[name].field(t, q, still)  # noqa: E731
        return FieldChart(field, x.states, x.units, x.solver)

    def transitions(self):
        return [self._transition(g, x) for g, x in enumerate(self.system.transitions())]

    def _transition(self, g: int, x: Any):
        still = jnp.zeros(self._size(x.source))

        def of(name):
            function = getattr(x, name)
            if function is None or isinstance(function, Scheduled):
                return function
            return lambda t, q, u: getattr(list(self.at(u[0]).transitions())[g], name)(t, q, still)

        return dataclasses.replace(x, **{name: of(name) for name in ("guard", "reset", "enabled")})

    def _size(self, chart: str) -> int:
        inputs = self.system.charts()[chart].inputs
        return len(self.system.inputs if inputs is None else inputs)


def under(s: Structure, u: Array) -> Structure:
    """The structure of a system at the parameter to which its input is added, if it is `Varied`."""
    return Structure(s.system.at(u[0])) if isinstance(s.system, Varied) else s
