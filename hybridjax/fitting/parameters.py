"""Free parameters of a system: names, bounds, and coordinates without bounds."""

import operator
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import DefinitionError
from ..systems.system import HybridSystem


Bounds = tuple[float | int, float | int]
Free = str | Sequence[str] | Mapping[str, Bounds | None]


class Parameters(eqx.Module):
    r"""The free parameters of a system, and coordinates x for them that have no bounds.

    With a bound on one side $v = l + e^x$ or $v = h - e^x$; with two $v = l + (h - l)/(1 +
    e^{-x})$; without any $v = s x$, with the size s of the first guess (1 if that is zero: then
    the parameter's unit matters, unless it has bounds). A parameter that only keeps its sign is
    therefore changed by factors.

    **Fields:** `names`; `low`, `high` (p,), infinite where there is no bound; `size` (p,).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    size: Float[Array, " p"]

    def read(self, system: HybridSystem) -> Float[Array, " p"]:
        """The values that a system has."""
        return jnp.stack([operator.attrgetter(name)(system) for name in self.names])

    def insert(self, system: HybridSystem, values: Float[Array, " p"]) -> HybridSystem:
        """The system with other values."""
        where = lambda s: [operator.attrgetter(name)(s) for name in self.names]  # noqa: E731
        return eqx.tree_at(where, system, list(values))

    def encode(self, values: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """Coordinates of values, NaN for those outside of their bounds."""
        low, high, cases = self._bounds()
        up, down = values - low, high - values
        return jnp.select(
            cases, [jnp.log(up / down), jnp.log(up), jnp.log(down)], values / self.size
        )

    def decode(self, x: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """Values at coordinates x."""
        low, high, cases = self._bounds()
        inside = low + (high - low) * jax.nn.sigmoid(x)
        return jnp.select(cases, [inside, low + jnp.exp(x), high - jnp.exp(x)], x * self.size)

    def _bounds(self):
        """Bounds with zero for infinity; where there are both, a low one, a high one."""
        low, high = jnp.isfinite(self.low), jnp.isfinite(self.high)
        finite = jnp.where(low, self.low, 0.0), jnp.where(high, self.high, 0.0)
        return *finite, [low & high, low, high]


def free_parameters(system: HybridSystem, free: Free) -> Parameters:
    """`free` as `fit_model` takes it, checked against a system.

    **Raises:** `DefinitionError` for names that are no numbers of the system, or bounds that do not
    enclose the values that it has.
    """
    free = (free,) if isinstance(free, str) else free
    names = tuple(free)
    if not names or len(set(names)) < len(names):
        raise DefinitionError(f"`free` names parameters, each once, and at least one: {names}.")
    low, high, size = [], [], []
    for name in names:
        value = _number(system, name)
        bounds = free[name] if isinstance(free, Mapping) else None
        if bounds is None:  # it keeps its sign
            bounds = (0.0 if value > 0 else -np.inf, 0.0 if value < 0 else np.inf)
        if len(bounds) != 2 or not bounds[0] < value < bounds[1]:
            raise DefinitionError(
                f"the bounds of '{name}', {bounds}, must be two numbers that enclose the value at "
                f"which the fit starts, {value:g}."
            )
        low.append(float(bounds[0]))
        high.append(float(bounds[1]))
        size.append(abs(value) if value else 1.0)
    return Parameters(names, jnp.array(low), jnp.array(high), jnp.array(size))


def _number(system: HybridSystem, name: str) -> float:
    try:
        value = operator.attrgetter(name)(system)
    except AttributeError:
        value = None
    if not eqx.is_inexact_array(value) or value.shape != ():
        known = [n for n, v in vars(system).items() if eqx.is_inexact_array(v) and v.shape == ()]
        raise DefinitionError(
            f"'{name}' is no parameter of {type(system).__name__} (a number that was declared by "
            f"hj.parameter); those are {', '.join(known)}."
        )
    return float(value)
