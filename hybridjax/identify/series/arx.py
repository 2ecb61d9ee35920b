r"""The linear problem $\chi y = B u$ (periodic ARX): where fits start, and what tells the order.

What inputs leave of the outputs 0, 1, ..., d cycles earlier is linearly dependent but for noise:
the coefficients of that combination are those of $\chi$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ..._core.threads import on_all_cores
from ..multipliers.denominator import multipliers_of
from ..multipliers.gauss_newton import Coefficients
from ..multipliers.order import refuse_invented
from .cycle_filters import delay_cycles, lagged_inputs
from .output_error import OutputErrorProblem
from .section_regression import SectionRegression, weighted_alike


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
    _, T, N, ny = problem.y.shape
    delays = range(order + 1)
    cycle = np.arange(T)[:, None]

    def section(n: int):
        gram, freedom = np.zeros((ny, order + 1, order + 1)), 0
        inputs = lagged_inputs(problem.u, n, problem.lags, problem.lead) @ problem.to_lags[n]
        known = (cycle >= problem.first[:, n] + problem.free).T[..., None]
        sampled, y = problem.sampled[:, :, n], problem.y[:, :, n]
        before = np.all([delay_cycles(sampled, j, not problem.free) for j in delays], axis=0)
        for rows, outputs in weighted_alike(known & before):
            no_starts = problem.drift[:, :, :0]
            regression = SectionRegression.make(inputs, no_starts, problem.drift, rows)
            past = np.concatenate([delay_cycles(y[..., outputs], j) for j in delays], axis=2)
            left = regression.solve(past)[1].reshape(-1, order + 1, len(outputs))
            gram[outputs] = np.einsum("rji,rki->ijk", left, left)
            freedom += max(regression.freedom, 0) * len(outputs)
        return gram, freedom

    grams, freedoms = zip(*on_all_cores(section, range(N)), strict=True)
    return DelayedOutputs(sum(grams), sum(freedoms))


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
