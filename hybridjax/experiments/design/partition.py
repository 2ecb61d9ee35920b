"""Which cosines may share an experiment, and how few experiments suffice.

A cosine at the frequency `f` (cycles per period) makes a periodic system of N sections answer at
`f + l` and, through its negative half, at `-f + l` for all integers l. So (Ankarali & Cowan,
Sec. V-B) two cosines may share an experiment unless their difference or their sum is an integer.
On the grid `f = j / P` that is one comparison: with `r = j mod P`, the *class* of a line is
`min(r, P - r)`, and two lines disturb each other exactly if their classes are equal.
Lines of one class need one experiment each, lines of different classes never meet; so the size
of the largest class is the exact minimum of experiments, and every greater number works too.

Lines are integers `j` here: `f = j / P`, angle per section `2 pi j / (N P)`.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Complex, Int

from ...errors import DefinitionError


# Normal equations are singular if, with unknowns scaled to magnitude 1, the least eigenvalue is
# below this, or if one magnitude is below this part of another; so are two phases of a line whose
# mean of exp(2i phase) is this close to 1, and a cosine at 0 or N/2 with this part of its power.
# Smaller: inputs that only rounding separates are accepted. Larger: good experiments with unequal
# inputs are refused.
SINGULAR = 1e-6


def line_class(line: Int[np.ndarray, " K"], periods: int) -> Int[np.ndarray, " K"]:
    """Return `min(r, P - r)` with `r = j mod P`: 0 for integers f, P/2 for f half way between."""
    remainder = line % periods
    return np.minimum(remainder, periods - remainder)


def is_half_integer(
    line: Int[np.ndarray, " K"], periods: int
) -> Bool[np.ndarray, " K"]:
    """Return whether f is a multiple of 1/2: the cosine aliases with its conjugate (eq. 16)."""
    return (2 * line) % periods == 0


def is_real(
    line: Int[np.ndarray, " K"], periods: int, n_sections: int
) -> Bool[np.ndarray, " K"]:
    """Return whether f is 0 or N/2: `cos(w n + phi)` is a factor times a fixed sequence."""
    return (line == 0) | (2 * line == n_sections * periods)


def needs_two_phases(
    line: Int[np.ndarray, " K"], periods: int, n_sections: int
) -> Bool[np.ndarray, " K"]:
    """Return whether f is a multiple of 1/2 other than 0 and N/2: it needs two phases."""
    return is_half_integer(line, periods) & ~is_real(line, periods, n_sections)


def regular(gram: Complex[np.ndarray, "k n n"]) -> Bool[np.ndarray, " k"]:
    """Return whether normal equations can be solved, for unknowns of any magnitude."""
    size = np.sqrt(np.einsum("kii->ki", gram).real)
    unit = np.maximum(size.max(axis=0, initial=0), np.finfo(float).tiny)
    even = (size / unit).min(axis=1) > SINGULAR * (size / unit).max(axis=1)
    size = np.where(even[:, None], size, 1.0)
    least = np.linalg.eigvalsh(gram / (size[:, :, None] * size[:, None, :]))[:, 0]
    return even & (least > SINGULAR)


def fewest_experiments(line: Int[np.ndarray, " K"], periods: int) -> int:
    """Return the exact minimum of experiments for these lines, repeated ones counted each time."""
    return int(np.bincount(line_class(line, periods)).max())


def assign(
    line: Int[np.ndarray, " K"],
    periods: int,
    experiments: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, " K"]:
    """Return a random partition that obeys the rules: the experiment of each line.

    Class after class, in random order, is spread over the experiments that are the least full
    at that moment (ties at random), so sizes differ by at most one. Needs
    `experiments >= fewest_experiments(line, periods)`, and then never fails.
    """
    classes = line_class(line, periods)
    load = np.zeros(experiments, int)
    experiment = np.empty(len(line), int)
    for c in rng.permutation(np.unique(classes)):
        members = rng.permutation(np.flatnonzero(classes == c))
        least_full = np.lexsort((rng.random(experiments), load))[: len(members)]
        experiment[members] = least_full
        load[least_full] += 1
    return experiment


def avoid_second_order(
    experiment: Int[np.ndarray, " K"],
    line: Int[np.ndarray, " K"],
    periods: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, " K"]:
    """Return the partition after random swaps, such that no second-order product of an experiment
    falls on one of its own lines. Sizes stay as they are.

    Simulated annealing on the number of such products. For N = 32, P = 64, f up to 10 and 80
    experiments about 30 000 swaps suffice.

    **Raises:** `DefinitionError` if no such partition was found.
    """
    classes = line_class(line, periods).tolist()
    products = _products(periods)
    members = [
        np.flatnonzero(experiment == e).tolist() for e in range(experiment.max() + 1)
    ]
    held = [[classes[i] for i in m] for m in members]
    hits = [_hits(c, products) for c in held]
    draws: Iterator[list[float]] = iter(())
    rounds = 200_000  # (fewer: divisions are missed that there are; more: vain searches last)
    for k in range(rounds):
        if k % 4096 == 0:
            bad = [e for e, n in enumerate(hits) if n]
            draws = iter(rng.random((4096, 5)).tolist())
        if not bad:
            break
        x = next(draws)
        e = bad[int(x[0] * len(bad))]
        f = int(x[1] * len(members))
        if hits[e] == 0:
            bad = [e for e, n in enumerate(hits) if n]
            continue
        i = int(x[2] * len(members[e]))
        j = int(x[3] * len(members[f]))
        a = held[e][i]
        b = held[f][j]
        if e == f or b in held[e] or a in held[f]:
            continue
        new_e = held[e].copy()
        new_f = held[f].copy()
        new_e[i] = b
        new_f[j] = a
        hits_e = _hits(new_e, products)
        hits_f = _hits(new_f, products)
        worse = hits_e + hits_f - hits[e] - hits[f]
        heat = 0.5 * max(1 - 2 * k / rounds, 0.0) + 1e-3  # cold in the second half
        if worse <= 0 or x[4] < np.exp(-worse / heat):
            members[e][i], members[f][j] = members[f][j], members[e][i]
            held[e] = new_e
            held[f] = new_f
            hits[e] = hits_e
            hits[f] = hits_f
            if hits_f and f not in bad:
                bad.append(f)
    if any(hits):
        more = (
            "`periods` that 3 does not divide"
            if periods / 3 in classes
            else "more experiments"
        )
        raise DefinitionError(
            "no division was found in which second-order products avoid the excited lines: take "
            f"{more}, or division='random'."
        )
    out = np.empty_like(experiment)
    for e, m in enumerate(members):
        out[m] = e
    return out


def _products(periods: int) -> list[list[int]]:
    """Return for each pair of classes a bit mask of the classes of its second-order products."""
    top = periods // 2 + 1

    def fold(x):
        return min(x % periods, -x % periods)

    return [
        [(1 << fold(a + b)) | (1 << fold(a - b)) for b in range(top)]
        for a in range(top)
    ]


def _hits(classes: list[int], products: list[list[int]]) -> int:
    """Return the number of second-order products of some classes that fall on one of them."""
    mask = sum(1 << c for c in classes)  # (an experiment has each class once)
    pairs = itertools.combinations_with_replacement(classes, 2)
    return sum((products[a][b] & mask).bit_count() for a, b in pairs)


def check_sharing(
    experiment: Int[np.ndarray, " K"], line: Int[np.ndarray, " K"], periods: int
) -> None:
    """Check that no two lines of one experiment have the same class.

    **Raises:** `DefinitionError` that names the experiment and the first pair.
    """
    classes = line_class(line, periods)
    order = np.lexsort((line, classes, experiment))
    e = experiment[order]
    c = classes[order]
    j = line[order]
    clash = (e[1:] == e[:-1]) & (c[1:] == c[:-1])
    if clash.any():
        k = int(np.argmax(clash))
        low = int(j[k])
        high = int(j[k + 1])
        number = int(e[k + 1])
        f = f"f = {low / periods:.10g}"
        reason = f"{f} is excited twice"
        if low < high:
            relation = "add up to" if (high - low) % periods else "differ by"
            reason = f"{f} and {high / periods:.10g} {relation} an integer"
        remedy = "move one of them to another experiment"
        if (
            experiment == number
        ).sum() > periods // 2 + 1:  # more than any design may have
            remedy = f"a recorded input must repeat after P = {periods} periods, with noise below "
            remedy += "`threshold`; one that a controller makes needs its `reference`"
        text = f"{reason}, so their responses fall on the same frequencies: {remedy}"
        raise DefinitionError(f"experiment {number}: {text}.")
