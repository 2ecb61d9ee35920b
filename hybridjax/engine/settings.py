"""Accuracy and effort of the flow, and every accuracy that the package takes by default."""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


# Default accuracies: the error that one step may have, relative to the size of each state. A tenth
# of the accuracy costs about 1.4 times as many steps (the method has order 7).
SIMULATION = 1e-10
"""Single trajectories (`simulate`), and settings that do not say."""
LIMIT_CYCLE = 1e-12
"""Limit cycles, and all that is linearized along them."""
SWEEP = 1e-9
"""Many limit cycles at once (`find_limit_cycles`)."""
TRANSIENT = 1e-6
"""Waiting until transients have died out, where a sweep's Newton fails."""

# Accuracies of data: the error at every section, accumulated since the start of an experiment,
# relative to the size of each state on the limit cycle.
EXPERIMENT = 1e-9
"""Experiments in double precision, and response functions."""
SINGLE_PRECISION_EXPERIMENT = 1e-4
"""Experiments in single precision."""
STEADY_START = 1e-10
"""Starts of periodic responses, relative to their largest entry."""


def _number(x) -> Array:
    return jnp.asarray(x, float)


def _numbers(x) -> Array | None:
    return None if x is None else jnp.asarray(x, float)


class Settings(eqx.Module):
    """Accuracy and effort of the flow.

    The estimated error of a step in state k of chart a is at most
    `rtol * |q[k]| + atol * scale[a, k]`.
    """

    rtol: Float[Array, ""] = eqx.field(converter=_number, default=SIMULATION)
    """Error of a step relative to each state's own size."""
    atol: Float[Array, ""] = eqx.field(converter=_number, default=SIMULATION)
    """Error of a step relative to each state's `scale`."""
    max_steps: int = eqx.field(static=True, default=256)
    """Bound on the number of iterations (steps, tried or taken) of one piece of flow."""
    scale: Float[Array, "A d"] | None = eqx.field(converter=_numbers, default=None)
    """Sizes that states usually have, by chart, padded to the dimension of the largest with
    anything; `None` for 1 in each state's own unit."""

    def tolerance(self, a: int, *q: Float[Array, "n L"]) -> Float[Array, "n L"]:
        """The error allowed in each state of chart a, for a step between the states `q`.

        (`rtol`, `atol` and `scale` may have lanes on a last axis of their own: see `PerLane`.)
        """
        size = ft.reduce(jnp.maximum, map(jnp.abs, q))
        if self.scale is None:
            return self.atol + self.rtol * size
        n = len(size)
        return self.atol * self.scale[a, :n].reshape(n, -1) + self.rtol * size
