"""The state and its rate halfway through a Runge-Kutta step, from the stages that the step has.

The cubic Hermite interpolant of a step knows its ends only. Weights of the stages that satisfy the
order conditions at half the step (E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary
Differential Equations I, section II.6) tell how far the solution is from that cubic, without a
further evaluation of the field.
"""

import functools as ft
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..systems.solver import Method


# The orders of weights, the best first. Higher: methods of order 7 have too few stages for it.
# Lower: the cubic is as accurate.
_ORDERS = (5, 4, 3)
# Order conditions are satisfied up to this error, and smaller weights are zero. Higher: weights
# that violate a condition are used. Lower: rounding errors of tableaus lower the order.
_SATISFIED = 1e-9

Tree = tuple
"""A rooted tree of the order conditions: the trees above its root."""


class Halfway(NamedTuple):
    """Weights of a step's stages, and last of the field at its end."""

    bend: Float[np.ndarray, " stages"]
    """Of the state halfway, less that of the cubic interpolant, as a part of the step."""
    twist: Float[np.ndarray, " stages"]
    """Of the rate halfway, less that of the cubic interpolant."""


@ft.lru_cache
def halfway(method: Method) -> Halfway:
    """How far the solution is from the cubic interpolant halfway through a step of a method; zero
    for methods of an order below 3, which are no more accurate than the cubic."""
    stages = len(method.b)
    a = np.zeros((stages + 1, stages + 1))
    a[:stages, :stages] = method.a
    a[stages, :stages] = method.b
    usable = np.ones(stages + 1, bool)
    if method.implicit:
        # (An explicit stage of a stiff chart may be large where a fast mode has been excited.)
        usable = np.diag(a) != 0
    start, end = np.eye(stages + 1)[[0, stages]]
    change = a[stages]
    state = 0.5 * change + 0.125 * (start - end)
    rate = 1.5 * change - 0.25 * (start + end)
    for order in _ORDERS:
        weights = _weights(a, usable, order)
        if weights is not None:
            return Halfway(_rounded(weights[0] - state), _rounded(weights[1] - rate))
    return Halfway(0.0 * state, 0.0 * rate)


def _rounded(weights: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    return np.where(np.abs(weights) < _SATISFIED, 0.0, weights)


def _weights(
    a: Float[np.ndarray, "s s"], usable: Bool[np.ndarray, " s"], order: int
) -> Float[np.ndarray, "2 s"] | None:
    """The smallest weights of the state and of the rate halfway, of an order; `None` if none have
    it."""
    trees = [tree for k in range(1, order + 1) for tree in _trees(k)]
    sums = np.array([_sums(tree, a) for tree in trees])[:, usable]
    sizes = np.array([_size(tree) for tree in trees])
    state = 0.5**sizes / np.array([_density(tree) for tree in trees])
    wanted = np.stack([state, sizes * state / 0.5], axis=1)
    weights = np.linalg.lstsq(sums, wanted, rcond=1e-12)[0]
    if np.abs(sums @ weights - wanted).max() > _SATISFIED:
        return None
    every = np.zeros((2, len(a)))
    every[:, usable] = weights.T
    return every


@ft.lru_cache
def _trees(size: int) -> tuple[Tree, ...]:
    """All rooted trees of so many nodes."""
    return tuple(dict.fromkeys(tuple(sorted(x)) for x in _forests(size - 1)))


def _forests(size: int) -> list[Tree]:
    """Rooted trees that have so many nodes together, in any order."""
    if size == 0:
        return [()]
    return [
        (tree, *others)
        for first in range(1, size + 1)
        for tree in _trees(first)
        for others in _forests(size - first)
    ]


def _size(tree: Tree) -> int:
    return 1 + sum(map(_size, tree))


def _density(tree: Tree) -> int:
    return _size(tree) * math.prod(map(_density, tree))


def _sums(tree: Tree, a: Float[np.ndarray, "s s"]) -> Float[np.ndarray, " s"]:
    """The elementary weights of the stages, for a tree."""
    return math.prod((a @ _sums(x, a) for x in tree), start=np.ones(len(a)))
