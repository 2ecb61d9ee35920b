r"""The linear problem $\chi y = B u$ (periodic ARX): the start of fits, and the test of the order.

The parts of the outputs 0, 1, ..., d cycles earlier that inputs do not explain are linearly
dependent, up to noise. The coefficients of this combination are those of $\chi$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..denominator import SLOWEST, multipliers_of
from ..descent import NO_LEADING_COEFFICIENT, Coefficients
from ..order import refuse_invented
from .linearization import sum_up
from .output_error import OutputErrorProblem, SectionRegression
from .records import CycleGrid, delay_cycles, lagged_inputs


class DelayedOutputs(NamedTuple):
    """The outputs 0, 1, ..., d cycles earlier, without the part that inputs explain."""

    gram: Float[np.ndarray, "ny d1 d1"]
    """Their Gram matrix, for each output."""
    freedom: int
    """The number of independent rows of all outputs: noise of variance 1 makes the sum of the Gram
    matrices that large."""


def delayed_outputs(problem: OutputErrorProblem, order: int) -> DelayedOutputs:
    """Return the Gram matrix from the rows whose lagged inputs and outputs are all measured."""
    N, _, ny = problem.shape
    delays = range(order + 1)

    def past(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny d1"]:
        return np.stack([delay_cycles(part.y[:, :, n], j) for j in delays], axis=3)

    def regress(k: int, part: CycleGrid, n: int) -> list[SectionRegression]:
        inputs = lagged_inputs(part.u, n, problem.lags, problem.records.lead) @ problem.to_lags[n]
        later = np.arange(part.y.shape[1]) >= part.first[:, n, None] + problem.free
        sampled = part.sampled[:, :, n]
        before = np.all([delay_cycles(sampled, j, not problem.free) for j in delays], axis=0)
        starts = part.drift[:, :, :0]
        return [
            SectionRegression.make(inputs, starts, part.drift, later & before[..., alike[0]])
            for alike in problem.alike[n]
        ]

    gram, freedom = np.zeros((ny, order + 1, order + 1)), 0
    for section in sum_up(problem, np.zeros(0), past, regress):
        for each in section:
            gram[each.fit.outputs] += each.products
            rows = round(each.freedom) - each.fit.root.shape[1]
            freedom += max(rows, 0) * len(each.fit.outputs)
    return DelayedOutputs(gram, freedom)


def total_least_squares(delayed: DelayedOutputs) -> Coefficients:
    """Return c without bias by white noise in the outputs."""
    order = delayed.gram.shape[1] - 1
    null = np.linalg.eigh(delayed.gram.sum(axis=0))[1][:, 0]
    if abs(null[0]) < NO_LEADING_COEFFICIENT * np.abs(null).max():
        return np.zeros(order)
    roots = np.roots(null / null[0])
    size = np.maximum(np.abs(roots) / SLOWEST, 1.0)
    return np.pad(np.poly(roots / size).real[1:], (0, order - len(roots)))


def ordinary_least_squares(delayed: DelayedOutputs) -> Complex[np.ndarray, " d"]:
    """Return the multipliers by plain regression, which noise in the outputs biases to zero."""
    gram = delayed.gram.sum(axis=0)
    return multipliers_of(-np.linalg.lstsq(gram[1:, 1:], gram[1:, 0])[0])


def refuse_order(delayed: DelayedOutputs, noise: Float[np.ndarray, " ny"]) -> None:
    """**Raises:** `DefinitionError` if the outputs, with noise of this standard deviation, do not
    support so many multipliers."""
    rows = max(delayed.freedom, 1)
    gram = (delayed.gram / noise[:, None, None] ** 2).sum(axis=0)
    refuse_invented(np.linalg.eigvalsh(gram) / rows, np.sqrt(2 / rows))
