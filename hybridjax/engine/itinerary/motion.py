"""What moves, alone or with its derivatives: the same stages serve both.

A stage is a function `moving, notes = stage(constants, moving, notes)`; notes have no derivatives.
Derivatives of a choice among stages are those of the stages: JAX takes many times as long to
differentiate the choice.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..._core.loops import pushed


Stage: TypeAlias = Callable[[Any, Any, Any], tuple[Any, Any]]


class Alone(NamedTuple):
    """What moves has its values only."""

    constants: Any

    def apply(self, stage: Stage, moving: Any, notes: Any) -> tuple[Any, Any]:
        """What moves, and the notes, after a stage."""
        return stage(self.constants, moving, notes)

    def part(self, moving: Any, name: str) -> Any:
        """A field of what moves."""
        return getattr(moving, name)

    def join(self, *moving: Any) -> Any:
        """A tuple of what moves."""
        return moving

    def values(self, moving: Any) -> Any:
        return moving

    def pack(self, moving: Any) -> Array:
        """One array of what moves."""
        return moving

    def unpack(self, moving: Array) -> Any:
        return moving


class InDirections(NamedTuple):
    """What moves is a pair: its values, and their derivatives in directions on the first axis."""

    constants: Any
    by_constants: Any

    def apply(self, stage: Stage, moving: Any, notes: Any) -> tuple[Any, Any]:
        """What moves, and the notes, after a stage."""
        values, columns = moving
        constants = self.constants, self.by_constants
        values, columns, notes = pushed(stage, *constants, values, columns, notes)
        return (values, columns), notes

    def part(self, moving: Any, name: str) -> Any:
        """A field of what moves."""
        return tuple(getattr(x, name) for x in moving)

    def join(self, *moving: Any) -> Any:
        """A tuple of what moves."""
        return tuple(zip(*moving, strict=True))

    def values(self, moving: Any) -> Any:
        return moving[0]

    def pack(self, moving: Any) -> Array:
        """One array of what moves: the values, then their derivatives."""
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
    """What moves, and the notes, after the stage with this number."""

    def branch(stage: Stage) -> Callable:
        return lambda moving, notes: motion.apply(stage, moving, notes)

    return chosen(index, [branch(stage) for stage in stages], moving, notes)


def chosen(index: Int[Array, ""], branches: Sequence[Callable], *arguments: Any) -> Any:
    """The result of the branch with this number."""
    if len(branches) == 1:
        return branches[0](*arguments)
    return jax.lax.switch(index, branches, *arguments)
