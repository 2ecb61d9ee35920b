"""Which cosines may share an experiment, and how few experiments suffice. Called by `multisine.py`,
`design.py` and estimates of HTFs.

A cosine at the frequency `f` (cycles per period) makes a periodic system of N sections answer at `f
+ l` and, through its negative half, at `-f + l` for all integers l. So two cosines may share an
experiment unless the difference or the sum of their frequencies is an integer (Ankarali & Cowan,
Sec. V-B).

A *line* is an integer `j`; its frequency is `f = j / P`, and its angle per section `2 pi j / (N
P)`. With `r = j mod P`, the *class* of a line is `min(r, P - r)`. Two lines disturb each other
exactly if their classes are equal. Lines of one class need one experiment each, and lines of
different classes never disturb each other. So the size of the largest class is the smallest
possible number of experiments, and every greater number works, too.

These rules follow from the theory and are no settings. `assign` makes a random division of lines
that obeys them, and `avoid_second_order` also avoids the frequencies of second-order distortion.

If a good design is refused, look at `line_class` and `check_sharing`; if second-order products are
left on lines, at `_anneal`, whose rounds are limited.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Int

from ...errors import DefinitionError


# Normal equations are singular if, with unknowns scaled to magnitude 1, their least eigenvalue is
# below this, or if one magnitude is below this part of another. The same number is used for two
# phases of a line, which are singular if the mean of exp(2i phase) is this close to 1; and for a
# cosine at 0 or N/2, which is singular if only this part of its power is left. Smaller: inputs that
# only rounding separates are accepted. Larger: good experiments with unequal inputs are refused.
SINGULAR = 1e-6
# Largest number of rounds of simulated annealing. Fewer: existing divisions are not found. More:
# vain searches last longer.
_ROUNDS = 200_000
# Number of rounds whose random numbers are drawn at once. Then the list of disturbed experiments is
# renewed. Fewer: searches last longer. More: the list contains more experiments that are not
# disturbed any more.
_DRAWS = 4096


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
    """Return whether normal equations can be solved, whatever the magnitudes of the unknowns
    are."""
    size = np.sqrt(np.einsum("kii->ki", gram).real)
    largest = size.max(axis=0, initial=0)
    relative = size / np.maximum(largest, np.finfo(float).tiny)
    even = relative.min(axis=1) > SINGULAR * relative.max(axis=1)
    size = np.where(even[:, None], size, 1.0)
    products = size[:, :, None] * size[:, None, :]
    least = np.linalg.eigvalsh(gram / products)[:, 0]
    return even & (least > SINGULAR)


def fewest_experiments(line: Int[np.ndarray, " K"], periods: int) -> int:
    """Return the smallest possible number of experiments for these lines. (A repeated line counts
    each time.)"""
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
    division = _Division(experiment, line, periods)
    _anneal(division, rng)
    if not any(division.hits):
        return division.experiment()
    if (3 * line_class(line, periods) == periods).any():
        raise DefinitionError(
            "no division was found in which second-order products avoid the excited lines: take "
            "`periods` that 3 does not divide, or division='random'."
        )
    raise DefinitionError(
        "no division was found in which second-order products avoid the excited lines: take more "
        "experiments, or division='random'."
    )


def _anneal(division: "_Division", rng: np.random.Generator) -> None:
    """Swap lines between experiments until no second-order product falls on a line, or too many
    rounds have passed."""
    disturbed: list[int] = []
    draws: Iterator[list[float]] = iter(())
    for k in range(_ROUNDS):
        if k % _DRAWS == 0:
            disturbed = division.disturbed()
            draws = iter(rng.random((_DRAWS, 5)).tolist())
        if not disturbed:
            return
        of_first, of_second, of_line, of_other, luck = next(draws)
        first = disturbed[int(of_first * len(disturbed))]
        if division.hits[first] == 0:
            disturbed = division.disturbed()
            continue
        second = int(of_second * len(division.lines))
        i = int(of_line * len(division.lines[first]))
        j = int(of_other * len(division.lines[second]))
        swap = division.swap(first, i, second, j)
        if swap is None:
            continue
        heat = 0.5 * max(1 - 2 * k / _ROUNDS, 0.0) + 1e-3  # cold in the second half
        if swap.worse <= 0 or luck < np.exp(-swap.worse / heat):
            division.apply(swap)
            if division.hits[second] and second not in disturbed:
                disturbed.append(second)


class _Swap(NamedTuple):
    """The exchange of line i of one experiment with line j of another one."""

    first: int
    i: int
    second: int
    j: int
    classes: tuple[list[int], list[int]]
    """Classes in both experiments afterwards."""
    hits: tuple[int, int]
    """Products that fall on a line in both experiments afterwards."""
    worse: int
    """By how much the number of such products grows."""


class _Division:
    """A division of lines among experiments. For each experiment, it has the numbers and classes of
    its lines, and how many second-order products fall on one of these lines."""

    def __init__(
        self,
        experiment: Int[np.ndarray, " K"],
        line: Int[np.ndarray, " K"],
        periods: int,
    ):
        of_line = line_class(line, periods)
        members = [np.flatnonzero(experiment == e) for e in range(experiment.max() + 1)]
        self._products = _products(periods)
        self.lines = [lines.tolist() for lines in members]
        self.classes = [of_line[lines].tolist() for lines in members]
        self.hits = [_hits(classes, self._products) for classes in self.classes]

    def disturbed(self) -> list[int]:
        """Return the experiments in which a product falls on a line."""
        return [e for e, hits in enumerate(self.hits) if hits]

    def swap(self, first: int, i: int, second: int, j: int) -> _Swap | None:
        """Return the exchange of two lines; None if an experiment would have a class twice."""
        leaves = self.classes[first][i]
        comes = self.classes[second][j]
        is_repeated = comes in self.classes[first] or leaves in self.classes[second]
        if first == second or is_repeated:
            return None
        of_first = self.classes[first].copy()
        of_second = self.classes[second].copy()
        of_first[i] = comes
        of_second[j] = leaves
        hits = _hits(of_first, self._products), _hits(of_second, self._products)
        worse = sum(hits) - self.hits[first] - self.hits[second]
        return _Swap(
            first=first,
            i=i,
            second=second,
            j=j,
            classes=(of_first, of_second),
            hits=hits,
            worse=worse,
        )

    def apply(self, swap: _Swap) -> None:
        """Exchange the lines."""
        first, i, second, j, *_ = swap
        lines = self.lines
        lines[first][i], lines[second][j] = lines[second][j], lines[first][i]
        self.classes[first], self.classes[second] = swap.classes
        self.hits[first], self.hits[second] = swap.hits

    def experiment(self) -> Int[np.ndarray, " K"]:
        """Return the experiment of each line."""
        sizes = [len(lines) for lines in self.lines]
        out = np.empty(sum(sizes), int)
        for e, lines in enumerate(self.lines):
            out[lines] = e
        return out


def _products(periods: int) -> list[list[int]]:
    """Return, for each pair of classes, the classes of its second-order products as a bit mask."""
    top = periods // 2 + 1

    def fold(x):
        return min(x % periods, -x % periods)

    def mask(a, b):
        return (1 << fold(a + b)) | (1 << fold(a - b))

    table = []
    for a in range(top):
        table.append([mask(a, b) for b in range(top)])
    return table


def _hits(classes: list[int], products: list[list[int]]) -> int:
    """Return how many second-order products of lines of these classes fall on one of the lines."""
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
    number = experiment[order]
    of_line = classes[order]
    j = line[order]
    same_number = number[1:] == number[:-1]
    same_line = of_line[1:] == of_line[:-1]
    clash = same_number & same_line
    if not clash.any():
        return
    k = int(np.argmax(clash))
    reason = _reason(int(j[k]), int(j[k + 1]), periods)
    lines = int((experiment == number[k]).sum())
    if lines > periods // 2 + 1:  # more than any design may have
        raise DefinitionError(
            f"experiment {number[k]}: {reason}, so their responses fall on the same frequencies: a "
            f"recorded input must repeat after P = {periods} periods, with noise below "
            "`threshold`; one that a controller makes needs its `references`."
        )
    raise DefinitionError(
        f"experiment {number[k]}: {reason}, so their responses fall on the same frequencies: move "
        "one of them to another experiment."
    )


def _reason(low: int, high: int, periods: int) -> str:
    """Return a phrase for an error: how two lines of one class disturb each other."""
    f = low / periods
    g = high / periods
    if low == high:
        return f"f = {f:.10g} is excited twice"
    if (high - low) % periods:
        return f"f = {f:.10g} and {g:.10g} add up to an integer"
    return f"f = {f:.10g} and {g:.10g} differ by an integer"
