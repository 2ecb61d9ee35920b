"""Multipliers by one regression of outputs on the outputs of earlier cycles, without iteration.

By the theorem of Cayley and Hamilton, outputs of successive cycles at one section, less what inputs
explain, obey the characteristic polynomial of the multipliers: a sum of the outputs of d + 1
successive cycles, weighted by its coefficients, is zero up to noise. `late_outputs` sums the
products of outputs 0, 1, ..., d cycles earlier over all sections and records. `total_least_squares`
has no bias by white noise: `fit_series` and the choice of an order start from its result.
`ordinary_least_squares` is biased to zero; it serves only as a comparison.

The output that is not delayed must stay the first one of the Gram matrix: both solutions count on
it. If a start is far off, look at the rows that `late_outputs` uses (`used`); if it is zero, the
leading coefficient was too small (`total_least_squares`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..denominator import SLOWEST, coefficients_of, multipliers_of
from ..descent import NO_LEADING_COEFFICIENT, Coefficients
from .linearization import sum_up
from .output_error import OutputErrorProblem, SectionRegression
from .records import CycleGrid, delay_cycles, lagged_inputs


class DelayedOutputs(NamedTuple):
    """The outputs 0, 1, ..., d cycles earlier, without the part that inputs explain."""

    gram: Float[np.ndarray, "ny d1 d1"]
    """Gram matrix of these outputs, for each output signal."""
    dof: int
    """Number of independent rows of all outputs, which is the expected sum of the Gram matrices for
    noise of variance 1."""


def late_outputs(problem: OutputErrorProblem, order: int) -> DelayedOutputs:
    """Return the Gram matrix from the rows whose lagged inputs and outputs are all measured."""
    N, _, ny = problem.shape
    delays = range(order + 1)

    def past(k: int, part: CycleGrid, n: int) -> Float[np.ndarray, "S T ny d1"]:
        delayed = [delay_cycles(part.y[:, :, n], j) for j in delays]
        return np.stack(delayed, axis=3)

    def regress(k: int, part: CycleGrid, n: int) -> list[SectionRegression]:
        columns = lagged_inputs(part.u, n, problem.lags, problem.records.lead)
        inputs = columns @ problem.to_lags[n]
        sampled = part.sampled[:, :, n]
        delayed = [delay_cycles(sampled, j, not problem.free) for j in delays]
        cycle = np.arange(part.y.shape[1])
        first = part.first[:, n, None] + problem.free
        is_later = cycle >= first
        used = np.all(delayed, axis=0) & is_later[..., None]
        no_starts = part.drift[:, :, :0]
        regressions = []
        for alike in problem.alike[n]:
            rows = used[..., alike[0]]
            regressions.append(
                SectionRegression.make(inputs, no_starts, part.drift, rows)
            )
        return regressions

    gram = np.zeros((ny, order + 1, order + 1))
    dof = 0
    for section in sum_up(problem, np.zeros(0), past, regress):
        for fit in section:
            gram[fit.outputs] += fit.products
            rows = round(fit.dof) - fit.root.shape[1]
            dof += max(rows, 0) * len(fit.outputs)
    return DelayedOutputs(gram, dof)


def total_least_squares(delayed: DelayedOutputs) -> Coefficients:
    """Return c without bias by white noise in the outputs."""
    order = delayed.gram.shape[1] - 1
    _, vectors = np.linalg.eigh(delayed.gram.sum(axis=0))
    null = vectors[:, 0]
    largest = np.abs(null).max()
    if abs(null[0]) < NO_LEADING_COEFFICIENT * largest:
        return np.zeros(order)
    roots = np.roots(null / null[0])
    too_slow = np.maximum(np.abs(roots) / SLOWEST, 1.0)
    c = coefficients_of(roots / too_slow)
    return np.pad(c, (0, order - len(roots)))


def ordinary_least_squares(delayed: DelayedOutputs) -> Complex[np.ndarray, " d"]:
    """Return the multipliers by plain regression, which noise in the outputs biases to zero."""
    gram = delayed.gram.sum(axis=0)
    earlier = gram[1:, 1:]
    c, *_ = np.linalg.lstsq(earlier, gram[1:, 0])
    return multipliers_of(-c)
