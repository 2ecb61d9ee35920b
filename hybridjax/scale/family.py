"""Systems as a function of parameters (`Family`), and the points at which a sweep evaluates them
(`SweepPoints` of users, `Space` within a sweep).

`sweeps.py` calls both. A `Family` is a system some of whose parameters vary, or a function of
parameters that returns a system. `Family.describe` is the part of a sweep's description by which a
store recognizes the model. If a point gets the values of another one, look at `Space.at`; if a
changed model is not noticed, at `Family.describe`.

The order of parameters in `Space.axes` must stay that in which they were given: it is the order of
the dimensions of results and of stores. A further way to choose points is a class method of
`SweepPoints`, as `sobol`. If a parameter is refused without need, look at `Family.__init__`.
"""

import contextlib
import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Scalar, Seed, Vector
from .._core.meaning import current_of_many
from .._core.pieces.description import digest_of
from .._core.pieces.store import Constant
from .._core.precision import require_x64
from ..errors import DefinitionError
from ..orbits.checks import check_periodic
from ..systems.system import (
    HybridSystem,
    describe,
    parameters_of,
    require_positive,
    unit_of_parameter,
)
from ..systems.varied import parameter_of, with_parameters


Axes = Mapping[str, Vector]
"""Values of parameters by name."""

Axis = Vector | Scalar
"""Values of one parameter: several, or one."""


@checked
class SweepPoints:
    """A list of points for `sweep`, each with one value of every parameter.

    **Example:**

    ```python
    points = hj.scale.SweepPoints({"k": [9.5, 10.0, 10.5], "b": [4.5, 5.0, 5.5]})
    print(hj.sweep(hopper, points).spectral_radius)
    ```

    **After:** `hj.sweep`.
    """

    def __init__(self, values: Axes):
        """**Arguments:** `values` of each parameter by name, all of one length.

        **Raises:** `DefinitionError` if there are none, or lengths differ.
        """
        self.values = {name: np.asarray(x, float) for name, x in values.items()}
        lengths = sorted({len(x) for x in self.values.values()})
        if len(lengths) != 1 or lengths == [0]:
            numbers = ", ".join(map(str, lengths)) or "none"
            raise DefinitionError(
                f"`values` must hold as many of each parameter, not {numbers}."
            )

    @classmethod
    def sobol(
        cls,
        ranges: Mapping[str, tuple[float, float]],
        count: ExperimentCount,
        *,
        seed: Seed = 0,
    ) -> "SweepPoints":
        """Return points that cover a box evenly, from a scrambled Sobol sequence (Owen 1998).

        **Arguments:** `ranges`: the lowest and the highest value of each parameter. `count`: number
        of points, best a power of two. `seed`: seed of the random scrambling of the Sobol sequence.
        Default: 0.

        **Raises:** `DefinitionError` for an empty range.
        """
        from scipy.stats import qmc  # takes long to import

        for name, (low, high) in ranges.items():
            if not low < high:
                raise DefinitionError(
                    f"the range of `{name}` must go up: {low} to {high}."
                )
        if not ranges:
            raise DefinitionError("`ranges` must name at least one parameter.")
        sequence = qmc.Sobol(len(ranges), rng=np.random.default_rng(seed))
        unit = sequence.random_base2(max(count - 1, 0).bit_length())[:count]
        low, high = np.array(list(ranges.values())).T
        values = low + (high - low) * unit
        return cls(dict(zip(ranges, values.T, strict=True)))

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __repr__(self) -> str:
        return f"SweepPoints({len(self)} of {', '.join(self.values)})"


@dataclasses.dataclass(frozen=True)
class Space:
    """The points of a sweep: all combinations of the values on the `axes` if `grid`, else a list of
    points."""

    axes: Mapping[str, Float[np.ndarray, " n"]]
    grid: bool

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions of results."""
        return tuple(self.axes) if self.grid else ("point",)

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of points along the dimensions."""
        return tuple(map(len, self.axes.values()))[: len(self.dims)]

    def at(self, index: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
        """Return the parameters at some points, given one index array per dimension."""
        each = index if self.grid else index * len(self.axes)
        return {
            name: x[i] for (name, x), i in zip(self.axes.items(), each, strict=True)
        }

    def constants(self, units: Mapping[str, str]) -> dict[str, Constant]:
        """Return the parameters as coordinates of results."""
        dims = self.dims if self.grid else self.dims * len(self.axes)
        about = {name: {"units": unit} if unit else {} for name, unit in units.items()}
        return {
            n: ((d,), x, about[n])
            for d, (n, x) in zip(dims, self.axes.items(), strict=True)
        }


class Family:
    """A system some of whose parameters vary, or a function of parameters that returns a system."""

    def __init__(
        self, model: HybridSystem | Callable[..., HybridSystem], names: Sequence[str]
    ):
        self.model = model
        self.names = tuple(names)
        allowed, required = _parameters(model)
        if isinstance(model, HybridSystem):
            for name in self.names:
                parameter_of(model, name)
        elif allowed is not None:
            require_among("parameter", self.names, allowed, "`model`: ")
        for name in required:
            if name not in self.names:
                raise DefinitionError(f"the model needs `{name}`: give it an axis.")

    def system(self, values: Mapping[str, Any]) -> Any:
        """Return the system at one point."""
        if not isinstance(self.model, HybridSystem):
            return self.model(**values)
        return with_parameters(self.model, {name: values[name] for name in self.names})

    def systems(self, values: Mapping[str, np.ndarray]) -> HybridSystem:
        """Return the systems at several points as one, whose arrays have a leading axis.

        **Raises:** `DefinitionError` for a parameter that must be positive and is not.
        """
        arrays = {name: jnp.asarray(x) for name, x in values.items()}
        systems = current_of_many(eqx.filter_vmap(self.system)(arrays))
        require_positive(systems)
        return systems

    def check(self, values: Mapping[str, float]) -> HybridSystem:
        """Return the system at one point.

        **Raises:** `DefinitionError` if `model` returns something else, or a bad system.
        """
        numbers = {name: jnp.asarray(x) for name, x in values.items()}
        system = self.system(numbers)
        if not isinstance(system, HybridSystem):
            raise DefinitionError(
                "`model` must be a system, or a function of parameters that returns one, not a "
                f"{type(system).__name__}."
            )
        require_x64(system)
        check_periodic(system)
        return system

    def units(self, system: HybridSystem) -> dict[str, str]:
        """Return the units of the parameters, "" if unknown."""
        units = dict.fromkeys(self.names, "")
        for name in self.names:
            # (A parameter of a function has no unit.)
            with contextlib.suppress(AttributeError, KeyError):
                units[name] = unit_of_parameter(system, name)
        return units

    def describe(self, system: HybridSystem) -> dict[str, Any]:
        """Return JSON from which the model can be told from others, given the system at a point."""
        model = describe(system)
        if isinstance(self.model, HybridSystem):
            for name in self.names:
                del model["numbers"][name]
            return model
        return model | {"from parameters": digest_of(self.model)}


def _parameters(model: Any) -> tuple[list[str] | None, list[str]]:
    """Return the names of all parameters (None: any name) and of those without a default."""
    if isinstance(model, HybridSystem):
        return list(parameters_of(model)), []
    parameters = inspect.signature(model).parameters.values()
    if any(x.kind is x.VAR_KEYWORD for x in parameters):
        return None, []
    usual = [
        x for x in parameters if x.kind in (x.POSITIONAL_OR_KEYWORD, x.KEYWORD_ONLY)
    ]
    return [x.name for x in usual], [x.name for x in usual if x.default is x.empty]
