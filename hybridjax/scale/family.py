"""Systems as a function of parameters."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.fingerprint import IndescribableError, program_digest
from .._core.pieces.description import digest_of, function_digest
from .._core.precision import require_x64
from ..engine.describe import describe
from ..errors import DefinitionError
from ..systems.check import check_system
from ..systems.system import HybridSystem, unit_of_parameter


class Family:
    """What `sweep` is given: a system of which some parameters take other values, or a function of
    parameters that returns a system."""

    def __init__(self, model: HybridSystem | Callable[..., HybridSystem], names: Sequence[str]):
        self.model, self.names = model, tuple(names)
        known, required = _parameters(model)
        for name in self.names:
            if known is not None and name not in known:
                raise DefinitionError(
                    f"`{name}` is no parameter of the model; its parameters are "
                    f"{', '.join(known) or 'none'}."
                )
        for name in required:
            if name not in self.names:
                raise DefinitionError(f"the model needs `{name}`: give it an axis.")

    def system(self, values: Mapping[str, Any]) -> Any:
        """The system at one point."""
        if not isinstance(self.model, HybridSystem):
            return self.model(**values)
        paths = [name.split(".") for name in self.names]
        return eqx.tree_at(
            lambda system: [_follow(system, path) for path in paths],
            self.model,
            [jnp.asarray(values[name], float) for name in self.names],
        )

    def systems(self, values: Mapping[str, np.ndarray]) -> HybridSystem:
        """The systems at some points: one whose arrays have a leading axis."""
        return eqx.filter_vmap(self.system)({name: jnp.asarray(x) for name, x in values.items()})

    def check(self, values: Mapping[str, float]) -> HybridSystem:
        """The system at a point.

        **Raises:** `DefinitionError` if there is none.
        """
        system = self.system({name: jnp.asarray(x) for name, x in values.items()})
        if not isinstance(system, HybridSystem):
            raise DefinitionError(
                f"`model` must be a system, or a function of parameters that returns one, not a "
                f"{type(system).__name__}."
            )
        require_x64(system)
        check_system(system)
        return system

    def units(self, system: HybridSystem) -> dict[str, str]:
        """Of the parameters, "" where none is known."""
        found = {}
        for name in self.names:
            try:
                found[name] = unit_of_parameter(system, name)
            except (AttributeError, KeyError):  # a parameter of a function
                found[name] = ""
        return found

    def describe(self, values: Mapping[str, float]) -> dict[str, Any]:
        """The model in words and digests, at a point."""
        found = describe(self.check(values))
        if isinstance(self.model, HybridSystem):
            for name in self.names:
                del found["numbers"][name]
            return found
        return found | {"from parameters": self._of_parameters(values)}

    def _of_parameters(self, values: Mapping[str, float]) -> str:
        def numbers(values):
            return jax.tree_util.tree_leaves(eqx.filter(self.system(values), eqx.is_array))

        try:
            given = {name: jnp.asarray(x) for name, x in values.items()}
            return digest_of(program_digest(numbers, given))
        except IndescribableError:
            return function_digest(self.model)


def _parameters(model: Any) -> tuple[list[str] | None, list[str]]:
    """Names that may be given (None: any), and those that have to be."""
    if isinstance(model, HybridSystem):
        leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(model, eqx.is_inexact_array))[0]
        scalars = [path for path, leaf in leaves if leaf.shape == ()]
        return [".".join(str(getattr(x, "name", x)) for x in path) for path in scalars], []
    parameters = inspect.signature(model).parameters.values()
    if any(x.kind is x.VAR_KEYWORD for x in parameters):
        return None, []
    usual = [x for x in parameters if x.kind in (x.POSITIONAL_OR_KEYWORD, x.KEYWORD_ONLY)]
    return [x.name for x in usual], [x.name for x in usual if x.default is x.empty]


def _follow(system: Any, path: Sequence[str]) -> Any:
    for name in path:
        system = getattr(system, name)
    return system
