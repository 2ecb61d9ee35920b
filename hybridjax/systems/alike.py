"""Transitions of one kind: contacts that are written once, and differ by a number.

`[Transition(..., guard=Contact(self, i), ...) for i in range(n)]` are n events, but one program:
what differs (`i`) becomes its argument. So n contacts are traced, compiled and evaluated as one.
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
"""Transitions by index: they have the same charts and direction, and functions that differ at most
in the numbers that they hold."""


class Member(NamedTuple):
    """A transition, or one for each lane, by its kind and its place there, which may be traced."""

    kind: Kind
    place: Int[Array, "..."]


def kinds(transitions: Sequence[Transition]) -> list[Kind]:
    """Kinds in the order of their first transitions."""
    found: dict[Hashable, list[int]] = {}
    for g, x in enumerate(transitions):
        found.setdefault(_form(x) or g, []).append(g)
    return [tuple(kind) for kind in found.values()]


def chosen(alike: Sequence[Any], place: Int[Array, ""]) -> Any:
    """Of pytrees that differ in numbers only, the one in this place."""
    leaves, structures = zip(*map(jax.tree_util.tree_flatten, alike), strict=True)
    columns = zip(*leaves, strict=True)
    return structures[0].unflatten([_chosen(column, place) for column in columns])


def _chosen(column: tuple, place: Int[Array, ""]) -> Any:
    if all(x is column[0] for x in column):
        return column[0]
    known = not any(isinstance(x, jax.Array) for x in column)
    return jnp.asarray(np.stack(column) if known else jnp.stack(column))[place]


def counts_alike(program: jex.Jaxpr) -> bool:
    """Whether a program computes with integers as Python does. (Of a power, JAX takes the bits of
    the exponent: what has a negative one, or too many digits, would be another number.)"""
    return not any(
        (eqn.primitive.name.startswith("shift") or eqn.primitive.name == "pow")
        and all(jnp.issubdtype(v.aval.dtype, jnp.integer) for v in eqn.invars)
        or not all(map(counts_alike, jaxprs(eqn.params)))
        for eqn in program.eqns
    )


def _form(x: Transition) -> Hashable:
    """All that functions of one kind have in common; `None` if x is the only one of its kind."""
    if isinstance(x.guard, Scheduled):
        return None
    leaves, structure = jax.tree_util.tree_flatten((x.guard, x.reset, x.enabled))
    form = x.source, x.target, x.direction, structure, *map(_kept, leaves)
    try:
        hash(form)
    except TypeError:  # something that is static in a function cannot be compared
        return None
    return form


def _kept(leaf: Any) -> Hashable:
    """A leaf, or of a number or an array its type and shape."""
    if type(leaf) in (int, float):
        return type(leaf), ()
    if eqx.is_array_like(leaf) and not isinstance(leaf, bool | complex):
        return leaf.dtype, leaf.shape
    return leaf
