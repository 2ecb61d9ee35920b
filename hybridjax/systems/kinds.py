"""Kinds of transitions: contacts that are written once and differ by an index.

`[Transition(..., guard=Contact(self, i), ...) for i in range(n)]` are n events of one kind: the
number in which they differ (`i`) becomes an argument of one function, so that n contacts are
traced, compiled and evaluated as one.
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from .._core.executor import Array
from .._core.vector_math.rewrite import jaxprs
from .transition import Scheduled, Transition


Kind = tuple[int, ...]
"""Indices of transitions with the same charts and direction, whose functions differ at most in
the numbers that they hold."""


class Member(NamedTuple):
    """A transition, or one for each lane, by its kind and its index there, which may be traced."""

    kind: Kind
    place: Int[Array | np.ndarray, "..."]


def kinds(transitions: Sequence[Transition]) -> list[Kind]:
    """Kinds in the order of their first transitions."""
    groups: dict[Hashable, list[int]] = {}
    for g, x in enumerate(transitions):
        groups.setdefault(_form(x) or g, []).append(g)
    return [tuple(kind) for kind in groups.values()]


def member_of(alike: Sequence[Any], place: Any) -> Any:
    """The pytree with this index among pytrees that differ in numbers only."""
    leaves, structures = zip(*map(jax.tree_util.tree_flatten, alike), strict=True)

    def select(column: tuple) -> Any:
        if all(x is column[0] for x in column):
            return column[0]
        on_device = any(isinstance(x, jax.Array) for x in column)
        return jnp.asarray(jnp.stack(column) if on_device else np.stack(column))[place]

    return structures[0].unflatten([select(column) for column in zip(*leaves, strict=True)])


def counts_alike(program: jex.Jaxpr) -> bool:
    """Test whether a program computes with integers as Python does. (JAX evaluates integer powers
    by the bits of the exponent: a negative or too large one would give another number.)"""
    return not any(
        (eqn.primitive.name.startswith("shift") or eqn.primitive.name == "pow")
        and all(jnp.issubdtype(getattr(v.aval, "dtype", object), jnp.integer) for v in eqn.invars)
        or not all(map(counts_alike, jaxprs(eqn.params)))
        for eqn in program.eqns
    )


def _form(x: Transition) -> Hashable:
    """All that functions of one kind have in common; `None` if x is the only one of its kind."""
    if isinstance(x.guard, Scheduled):
        return None
    leaves, structure = jax.tree_util.tree_flatten((x.guard, x.reset, x.enabled))
    form = x.source, x.target, x.direction, structure, *map(_form_of_leaf, leaves)
    try:
        hash(form)
    except TypeError:  # a static part of a function cannot be compared
        return None
    return form


def _form_of_leaf(leaf: Any) -> Hashable:
    """Type and shape of a number or an array; another leaf itself."""
    if type(leaf) in (int, float):
        return type(leaf), ()
    if eqx.is_array_like(leaf) and not isinstance(leaf, bool | complex):
        return leaf.dtype, leaf.shape
    return leaf
