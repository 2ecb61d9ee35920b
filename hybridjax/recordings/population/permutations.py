"""Sign flips and label permutations of maps, with maximum and cluster statistics.

Sign flips of paired differences, and permutations of the labels of groups, leave the joint
distribution of a map unchanged if there is no difference. The largest statistic of each relabeling
therefore gives p-values that hold the family-wise error (Nichols and Holmes 2002; clusters: Maris
and Oostenveld 2007).
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Inexact, Int
from scipy import ndimage, stats
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def relabelings(
    true: Float[np.ndarray, " n"], paired: bool, draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "P n"]:
    """Return weights +1 and -1 of the subjects, the true ones first: of up to 12 subjects all flips
    of signs (those of all signs alike give the same) or divisions into two groups, else draws."""
    n = len(true)
    if n > 12 and paired:
        signs = rng.choice([-1.0, 1.0], (draws, n))
    elif n > 12:
        signs = np.stack([rng.permutation(true) for _ in range(draws)])
    else:
        signs = 1.0 - 2.0 * ((np.arange(2 ** (n - paired))[:, None] >> np.arange(n)) & 1)
        signs = signs if paired else signs[signs.sum(axis=1) == true.sum()]
        signs = signs[np.argsort((signs != true).any(axis=1), stable=True)]
    signs[0] = true
    return signs


def statistics(
    y: Inexact[np.ndarray, "n V"], signs: Float[np.ndarray, "P n"], paired: bool
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


def point_threshold(level: float, freedom: int, is_complex: bool) -> float:
    """Return the statistic that one point exceeds with probability `level` (two-sided)."""
    if is_complex:
        return float(np.sqrt(stats.f.isf(level, 2, 2 * freedom)))
    return float(stats.t.isf(level / 2, freedom))


def largest(
    y: Inexact[np.ndarray, "n *grid"], signs: Float[np.ndarray, "P n"], paired: bool,
    threshold: float, cyclic: tuple[bool, ...],
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:  # fmt: skip
    """Return the largest |t| and the largest cluster mass (sum of |t|) of each relabeling."""
    points, masses = [], []
    step = max(1, 8_000_000 // y[0].size)  # statistics of a part fit into 64 MB
    for part in (signs[i : i + step] for i in range(0, len(signs), step)):
        t = statistics(y.reshape(len(y), -1), part, paired)
        labels = clusters(t.reshape(-1, *y.shape[1:]), threshold, cyclic).reshape(t.shape)
        mass = np.bincount(labels.ravel(), np.abs(t).ravel())
        mass[0] = 0.0
        points.append(np.abs(t).max(axis=1))
        masses.append(mass[labels].max(axis=1))
    return np.concatenate(points), np.concatenate(masses)


def exceeding(draws: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the fraction of draws that are at least as large, up to rounding."""
    return 1 - np.searchsorted(np.sort(draws), values * (1 - 1e-9)) / len(draws)


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
        for axis in (k for k, wraps in enumerate(cyclic, 1) if wraps):
            regions, count = _joined(regions, count, axis)
        labels += np.where(regions > 0, regions + last, 0)
        last += count
    return labels


def _joined(labels, count: int, axis: int):
    """Join regions that touch across the end of a cyclic axis."""
    a, b = np.take(labels, 0, axis), np.take(labels, -1, axis)
    touch = (a > 0) & (b > 0)
    edges = coo_array((np.ones(touch.sum()), (a[touch], b[touch])), (count + 1, count + 1))
    # Number 0 is the outside, which no region touches.
    new = connected_components(edges, directed=False)[1]
    return new[labels], int(new.max())
