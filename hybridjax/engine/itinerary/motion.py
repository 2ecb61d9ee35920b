"""Stages, which serve trajectories alone and trajectories with their derivatives.

A row of an itinerary is done in stages, `moving, notes = stage(constants, moving, notes)`. Here,
`moving` are numbers that have derivatives, such as the `Course` of a trajectory, and `notes` are
numbers that have none, such as its `Flags`. Code that chains stages takes a `Motion`:

| | `Alone` | `InDirections` |
|---|---|---|
| `moving` is | the values | the pair (values, derivatives), directions on the first axis |
| `apply(stage, ...)` | calls the stage | calls it, and pushes the derivatives forward |
| `pack(x)` of x (...) | x | one array (1 + directions, ...) |

The derivative of a choice among stages is the choice among derivatives (`choose`): JAX would take
many times as long to differentiate the choice itself.

`turn.py` makes the `Motion`, and `bodies.py` uses it. Both classes must keep the same methods, so
that code with a `Motion` has no cases. If values are right and a derivative is zero that should not
be, look for a number with derivatives among the `notes`, or for a `still` around it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..._core.loops import pushed


Stage: TypeAlias = Callable[[Any, Any, Any], tuple[Any, Any]]


class Alone(NamedTuple):
    """Values only."""

    constants: Any

    def apply(self, stage: Stage, moving: Any, notes: Any) -> tuple[Any, Any]:
        """`moving` and `notes` after a stage."""
        return stage(self.constants, moving, notes)

    def part(self, moving: Any, name: str) -> Any:
        """The field `name` of `moving`."""
        return getattr(moving, name)

    def join(self, *moving: Any) -> Any:
        """Several `moving` as one, whose values are a tuple."""
        return moving

    def values(self, moving: Any) -> Any:
        return moving

    def pack(self, moving: Any) -> Array:
        """`moving` as one array."""
        return moving

    def unpack(self, moving: Array) -> Any:
        return moving


class InDirections(NamedTuple):
    """Values, and their derivatives in directions on the first axis."""

    constants: Any
    by_constants: Any

    def apply(self, stage: Stage, moving: Any, notes: Any) -> tuple[Any, Any]:
        """`moving` and `notes` after a stage."""
        values, columns = moving
        constants = self.constants, self.by_constants
        values, columns, notes = pushed(stage, *constants, values, columns, notes)
        return (values, columns), notes

    def part(self, moving: Any, name: str) -> Any:
        """The field `name` of `moving`."""
        return tuple(getattr(x, name) for x in moving)

    def join(self, *moving: Any) -> Any:
        """Several `moving` as one, whose values are a tuple."""
        return tuple(zip(*moving, strict=True))

    def values(self, moving: Any) -> Any:
        return moving[0]

    def pack(self, moving: Any) -> Array:
        """`moving` as one array: the values, then their derivatives."""
        values, columns = moving
        return jnp.concatenate([values[None], columns])

    def unpack(self, moving: Array) -> Any:
        return moving[0], moving[1:]


Motion: TypeAlias = Alone | InDirections


def choose(
    motion: Motion,
    index: Int[Array, ""],
    stages: Sequence[Stage],
    moving: Any,
    notes: Any = None,
) -> tuple[Any, Any]:
    """`moving` and `notes` after the stage with this number."""

    def branch(stage: Stage) -> Callable:
        return lambda moving, notes: motion.apply(stage, moving, notes)

    return chosen(index, [branch(stage) for stage in stages], moving, notes)


def chosen(index: Int[Array, ""], branches: Sequence[Callable], *arguments: Any) -> Any:
    """The result of the branch with this number."""
    if len(branches) == 1:
        return branches[0](*arguments)
    return jax.lax.switch(index, branches, *arguments)


def still(tree: Any) -> Any:
    """The same numbers without derivatives, for notes."""
    return jax.lax.stop_gradient(tree)
