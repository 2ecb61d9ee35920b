"""Weights by which a Runge-Kutta step computes the state and its rate halfway through the step.

`runge_kutta.py` asks for them with `halfway(method)`, once for each method. The cubic Hermite
interpolant of a step uses the ends of the step only. The state halfway, which the weights give
without a further evaluation of the field, tells how far the solution is from that cubic. The
weights satisfy the order conditions at half the step (E. Hairer, S. P. Norsett and G. Wanner,
Solving Ordinary Differential Equations I, section II.6).

No state at the end of a step depends on these weights, only the margins of watched functions
(`_margin` in `search/attempt.py`). If steps are halved in vain or events are missed with one method
only, look at `_weights`: the limits below decide which order is used. The conditions of lower
orders must stay exact, so that the error vanishes for short steps.
"""

import functools as ft
import math
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..systems.solver import Method


# Orders of weights to try, the highest first. Above 5: methods of order 7 have too few stages.
# Below 3: the cubic is as accurate.
_ORDERS = (5, 4, 3)
# Conditions of the highest order may be violated by this much. (The default method violates them by
# 1.1e-4, the cubic by 5e-4.) Higher: weights may be as inaccurate as the cubic. Lower: weights of
# lower order are used instead.
_VIOLATED = 2e-4
# How much more the conditions of lower orders count in the least-squares problem than those of the
# highest order. Higher: rounding errors. Lower: the conditions of lower orders are violated, too,
# and the error does not vanish for short steps.
_FIRST = 1e5
# Weights of the state are no larger than this. Higher: errors of the stages are larger halfway than
# those of the cubic (Kvaerno5). Lower: the order of weights is lower.
_LARGEST = 1.0
# Conditions are satisfied up to this error, and smaller weights are zero. Higher: weights that
# count are zero. Lower: steps add numbers without a meaning.
_ROUNDING = 1e-9

Tree = tuple
"""A rooted tree of the order conditions: the trees above its root."""


class Halfway(NamedTuple):
    """Weights of the stages of a step."""

    state: tuple[float, ...]
    """Weights that give the change of the state from the start until halfway, in units of the step
    length."""
    rate: tuple[float, ...]
    """Weights that give the rate halfway."""


@ft.lru_cache
def halfway(method: Method) -> Halfway | None:
    """The weights of a method; `None` if there are none of order 3 or more, so that they would be
    no more accurate than the cubic."""
    a = np.array(method.a)
    every = np.ones(len(method.b), bool)
    if method.implicit:
        # (Of an implicit method, explicit stages are not used: in a stiff chart they are large
        # where a fast mode has been excited.)
        every = np.diag(a) != 0
    # (As few stages as possible, since each one takes time in every step.)
    cheap = every & (np.array(method.b) != 0)
    for order, usable in product(_ORDERS, (cheap, every)):
        weights = _weights(a, usable, order)
        if weights is not None:
            return Halfway(*(tuple(map(float, x)) for x in weights))
    return None


def _weights(
    a: Float[np.ndarray, "s s"], usable: Bool[np.ndarray, " s"], order: int
) -> Float[np.ndarray, "2 s"] | None:
    """The smallest weights of usable stages for an order; `None` if there are none."""
    trees: list[Tree] = []
    for size in range(1, order + 1):
        trees.extend(_trees(size))
    sums = np.array([_sums(tree, a) for tree in trees])[:, usable]
    sizes = np.array([_size(tree) for tree in trees])
    densities = np.array([_density(tree) for tree in trees])
    state = 0.5**sizes / densities
    rate = sizes * state / 0.5
    wanted = np.stack([state, rate], axis=1)
    is_lower = sizes < order
    first = np.where(is_lower, _FIRST, 1.0)[:, None]
    weights, *_ = np.linalg.lstsq(first * sums, first * wanted, rcond=1e-12)
    violated = np.abs(sums @ weights - wanted).max(axis=1)
    if np.any(violated > np.where(is_lower, _ROUNDING, _VIOLATED)):
        return None
    if np.abs(weights[:, 0]).max() > _LARGEST:
        return None
    full = np.zeros((2, len(a)))
    is_rounding = np.abs(weights) < _ROUNDING
    full[:, usable] = np.where(is_rounding, 0.0, weights).T
    return full


@ft.lru_cache
def _trees(size: int) -> tuple[Tree, ...]:
    """All rooted trees with `size` nodes."""
    trees = (tuple(sorted(x)) for x in _forests(size - 1))
    return tuple(dict.fromkeys(trees))


def _forests(size: int) -> list[Tree]:
    """All sets of rooted trees that have `size` nodes together."""
    if size == 0:
        return [()]
    found: list[Tree] = []
    for first in range(1, size + 1):
        for tree, others in product(_trees(first), _forests(size - first)):
            found.append((tree, *others))
    return found


def _size(tree: Tree) -> int:
    return 1 + sum(map(_size, tree))


def _density(tree: Tree) -> int:
    return _size(tree) * math.prod(map(_density, tree))


def _sums(tree: Tree, a: Float[np.ndarray, "s s"]) -> Float[np.ndarray, " s"]:
    """The elementary weights of the stages, for a tree."""
    return math.prod((a @ _sums(x, a) for x in tree), start=np.ones(len(a)))
