"""Parameters by name, and parameters as inputs: a system whose inputs are added to them."""

import dataclasses
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._core.executor import Array
from ..errors import DefinitionError
from .chart import DerivedChart
from .system import Derived, HybridSystem, unit_of_parameter
from .transition import Scheduled


def parameter_of(system: HybridSystem, parameter: str) -> Array:
    """The parameter of that name.

    **Raises:** `DefinitionError` if there is none.
    """
    leaves = jax.tree_util.tree_leaves_with_path(system)
    is_number = lambda x: eqx.is_inexact_array(x) and x.shape == ()  # noqa: E731
    names = (jax.tree_util.keystr(path).lstrip(".") for path, x in leaves if is_number(x))
    name, text = type(system).__name__, f"parameters are {', '.join(names)}."
    try:
        value = operator.attrgetter(parameter)(system)
    except (AttributeError, TypeError) as error:
        raise DefinitionError(f"{name} has no parameter '{parameter}'; {text}") from error
    if not is_number(value):
        raise DefinitionError(f"'{parameter}' of {name} is no single floating-point number; {text}")
    return value


def with_parameter(system: HybridSystem, parameter: str, value: Any) -> HybridSystem:
    """The system with another value of a parameter."""
    return eqx.tree_at(operator.attrgetter(parameter), system, jnp.asarray(value, float))


class Varied(Derived):
    """`system`, whose one input is added to a parameter; its own inputs are zero."""

    parameter: str = eqx.field(static=True)

    def __init__(self, system: HybridSystem, parameter: str):
        parameter_of(system, parameter)
        self.system, self.parameter, self.solver = system, parameter, system.solver

    @property
    def inputs(self) -> tuple[str, ...]:  # type: ignore[override]  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self.parameter,)

    @property
    def input_units(self) -> tuple[str, ...]:  # type: ignore[override]  # pyright: ignore[reportIncompatibleVariableOverride]
        unit = unit_of_parameter(self.system, self.parameter)
        return (unit,) if unit else ()

    def at(self, change: Array) -> HybridSystem:
        """The system after a change of the parameter."""
        value = parameter_of(self.system, self.parameter)
        return with_parameter(self.system, self.parameter, value + change)

    def charts(self):
        return {name: _Varied(x, self, name) for name, x in self.system.charts().items()}

    def transitions(self):
        return [self._transition(g, x) for g, x in enumerate(self.system.transitions())]

    def _transition(self, g: int, x: Any):
        still = jnp.zeros(self._size(x.source))

        def of(name):
            function = getattr(x, name)
            if function is None or isinstance(function, Scheduled):
                return function
            return lambda t, q, u: getattr(list(self.at(u[0]).transitions())[g], name)(t, q, still)

        names = "guard", "reset", "enabled"
        return dataclasses.replace(x, **{name: of(name) for name in names})

    def _size(self, chart: str) -> int:
        inputs = self.system.charts()[chart].inputs
        return len(self.system.inputs if inputs is None else inputs)


class _Varied(DerivedChart):
    """A chart of the system at another value of the parameter."""

    varied: Varied
    name: str = eqx.field(static=True)
    inputs = None  # type: ignore[assignment]

    def field(self, t, q, u):
        chart = self.varied.at(u[0]).charts()[self.name]
        return chart.field(t, q, jnp.zeros(self.varied._size(self.name)))
