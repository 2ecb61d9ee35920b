"""Sign flips and label permutations of maps, with maximum and cluster statistics.

Sign flips of paired differences, and permutations of the labels of groups, leave the joint
distribution of a map unchanged if there is no difference. The largest statistic of each relabeling
therefore gives p-values that hold the family-wise error (Nichols and Holmes 2002; clusters: Maris
and Oostenveld 2007).
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage, stats
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


class Relabelings(NamedTuple):
    """Rows of weights +1 and -1 for each subject, the true ones first; `exact` if they are all."""

    signs: Float[np.ndarray, "P n"]
    exact: bool


def sign_flips(n: int, draws: int, rng: np.random.Generator) -> Relabelings:
    """Return all flips of up to 12 signs (those of all signs alike give the same), else draws."""
    if n <= 12:
        bits = (np.arange(2 ** (n - 1))[:, None] >> np.arange(n)) & 1
        return Relabelings(1.0 - 2.0 * bits, True)
    signs = rng.choice([-1.0, 1.0], (draws, n))
    signs[0] = 1.0
    return Relabelings(signs, False)


def label_permutations(first, draws: int, rng: np.random.Generator) -> Relabelings:
    """Return all divisions of up to 12 subjects into two groups, else draws."""
    n, k = len(first), int(first.sum())
    true = np.where(first, 1.0, -1.0)
    if n <= 12:
        signs = -np.ones((math.comb(n, k), n))
        for row, chosen in zip(signs, itertools.combinations(range(n), k), strict=True):
            row[list(chosen)] = 1.0
        other = signs[(signs != true).any(axis=1)]
        return Relabelings(np.concatenate([true[None], other]), True)
    return Relabelings(np.stack([true, *(rng.permutation(true) for _ in range(draws - 1))]), False)


def statistics(
    y: Float[np.ndarray, "n V"], signs: Float[np.ndarray, "P n"], paired: bool
) -> Float[np.ndarray, "P V"]:
    """Return Student's t for each relabeling; for complex maps the root of the F ratio of a complex
    mean, which has no sign."""
    n = len(y)
    square = np.sum(np.abs(y) ** 2, axis=0)
    if paired:
        mean = signs @ y / n
        variance = (square / n - np.abs(mean) ** 2) / (n - 1)
    else:
        is_first = (signs > 0).astype(float)
        k = is_first[0].sum()
        a, b = is_first @ y / k, (1 - is_first) @ y / (n - k)
        mean = a - b
        inside = square - k * np.abs(a) ** 2 - (n - k) * np.abs(b) ** 2
        variance = inside / (n - 2) * (1 / k + 1 / (n - k))
    # A map that is zero in all subjects has no statistic.
    size = np.sqrt(np.maximum(variance, 1e-24 * np.maximum(square / n, 1e-290)))
    return np.abs(mean) / size if np.iscomplexobj(y) else mean / size


def point_threshold(level: float, n: int, paired: bool, is_complex: bool) -> float:
    """Return the statistic that one point exceeds with probability `level` (two-sided)."""
    freedom = n - 1 if paired else n - 2
    if is_complex:
        return float(np.sqrt(stats.f.isf(level, 2, 2 * freedom)))
    return float(stats.t.isf(level / 2, freedom))


def clusters(
    t: Float[np.ndarray, "P *grid"], threshold: float, cyclic: tuple[bool, ...]
) -> Int[np.ndarray, "P *grid"]:
    """Return numbers of the connected regions in which |t| exceeds the threshold with one sign."""
    inside = ndimage.generate_binary_structure(t.ndim, 1)
    inside[[0, 2]] = False  # no neighbors in other relabelings
    labels, last = np.zeros(t.shape, int), 0
    for side in (t > threshold, t < -threshold):
        label: Any = ndimage.label(side, inside)
        regions, count = label
        for axis, wraps in enumerate(cyclic, 1):
            if wraps:
                regions, count = _joined(regions, count, axis)
        labels += np.where(regions > 0, regions + last, 0)
        last += count
    return labels


def _joined(labels, count: int, axis: int):
    """Join regions that touch across the end of a cyclic axis."""
    a, b = np.take(labels, 0, axis), np.take(labels, -1, axis)
    touch = (a > 0) & (b > 0)
    edges = coo_array((np.ones(touch.sum()), (a[touch], b[touch])), (count + 1, count + 1))
    new = connected_components(edges, directed=False)[1]
    new = new - new[0]  # number 0 is the outside, which no region touches
    return np.where(labels > 0, new[labels], 0), int(new.max())


def masses(
    t: Float[np.ndarray, "P *grid"], labels: Int[np.ndarray, "P *grid"]
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " clusters"]]:
    """Return the largest cluster mass (sum of |t|) of each relabeling, and the masses of the
    clusters of the first."""
    flat = labels.reshape(len(t), -1)
    mass = np.bincount(flat.ravel(), np.abs(t).ravel())
    mass[0] = 0.0
    first = np.unique(flat[0][flat[0] > 0])
    return mass[flat].max(axis=1), mass[first]


def in_parts(count: int, size: int) -> Iterator[slice]:
    """Return parts of the relabelings, so that statistics of a part fit into 64 MB."""
    step = max(1, 8_000_000 // max(size, 1))
    return (slice(i, i + step) for i in range(0, count, step))
