"""The state and its rate halfway through a Runge-Kutta step, from the stages that the step has.

The cubic Hermite interpolant of a step knows its ends only. Weights of the stages that satisfy the
order conditions at half the step (E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary
Differential Equations I, section II.6) tell how far the solution is from that cubic, without a
further evaluation of the field.
"""

import functools as ft
import math
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..systems.solver import Method


# The orders of weights, the best first. Higher: methods of order 7 have too few stages for it.
# Lower: the cubic is as accurate.
_ORDERS = (5, 4, 3)
# Order conditions of the highest order may be violated by this: the default method misses them by
# 1.1e-4, where the cubic misses them by 5e-4. Higher: weights are as wrong as the cubic. Lower: the
# order of weights is lower.
_VIOLATED = 2e-4
# Conditions of lower orders weigh so much more. Higher: rounding errors. Lower: weights violate
# them, too, and their error does not vanish with the step.
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
    """Of the change of the state until halfway, as a part of the step."""
    rate: tuple[float, ...]
    """Of the rate halfway."""


@ft.lru_cache
def halfway(method: Method) -> Halfway | None:
    """The weights of a method; `None` if it has no order of 3, and is no more accurate than the
    cubic."""
    a = np.array(method.a)
    every = np.ones(len(method.b), bool)
    if method.implicit:
        # (An explicit stage of a stiff chart may be large where a fast mode has been excited.)
        every = np.diag(a) != 0
    # (Fewer stages, if these are enough: each takes time in every step.)
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
    """All rooted trees of so many nodes."""
    trees = (tuple(sorted(x)) for x in _forests(size - 1))
    return tuple(dict.fromkeys(trees))


def _forests(size: int) -> list[Tree]:
    """Rooted trees that have so many nodes together, in any order."""
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
