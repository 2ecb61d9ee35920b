r"""The linear problem $\chi y = B u$ (periodic ARX): where fits start, and what tells the order.

What inputs leave of the outputs 0, 1, ..., d cycles earlier is linearly dependent but for noise:
the coefficients of that combination are those of $\chi$.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..descent import Coefficients
from ..multipliers.denominator import multipliers_of
from ..multipliers.order import refuse_invented
from .cycle_filters import delay_cycles, lagged_inputs
from .output_error import OutputErrorProblem, Part, in_passes
from .section_regression import SectionRegression, root_of


# The leading coefficient relative to the largest one, below which the solution is no start (c would
# be infinite): zero is taken instead. Doubled: nothing changes but in such degenerate cases.
_NO_LEADING_COEFFICIENT = 1e-8
# Largest modulus of a multiplier in a start: unstable ones are brought here. Doubled: simulations
# from such a start would overflow.
_LARGEST_MODULUS = 0.99


class DelayedOutputs(NamedTuple):
    """What inputs leave of the outputs 0, 1, ..., d cycles earlier."""

    gram: Float[np.ndarray, "ny d1 d1"]
    """Their Gram matrix, for each output."""
    freedom: int
    """The number of independent rows of all outputs: noise of variance 1 makes the sum of the Gram
    matrices that large."""

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "DelayedOutputs":
        """The same with each output in units of its noise, which was `noise` units before."""
        return self._replace(gram=self.gram / (noise**2)[:, None, None])

    @property
    def order(self) -> int:
        """d."""
        return self.gram.shape[1] - 1


def delayed_outputs(problem: OutputErrorProblem, order: int) -> DelayedOutputs:
    """Only from rows whose lagged inputs and outputs are all known."""
    N, _, ny = problem.shape
    delays = range(order + 1)
    sums = [[_Sums(some) for some in alike] for alike in problem.alike]

    def regress(part: Part, _, n: int):
        inputs = lagged_inputs(part.u, n, problem.lags, problem.lead) @ problem.to_lags[n]
        cycle = np.arange(part.y.shape[1])[:, None]
        known = (cycle >= part.first[:, n] + problem.free).T
        sampled = part.weight[:, :, n] > 0
        before = np.all([delay_cycles(sampled, j, not problem.free) for j in delays], axis=0)
        past = np.stack([delay_cycles(part.y[:, :, n], j) for j in delays], axis=2)
        no_starts = part.drift[:, :, :0]
        found = []
        for some in problem.alike[n]:
            rows = known & before[..., some[0]]
            regression = SectionRegression.make(inputs, no_starts, part.drift, rows)
            x = past[..., some]
            reduced = regression.reduced(x.reshape(*x.shape[:2], -1))
            found.append((regression, reduced))
        return found

    def of(work):
        def section(k, part, n, regressions):
            for one, (regression, reduced) in zip(sums[n], regressions, strict=True):
                work(one, regression, reduced)

        return section

    in_passes(problem, [of(_Sums.begin), of(_Sums.finish)], regress, lambda part: None)
    gram, freedom = np.zeros((ny, order + 1, order + 1)), 0
    for one in (x for some in sums for x in some):
        gram[one.outputs] += one.left
        freedom += max(round(one.freedom) - one.root.shape[1], 0) * len(one.outputs)
    return DelayedOutputs(gram, freedom)


class _Sums:
    """What two passes add up for some outputs of a section: the second one sees what the first has
    left, and corrects what rounding has left in that."""

    def __init__(self, outputs: list[int]):
        self.outputs = outputs
        self.freedom = 0.0
        self._gram: Any = 0.0
        self._along: Any = 0.0
        self._along_left: Any = 0.0
        self._squares: Any = 0.0
        self.root: Any = None

    def begin(self, regression: SectionRegression, reduced: Float[np.ndarray, "rows C"]) -> None:
        self._gram += regression.gram
        self.freedom += regression.freedom
        self._along += regression.along(reduced)

    def finish(self, regression: SectionRegression, reduced: Float[np.ndarray, "rows C"]) -> None:
        if self.root is None:
            self.root = root_of(self._gram)
            self._along = self._solved(self._along)
        left = reduced - regression.remainder @ self._along
        self._along_left += regression.along(left)
        self._squares += self._products(left, left)

    @property
    def left(self) -> Float[np.ndarray, "m d1 d1"]:
        """Of each output, products of what is left of it at different delays."""
        missed = self._solved(self._along_left)
        return self._squares - self._products(self._along_left, missed)

    def _products(self, x: Float[np.ndarray, "rows C"], y: Float[np.ndarray, "rows C"]):
        x, y = (z.reshape(len(z), -1, len(self.outputs)) for z in (x, y))
        return np.einsum("rji,rki->ijk", x, y)

    def _solved(self, along: Float[np.ndarray, "r C"]) -> Float[np.ndarray, "r C"]:
        return self.root @ (self.root.T @ along)


def total_least_squares(delayed: DelayedOutputs) -> Coefficients:
    """The coefficients of chi, which white noise in the outputs does not bias."""
    order = delayed.order
    null = np.linalg.eigh(delayed.gram.sum(axis=0))[1][:, 0]
    if abs(null[0]) < _NO_LEADING_COEFFICIENT * np.abs(null).max():
        return np.zeros(order)
    roots = np.roots(null / null[0])
    size = np.maximum(np.abs(roots) / _LARGEST_MODULUS, 1.0)
    return np.pad(np.poly(roots / size).real[1:], (0, order - len(roots)))


def ordinary_least_squares(delayed: DelayedOutputs) -> Complex[np.ndarray, " d"]:
    """The multipliers by plain regression, which noise in the outputs biases towards zero."""
    gram = delayed.gram.sum(axis=0)
    return multipliers_of(-np.linalg.lstsq(gram[1:, 1:], gram[1:, 0])[0])


def refuse_order(delayed: DelayedOutputs) -> None:
    """**Raises:** `DefinitionError` if the outputs, in units of their noise, do not carry so many
    multipliers."""
    rows = max(delayed.freedom, 1)
    gram = delayed.gram.sum(axis=0)
    refuse_invented(np.linalg.eigvalsh(gram) / rows, np.sqrt(2 / rows))
