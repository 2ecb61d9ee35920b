"""Parameters by name (`parameter_of`, `with_parameters`), and parameters as inputs (`Varied`).

`Varied` is a structure whose single input is added to a parameter: derivatives by this input are
derivatives by the parameter. Sensitivities and continuation use it.

Fields, guards and resets are evaluated at the changed parameter here, by `_under`; periods,
outputs, schedules and levels of sections in `engine/kernels.py`, by `Structure.under`. A further
function with derivatives by parameters needs the one or the other. If a derivative lacks a part,
look at these two; if a parameter is not found, at `parameters_of` in `system.py`, which lists
single floating-point numbers only.
"""

import operator
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._core.boundary.leads import about_parameter
from .._core.executor import Array
from ..errors import DefinitionError
from .structure import Structure
from .system import HybridSystem, parameters_of


def parameter_of(system: HybridSystem, parameter: str) -> Array:
    """The parameter of that name.

    **Raises:** `DefinitionError` if there is none.
    """
    numbers = parameters_of(system)
    if parameter not in numbers:
        raise DefinitionError(about_parameter(type(system), parameter, list(numbers)))
    return numbers[parameter]


def with_parameters(system: HybridSystem, values: Mapping[str, Any]) -> HybridSystem:
    """The system with other values of some parameters."""

    def where(x):
        return [operator.attrgetter(name)(x) for name in values]

    return eqx.tree_at(where, system, [jnp.asarray(x, float) for x in values.values()])


def _under(name: str) -> Any:
    """The method of that name of the structure `under` an input: a function (x, t, q, u) of a chart
    or transition x."""

    def function(self, x, t, q, u):
        s = self.under(u)
        return getattr(s, name)(x, t, q, jnp.zeros(s.nu))

    return function


@jax.tree_util.register_pytree_node_class
class Varied(Structure):
    """The structure of a system whose one input is added to a parameter; its own inputs are zero.

    Transitions have the guards of the unchanged system, but for those of `under`.
    """

    nu = 1  # type: ignore[assignment]
    field, guard, reset = map(_under, ("field", "guard", "reset"))

    def __init__(self, source: HybridSystem, parameter: str):
        super().__init__(source)
        self.parameter = parameter

    def tree_flatten(self):
        return (self.source,), self.parameter

    @classmethod
    def tree_unflatten(cls, parameter, children):
        return cls(children[0], parameter)

    def under(self, u: Array) -> Structure:
        """The structure whose parameter is larger by the input u (1,)."""
        value = parameter_of(self.system, self.parameter) + u[0]
        return Structure(with_parameters(self.system, {self.parameter: value}))
